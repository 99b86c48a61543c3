"""Pictures of periodic motions: branches, sweeps, boundaries, multipliers, a saddle's manifolds,
and attractors near a grazing."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from .._checks import flag, instance_of, one_of, tuple_of
from ..machine import (
    cycles_in_words,
    drive_speed,
    in_brackets,
    is_angle,
    name_in,
    quantity_of,
    unit_of,
    units_of,
)
from ..orbit import (
    KINDS,
    Boundary,
    Branch,
    Grazing,
    Motions,
    Orbit,
    branch_hits_in_words,
    check_multipliers,
)
from ..robust import Manifold
from ..scans import REGIMES, Sweep
from .colors import BLUE, DASHES, IRREGULAR, RED, color_of, draw_mark, once, thick
from .motion import new_axes

# Names of lines in a legend, and the order of dots: above lines and below marks.
_STABLE, _UNSTABLE = "stable", "unstable"
_DOTS = 3

# Segments along which an angle passes half a turn are not drawn.
_NONE = 2

# Sections drawn at each value of the parameter, the last ones: more would coincide.
_DRAWN = 64

# Ticks of the axis: with its scale, more would overlap.
_TICKS = 5

# The largest number of motions named in the legend.
_NAMED = 8


def plot_branch(
    branch: Branch,
    *,
    ax: Axes | None = None,
    y: str | None = None,
    x: str = "parameter",
    special: bool = True,
    legend: bool = True,
    **style: Any,
) -> Axes:
    """Draw a branch: stable parts solid, unstable ones dashed, special points marked.

    The colour is that of its period, as in all pictures. A motion of two cycles with several
    impacts has another colour than one with a single impact.

    **Arguments:** `branch`; `ax`, by default a new figure; `y` and `x`, names of columns of the
    branch (`Branch.column_names`): `"duration"`, `"section_Y"`, or one of the machine's averages
    such as `"power"` (`y` is by default the first of `"y_min"`, `"y_max"` that stops do not fix,
    else the speed of impacts); `special`, whether to mark the special points; `legend`, whether to
    draw one with the period and the impacts of the colour (or the branch's `label`), the meaning of
    solid and dashed lines, and the marks; options of `Axes.plot`.
    """
    instance_of("branch", branch, Branch, "a `Branch`, from `continue_orbit`")
    y = _moving(branch) if y is None else y
    across, up = _array(branch, "x", x), _array(branch, "y", y)
    ax = new_axes(ax)
    # At changes of stability, which are points of the branch, rounding decides.
    inside = np.abs(branch.multipliers).max(axis=1) < 1 + 1e-6
    stable = inside[1:] & inside[:-1]
    angles = [z for name, z in ((x, across), (y, up)) if _is_angle(branch, name)]
    kinds = np.where(np.any([np.abs(np.diff(z)) > np.pi for z in angles], axis=0), _NONE, stable)
    label = style.pop("label", None)
    look = {"color": color_of(branch.cycles, int(branch.impacts.max())), "lw": thick(1.6), **style}
    if label is not None:
        ax.plot([], [], label=label, **{"ls": "-", **look})
    for start, end, kind in _stretches(kinds):
        part = slice(start, end)
        if kind != _NONE:
            ax.plot(across[part], up[part], **{"ls": "-" if kind else "--", **look})
    if label is None and legend:
        period = cycles_in_words(branch.problem.machine, branch.cycles)
        motion = f"{period}, {branch_hits_in_words(branch)}"
        ax.plot([], [], label=once(ax, motion), **{"ls": "-", **look})
    for word, line, drawn in ((_STABLE, "-", stable.any()), (_UNSTABLE, "--", not stable.all())):
        if drawn:
            ax.plot([], [], line, color="0.3", lw=look["lw"], label=once(ax, word))
    for point in branch.special if special else ():
        draw_mark(ax, point.kind, across[point.index], up[point.index])
    if legend:
        _legend(ax)
    machine = branch.problem.machine
    along = x if x in branch.free else branch.name
    units = units_of(machine)
    ax.set_xlabel(_speed_label(units) if x == "frequency_ratio" else axis_name(along, units))
    ax.set_ylabel(extreme_name(y, machine.labels, units, branch.averages))
    return ax


def _is_angle(branch: Branch, name: str) -> bool:
    on_section = name.startswith("section_")
    return on_section and is_angle(branch.problem.machine, name.removeprefix("section_"))


def _moving(found: Branch | Sweep) -> str:
    """Return the name of the extreme that varies, or if stops fix both, of the fastest impact."""
    extremes = np.stack([found.y_min, found.y_max]).reshape(2, -1)
    extremes = extremes[:, np.isfinite(extremes).all(axis=0)]
    if extremes.shape[1] < 2:
        return "y_min"
    low, high = np.ptp(extremes, axis=1) > 1e-9 * np.abs(extremes).max()
    if not low and not high and np.any(np.asarray(found.impacts) > 0):
        return "fastest_impact" if isinstance(found, Branch) else "impact_speed"
    return "y_max" if high and not low else "y_min"


def _array(found: Branch | Sweep, argument: str, name: str) -> np.ndarray:
    """Return an array with a number for each point. **Raises:** `ValueError` with their names."""
    if isinstance(found, Branch):
        return found.column(one_of(argument, name, found.column_names))
    arrays = {
        name: x
        for name, x in {**vars(found), **found.averages}.items()
        if hasattr(x, "dtype") and x.shape == found.y_min.shape
    }
    return np.asarray(arrays[one_of(argument, name, tuple(arrays))])


def _legend(ax: Axes) -> None:
    """Draw a legend: branches first, then their lines, then the marks."""
    named = list(zip(*ax.get_legend_handles_labels(), strict=True))
    named.sort(key=lambda x: 2 if x[1] in KINDS else x[1] in (_STABLE, _UNSTABLE))
    if named:
        handles, labels = zip(*named, strict=True)
        ax.legend(handles, labels, fontsize="small", frameon=False)


def _stretches(kinds: np.ndarray) -> list[tuple[int, int, int]]:
    """Return the first and last point (exclusive) and the kind of each part with equal segments."""
    edges = [0, *(np.flatnonzero(np.diff(kinds.astype(int))) + 1), len(kinds)]
    return [(int(a), int(b) + 1, int(kinds[a])) for a, b in itertools.pairwise(edges)]


def plot_sweep(
    sweep: Sweep, *, ax: Axes | None = None, y: str | None = None, x: str = "values", **style: Any
) -> Axes:
    """Draw a sweep as dots, one for each value, above the branches in the same axes.

    **Arguments:** `sweep`; `ax`; `y` and `x`, names of its arrays with a number for each value, as
    for `plot_branch`; options of `Axes.plot`.
    """
    instance_of("sweep", sweep, Sweep, "a `Sweep`, from `sweep`")
    y = _moving(sweep) if y is None else y
    across, up = _array(sweep, "x", x), _array(sweep, "y", y)
    ax = new_axes(ax)
    look = {"marker": ".", "ms": 3, "ls": "none", "color": "0.3", "zorder": _DOTS, **style}
    ax.plot(across, up, **look)
    units = dict(sweep.units)
    ax.set_xlabel(axis_name(sweep.parameter if x == "values" else x, units))
    ax.set_ylabel(extreme_name(y, sweep.labels, units, sweep.averages))
    return ax


def plot_boundary(
    curve: Boundary, *, ax: Axes | None = None, special: bool = True, legend: bool = True,
    **style: Any,
) -> Axes:  # fmt: skip
    """Draw a boundary curve in its two parameters, with points of codimension two.

    The colour is that of the motion's period, the dash that of the bifurcation: solid for a
    grazing, dashed for a period doubling, dash-dotted for a fold, with two dots for a
    Neimark–Sacker bifurcation, dotted for a loss of symmetry or a branch point.

    **Arguments:** `curve`; `ax`; `special`, whether to mark the points of codimension two;
    `legend`, whether to draw one with the meaning of the dash (or the curve's `label`) and the
    marks; options of `Axes.plot`.
    """
    instance_of("curve", curve, Boundary, "a `Boundary`, from `boundary`")
    ax = new_axes(ax)
    look = {"ls": DASHES[curve.kind], "lw": thick(1.6), "label": curve.kind}
    if "linestyle" in style:
        look.pop("ls")
    color = color_of(curve.problem.cycles, curve.impact_speed.shape[1])
    ax.plot(*curve.parameters.T, **{"color": color, **look, **style})
    for point in curve.special if special else ():
        draw_mark(ax, point.kind, *point.parameters)
    if legend:
        _legend(ax)
    units = units_of(curve.problem.machine)
    ax.set_xlabel(axis_name(curve.names[0], units))
    ax.set_ylabel(axis_name(curve.names[1], units))
    return ax


def extreme_name(
    name: str, labels: tuple[str, str], units: Mapping[str, str], averages: Any = ()
) -> str:
    """Return the machine's label of an axis of smallest or greatest positions, or of an average."""
    if name in averages:
        return in_brackets(f"mean {name}", unit_of(units, name))
    least = {"y_min": "min", "y_max": "max"}.get(name)
    if least is None:
        if name == "frequency_ratio":
            return f"mean {_speed_label(units)}"
        quantity = quantity_of(name)
        name = f"{name.removeprefix('section_')} on the section" if "section_" in name else name
        return name if quantity is None else in_brackets(name, unit_of(units, quantity))
    return in_brackets(f"{least} {name_in(labels[0])}", unit_of(units, "position"))


def _speed_label(units: Mapping[str, str]) -> str:
    name = drive_speed(units)
    unit = unit_of(units, "frequency_ratio")
    return f"frequency ratio {name}" if name == "ζ" else in_brackets(name, unit)


def axis_name(name: str, units: Mapping[str, str]) -> str:
    """Return the symbol of a parameter, with its unit unless it is a ratio."""
    symbols = {
        "frequency_ratio": "frequency ratio ζ",
        "restitution": "restitution k",
        "gap": "gap d",
        "damping_ratio": "damping ratio ξ",
        "drive.control": "motor control κ",
        "drive.strength": "motor strength τ0",
    }
    last = name.split(".")[-1]
    unit = "" if last == "frequency_ratio" else unit_of(units, name)
    return in_brackets(symbols.get(name) or symbols.get(last, name), unit)


def plot_multipliers(
    orbits: Orbit | Sequence[Orbit], *, ax: Axes | None = None, **style: Any
) -> Axes:
    """Draw Floquet multipliers in the complex plane with the unit circle: stable if all lie inside.

    **Arguments:** `orbits`, an `Orbit` (or a batch of them, or a list); `ax`, by default a new
    figure; options of `Axes.plot`.
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

    **Arguments:** `found`, the result of `manifold`; `ax`, such as that of `plot_basins`, by
    default a new figure; options of `Axes.plot`.
    """
    is_new = ax is None
    ax = new_axes(ax)
    machine, color = found.machine, BLUE if found.which == "stable" else RED
    label: str | None = f"{found.which} manifold"
    for branch in found.branches:
        across, up = (np.asarray(jax.vmap(f)(branch)) for f in (machine.position, machine.velocity))
        ax.plot(across, up, **{"color": color, "lw": thick(1.2), "label": label, **style})
        label = None
    state = found.orbit.state
    ax.plot(machine.position(state), machine.velocity(state), "kX", ms=7, mec="w", zorder=4)
    if is_new:
        ax.set(xlabel=machine.labels[0], ylabel=machine.labels[1])
    return ax


def plot_grazing(
    found: Grazing, *, ax: Axes | None = None, legend: bool = True, **style: Any
) -> Axes:
    """Draw the attractor of a local map above the simulated motions of the machine.

    The axis is the parameter minus its value at the grazing, scaled by the square root, so motions
    that grow as the root lie between straight lines. The ordinate is the first coordinate on the
    section minus that of the motion without impact. The machine's attractor is in pale rings (if it
    was simulated), the forecast's in dots with the colour of its period, chaos dark. If there is no
    attractor near, grey dots are the far motion of the machine, `found.far`.

    **Arguments:** `found`, a `Grazing`; `ax`, by default a new figure; `legend`, whether to draw
    one; options of `Axes.plot` for the forecast's dots.
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
    draw_mark(ax, "grazing", 0.0, 0.0)
    ax.set_xscale("function", functions=(_root, lambda x: x * np.abs(x)))
    farthest = found.forecast.offset[np.argmax(np.abs(found.forecast.offset))]
    ax.plot([farthest, 0.0], [0.0, 0.0], ls="none")  # for the axis if nothing is drawn
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
    """Draw the motions of the machine near the grazing and, if most are there, far away."""
    near = machine.period >= 0
    if near.any() or found.far is None:
        across, up = _dots(machine.offset[near], machine.position[near])
        rings = {"marker": "o", "ms": 4.5, "mfc": "none", "mec": "0.72", "mew": 0.6, "ls": "none"}
        ax.plot(across, up, label="the machine", **rings)
    if found.far is not None:
        across, up = _dots(machine.offset[~near], machine.position[~near])
        dots = {"marker": ".", "ms": 2, "color": "0.6", "ls": "none"}
        ax.plot(across, up, **dots)
        ax.plot([], [], ".", color="0.6", label=f"the machine, far away: {found.distant_in_words}")


def _dots(offset: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    up = position[:, -_DRAWN:]
    return np.repeat(offset, up.shape[1]), up.ravel()


def _root(x: object) -> np.ndarray:
    """Return the square root, continued as an odd function."""
    x = np.asarray(x, float)
    return np.sign(x) * np.sqrt(np.abs(x))
