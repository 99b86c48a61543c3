"""Pictures of what a grazing leads to: the forecast's attractor over the machine's own."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._checks import flag, instance_of
from ..machine import in_brackets, name_in, unit_of
from ..orbit import Grazing, Motions
from ..scans import REGIMES
from .branch import axis_name
from .colors import IRREGULAR, color_of, mark_style
from .motion import new_axes

# Sections drawn at each value of the parameter, the last ones: more would only lie on each other.
_DRAWN = 64

# Marks on the axis, which its scale would let run into each other.
_TICKS = 5

# At most so many motions are named in the legend.
_NAMED = 8


def plot_grazing(
    found: Grazing, *, ax: Axes | None = None, legend: bool = True, **style: Any
) -> Axes:
    """Draw the attractor of a local map above the simulated motions of the machine.

    The axis is the parameter, less its value at the grazing, scaled by the square root, so motions
    that grow as the root lie between straight lines; upwards the first coordinate on the section,
    less that of the motion without impact. The machine's attractor is in pale rings (if it was
    simulated), the forecast's in dots of the colour of its period, chaos dark. If nothing near
    attracts, grey dots are the far motion of the machine, `found.far`.

    **Arguments:** the `Grazing`; `ax`, axes to draw into, a new figure if left out; `legend`,
    whether to draw one; options of `Axes.plot` for the forecast's dots.

    **Returns:** the axes.

    **Raises:** `TypeError` if this is no `Grazing`.
    """
    instance_of("found", found, Grazing, "a `Grazing`, from `grazing`")
    legend, ax = flag("legend", legend), new_axes(ax)
    if found.machine is not None:
        _draw_machine(ax, found, found.machine)
    period = found.forecast.period
    if found.far is None and not (period >= 0).any():
        ax.text(0.5, 0.6, "forecast: no attractor near", transform=ax.transAxes, ha="center")
    for n in sorted(set(period[period >= 0]), key=lambda n: (n == 0, n)):
        lanes = period == n
        across, up = _dots(found.forecast.offset[lanes], found.forecast.position[lanes])
        color = color_of(int(n) * found.cycles) if n else IRREGULAR[REGIMES.chaotic]
        look = {"marker": ".", "ms": 2, "ls": "none", "color": color, **style}
        ax.plot(across, up, **look)
    for n in sorted(set(period[period > 0]))[:_NAMED]:
        named = f"forecast: {n} periods" if n > 1 else "forecast: one period"
        ax.plot([], [], ".", color=color_of(int(n) * found.cycles), label=named)
    if (period == 0).any():
        chaos = IRREGULAR[REGIMES.chaotic]
        ax.plot([], [], ".", color=chaos, label="forecast: no period")
    ax.plot(0.0, 0.0, **{**mark_style("grazing"), "label": "grazing", "zorder": 4})
    ax.set_xscale("function", functions=(_root, _square))
    farthest = found.forecast.offset[np.argmax(np.abs(found.forecast.offset))]
    ax.plot([farthest, 0.0], [0.0, 0.0], ls="none")  # where nothing is drawn, the axis as it is
    ticks = farthest * (np.arange(_TICKS) / (_TICKS - 1)) ** 2
    ax.set_xticks(ticks, ["0", *(f"{x:.2g}" for x in ticks[1:])])
    units = dict(found.units)
    ax.set_xlabel(f"{axis_name(found.parameter, units)}, from {found.value:.6g}")
    upwards = f"{name_in(found.labels[0])} on the section, from that without impact"
    ax.set_ylabel(in_brackets(upwards, unit_of(units, "position")))
    if legend:
        ax.legend(fontsize="small", frameon=False)
    return ax


def _draw_machine(ax: Axes, found: Grazing, machine: Motions) -> None:
    """What the machine settles on, near the grazing and, if most of it is there, far away."""
    near = machine.period >= 0
    if near.any() or found.far is None:
        across, up = _dots(machine.offset[near], machine.position[near])
        rings = {"marker": "o", "ms": 4.5, "mfc": "none", "mec": "0.72", "mew": 0.6, "ls": "none"}
        ax.plot(across, up, label="the machine", **rings)
    if found.far is not None:
        across, up = _dots(machine.offset[~near], machine.position[~near])
        dots = {"marker": ".", "ms": 2, "color": "0.6", "ls": "none"}
        ax.plot(across, up, **dots)
        ax.plot([], [], ".", color="0.6", label=f"the machine, far away: {found.afar}")


def _dots(offset: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The last sections of each lane as points."""
    up = position[:, -_DRAWN:]
    return np.repeat(offset, up.shape[1]), up.ravel()


def _root(x: object) -> np.ndarray:
    """The square root, continued as an odd function."""
    x = np.asarray(x, float)
    return np.sign(x) * np.sqrt(np.abs(x))


def _square(x: object) -> np.ndarray:
    x = np.asarray(x, float)
    return np.sign(x) * x * x
