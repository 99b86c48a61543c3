"""The whole reproduction: figures, measured claims and errors, and a report."""

import json
import signal
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from tools.pictures import save_picture
from vi_jax.machine import Parameters, Scene
from vi_jax.orbit import Boundary
from vi_jax.plot import plot_sketch

from .assumptions import check_assumptions, check_motor
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
from .faults import check_faults
from .figure2_claims import check_figure_2
from .figures import draw_figure
from .motions import figure_scene, simulate_cases, table_damping_ratio
from .motors import draw_motors, simulate_motors
from .orbits import orbit_table
from .pages import Findings, as_json, as_markdown
from .response import response
from .response_figure import LOOK, draw_response

KEPT = Path(__file__).parent / "report" / "report.json"
"""The report of an earlier run, with which each run is compared."""
LONG_CURVES = tuple(name for name in CURVES if name not in SHORT_CURVES)
# Located points agree to rounding, splines through curves to 1e-5.
_AGREE = 1e-5

STEPS = (
    "simulating: from rest, from the 4π and from the 2π state, undamped and damped",
    "drawing Figures 1, 3 and 4",
    "measuring the faults of the printed text",
    "finding the periodic motions",
    "Figures 3 and 4 with the motor",
    "following the boundaries of the discrepancy in (ζ, k) and (ζ, c)",
    "waiting for Figure 2, which a second process computes",
    "measuring what the paper claims and assumes",
)


class Figure2(NamedTuple):
    """The results of Figure 2."""

    panels: dict[str, Any]
    """The panels as returned by `describe`."""
    claims: list[Claim]
    curves: dict[str, Boundary]
    """The curves of `LONG_CURVES`, which begin on its branches."""


def reproduce(out: Path, tell: Callable[[str], None]) -> Findings:
    """Draw Figures 1 to 4 and the boundaries of the discrepancy, and write the report.

    Figure 2 is computed in a second process. Most of the time is tracing, which holds Python's
    global lock, so threads would use only one core.

    **Arguments:** the folder to write into, which is created if it is missing; a function that is
    called with each of `STEPS` at its beginning. Double precision is needed.
    """
    out.mkdir(parents=True, exist_ok=True)
    # Ctrl-C ends the other process too, without a traceback.
    end = {"initializer": signal.signal, "initargs": (signal.SIGINT, signal.SIG_DFL)}
    with ProcessPoolExecutor(1, get_context("spawn"), **end) as second:
        later = second.submit(figure_2, out)
        findings = _findings(out, _each(tell), later.result)
    (out / "report.json").write_text(as_json(findings), encoding="utf-8")
    (out / "report.md").write_text(as_markdown(findings), encoding="utf-8")
    return findings


def _each(tell: Callable[[str], None]) -> Callable[[], None]:
    """Return a function that reports the next step."""
    steps = iter(STEPS)
    return lambda: tell(next(steps))


def _findings(out: Path, begin: Callable[[], None], figure_2: Callable[[], Figure2]) -> Findings:
    begin()
    cases = simulate_cases()
    begin()
    figure = Figure(figsize=(12, 5), layout="constrained")
    plot_sketch(Parameters().scene(), ax=figure.subplots())
    save_picture(figure, out / "fig1.png")
    for number in (3, 4):
        draw_figure(number, cases, out / f"fig{number}.png")
    begin()
    faults = check_faults()
    begin()
    orbits = orbit_table(_table_scenes())
    begin()
    motors = simulate_motors()
    save_picture(draw_motors(motors.runs, cases[0].from_rest), out / "motor.png")
    begin()
    curves = follow_curves(SHORT_CURVES)
    begin()
    found = figure_2()
    bounds = BoundaryCurves(**curves, **found.curves)
    save_picture(draw_boundaries(bounds), out / "boundaries.png")
    begin()
    claims = check_claims(cases, found.panels["panels"]) + found.claims
    claims += check_assumptions(cases[0]) + check_motor(motors)
    borders = describe_boundaries(bounds)
    return Findings(cases, claims, faults, orbits + motors.rows, found.panels, borders)


def figure_2(out: Path) -> Figure2:
    """Draw Figure 2 into a folder, measure it, and follow the curves that begin on it."""
    found = response()
    save_picture(draw_response(found), out / "fig2.png", **LOOK)
    panels = describe(found)
    branches = [branch for system in found.systems for branch in system.branches]
    curves = follow_curves(LONG_CURVES, branches)
    return Figure2(panels, check_figure_2(found, panels["panels"]), curves)


def _table_scenes() -> dict[str, Scene]:
    """Return the ideal scenes whose 2π and 4π motions are listed."""
    table = table_damping_ratio()
    return {
        "k = 0.5, undamped": figure_scene(0.0),
        "k = 0.5, Table 1's damping": figure_scene(table),
        "k = 0.8, Table 1's damping": figure_scene(table, restitution=0.8),
    }


def summary(claims: Sequence[Claim]) -> str:
    """Return a line for each claim."""
    width = max(len(claim.verdict) for claim in claims)
    return "\n".join(f"  {claim.verdict:<{width}}  {claim.name}" for claim in claims)


def differences(new: dict[str, Any], kept: dict[str, Any]) -> list[str]:
    """Return the differences of two reports in verdicts and special points, in words.

    **Arguments:** both reports as in `report.json`.
    """
    verdicts, others = ({x["name"]: x["verdict"] for x in of["claims"]} for of in (new, kept))
    found = [
        f"{name}: {verdicts.get(name, 'absent')}, kept: {others.get(name, 'absent')}"
        for name in {**others, **verdicts}
        if verdicts.get(name) != others.get(name)
    ]
    places, beside = headline_numbers(new), headline_numbers(kept)
    return found + [
        f"{name}: {places.get(name)}, kept: {beside.get(name)}"
        for name in {**beside, **places}
        if not abs(places.get(name, float("inf")) - beside.get(name, float("inf"))) < _AGREE
    ]


def headline_numbers(report: dict[str, Any]) -> dict[str, float]:
    """Return the boundaries of a report and the special points of its Figure 2, by name."""
    numbers = {name: x for name, x in report["boundaries"].items() if x is not None}
    for panel in report["figure_2"]["panels"]:
        damped = "damped" if panel["damping_ratio"] else "undamped"
        of = f"k = {panel['restitution']:g}, {damped}"
        numbers |= {f"{of}: BB'": panel["BB"], f"{of}: CC'": panel["CC"]}
        for point in panel["special_points"]:
            count = point["impacts"]
            motion = f"{2 * point['cycles']}π, {count} impact{'s' * (count > 1)}"
            at = point["frequency_ratio"]
            numbers[f"{of}, {motion}: {point['kind']} {at:.3f}"] = at
    return numbers


def read(path: Path) -> dict[str, Any]:
    """Return a report in JSON."""
    return json.loads(path.read_text(encoding="utf-8"))
