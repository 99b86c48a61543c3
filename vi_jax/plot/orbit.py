"""Pictures of single motions: multipliers, a saddle's manifolds, what a grazing leads to."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from .._checks import flag, instance_of, tuple_of
from ..machine import in_brackets, name_in, unit_of
from ..orbit import Grazing, Motions, Orbit, check_multipliers
from ..robust import Manifold
from ..scans import REGIMES
from .branch import axis_name
from .colors import BLUE, IRREGULAR, RED, color_of, mark_style, thick
from .motion import new_axes

# Sections drawn at each value of the parameter, the last ones: more would only lie on each other.
_DRAWN = 64

# Marks on the axis, which its scale would let run into each other.
_TICKS = 5

# At most so many motions are named in the legend.
_NAMED = 8


def plot_multipliers(
    orbits: Orbit | Sequence[Orbit], *, ax: Axes | None = None, **style: Any
) -> Axes:
    """Draw Floquet multipliers in the complex plane with the unit circle: stable if all lie inside.

    **Arguments:** an `Orbit` (or a batch of them, or a list); `ax`, axes to draw into, a new
    figure if left out; options of `Axes.plot`.
    """
    listed = [orbits] if isinstance(orbits, Orbit) else tuple_of("orbits", orbits, Orbit)
    for orbit in listed:
        instance_of("orbits", orbit, Orbit, "an `Orbit`, from `find_orbit`, or a list of them")
        check_multipliers("orbits", orbit)
    ax = new_axes(ax)
    angle = np.linspace(0, 2 * np.pi, 256)
    ax.plot(np.cos(angle), np.sin(angle), color="0.5", lw=1)
    ax.axhline(0, color="0.85", lw=0.8, zorder=0)
    ax.axvline(0, color="0.85", lw=0.8, zorder=0)
    for orbit in listed:
        values = np.asarray(orbit.multipliers).ravel()
        ax.plot(np.real(values), np.imag(values), "o", **{"color": BLUE, "ms": 5, **style})
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="Re μ", ylabel="Im μ")
    return ax


def plot_manifold(found: Manifold, *, ax: Axes | None = None, **style: Any) -> Axes:
    """Draw a manifold of a saddle over position and velocity: stable blue, unstable red.

    The saddle is a cross.

    **Arguments:** what `manifold` found; `ax`, axes to draw into, as those of `plot_basins`, a new
    figure if left out; options of `Axes.plot`.
    """
    own = ax is None
    ax = new_axes(ax)
    machine, color = found.machine, BLUE if found.which == "stable" else RED
    label: str | None = f"{found.which} manifold"
    for branch in found.branches:
        across, up = (np.asarray(jax.vmap(f)(branch)) for f in (machine.position, machine.velocity))
        ax.plot(across, up, **{"color": color, "lw": thick(1.2), "label": label, **style})
        label = None
    state = found.orbit.state
    ax.plot(machine.position(state), machine.velocity(state), "kX", ms=7, mec="w", zorder=4)
    if own:
        ax.set(xlabel=machine.labels[0], ylabel=machine.labels[1])
    return ax


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
    up = position[:, -_DRAWN:]
    return np.repeat(offset, up.shape[1]), up.ravel()


def _root(x: object) -> np.ndarray:
    """The square root, continued as an odd function."""
    x = np.asarray(x, float)
    return np.sign(x) * np.sqrt(np.abs(x))


def _square(x: object) -> np.ndarray:
    x = np.asarray(x, float)
    return np.sign(x) * x * x
