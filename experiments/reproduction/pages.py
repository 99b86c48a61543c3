"""The report of a reproduction, as JSON and as a Markdown page."""

import json
from typing import Any, NamedTuple

from tools.tables import table

from .discrepancy import motion_name, shares
from .motions import FREQUENCY_RATIO, GAP, RESTITUTION, Case, TableRow, mean_ratio
from .rows import WORDS, Row, listed


class Findings(NamedTuple):
    """The contents of the report."""

    cases: tuple[Case, Case]
    claims: list[Row]
    faults: list[Row]
    orbits: list[TableRow]
    panels: dict[str, Any]
    borders: dict[str, float | None]


def as_json(found: Findings) -> str:
    """Return the report as strict JSON, without NaN; an absent number is null."""
    cases = found.cases
    data = {
        "settings": {
            "frequency_ratio": FREQUENCY_RATIO,
            "restitution": RESTITUTION,
            "gap": GAP,
            "damping_ratio": {case.name: float(case.scene.damping_ratio) for case in cases},
            "cycles": int(cases[0].from_rest.impacts.shape[0]),
        },
        "closed_forms": {
            case.name: {"2pi": _orbit(case.short), "4pi": _orbit(case.long)} for case in cases
        },
        "claims": [vars(claim) for claim in found.claims],
        "faults": [vars(fault) for fault in found.faults],
        "orbits": [_found(row) for row in found.orbits],
        "figure_2": found.panels,
        "boundaries": found.borders,
    }
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _orbit(orbits) -> dict:
    """Return the first motion of its kind, admissible or not."""
    if not bool(orbits.exists[0]):
        return {"exists": False}
    names = ("Y", "V", "impact_phase", "impact_speed", "y_min", "y_max")
    return {
        "exists": True,
        "admissible": bool(orbits.admissible[0]),
        **{name: float(getattr(orbits, name)[0]) for name in names},
        "multipliers": _pairs(orbits.multipliers[0]),
    }


def _pairs(numbers) -> list[list[float]]:
    """Return the real and imaginary part of each number."""
    return [[float(x.real), float(x.imag)] for x in numbers]


def _found(row: TableRow) -> dict:
    orbit = row.orbit
    return {
        "scene": row.scene,
        "found": True,
        "kappa": row.kappa,
        "frequency_ratio": mean_ratio(orbit),
        "period_in_cycles": int(orbit.cycles),
        "state": {name: float(x) for name, x in vars(orbit.state).items()},
        "y_min": float(orbit.y_min),
        "impact_phase": [float(x) for x in orbit.impact_phase],
        "impact_speed": [float(x) for x in orbit.impact_speed],
        "multipliers": _pairs(orbit.multipliers),
        "stable": bool(orbit.stable),
        "residual": float(orbit.residual),
    }


def _orbits(orbits: list[TableRow]) -> str:
    heads = "scene,κ,mean ζ,period,Y,V,min Y,V⁻,largest multiplier,stable,residual".split(",")
    return table(heads, [
        [
            name, "–" if kappa is None else f"{kappa:.6f}", f"{mean_ratio(orbit):.6f}",
            f"{2 * int(orbit.cycles)}π",
            *(f"{float(x):.6f}" for x in (orbit.state.Y, orbit.state.V, orbit.y_min)),
            listed("{:.5f}", map(float, orbit.impact_speed), ", "),
            f"{abs(complex(orbit.multipliers[0])):.6f}", "yes" if orbit.stable else "no",
            f"{float(orbit.residual):.0e}",
        ]
        for name, orbit, kappa in orbits
    ])  # fmt: skip


def _response(panels: list[dict[str, Any]]) -> dict[str, str]:
    """Return the tables of Figure 2, of its motions and of its branches, by their places."""
    sweeps, motions, branches, explained = [], [], [], []
    for panel in panels:
        k, xi = panel["restitution"], panel["damping_ratio"]
        begin = [f"{k:g}", f"{xi:.4f}"]
        for name, at in panel["sweeps"].items():
            curve = at["on_the_4pi_curve"]
            sweeps.append([
                *begin, name, f"{panel['BB']:.6f}", f"{panel['CC']:.6f}",
                f"{at['apart']} of {at['values']}",
                f"{at['widest']:.3f} at ζ = {at['widest_at']:.3f}", f"{at['maximum_off']:.0e}",
                f"{curve['on_it']} of {curve['stable_values']}",
            ])  # fmt: skip
            long = [m for m in at["motions"] if m["values"] >= 4]
            motions.append([*begin, name, listed("{0[from]:.3f}…{0[to]:.3f} {0[motion]}", long)])
            explained.append((k, xi, name, *shares(at)))
        special: dict[str, list[dict]] = {}
        for x in panel["special_points"]:
            special.setdefault(motion_name(x["cycles"], x["impacts"]), []).append(x)
        for name, points in special.items():
            branches.append([*begin, name, listed("{0[kind]} {0[frequency_ratio]:.6f}", points)])
    heads = "k,ξ,sweep,BB',CC',apart,largest difference of min Y,of max Y,on the 4π curve"
    return {
        "sweeps": table(heads.split(","), sweeps),
        "motions": table(["k", "ξ", "sweep", "motions"], motions),
        "shares": listed("k = {:g}, ξ = {:.3f}, {}: {:.0%} and {:.0%}", explained),
        "branches": table(["k", "ξ", "motion", "special points of its branch, ζ"], branches),
    }


def as_markdown(found: Findings) -> str:
    """Return the report as a Markdown page with its figures."""
    undamped, damped = found.cases
    page, claim, fault = ("\n\n".join(WORDS[name]) for name in ("page", "claim", "fault"))
    claims = [claim.format(x, title=x.name[0].upper() + x.name[1:]) for x in found.claims]
    borders = [
        [name, "is not reached" if x is None else f"{x:.6f}"] for name, x in found.borders.items()
    ]
    filled = page.format(
        zeta=FREQUENCY_RATIO,
        k=RESTITUTION,
        gap=GAP,
        cycles=undamped.from_rest.impacts.shape[0],
        xi=float(damped.scene.damping_ratio),
        section="second" if undamped.long_shift else "first",
        verdicts=table(
            ["claim", "where", "verdict"], [(x.name, x.place, x.verdict) for x in found.claims]
        ),
        claims="\n\n".join(claims),
        orbits=_orbits(found.orbits),
        printed=found.panels["printed"],
        borders=table(["", ""], borders),
        faults="\n\n".join(map(fault.format, found.faults)),
        **_response(found.panels["panels"]),
    )
    return filled + "\n"
