"""Looks of pictures for a purpose, for as long as a `with` block lasts."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import matplotlib

from .._checks import count, one_of

# Inches.
_MILLIMETRE = 1 / 25.4


class _Look(NamedTuple):
    """Widths of a figure by the columns it takes, and its height over its width; points."""

    widths: tuple[float, ...]
    shape: float
    font: float
    line: float
    frame: float


# 85 and 175 mm: the columns of most journals of mechanics, or some millimetres less; slides 16:9.
_LOOKS = {
    "journal": _Look((85 * _MILLIMETRE, 175 * _MILLIMETRE), 0.62, 8.0, 1.0, 0.6),
    "slides": _Look((6.0, 12.0), 0.5, 16.0, 2.2, 1.2),
}


@contextmanager
def plot_style(name: str = "journal", *, columns: int = 1) -> Iterator[None]:
    """Pictures made within this `with` block are for a journal, or for slides.

    It sets the size of new figures, of words and of lines, and that fonts are embedded in vector
    files as TrueType (type 42), as publishers ask, by matplotlib's `rcParams`; these are as before
    when the block ends. Write the picture within the block too.

        with vi.plot_style("journal"):
            ax = vi.plot_history(run, machine=scene)
            vi.save_picture(ax.figure, "figure.pdf", dpi=600)

    **Arguments:**

    - `name`: `"journal"` (85 or 175 mm wide, words of 8 points, lines of 1 point) or `"slides"`
      (6 or 12 inches, 16 points).
    - `columns`: how many columns of the page the figure takes, 1 or 2.

    **Raises:** `ValueError` for another name or number of columns.
    """
    look = _LOOKS[one_of("name", name, tuple(_LOOKS))]
    columns = count("columns", columns, least=1, most=len(look.widths))
    width = look.widths[columns - 1]
    parts: dict[Any, Any] = {
        "figure.figsize": (width, width * look.shape / columns),
        "figure.constrained_layout.use": True,
        "font.size": look.font,
        "axes.titlesize": look.font,
        "axes.labelsize": look.font,
        "xtick.labelsize": 0.875 * look.font,
        "ytick.labelsize": 0.875 * look.font,
        "legend.fontsize": 0.875 * look.font,
        "lines.linewidth": look.line,
        "lines.markersize": 3.5 * look.line,
        "axes.linewidth": look.frame,
        "xtick.major.width": look.frame,
        "ytick.major.width": look.frame,
        "pdf.fonttype": 42,
        "ps.fonttype": 42,
        "svg.fonttype": "none",
        "savefig.dpi": 600,
    }
    with matplotlib.rc_context(parts):
        yield


def is_set(name: Any) -> bool:
    """Whether one of matplotlib's `rcParams` is another than it is by default."""
    return matplotlib.rcParams[name] != matplotlib.rcParamsDefault[name]


def thick(points: float) -> float:
    """A line's width, thinner or thicker as lines are set to be."""
    name: Any = "lines.linewidth"
    return points * matplotlib.rcParams[name] / matplotlib.rcParamsDefault[name]
