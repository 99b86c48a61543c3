"""Shared parts of the pictures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

# Dots per inch of a picture in the repository.
_DPI = 110


def open_frames(panels: Iterable[Axes]) -> None:
    """Remove the upper and the right line of the frames of panels."""
    for ax in panels:
        ax.spines[["top", "right"]].set_visible(False)


def gridded(panels: Iterable[Axes], titles: Iterable[str]) -> None:
    """Give each panel a pale grid and a title."""
    for ax, title in zip(panels, titles, strict=True):
        ax.grid(alpha=0.3)
        ax.set_title(title)


def legend_below(figure: Any, handles: Iterable[Any], columns: int, **look: Any) -> None:
    """Draw one legend for all panels, below them."""
    look = {"frameon": False, "fontsize": 9, **look}
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns, **look)


def panels(
    width: float, height: float, *grid: int, w_pad: float | None = None, **look: Any
) -> tuple[Figure, Any]:
    """Return a figure of a size in inches, and its panels as `Figure.subplots` returns them, with
    so many inches beside each."""
    figure = Figure(figsize=(width, height))
    figure.set_layout_engine("constrained", w_pad=w_pad)
    return figure, figure.subplots(*grid, **look)


def save_picture(figure: Figure, path: str | Path, *, dpi: int = _DPI, colors: int = 200) -> None:
    """Write a figure as a small PNG; the same figure gives the same file.

    **Arguments:** the file; dots per inch; `colors`, the number of colours, at most 256.
    """
    figure.savefig(path, dpi=dpi)
    shrink(path, colors=colors)


def shrink(path: str | Path, *, colors: int = 200) -> None:
    """Write a PNG again with few colours, which loses nothing in line drawings."""
    with Image.open(path) as image:
        dpi = image.info.get("dpi")
        picture = image.convert("RGB").quantize(colors, dither=Image.Dither.NONE)
    picture.save(path, "png", optimize=True, dpi=dpi)
