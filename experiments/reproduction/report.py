"""The whole reproduction: figures, measured claims and errors, and a report."""

import json
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tools.pictures import panels, save_picture
from tools.study import say
from vi_jax.machines import Parameters
from vi_jax.orbit import Boundary
from vi_jax.plot import plot_sketch

from .boundaries import CURVES, describe_boundaries, draw_boundaries, follow_curves
from .claims import check_assumptions, check_claims, check_figure_2
from .discrepancy import describe, in_words, motion_name
from .faults import check_faults
from .figures import draw_figure
from .motions import figure_scene, orbit_table, simulate_cases, table_damping_ratio
from .motors import draw_motors, simulate_motors
from .pages import Findings, as_json, as_markdown
from .response import response
from .response_figure import LOOK, draw_response
from .rows import Row

KEPT = Path(__file__).parent / "report" / "report.json"
"""The report of an earlier run, with which each run is compared."""
# Located points agree to rounding, splines through curves to 1e-5.
_AGREE = 1e-5


def reproduce(out: Path) -> Findings:
    """Draw Figures 1 to 4 and the boundaries of the discrepancy, and write the report into a
    folder.

    Figure 2 is computed in a second process. Most of the time is tracing, which holds Python's
    global lock, so threads would use only one core.
    """
    out.mkdir(parents=True, exist_ok=True)
    # Ctrl-C ends the other process too, without a traceback.
    end = {"initializer": signal.signal, "initargs": (signal.SIGINT, signal.SIG_DFL)}
    with ProcessPoolExecutor(1, get_context("spawn"), **end) as second:
        later = second.submit(_figure_2, out)
        findings = _findings(out, later.result)
    (out / "report.json").write_text(as_json(findings), encoding="utf-8")
    (out / "report.md").write_text(as_markdown(findings), encoding="utf-8")
    return findings


def _findings(out: Path, figure_2: Callable[[], Any]) -> Findings:
    say("simulating, undamped and damped")
    cases = simulate_cases()
    say("drawing Figures 1, 3 and 4")
    figure, ax = panels(12, 5)
    plot_sketch(Parameters().scene(), ax=ax)
    save_picture(figure, out / "fig1.png")
    for number in (3, 4):
        draw_figure(number, cases, out / f"fig{number}.png")
    say("measuring the faults of the printed text")
    faults = check_faults()
    say("finding the periodic motions")
    table = table_damping_ratio()
    orbits = orbit_table({
        "k = 0.5, undamped": figure_scene(0.0),
        "k = 0.5, Table 1's damping": figure_scene(table),
        "k = 0.8, Table 1's damping": figure_scene(table, restitution=0.8),
    })  # fmt: skip
    say("Figures 3 and 4 with the motor")
    motor_orbits, motors = simulate_motors()
    save_picture(draw_motors(motors, cases[0].from_rest), out / "motor.png")
    say("following the boundaries of the discrepancy")
    curves = follow_curves([name for name, at in CURVES.items() if at[0] == 1])
    say("waiting for Figure 2, which a second process computes")
    found, figure_2_claims, long_curves = figure_2()
    curves |= long_curves
    save_picture(draw_boundaries(curves), out / "boundaries.png")
    claims = check_claims(cases, found["panels"]) + figure_2_claims
    claims += check_assumptions(cases[0], motors)
    rows = orbits + motor_orbits
    return Findings(cases, claims, faults, rows, found, describe_boundaries(curves))


def _figure_2(out: Path) -> tuple[dict[str, Any], list[Row], dict[str, Boundary]]:
    """Draw Figure 2 into a folder; return its panels, its claims, and the curves of 4π motions,
    which begin on its branches."""
    found = response()
    described = describe(found)
    save_picture(draw_response(found, described["panels"]), out / "fig2.png", **LOOK)
    branches = [branch for system in found.systems for branch in system.branches]
    curves = follow_curves([name for name, at in CURVES.items() if at[0] == 2], branches)
    return described, check_figure_2(found, described["panels"]), curves


def differences(new: dict[str, Any], kept: dict[str, Any]) -> list[str]:
    """Return the differences of two reports in verdicts and special points, in words."""
    found, wanted = _headlines(new), _headlines(kept)

    def same(name: str) -> bool:
        a, b = found.get(name), wanted.get(name)
        return a == b or (isinstance(a, float) and isinstance(b, float) and abs(a - b) < _AGREE)

    return [
        f"{name}: {found.get(name, 'absent')}, kept: {wanted.get(name, 'absent')}"
        for name in {**wanted, **found}
        if not same(name)
    ]


def _headlines(report: dict[str, Any]) -> dict[str, Any]:
    """Return verdicts, boundaries and the special points of Figure 2 in a report, by name."""
    numbers = {x["name"]: x["verdict"] for x in report["claims"]}
    numbers |= {name: x for name, x in report["boundaries"].items() if x is not None}
    for panel in report["figure_2"]["panels"]:
        of = in_words(panel)
        numbers |= {f"{of}: BB'": panel["BB"], f"{of}: CC'": panel["CC"]}
        for x in panel["special_points"]:
            name, at = motion_name(x["cycles"], x["impacts"]), x["frequency_ratio"]
            numbers[f"{of}, {name}: {x['kind']} {at:.3f}"] = at
    return numbers


def read(path: Path) -> dict[str, Any]:
    """Return a report in JSON."""
    return json.loads(path.read_text(encoding="utf-8"))
