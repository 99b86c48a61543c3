"""The picture of `escape_from_2pi.py`, and the runs that it shows."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from tools.pictures import panels
from vi_jax.plot.colors import BLUE, ORANGE, RED

CYCLES, NEAR = 600, 0.05
STYLE = {
    "displaced start": ("k", "x"),
    "ExactFlight": (ORANGE, "*"),
    "Adaptive Dopri8": (BLUE, "o"),
    "Adaptive Tsit5": (RED, "o"),
    "FixedStep Dopri8": (BLUE, "s"),
    "FixedStep Tsit5": (RED, "s"),
}


class Escape(NamedTuple):
    group: str
    setting: str
    tolerance: float
    error: float
    predicted: float
    """Cycles by the sharper law."""
    cycles: int
    """First cycle that ends away from the motion; -1 if none does."""
    repeats: bool
    """Whether the last sections repeat to the last bit."""


def counted(row: Escape) -> str:
    """Its cycles in words."""
    if row.cycles >= 0:
        return str(row.cycles)
    return f"none in {CYCLES}" + (" (repeats bit for bit)" if row.repeats else "")


def picture(rows: list[Escape], law: Callable[[np.ndarray], np.ndarray]) -> Figure:
    """Cycles near the motion over the error measured, and over the tolerance asked for."""
    figure, grid = panels(10.5, 5.0, 2, 2, sharex="col", sharey="row", height_ratios=(1, 8))
    figure.get_layout_engine().set(hspace=0.0, h_pad=0.02)  # pyright: ignore
    (above, beside), (left, right) = grid
    for row in rows:
        dots, stayed = _look(row), row.cycles < 0
        height = CYCLES if stayed else row.cycles
        (above if stayed else left).plot(row.error, height, **dots)
        (beside if stayed else right).plot(row.tolerance, height, **dots)
    for name, (color, marker) in STYLE.items():
        left.plot([], [], marker, color=color, ms=11 if marker == "*" else 6, label=name)
    left.plot([], [], "o", color="0.4", mfc="none", label="hollow: float32")
    left.plot([], [], "^", color="0.4", mfc="none", label=f"stayed all {CYCLES} cycles")
    for axes, label in ((left, "error of one cycle (a, a ω)"), (right, "rtol = atol")):
        errors, name = np.logspace(-15, -2, 50), "ln(0.05/error)/ln 1.166"
        axes.plot(errors, law(errors), color="0.5", lw=1.2, zorder=0, label=name)
        axes.set_xscale("log")
        axes.set_xlabel(label)
        axes.grid(alpha=0.3)
    left.set_ylabel("cycles within 0.05 of the unstable 2π motion")
    above.set_title("against the error measured")
    beside.set_title("against the tolerance asked for (Adaptive)")
    above.set_yticks([CYCLES], [f"{CYCLES}\n(all)"])
    above.set_ylim(CYCLES - 30, CYCLES + 30)
    left.set_ylim(0, 215)
    _broken(above, left)
    _broken(beside, right)
    left.legend(fontsize=8.5, loc="lower left")
    return figure


def _look(row: Escape) -> dict[str, Any]:
    """How a run is marked."""
    name, _, precision = row.group.partition(", ")
    color, marker = STYLE[name]
    dots = {"color": color, "ls": "", "marker": marker, "ms": 6, "zorder": 3}
    if marker == "*":
        dots |= {"ms": 13, "zorder": 5}
    if row.cycles < 0:
        dots |= {"marker": "^", "ms": 8}
    if precision:
        dots["mfc"] = "none"
    return dots


def _broken(top: Any, bottom: Any) -> None:
    """The break of the axis between two panels."""
    top.spines.bottom.set_visible(False)
    bottom.spines.top.set_visible(False)
    top.tick_params(bottom=False, which="both")
    top.grid(alpha=0.3)
    cut = {"marker": [(-1, -0.5), (1, 0.5)], "ms": 9, "ls": "none", "color": "k", "clip_on": False}
    top.plot([0, 1], [0, 0], transform=top.transAxes, **cut)
    bottom.plot([0, 1], [1, 1], transform=bottom.transAxes, **cut)
