"""The reproduction in one go: figures, measured claims and faults, and a report of them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from ..orbit import ORBIT_RESULTS
from .claims import Claim, check_claims
from .faults import Fault, check_faults
from .figures import draw_figure
from .motions import FREQUENCY_RATIO, GAP, RESTITUTION, Case, simulate_cases
from .orbits import TableRow, orbit_table

REPORT, NUMBERS = "report.md", "report.json"


class Reproduction(NamedTuple):
    """What a reproduction found, and the files that it wrote."""

    claims: list[Claim]
    faults: list[Fault]
    files: list[Path]


def reproduce(
    out: str | Path, *, quick: bool = False, progress: Callable[[str], None] | None = None
) -> Reproduction:
    """Draw Figures 3 and 4 and write the report about them.

    **Arguments:** the folder to write into, made if it is missing; `quick` for fewer cycles and
    samples; `progress`, called with the name of each step as it begins. The numbers need double
    precision (`jax.config.update("jax_enable_x64", True)`), which the command line turns on.

    **Returns:** the claims, the faults, and the files in the order in which they were written:
    `fig3.png`, `fig4.png`, `report.json`, `report.md`.
    """
    tell = progress or (lambda _: None)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    files = []

    tell("simulating: from rest, from the 4π and from the 2π state, undamped and damped")
    cases = simulate_cases(quick=quick)
    for number in (3, 4):
        tell(f"drawing Figure {number}")
        files.append(out / f"fig{number}.png")
        draw_figure(number, cases, files[-1])
    tell("measuring what the paper claims with the figures")
    claims = check_claims(cases)
    tell("measuring the faults of the printed text")
    faults = check_faults()
    tell("finding the periodic motions")
    orbits = orbit_table(quick=quick)
    for name, text in (
        (NUMBERS, as_json(cases, claims, faults, orbits, quick=quick)),
        (REPORT, as_markdown(cases, claims, faults, orbits, quick=quick)),
    ):
        files.append(out / name)
        files[-1].write_text(text, encoding="utf-8")
    return Reproduction(claims, faults, files)


def as_json(
    cases: tuple[Case, Case],
    claims: list[Claim],
    faults: list[Fault],
    orbits: list[TableRow],
    *,
    quick: bool,
) -> str:
    """The report as strict JSON: no NaN; what is absent is null."""
    data = {
        "settings": {
            "frequency_ratio": FREQUENCY_RATIO,
            "restitution": RESTITUTION,
            "gap": GAP,
            "damping_ratio": {case.name: float(case.scene.damping_ratio) for case in cases},
            "cycles": int(cases[0].from_rest.impacts.shape[0]),
            "quick": quick,
        },
        "closed_forms": {
            case.name: {"2pi": _orbit(case.short), "4pi": _orbit(case.long)} for case in cases
        },
        "claims": [claim._asdict() for claim in claims],
        "faults": [fault._asdict() for fault in faults],
        "orbits": [_found(row) for row in orbits],
    }
    return json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _orbit(orbits) -> dict:
    """The first motion of its kind, admissible or not."""
    if not bool(orbits.exists[0]):
        return {"exists": False}
    names = ("Y", "V", "impact_phase", "impact_speed", "y_min", "y_max")
    return {
        "exists": True,
        "admissible": bool(orbits.admissible[0]),
        **{name: float(getattr(orbits, name)[0]) for name in names},
        "multipliers": [[float(m.real), float(m.imag)] for m in orbits.multipliers[0]],
    }


def _found(row: TableRow) -> dict:
    orbit = row.orbit
    if not bool(orbit.successful):
        return {"scene": row.scene, "found": False, "reason": ORBIT_RESULTS[orbit.result]}
    return {
        "scene": row.scene,
        "found": True,
        "period_in_cycles": int(orbit.cycles),
        "state": {name: float(x) for name, x in vars(orbit.state).items()},
        "y_min": float(orbit.y_min),
        "impact_phase": [float(x) for x in orbit.impact_phase],
        "impact_speed": [float(x) for x in orbit.impact_speed],
        "multipliers": [[float(m.real), float(m.imag)] for m in orbit.multipliers],
        "stable": bool(orbit.stable),
        "residual": float(orbit.residual),
    }


def _table(orbits: list[TableRow]) -> list[str]:
    lines = [
        "| scene | period | Y | V | min Y | V⁻ | largest multiplier | stable | residual |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, orbit in orbits:
        if not bool(orbit.successful):
            lines.append(f"| {name} | none found | | | | | | | {float(orbit.residual):.1e} |")
            continue
        speeds = ", ".join(f"{float(v):.5f}" for v in orbit.impact_speed)
        lines.append(
            f"| {name} | {2 * int(orbit.cycles)}π | {float(orbit.state.Y):.6f} | "
            f"{float(orbit.state.V):.6f} | {float(orbit.y_min):.6f} | {speeds} | "
            f"{abs(complex(orbit.multipliers[0])):.6f} | {'yes' if orbit.stable else 'no'} | "
            f"{float(orbit.residual):.0e} |"
        )
    return lines


def as_markdown(
    cases: tuple[Case, Case],
    claims: list[Claim],
    faults: list[Fault],
    orbits: list[TableRow],
    *,
    quick: bool,
) -> str:
    """The report as a page to read, with the figures in it."""
    undamped, damped = cases
    cycles = undamped.from_rest.impacts.shape[0]
    ratio = float(damped.scene.damping_ratio)
    even = "second" if undamped.long_shift else "first"
    lines = [
        "# Figures 3 and 4 of the paper, again",
        "",
        f"ζ = {FREQUENCY_RATIO:.2f}, k = {RESTITUTION:.2f}, d = Δ/a = {GAP:g}, ideal drive, "
        f"{cycles} drive cycles{' (quick)' if quick else ''}. Lengths are in units of the crank "
        "radius a; the simulation carries flights in closed form and solves for the impacts.",
        "",
        "The figures cannot be had with the damping of Table 1 (fault 6 below). The upper row of "
        f"each picture is the undamped system (ξ = 0), the lower row Table 1 (ξ = {ratio:.7f}).",
        "",
        "![Figure 3](fig3.png)",
        "",
        "![Figure 4](fig4.png)",
        "",
        "A motion of period 4π can lie on the axis of φ in two ways, one cycle apart. In Figure 3 "
        f"the 4π closed form is drawn so that it is on its {even} section (of the two after its "
        "impact) at even cycles, as the run from rest is in the end; in Figure 4 the run starts "
        "on the first, from a state that optax (Adam) fitted to the periodic-orbit residual from a "
        "guess 5 % off.",
        "",
        "## What the paper claims with them",
        "",
        "| claim | where | verdict |",
        "|---|---|---|",
        *(f"| {claim.name} | {claim.place} | {claim.verdict} |" for claim in claims),
        "",
    ]
    for claim in claims:
        lines += [
            f"### {claim.name[0].upper()}{claim.name[1:]}: {claim.verdict}",
            "",
            f"Claimed ({claim.place}): {claim.claimed}",
            "",
            f"Measured: {claim.measured}",
            "",
        ]
    lines += [
        "## Periodic motions",
        "",
        "Found by Newton's method on the cycle map from the closed forms, stable or not; Y and V "
        "on the section φ = 0, the largest multiplier by modulus.",
        "",
        *_table(orbits),
        "",
        "## Faults of the printed text",
        "",
    ]
    for fault in faults:
        lines += [
            f"### {fault.number}. {fault.place}",
            "",
            f"Printed: {fault.printed}. Right, or taken here: {fault.right}.",
            "",
            fault.measured,
            "",
        ]
    return "\n".join(lines)


def summary(found: Reproduction) -> str:
    """About twelve lines for a terminal."""
    width = max(len(claim.verdict) for claim in found.claims)
    lines = [f"  {claim.verdict:<{width}}  {claim.name}" for claim in found.claims]
    folder = found.files[0].parent
    names = ", ".join(path.name for path in found.files)
    return "\n".join(
        [
            "Figures 3 and 4 (ζ = 0.90, k = 0.50, Δ = 2a), claims of the paper:",
            *lines,
            f"{len(found.faults)} faults of the printed text, with their numbers: {REPORT}",
            f"Written to {folder}: {names}",
        ]
    )
