"""Pictures of grids: maps of regimes, basins of attraction, and their erosion."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from .._checks import flag, instance_of, one_of
from .._messages import count_of
from .._types import xr
from ..machine import AbstractMachine, cycles_in_words, in_brackets, unit_of, units_of
from ..scans import NOT_COMPUTED, REGIMES, Basins, IntegrityProfile
from . import colors as look
from .colors import IRREGULAR, OUTCOMES, PERIODS, color_of, distinct_colors, thick
from .motion import new_axes
from .orbit import axis_name

# Lanes that were not computed lie below all regimes.
_LEAST = min(REGIMES) - 1
# In the order of a legend, after the periods.
_OTHERS = {
    **{int(regime): (regime.meaning, color) for regime, color in IRREGULAR.items()},
    _LEAST: ("not computed", look.NOT_COMPUTED),
}
# The number for the period of a motion that no event ended, if its period is unknown.
_GOES_ON = len(PERIODS) + 1

# Motions with their own line in the legend; further ones share its last line.
_NAMED = 12


def plot_regimes(
    data: "xr.Dataset",
    *,
    machine: AbstractMachine | None = None,
    ax: Axes | None = None,
    x: str | None = None,
    y: str | None = None,
    legend: bool = True,
) -> Axes:
    """Draw a map of the regimes of motion, or of outcomes, over two axes of a scan.

    Each cell has the colour of its period, up to 8 drive cycles and beyond. Chaotic, transiently
    chaotic, unsettled and failed lanes have different greys. If the data contain `impacts`, motions
    without impacts are paler, and motions of two cycles with one impact and with more have
    different colours. A lane that an event ended has the colour of its outcome. The legend has the
    colours that occur.

    **Arguments:** `data` of a scan with the measure `"regime"`, or of a machine whose events or
    stops have outcomes (`ends="overturned"`); `machine`, for the names of periods (by default 2π
    and so on for a `Scene`, cycles for any other machine); `ax`, by default a new figure; `x` and
    `y`, the names of the axes, by default the first and the second of the scan; `legend`, whether
    to draw one, on the right of the axes.

    **Raises:** `ValueError` if there is no period and no outcome in the data, or not over two axes.
    """
    legend = flag("legend", legend)
    if "period" not in data and "outcome" not in data:
        raise ValueError(
            "Argument `data` must hold `period` or `outcome`, but holds "
            f'{", ".join(str(name) for name in data.data_vars)}. Scan with measure="regime".'
        )
    kind = data["period" if "period" in data else "outcome"]
    x, y = _two_axes([str(name) for name in kind.dims], x, y)
    lanes = _lanes(data.transpose(y, x, ...))
    period_name = _period_namer(data) if machine is None else partial(cycles_in_words, machine)
    ax = new_axes(ax)
    across, up = np.asarray(data[x], float), np.asarray(data[y], float)
    outcomes = data["outcome"].attrs["flag_meanings"].split()[1:] if "outcome" in data else []
    kinds, shown = np.unique(lanes.reshape(-1, 3), axis=0, return_inverse=True)
    entries = [_entry(kind, period_name, outcomes) for kind in kinds.tolist()]
    _image(ax, across, up, shown.reshape(lanes.shape[:2]), [color for _, _, color in entries])
    if legend:
        _legend(ax, [entry[1:] for entry in sorted(entries)])
    for name, set_label in ((x, ax.set_xlabel), (y, ax.set_ylabel)):
        set_label(axis_name(name, {name: data[name].attrs.get("units", "")}))
    return ax


def _lanes(data: "xr.Dataset") -> np.ndarray:
    """Return three numbers of each lane: its outcome; its period or regime; its impacts if they are
    distinguished, 2 for more than one. -1 means absent."""
    if "period" in data:
        period = np.clip(np.asarray(data["period"]).astype(int), _LEAST + 1, len(PERIODS))
    else:
        failed = np.isin(np.asarray(data["result"]), (0, NOT_COMPUTED), invert=True)
        period = np.where(failed, int(REGIMES.failed), _GOES_ON)
    lanes = np.stack([np.full_like(period, -1), period, np.full_like(period, -1)], axis=-1)
    if "period" in data and "impacts" in data:
        impacts = np.asarray(data["impacts"], float)
        lanes[(period > 0) & (impacts < 0.5), 2] = 0
        for number, selected in ((1, impacts >= 0.5), (2, impacts > 1.5)):
            lanes[(period == 2) & selected, 2] = number
    if "outcome" in data:
        outcome = np.asarray(data["outcome"]).astype(int)
        lanes[outcome >= 0] = -1
        lanes[..., 0] = np.maximum(outcome, -1)
    if "result" in data:
        lanes[np.asarray(data["result"]) == NOT_COMPUTED] = -1, _LEAST, -1
    return lanes


def _entry(
    kind: Sequence[int], period_name: Callable[[int], str], outcomes: Sequence[str]
) -> tuple[tuple[int, ...], str, str]:
    """Return place in the legend, name and colour of lanes: periods and impacts, then outcomes."""
    outcome, period, impacts = kind
    if outcome >= 0:
        return (1, outcome), outcomes[outcome], OUTCOMES[outcome % len(OUTCOMES)]
    if period <= 0:
        return (2, list(_OTHERS).index(period)), *_OTHERS[period]
    if period == _GOES_ON:
        return (1, -1), "goes on", IRREGULAR[REGIMES.unsettled]
    most = len(PERIODS)
    name = f"> {period_name(most - 1)}" if period == most else period_name(period)
    name += {-1: "", 0: ", no impact", 1: ", 1 impact", 2: ", more impacts"}[impacts]
    return (0, period, impacts), name, color_of(period, None if impacts < 0 else impacts)


def _period_namer(data: "xr.Dataset") -> Callable[[int], str]:
    """Return the function that names periods in data from a machine of this class."""
    if data.attrs.get("machine_class", "Scene") != "Scene":
        return lambda cycles: count_of(cycles, "cycle")
    return lambda cycles: f"{2 * cycles}π"


def plot_basins(found: Basins, *, ax: Axes | None = None) -> Axes:
    """Draw basins of attraction over two components of the start, with the motions' section points.

    A grid of starts is drawn as an image, random starts as dots. The legend has each motion's
    period, its impacts and its share of the starts. A basin has the colour of its motion's period,
    as in all pictures; further motions of the same kind have other shades of it.

    **Arguments:** `found`, the result of `basins`; `ax`, by default a new figure.

    **Raises:** `ValueError` if the region does not span two components of the start.
    """
    label = found.data["label"]
    names = [str(name) for name in found.data.coords if str(name).startswith("start.")]
    x, y = _two_axes(names, None, None)
    ax = new_axes(ax)
    across, up = np.asarray(found.data[x], float), np.asarray(found.data[y], float)
    irregular = len(REGIMES)
    colors = [IRREGULAR[regime] for regime in sorted(REGIMES)]
    colors += distinct_colors((a.period, a.impacts) for a in found.attractors)
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
        motion = f"{found.period_of(a.period)}, {count_of(round(a.impacts), 'impact')}"
        entries.append((f"{motion}: {100 * a.fraction:.1f} %", color))
    if len(entries) > _NAMED:
        rest = sum(a.fraction for a in found.attractors[_NAMED:])
        further = (f"{len(entries) - _NAMED} further: {100 * rest:.1f} %", "none")
        entries = [*entries[:_NAMED], further]
    for regime in REGIMES:
        part = found.irregular.get(regime.name, 0.0)  # absent in older files
        if part:
            entries.append((f"{regime.meaning}: {100 * part:.1f} %", IRREGULAR[regime]))
    points = {"ls": "none", "marker": "o", "mfc": "w", "mec": "k", "ms": 6}
    named = [Line2D([], [], label="sections of the motions", **points)]
    _legend(ax, entries, named if found.attractors else [])
    ax.set(xlim=region[0], ylim=region[1])  # section points beyond the region stay outside
    ax.set_xlabel(_start_name(found.machine, x))
    ax.set_ylabel(_start_name(found.machine, y))
    return ax


def _start_name(machine: AbstractMachine, name: str) -> str:
    """Return the label of an axis of starts: the component's name and unit."""
    name = name.removeprefix("start.")
    return in_brackets(f"{name} at the start", unit_of(units_of(machine), name))


def _two_axes(names: list[str], x: str | None, y: str | None) -> tuple[str, str]:
    if len(names) != 2:
        raise ValueError(
            f"A map needs two axes, but these data have {len(names)} ({', '.join(names)}). "
            + (
                "Select from the others first, with `data.sel(...)`."
                if len(names) > 2
                else "Scan a second number, or draw this one by `vi.plot_sweep` of a `vi.sweep`."
            )
        )
    first = next(name for name in names if name != y)
    x = first if x is None else one_of("x", x, tuple(names))
    second = next(name for name in names if name != x)
    y = second if y is None else one_of("y", y, tuple(names))
    if x == y:
        raise ValueError(f"Arguments `x` and `y` must be different axes, but both are {x!r}.")
    return x, y


def _image(ax: Axes, across: np.ndarray, up: np.ndarray, shades: Any, colors: list[str]) -> None:
    """Draw cells around points in any order; `shades` are indices into `colors` as (up, across)."""
    columns, rows = np.argsort(across), np.argsort(up)
    ax.pcolormesh(
        _cell_edges(across[columns]),
        _cell_edges(up[rows]),
        shades[np.ix_(rows, columns)],
        cmap=ListedColormap([to_rgb(c) for c in colors]),
        vmin=-0.5,
        vmax=len(colors) - 0.5,
        rasterized=True,
    )


def _cell_edges(row: np.ndarray) -> np.ndarray:
    if row.size == 1:
        return row[0] + 0.5 * np.array([-1.0, 1.0])
    middle = 0.5 * (row[1:] + row[:-1])
    return np.concatenate([[2 * row[0] - middle[0]], middle, [2 * row[-1] - middle[-1]]])


def _legend(ax: Axes, entries: list[tuple[str, str]], marks: Sequence[Line2D] = ()) -> None:
    patches: list[Any] = [
        Patch(facecolor=color, edgecolor="0.4", label=name) for name, color in entries
    ]
    place = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0.0}
    ax.legend(handles=[*patches, *marks], frameon=False, fontsize="small", **place)


_WORDS = {
    "share": "part of the starts, %",
    "local": "largest ball of starts around the motion",
    "factor": "largest ball of starts",
}
# Motions with their own line in its legend.
_NAMED_LINES = 8


def plot_integrity(
    profile: IntegrityProfile, *, y: str = "share", ax: Axes | None = None, legend: bool = True
) -> Axes:
    """Draw an erosion profile: the share or the integrity of each motion over the parameter.

    A line has the colour of its motion's period, as in all pictures; further motions of the same
    kind have other shades of it. As its line falls, a motion loses its basin although it may still
    be stable. The band around a share is its standard error, that around a radius the resolution of
    the grid. Open circles are radii limited by the edge of the region.

    **Arguments:** `profile`, the result of `integrity_profile`; `y`, `"share"`, `"local"` (local
    integrity measure) or `"factor"` (integrity factor); `ax`, by default a new figure; `legend`,
    whether to draw one, which names the first eight motions.
    """
    instance_of("profile", profile, IntegrityProfile, "from `integrity_profile`")
    y, legend = one_of("y", y, tuple(_WORDS)), flag("legend", legend)
    ax = new_axes(ax)
    percent = 100.0 if y == "share" else 1.0
    colors = distinct_colors(zip(profile.period, profile.impacts, strict=True))
    for i, (row, color) in enumerate(zip(getattr(profile, y), colors, strict=True)):
        error = profile.error[i] if y == "share" else profile.resolution
        low, high = percent * np.maximum(row - error, 0.0), percent * (row + error)
        name = profile.name_of(i) if i < _NAMED_LINES else None
        ax.plot(profile.values, percent * row, ".-", ms=4, lw=thick(1.6), color=color, label=name)
        if y != "share":
            at_edge = getattr(profile, f"{y}_at_edge")[i]
            ax.plot(profile.values[at_edge], row[at_edge], "o", ms=4, mec=color, mfc="w", zorder=3)
        ax.fill_between(profile.values, low, high, color=color, alpha=0.2, lw=0)
    irregular = sum(profile.irregular.values())
    if y == "share" and np.any(irregular):
        ax.plot(profile.values, 100 * irregular, ":", color="0.4", label="no periodic motion")
    if y != "share" and getattr(profile, f"{y}_at_edge").any():
        open_circle = {"ls": "none", "marker": "o", "ms": 4, "mec": "0.4", "mfc": "w"}
        ax.plot([], [], **open_circle, label="cut by the region's edge")
    if legend and ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize="small", frameon=False)
    parameter = axis_name(profile.parameter, profile.basins[0].machine.units)
    ax.set(xlabel=parameter, ylabel=_WORDS[y], ylim=(0.0, None))
    return ax
