"""Pictures of branches, sweeps and boundaries, in the field's conventions."""

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._checks import instance_of, one_of
from ..machine import (
    cycles_in_words,
    in_brackets,
    is_angle,
    name_in,
    quantity_of,
    unit_of,
    units_of,
)
from ..orbit import Boundary, Branch, branch_hits_in_words
from ..scans import Sweep
from .colors import DASHES, MARKS, color_of, mark_style, once, thick
from .motion import new_axes

# Names of lines in a legend, and where dots lie: above lines and below the marks.
_STABLE, _UNSTABLE = "stable", "unstable"
_DOTS = 3

# Of a segment along which an angle passes half a turn, where it begins again: no line is drawn.
_NONE = 2


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

    Its colour is that of its period, as in all pictures; a motion of two cycles with several
    impacts has another than one with a single impact.

    **Arguments:** the branch; `ax`, a new figure if left out; `y` and `x`, names of columns of the
    branch (`Branch.column_names`): `"duration"`, `"section_Y"`, or an average of the machine's such
    as `"power"` (`y` is by default the first of `"y_min"`, `"y_max"` that is not fixed by a stop);
    `special`, whether to mark the special points; `legend`, whether to draw one: the period and the
    impacts that the colour stands for (or the branch's `label`), what solid and dashed lines are,
    and the marks; options of `Axes.plot`.
    """
    instance_of("branch", branch, Branch, "a `Branch`, from `continue_orbit`")
    y = _moving(branch) if y is None else y
    across, up = _array(branch, "x", x), _array(branch, "y", y)
    ax = new_axes(ax)
    # Points where stability changes are points of the branch: there rounding decides.
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
        mark = {**mark_style(point.kind), "zorder": 4, "label": once(ax, point.kind)}
        ax.plot(across[point.index], up[point.index], **mark)
    if legend:
        _legend(ax)
    machine = branch.problem.machine
    along = x if x in branch.free else branch.name
    ax.set_xlabel("ζ" if x == "frequency_ratio" else axis_name(along, units_of(machine)))
    ax.set_ylabel(extreme_name(y, machine.labels, units_of(machine), branch.averages))
    return ax


def _is_angle(branch: Branch, name: str) -> bool:
    on_section = name.startswith("section_")
    return on_section and is_angle(branch.problem.machine, name.removeprefix("section_"))


def _moving(found: Branch | Sweep) -> str:
    """The extreme that varies: the other one may be a stop's place. The least if neither does."""
    extremes = np.asarray(found.y_min), np.asarray(found.y_max)
    low, high = (np.ptp(x) > 1e-9 * np.abs(extremes).max() for x in extremes)
    return "y_max" if high and not low else "y_min"


def _array(found: Branch | Sweep, argument: str, name: str) -> np.ndarray:
    """An array with a number for each point. **Raises:** `ValueError` that lists them."""
    if isinstance(found, Branch):
        return found.column(one_of(argument, name, found.column_names))
    arrays = {
        name: x
        for name, x in {**vars(found), **found.averages}.items()
        if hasattr(x, "dtype") and x.shape == found.y_min.shape
    }
    return np.asarray(arrays[one_of(argument, name, tuple(arrays))])


def _legend(ax: Axes) -> None:
    """Branches first, then their lines, then the marks."""
    named = list(zip(*ax.get_legend_handles_labels(), strict=True))
    named.sort(key=lambda x: 2 if x[1] in MARKS else x[1] in (_STABLE, _UNSTABLE))
    if named:
        handles, labels = zip(*named, strict=True)
        ax.legend(handles, labels, fontsize="small", frameon=False)


def _stretches(kinds: np.ndarray) -> list[tuple[int, int, int]]:
    """First and last point (exclusive) and kind of each stretch of like segments."""
    edges = [0, *(np.flatnonzero(np.diff(kinds.astype(int))) + 1), len(kinds)]
    return [(int(a), int(b) + 1, int(kinds[a])) for a, b in itertools.pairwise(edges)]


def plot_sweep(
    sweep: Sweep, *, ax: Axes | None = None, y: str | None = None, x: str = "values", **style: Any
) -> Axes:
    """Draw a sweep as dots, one for each value, above the branches in the same axes.

    **Arguments:** one sweep; `ax`; names of its arrays with a number for each value, as for
    `plot_branch`; options of `Axes.plot`.
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

    Its colour is that of the motion's period, its dash shows what happens there: solid a grazing,
    dashed a period doubling, dash-dotted a fold, with two dots a Neimark–Sacker bifurcation, dotted
    a loss of symmetry or a branch point.

    **Arguments:** the curve; `ax`; `special`, whether to mark the points of codimension two;
    `legend`, whether to draw one: what the dash means (or the curve's `label`), and the marks;
    options of `Axes.plot`.
    """
    instance_of("curve", curve, Boundary, "a `Boundary`, from `boundary`")
    ax = new_axes(ax)
    look = {"ls": DASHES[curve.kind], "lw": thick(1.6), "label": curve.kind}
    if "linestyle" in style:
        look.pop("ls")
    color = color_of(curve.problem.cycles, curve.impact_speed.shape[1])
    ax.plot(*curve.parameters.T, **{"color": color, **look, **style})
    for point in curve.special if special else ():
        mark = {**mark_style(point.kind), "zorder": 4, "label": once(ax, point.kind)}
        ax.plot(*point.parameters, **mark)
    if legend:
        _legend(ax)
    units = units_of(curve.problem.machine)
    ax.set_xlabel(axis_name(curve.names[0], units))
    ax.set_ylabel(axis_name(curve.names[1], units))
    return ax


def extreme_name(
    name: str, labels: tuple[str, str], units: Mapping[str, str], averages: Any = ()
) -> str:
    """The label of an axis of smallest or greatest positions, in the machine's words, or of an
    average of the machine's own."""
    if name in averages:
        return in_brackets(f"mean {name}", unit_of(units, name))
    least = {"y_min": "min", "y_max": "max"}.get(name)
    if least is None:
        if name == "frequency_ratio":
            return "mean frequency ratio ζ"
        quantity = quantity_of(name)
        name = f"{name.removeprefix('section_')} on the section" if "section_" in name else name
        return name if quantity is None else in_brackets(name, unit_of(units, quantity))
    return in_brackets(f"{least} {name_in(labels[0])}", unit_of(units, "position"))


def axis_name(name: str, units: Mapping[str, str]) -> str:
    """Return the symbol of a parameter, with its unit unless it is a ratio."""
    symbols = {
        "frequency_ratio": "frequency ratio ζ",
        "restitution": "restitution k",
        "gap": "gap d",
        "damping_ratio": "damping ratio ξ",
        "control": "motor control κ",
        "strength": "motor strength τ0",
    }
    last = name.split(".")[-1]
    unit = "" if last == "frequency_ratio" else unit_of(units, name)
    return in_brackets(symbols.get(last, name), unit)
