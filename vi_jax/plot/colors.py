"""Styles of all pictures: colours that are distinct with any colour vision, marks, widths.

A colour stands for the same period in all pictures; motions without a period are grey. The colours
are from the sets of Okabe and Ito and of Paul Tol. Their order is such that each differs from those
before it, also in lightness, with normal and with each kind of dichromatic vision (a test measures
the differences). Bifurcations differ by mark and dash, so that they need no colour.
"""

from collections.abc import Iterable, Iterator
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.lines import Line2D

from ..orbit import KINDS
from ..scans import REGIMES

# The colours of periods 2π, 4π, ... (drive cycles); longer periods have the last one.
PERIODS = (
    "#0072b2", "#e69f00", "#882255", "#66ccee", "#332288", "#ddcc77", "#d55e00", "#5e3c99",
    "#cc79a7",
)  # fmt: skip
# The 4π motions with several impacts: darker, as they are another family.
MORE_IMPACTS = "#a3480b"

# Outcomes with which events end a motion, by number; periods have other colours.
OUTCOMES = ("#009e73", "#aaaa00", "#ee8866", "#99ddff")

# Less regular motions are darker; failed lanes are white.
IRREGULAR = {
    REGIMES.unsettled: "#b9b9b9",
    REGIMES.transient: "#7f7f7f",
    REGIMES.chaotic: "#1a1a1a",
    REGIMES.quasiperiodic: "#d9c58b",
    REGIMES.failed: "#ffffff",
}
NOT_COMPUTED = "#e6e6e6"

BLUE, ORANGE, RED, GREEN = "#0072b2", "#e69f00", "#d55e00", "#009e73"
STOP = GREEN

DASHES = {kind: row.dash for kind, row in KINDS.items() if row.dash is not None}


def color_of(cycles: int, impacts: float | int | None = None) -> str:
    """Return the colour of a motion of this period in drive cycles, or of a regime without one.

    With the impacts in a period, a motion without any is paler, and one of two cycles with more
    than one has another colour.
    """
    if cycles <= 0:
        return IRREGULAR[REGIMES(cycles)]
    color = PERIODS[min(cycles, len(PERIODS)) - 1]
    if impacts is None:
        return color
    if impacts < 0.5:
        return paler(color)
    return MORE_IMPACTS if cycles == 2 and impacts > 1.5 else color


def distinct_colors(motions: Iterable[tuple[int, float]]) -> list[str]:
    """Return colours of motions by periods and impacts, in other shades for more of a kind."""
    kinds: dict[str, Iterator[str]] = {}
    colors = (color_of(int(cycles), float(impacts)) for cycles, impacts in motions)
    return [next(kinds.setdefault(color, _shades(color))) for color in colors]


def _shades(color: str) -> Iterator[str]:
    """Yield the colour, and then other shades of it for further motions of the same kind."""
    yield color
    while True:
        for part in (0.7, 0.35):
            yield paler(color, part)
        for part in (0.75, 0.5):
            yield to_hex(tuple(part * np.array(to_rgb(color))))


def paler(color: str, part: float | int = 0.45) -> str:
    """Return the colour mixed with white; `part` is the share of the colour, from 0 to 1."""
    return to_hex(tuple(part * np.array(to_rgb(color)) + 1 - part))


def mark_of(kind: str, **style: Any) -> Line2D:
    """Return the marker of a special point of this kind."""
    return Line2D([], [], **{**mark_style(kind), "label": kind, **style})


def mark_style(kind: str) -> dict[str, Any]:
    """Return options of `Axes.plot` for a special point."""
    marker, fill = KINDS[kind].mark
    size = {"*": 9.0, "X": 7.0, "P": 7.0}.get(marker, 7.0 if "$" in marker else 5.0)
    return {"marker": marker, "mfc": fill, "mec": "k", "mew": 0.8, "ms": size, "ls": "none"}


def draw_mark(ax: Axes, kind: str, x: Any, y: Any) -> None:
    """Draw a special point, with its kind once in the legend."""
    ax.plot(x, y, **{**mark_style(kind), "zorder": 4, "label": once(ax, kind)})


def once(ax: Axes, label: str) -> str | None:
    """Return the label, or `None` if the axes have it already."""
    return None if label in ax.get_legend_handles_labels()[1] else label


def thick(points: float) -> float:
    """Return the width of a line, scaled with matplotlib's setting of line widths."""
    name: Any = "lines.linewidth"
    return points * matplotlib.rcParams[name] / matplotlib.rcParamsDefault[name]
