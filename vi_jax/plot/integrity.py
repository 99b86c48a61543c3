"""Pictures of how basins erode."""

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes

from .._checks import flag, instance_of, one_of
from ..scans import IntegrityProfile
from .branch import axis_name
from .colors import color_of, shades, thick
from .motion import new_axes

_WORDS = {
    "share": "part of the starts, %",
    "local": "largest ball of starts around the motion",
    "factor": "largest ball of starts",
}

# Motions named one by one in the legend.
_NAMED = 8


def plot_integrity(
    profile: IntegrityProfile, *, y: str = "share", ax: Axes | None = None, legend: bool = True
) -> Axes:
    """Draw an erosion profile: the share or the integrity of each motion over the parameter.

    A line has the colour of its motion's period, as in all pictures; further motions of the same
    kind have other shades of it. At a fall of a line, the motion loses its basin although it may
    still be stable. The band around a share is its standard error, that around a radius the
    resolution of the grid. Open circles are radii limited by the edge of the region.

    **Arguments:** what `integrity_profile` found; `y`, `"share"`, `"local"` (local integrity
    measure) or `"factor"` (integrity factor); `ax`, axes to draw into, a new figure if left out;
    `legend`, whether to draw one, which names the first eight motions.

    **Returns:** the axes.

    **Raises:** `TypeError` or `ValueError` if there is no such profile or number.
    """
    instance_of("profile", profile, IntegrityProfile, "from `integrity_profile`")
    y, legend = one_of("y", y, tuple(_WORDS)), flag("legend", legend)
    ax = new_axes(ax)
    kinds: dict[str, Iterator[str]] = {}
    percent = 100.0 if y == "share" else 1.0
    for i, row in enumerate(getattr(profile, y)):
        color = color_of(int(profile.period[i]), float(profile.impacts[i]))
        color = next(kinds.setdefault(color, shades(color)))
        error = profile.error[i] if y == "share" else profile.resolution
        low, high = percent * np.maximum(row - error, 0.0), percent * (row + error)
        name = profile.name_of(i) if i < _NAMED else None
        ax.plot(profile.values, percent * row, ".-", ms=4, lw=thick(1.6), color=color, label=name)
        if y != "share":
            cut = getattr(profile, f"{y}_at_edge")[i]
            ax.plot(profile.values[cut], row[cut], "o", ms=4, mec=color, mfc="w", zorder=3)
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
