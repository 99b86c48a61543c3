"""Pictures of grids: maps of the regimes of motion, and basins of attraction."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.patches import Patch

from ..scan import REGIMES, Basins
from ..scan.regime import LABELS
from ..scan.store import NOT_COMPUTED
from .branch import axis_name
from .motion import new_axes

# Colours by period; a period beyond the list has the last one.
_PERIODS = (
    "#4c78a8", "#f58518", "#54a24b", "#e45756", "#72b7b2", "#eeca3b", "#b279a2", "#9d755d",
    "#ff9da6",
)  # fmt: skip
_COLORS = {
    REGIMES.unsettled: "#c8c8c8",
    REGIMES.transient: "#7a6f86",
    REGIMES.chaotic: "#222222",
    REGIMES.failed: "#ffffff",
}
# What was not computed lies below all regimes.
_LEAST = min(REGIMES) - 1
_OTHERS: dict[int, tuple[str, str]] = {
    **{regime: (regime.meaning, color) for regime, color in _COLORS.items()},
    _LEAST: ("not computed", "#f3f3f3"),
}

# Motions named one by one in the legend; further ones share its last line.
_NAMED = 12


def plot_regimes(
    data: xr.Dataset, *, ax: Axes | None = None, x: str | None = None, y: str | None = None
) -> Axes:
    """A map of the regimes of motion over two axes of a scan.

    Each cell has the colour of its period, up to 8 drive cycles and beyond; chaotic, transiently
    chaotic, unsettled and failed lanes have colours of their own. The legend names what is there.

    **Arguments:** the data of a scan that measured `"regime"`; `ax`, axes to draw into, a new
    figure if left out; `x` and `y`, the names of the axes to draw along, the first and the second
    of the scan if left out.

    **Returns:** the axes.

    **Raises:** `ValueError` if there is no period in the data, or not over two axes.
    """
    if "period" not in data:
        raise ValueError('Argument `data` must hold `period`: scan with measure="regime".')
    period = data["period"]
    x, y = _two_axes([str(name) for name in period.dims], x, y)
    period = period.transpose(y, x)
    codes = np.asarray(period).astype(int)
    shades = np.clip(codes, _LEAST + 1, len(_PERIODS))
    if "result" in data:
        shades[np.asarray(data["result"].transpose(y, x)) == NOT_COMPUTED] = _LEAST
    ax = new_axes(ax)
    across, up = np.asarray(data[x], float), np.asarray(data[y], float)
    colors = [_shade(i)[1] for i in range(_LEAST, len(_PERIODS) + 1)]
    _image(ax, across, up, shades - _LEAST, colors)
    order = [*range(1, len(_PERIODS) + 1), *_OTHERS]
    order = [i for i in order if (shades == i).any()]
    _legend(ax, [_shade(i) for i in order])
    ax.set_xlabel(axis_name(x))
    ax.set_ylabel(axis_name(y))
    return ax


def _shade(code: int) -> tuple[str, str]:
    """Name and colour of a regime."""
    if code <= 0:
        return _OTHERS[code]
    most = len(_PERIODS)
    return f"> {2 * (most - 1)}π" if code == most else f"{2 * code}π", _PERIODS[code - 1]


def plot_basins(found: Basins, *, ax: Axes | None = None) -> Axes:
    """Basins of attraction over two parts of the start, with the motions' section points.

    A grid of starts is drawn as an image, random starts as dots. The legend gives each motion's
    period, its impacts and its part of the starts.

    **Arguments:** what `basins` found; `ax`, axes to draw into, a new figure if left out.

    **Returns:** the axes.

    **Raises:** `ValueError` if the region does not span two parts of the start.
    """
    label = found.data["label"]
    names = [str(name) for name in found.data.coords if str(name).startswith("start.")]
    x, y = _two_axes(names, None, None)
    ax = new_axes(ax)
    across, up = np.asarray(found.data[x], float), np.asarray(found.data[y], float)
    colors, irregular = _basin_colors(len(found.attractors)), len(LABELS)
    if label.dims == ("sample",):
        ax.scatter(across, up, c=[colors[i + irregular] for i in np.asarray(label)], s=6, lw=0)
    else:
        _image(ax, across, up, np.asarray(label.transpose(y, x)).astype(int) + irregular, colors)
    region = ax.get_xlim(), ax.get_ylim()
    entries = []
    for a in found.attractors:
        color = colors[a.label + irregular]
        parts = [a.sections[name.removeprefix("start.")] for name in (x, y)]
        ax.plot(*parts, "o", color=color, mec="k", mew=1.0, ms=6, zorder=3)
        impacts = f"{a.impacts:g} impact{'' if a.impacts == 1 else 's'}"
        entries.append((f"{2 * a.period}π, {impacts}: {100 * a.fraction:.1f} %", color))
    if len(entries) > _NAMED:
        rest = sum(a.fraction for a in found.attractors[_NAMED:])
        further = (f"{len(entries) - _NAMED} further: {100 * rest:.1f} %", "none")
        entries = [*entries[:_NAMED], further]
    for regime in LABELS:
        part = found.irregular[regime.name]
        if part:
            entries.append((f"{regime.meaning}: {100 * part:.1f} %", _COLORS[regime]))
    _legend(ax, entries)
    ax.set(xlim=region[0], ylim=region[1])  # section points beyond the region stay outside
    ax.set_xlabel(f"{x.removeprefix('start.')} at the start")
    ax.set_ylabel(f"{y.removeprefix('start.')} at the start")
    return ax


def _basin_colors(motions: int) -> list[str]:
    """Colours of the labels, the least first; many motions share them in turn."""
    irregular = [_COLORS[regime] for regime in sorted(LABELS, key=LABELS.__getitem__)]
    return irregular + [_PERIODS[i % len(_PERIODS)] for i in range(motions)]


def _two_axes(names: list[str], x: str | None, y: str | None) -> tuple[str, str]:
    if len(names) != 2:
        raise ValueError(
            f"A map needs two axes, but these data have {len(names)} ({', '.join(names)}). Select "
            "from the others first, with `data.sel(...)`."
        )
    if x is None:
        x = names[0] if y != names[0] else names[1]
    if y is None:
        y = names[1] if x != names[1] else names[0]
    for argument, name in (("x", x), ("y", y)):
        if name not in names:
            raise ValueError(f"Argument `{argument}` must be one of {names}, but got {name!r}.")
    if x == y:
        raise ValueError(f"Arguments `x` and `y` must be different axes, but both are {x!r}.")
    return x, y


def _image(ax: Axes, across: np.ndarray, up: np.ndarray, shades: Any, colors: list[str]) -> None:
    """Cells around the points of a grid, whose rows may be in any order."""
    columns, rows = np.argsort(across), np.argsort(up)
    ax.pcolormesh(
        _edges(across[columns]),
        _edges(up[rows]),
        shades[np.ix_(rows, columns)],
        cmap=ListedColormap([to_rgb(c) for c in colors]),
        vmin=-0.5,
        vmax=len(colors) - 0.5,
        rasterized=True,
    )


def _edges(row: np.ndarray) -> np.ndarray:
    """Edges of the cells around rising points, halfway between them."""
    if row.size == 1:
        return row[0] + 0.5 * np.array([-1.0, 1.0])
    middle = 0.5 * (row[1:] + row[:-1])
    return np.concatenate([[2 * row[0] - middle[0]], middle, [2 * row[-1] - middle[-1]]])


def _legend(ax: Axes, entries: list[tuple[str, str]]) -> None:
    patches = [Patch(facecolor=color, edgecolor="0.4", label=name) for name, color in entries]
    place = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0.0}
    ax.legend(handles=patches, frameon=False, fontsize="small", **place)
