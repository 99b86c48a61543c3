"""The reproduction in one go: figures, measured claims and faults, and a report of them."""

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from .._files import write_whole
from ..machine import Scene
from ..plot import save_picture
from .assumptions import check_assumptions
from .boundaries import boundary_curves, describe_boundaries, draw_boundaries
from .claims import Claim, check_claims
from .discrepancy import describe
from .faults import Fault, check_faults
from .figure2_claims import check_figure_2
from .figures import draw_figure
from .motions import figure_scene, simulate_cases, table_damping_ratio
from .motors import Motors, draw_motors, simulate_motors
from .orbits import orbit_table
from .pages import Findings, as_json, as_markdown
from .response import response
from .response_figure import LOOK, draw_response
from .sketch import draw_sketch

REPORT, NUMBERS = "report.md", "report.json"

# The steps in their order, and the seconds that each took where it was measured (two cores).
_CASES, _FIGURE_3, _FIGURE_4, _FAULTS, _ORBITS, _RESPONSE, _CURVES, _MOTORS, _CLAIMS = _STEPS = (
    "simulating: from rest, from the 4π and from the 2π state, undamped and damped",
    "drawing Figure 3",
    "drawing Figure 4",
    "measuring the faults of the printed text",
    "finding the periodic motions",
    "Figure 2: closed forms, branches, sweeps up and down",
    "following the boundaries of the discrepancy in (ζ, k) and (ζ, c)",
    "Figures 3 and 4 with the motor",
    "measuring what the paper claims and assumes",
)
_SECONDS: dict[str, float] = dict(
    zip(_STEPS, (8.0, 4.0, 1.0, 2.0, 2.0, 18.0, 11.0, 2.0, 5.0), strict=True)
)
_NOT_QUICK = (_RESPONSE, _CURVES, _MOTORS)

Progress = Callable[[str, float], None]
"""Called as a step begins with its name and about how many seconds there are left."""


class Reproduction(NamedTuple):
    """What a reproduction found, and the files that it wrote."""

    claims: list[Claim]
    faults: list[Fault]
    files: list[Path]


def reproduce(
    out: str | Path, *, quick: bool = False, progress: Progress | None = None
) -> Reproduction:
    """Draw Figures 1 to 4 and the boundaries of the discrepancy, and write the report.

    **Arguments:** the folder to write into, made if it is missing; `quick` for fewer cycles and
    samples, without Figure 2, the boundaries and the motors; `progress`, called as each step
    begins with its name and about how many seconds there are left, estimated from the steps before
    it. The numbers need double precision (`jax.config.update("jax_enable_x64", True)`), which the
    command line turns on.

    **Returns:** the claims, the faults, and the files in the order in which they were written:
    `fig1.png`, `fig3.png`, `fig4.png`, `motor.png`, `fig2.png`, `boundaries.png`, `report.json`,
    `report.md`.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    files: list[Path] = []
    # What takes the time is compiling, of which two threads do more than one.
    with ThreadPoolExecutor(1) as aside:
        motors = None if quick else aside.submit(simulate_motors)
        findings = _measured(out, files, motors, _countdown(quick, progress))
    for name, text in ((NUMBERS, as_json(findings)), (REPORT, as_markdown(findings))):
        files.append(out / name)
        write_whole(files[-1], text)
    return Reproduction(findings.claims, findings.faults, files)


def _countdown(quick: bool, progress: Progress | None) -> Callable[[str], None]:
    """A function that reports the step that begins, and how long this computer takes from there."""
    steps = [step for step in _STEPS if not (quick and step in _NOT_QUICK)]
    begin = time.perf_counter()

    def tell(step: str) -> None:
        place = steps.index(step)
        past, ahead = (sum(_SECONDS[x] for x in part) for part in (steps[:place], steps[place:]))
        pace = (time.perf_counter() - begin) / past if past else 1.0
        if progress is not None:
            progress(step, pace * ahead)

    return tell


def _measured(
    out: Path, files: list[Path], motors: Future[Motors] | None, tell: Callable[[str], None]
) -> Findings:
    """All work but the report's; quick if `motors` is `None`. Pictures are added to `files`."""

    def keep(name: str, figure: Figure, **look: Any) -> None:
        files.append(save_picture(figure, out / name, **look))

    tell(_CASES)
    keep("fig1.png", draw_sketch())
    cases = simulate_cases(quick=motors is None)
    for number, step in ((3, _FIGURE_3), (4, _FIGURE_4)):
        tell(step)
        files.append(out / f"fig{number}.png")
        draw_figure(number, cases, files[-1])
    tell(_FAULTS)
    faults = check_faults()
    tell(_ORBITS)
    orbits = orbit_table(_table_scenes())
    if motors is None:
        tell(_CLAIMS)
        claims = [*check_claims(cases), *check_assumptions(cases[0])]
        return Findings(cases, claims, faults, orbits, None, None, None)
    tell(_RESPONSE)
    found = response()
    panels = describe(found)
    tell(_CURVES)
    curves = boundary_curves([b for system in found.systems for b in system.branches])
    tell(_MOTORS)
    driven = motors.result()
    keep("motor.png", draw_motors(driven.runs, cases[0].from_rest))
    keep("fig2.png", draw_response(found), **LOOK)
    keep("boundaries.png", draw_boundaries(curves))
    tell(_CLAIMS)
    claims = check_claims(cases, panels["panels"]) + check_figure_2(found, panels["panels"])
    claims += check_assumptions(cases[0], driven)
    borders = describe_boundaries(curves)
    return Findings(cases, claims, faults, orbits + driven.rows, driven, panels, borders)


def _table_scenes() -> dict[str, Scene]:
    """The ideal scenes whose 2π and 4π motions are listed."""
    table = table_damping_ratio()
    return {
        "k = 0.5, undamped": figure_scene(0.0),
        "k = 0.5, Table 1's damping": figure_scene(table),
        "k = 0.8, Table 1's damping": figure_scene(table, restitution=0.8),
    }


def summary(found: Reproduction) -> str:
    """A line for each claim, and where the rest is."""
    width = max(len(claim.verdict) for claim in found.claims)
    lines = [f"  {claim.verdict:<{width}}  {claim.name}" for claim in found.claims]
    folder = found.files[0].parent
    names = ", ".join(path.name for path in found.files)
    return "\n".join(
        [
            "Claims and assumptions of the paper (Figures 3 and 4: ζ = 0.90, k = 0.50, Δ = 2a):",
            *lines,
            f"{len(found.faults)} faults of the printed text, with their numbers: {REPORT}",
            f"Written to {folder}: {names}",
        ]
    )
