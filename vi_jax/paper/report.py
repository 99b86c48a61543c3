"""The reproduction in one go: figures, measured claims and faults, and a report of them."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from .._files import write_whole
from ..machine import Scene
from ..orbit import Boundary
from ..plot import save_picture
from .assumptions import check_assumptions
from .beside import beside, second_core
from .boundaries import (
    CURVES,
    SHORT_CURVES,
    BoundaryCurves,
    describe_boundaries,
    draw_boundaries,
    follow_curves,
)
from .claims import Claim, check_claims
from .discrepancy import describe
from .faults import Fault, check_faults
from .figure2_claims import check_figure_2
from .figures import draw_figure
from .motions import Case, figure_scene, simulate_cases, table_damping_ratio
from .motors import draw_motors, simulate_motors
from .orbits import TableRow, orbit_table
from .pages import Findings, as_json, as_markdown
from .response import response
from .response_figure import LOOK, draw_response
from .sketch import draw_sketch

REPORT, NUMBERS = "report.md", "report.json"
# The paper's figures in their order, then what it does not show; and those of a quick one.
_PICTURES = ("fig1.png", "fig2.png", "fig3.png", "fig4.png", "boundaries.png", "motor.png")
_QUICK_PICTURES = ("fig1.png", "fig3.png", "fig4.png")

_CASES, _FIGURE_3, _FIGURE_4, _FIGURE_2, _FAULTS, _ORBITS, _MOTORS, _CURVES, _WAITING, _CLAIMS = (
    "simulating: from rest, from the 4π and from the 2π state, undamped and damped",
    "drawing Figure 3",
    "drawing Figure 4",
    "Figure 2 and the boundaries: closed forms, branches, sweeps up and down",
    "measuring the faults of the printed text",
    "finding the periodic motions",
    "Figures 3 and 4 with the motor",
    "following the boundaries of the discrepancy in (ζ, k) and (ζ, c)",
    "Figure 2, which was computed beside all this",
    "measuring what the paper claims and assumes",
)
# The steps in their order, and the seconds that each took where it was measured: of a quick
# reproduction, in one process, and in two.
_FIRST = {_CASES: 6.5, _FIGURE_3: 2.0, _FIGURE_4: 2.0}
_SECOND = {_FAULTS: 3.0, _ORBITS: 3.5}
_QUICK = {**_FIRST, **_SECOND, _CLAIMS: 3.5}
_ALONE = {**_FIRST, _FIGURE_2: 40.0, **_SECOND, _MOTORS: 8.5, _CLAIMS: 3.5}
_TOGETHER = {**_FIRST, **_SECOND, _MOTORS: 8.5, _CURVES: 13.0, _WAITING: 3.0, _CLAIMS: 3.5}

Progress = Callable[[str, float], None]
"""Called as a step begins with its name and about how many seconds there are left."""


class Reproduction(NamedTuple):
    """What a reproduction found, and the files that it wrote."""

    claims: list[Claim]
    faults: list[Fault]
    files: list[Path]


class Figure2(NamedTuple):
    """What is found with Figure 2."""

    panels: dict[str, Any]
    """As `describe` gives them."""
    claims: list[Claim]
    curves: dict[str, Boundary]
    """Those of `follow_curves` that were wanted."""


def reproduce(
    out: str | Path, *, quick: bool = False, progress: Progress | None = None
) -> Reproduction:
    """Draw Figures 1 to 4 and the boundaries of the discrepancy, and write the report.

    On a CPU of more than one core Figure 2 is computed in a second process.

    **Arguments:** the folder to write into, made if it is missing; `quick` for fewer cycles and
    samples, without Figure 2, the boundaries and the motors; `progress`, called as each step
    begins with its name and about how many seconds there are left, estimated from the steps before
    it. The numbers need double precision (`jax.config.update("jax_enable_x64", True)`), which the
    command line turns on.

    **Returns:** the claims, the faults, and the files: `fig1.png`, `fig2.png`, `fig3.png`,
    `fig4.png`, `boundaries.png`, `motor.png`, `report.json`, `report.md`.
    """
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    if quick:
        findings = _quick(out, _countdown(_QUICK, progress))
    elif second_core():
        theirs = [name for name in CURVES if name not in SHORT_CURVES]
        with beside(figure_2, out, theirs) as other:
            findings = _whole(out, _countdown(_TOGETHER, progress), other, SHORT_CURVES)
    else:
        alone = partial(figure_2, out, CURVES)
        findings = _whole(out, _countdown(_ALONE, progress), alone, ())
    texts = {NUMBERS: as_json(findings), REPORT: as_markdown(findings)}
    for name, text in texts.items():
        write_whole(out / name, text)
    pictures = _QUICK_PICTURES if quick else _PICTURES
    return Reproduction(findings.claims, findings.faults, [out / x for x in (*pictures, *texts)])


def _countdown(steps: dict[str, float], progress: Progress | None) -> Callable[[str], None]:
    """A function that reports the step that begins, and how long this computer takes from there."""
    begin = time.perf_counter()

    def tell(step: str) -> None:
        place, seconds = list(steps).index(step), list(steps.values())
        past, ahead = sum(seconds[:place]), sum(seconds[place:])
        pace = (time.perf_counter() - begin) / past if past else 1.0
        if progress is not None:
            progress(step, pace * ahead)

    return tell


def _first(out: Path, tell: Callable[[str], None], *, quick: bool) -> tuple[Case, Case]:
    """The motions of Figures 3 and 4, with both drawn, and the sketch."""
    tell(_CASES)
    save_picture(draw_sketch(), out / "fig1.png")
    cases = simulate_cases(quick=quick)
    for number, step in ((3, _FIGURE_3), (4, _FIGURE_4)):
        tell(step)
        draw_figure(number, cases, out / f"fig{number}.png")
    return cases


def _second(tell: Callable[[str], None]) -> tuple[list[Fault], list[TableRow]]:
    """The faults of the text, and the table of the periodic motions."""
    tell(_FAULTS)
    faults = check_faults()
    tell(_ORBITS)
    return faults, orbit_table(_table_scenes())


def _quick(out: Path, tell: Callable[[str], None]) -> Findings:
    """All work of a quick reproduction but the report's."""
    cases = _first(out, tell, quick=True)
    faults, orbits = _second(tell)
    tell(_CLAIMS)
    claims = [*check_claims(cases), *check_assumptions(cases[0])]
    return Findings(cases, claims, faults, orbits, None, None, None)


def _whole(
    out: Path, tell: Callable[[str], None], other: Callable[[], Figure2], own: Sequence[str]
) -> Findings:
    """All work but the report's.

    **Arguments:** `other`, which computes or waits for what is found with Figure 2; `own`, the
    curves that are not among that, none if there is no other process.
    """
    cases = _first(out, tell, quick=False)
    found: Figure2 | None = None
    if not own:
        tell(_FIGURE_2)
        found = other()
    faults, orbits = _second(tell)
    tell(_MOTORS)
    driven = simulate_motors()
    save_picture(draw_motors(driven.runs, cases[0].from_rest), out / "motor.png")
    curves: dict[str, Boundary] = {}
    if found is None:
        tell(_CURVES)
        curves = follow_curves(own)
        tell(_WAITING)
        found = other()
    bounds = BoundaryCurves(**curves, **found.curves)
    save_picture(draw_boundaries(bounds), out / "boundaries.png")
    tell(_CLAIMS)
    claims = check_claims(cases, found.panels["panels"]) + found.claims
    claims += check_assumptions(cases[0], driven)
    borders = describe_boundaries(bounds)
    return Findings(cases, claims, faults, orbits + driven.rows, driven, found.panels, borders)


def figure_2(out: Path, names: Sequence[str]) -> Figure2:
    """Draw Figure 2 into a folder, measure it, and follow the curves of these names from it."""
    found = response()
    save_picture(draw_response(found), out / "fig2.png", **LOOK)
    panels = describe(found)
    branches = [branch for system in found.systems for branch in system.branches]
    curves = follow_curves(names, branches)
    return Figure2(panels, check_figure_2(found, panels["panels"]), curves)


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
