"""The report of a reproduction, as JSON and as a Markdown page."""

import json
from typing import Any, NamedTuple

from tools.tables import table
from vi_jax.orbit import ORBIT_RESULTS

from .claims import Claim
from .discrepancy import shares
from .faults import Fault
from .motions import FREQUENCY_RATIO, GAP, RESTITUTION, Case
from .orbits import TableRow, mean_ratio


class Findings(NamedTuple):
    """The contents of the report."""

    cases: tuple[Case, Case]
    claims: list[Claim]
    faults: list[Fault]
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
        "claims": [claim._asdict() for claim in found.claims],
        "faults": [fault._asdict() for fault in found.faults],
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
    if not bool(orbit.successful):
        return {"scene": row.scene, "found": False, "reason": ORBIT_RESULTS[orbit.result]}
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
    heads = [
        "scene", "κ", "mean ζ", "period", "Y", "V", "min Y", "V⁻", "largest multiplier", "stable",
        "residual",
    ]  # fmt: skip
    rows = []
    for name, orbit, kappa in orbits:
        if not bool(orbit.successful):
            rows.append([name, "", "", "none found", *[""] * 6, f"{float(orbit.residual):.1e}"])
            continue
        rows.append([
            name, "–" if kappa is None else f"{kappa:.6f}", f"{mean_ratio(orbit):.6f}",
            f"{2 * int(orbit.cycles)}π",
            *(f"{float(x):.6f}" for x in (orbit.state.Y, orbit.state.V, orbit.y_min)),
            ", ".join(f"{float(v):.5f}" for v in orbit.impact_speed),
            f"{abs(complex(orbit.multipliers[0])):.6f}", "yes" if orbit.stable else "no",
            f"{float(orbit.residual):.0e}",
        ])  # fmt: skip
    return table(heads, rows)


def _response(panels: dict[str, Any]) -> list[str]:
    """Return the lines on Figure 2, panel by panel."""
    numbers, motions, explained = [], [], []
    for panel in panels["panels"]:
        k, xi = panel["restitution"], panel["damping_ratio"]
        for name, at in panel["sweeps"].items():
            begin, curve = [f"{k:g}", f"{xi:.4f}", name], at["on_the_4pi_curve"]
            numbers.append([
                *begin, f"{panel['BB']:.6f}", f"{panel['CC']:.6f}",
                f"{at['apart']} of {at['values']}",
                f"{at['widest']:.3f} at ζ = {at['widest_at']:.3f}", f"{at['maximum_off']:.0e}",
                f"{curve['on_it']} of {curve['stable_values']}",
            ])  # fmt: skip
            described = "; ".join(
                f"{m['from']:.3f}…{m['to']:.3f} {m['motion']}"
                for m in at["motions"]
                if m["values"] >= 4
            )
            motions.append([*begin, described])
            one, four = shares(at)
            explained.append(f"k = {k:g}, ξ = {xi:.3f}, {name}: {one:.0%} and {four:.0%}")
    heads = [
        "k", "ξ", "sweep", "BB'", "CC'", "apart", "largest difference of min Y", "of max Y",
        "on the 4π curve",
    ]  # fmt: skip
    return [
        "## Figure 2",
        "![Figure 2](fig2.png)",
        f"Printed: {panels['printed']}",
        "BB' is where the 2π motion with one impact is born in a grazing, CC' where it becomes "
        "stable in a period doubling. Between them the 2π analysis is about an unstable motion. "
        '"Apart" counts the values of ζ there at which the swept min Y differs from it by more '
        'than 0.001 a. "On the 4π curve" counts those of the values with an admissible and stable '
        "4π motion of one impact at which the sweep is on it to 1e-6; at the others the sweep is "
        "on a motion that coexists with it. Without damping a free motion is never forgotten: "
        "where the sweeps do not strike, outside of the stretch, their marks wander.",
        table(heads, numbers),
        "What the sweeps are on between BB' and CC' (stretches of at least four values of ζ):",
        table(["k", "ξ", "sweep", "motions"], motions),
        "So far the paper's explanation reaches: the minimum parts from the 2π analysis because "
        "the 2π motion is unstable, and over a part of the stretch the motion is the one of period "
        "4π with one impact that the paper names. Over the rest it has other impacts, other "
        "periods, or none. Shares of the stretch on the 4π motion with one impact, and on any of "
        f"period 4π: {'; '.join(explained)}.",
    ]


def _branches(panels: dict[str, Any]) -> list[str]:
    """Return the special points of the branches of Figure 2, and their connections."""
    rows = []
    for panel in panels["panels"]:
        motions: dict[str, list[str]] = {}
        for x in panel["special_points"]:
            name = f"{2 * x['cycles']}π, {x['impacts']} impact{'s' * (x['impacts'] > 1)}"
            motions.setdefault(name, []).append(f"{x['kind']} {x['frequency_ratio']:.6f}")
        begin = f"{panel['restitution']:g}", f"{panel['damping_ratio']:.4f}"
        rows += [[*begin, name, "; ".join(points)] for name, points in motions.items()]
    return [
        "## Why the motion takes 4π",
        "At BB' the vibration without impacts touches the stop. The 2π motion with one impact is "
        "born there, and it is unstable: a grazing gives it a multiplier without bound. It becomes "
        "stable at CC' only, in a period doubling. The doubled motion has two impacts in 4π, and "
        "loses one of them in a grazing of its own. From there the 4π motion with one impact goes "
        "on, to another grazing. So the 4π motion does not come from the grazing at BB': it hangs "
        "together with CC'.",
        table(["k", "ξ", "motion", "special points of its branch, ζ"], rows),
    ]


def as_markdown(found: Findings) -> str:
    """Return the report as a Markdown page with its figures."""
    undamped, damped = found.cases
    cycles = undamped.from_rest.impacts.shape[0]
    ratio = float(damped.scene.damping_ratio)
    even = "second" if undamped.long_shift else "first"
    borders = [
        [name, "is not reached" if x is None else f"{x:.6f}"] for name, x in found.borders.items()
    ]
    blocks = [
        "# Figures 2, 3 and 4 of the paper, again",
        f"ζ = {FREQUENCY_RATIO:.2f}, k = {RESTITUTION:.2f}, d = Δ/a = {GAP:g}, ideal drive, "
        f"{cycles} drive cycles. Lengths are in units of the "
        "crank radius a; the simulation carries flights in closed form and solves for the impacts.",
        "The figures cannot be had with the damping of Table 1 (fault 6 below). The upper row of "
        f"each picture is the undamped system (ξ = 0), the lower row Table 1 (ξ = {ratio:.7f}).",
        "![Figure 1](fig1.png)",
        "Figure 1 is a sketch from the text, which has no picture.",
        "![Figure 3](fig3.png)",
        "![Figure 4](fig4.png)",
        "A motion of period 4π can lie on the axis of φ in two ways, one cycle apart. In Figure 3 "
        f"the 4π closed form is drawn so that it is on its {even} section (of the two after its "
        "impact) at even cycles, as the run from rest is in the end; in Figure 4 the run starts "
        "on the first, from a state that optax (Adam) fitted to the periodic-orbit residual from a "
        "guess 5 % off.",
        "## What the paper claims and assumes",
        table(["claim", "where", "verdict"], [(x.name, x.place, x.verdict) for x in found.claims]),
    ]
    for claim in found.claims:
        blocks += [
            f"### {claim.name[0].upper()}{claim.name[1:]}: {claim.verdict}",
            f"Claimed ({claim.place}): {claim.claimed}",
            f"Measured: {claim.measured}",
        ]
    blocks += [
        "## Periodic motions",
        "Found by Newton's method on the cycle map from the closed forms, stable or not; Y and V "
        "on the section φ = 0, the largest multiplier by modulus. A motor's κ is tuned so that "
        "the mean ζ of the motion is 0.90.",
        _orbits(found.orbits),
        "![With the motor](motor.png)",
        *_response(found.panels),
        *_branches(found.panels),
        "## Where the discrepancy lives",
        "![Boundaries](boundaries.png)",
        "Bifurcations and grazings followed in two parameters (c in N·s/m).",
        table(["", ""], borders),
        "## Faults of the printed text",
    ]
    for fault in found.faults:
        blocks += [
            f"### {fault.number}. {fault.place}",
            f"Printed: {fault.printed}. Right, or taken here: {fault.right}.",
            fault.measured,
        ]
    return "\n\n".join(blocks) + "\n"
