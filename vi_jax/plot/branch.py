"""Pictures of branches, sweeps and boundaries, in the field's conventions."""

import itertools
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ..orbit import Boundary, Branch
from ..scan import Sweep
from .motion import BLUE, new_axes

MARKERS = {
    "fold": ("s", "tab:orange"),
    "period-doubling": ("D", "tab:red"),
    "neimark-sacker": ("^", "tab:purple"),
    "branch-point": ("X", "tab:brown"),
    "grazing": ("o", "k"),
}


def plot_branch(
    branch: Branch,
    *,
    ax: Axes | None = None,
    y: str = "y_min",
    x: str = "parameter",
    special: bool = True,
    **style: Any,
) -> Axes:
    """A branch: stable parts solid, unstable ones dashed, special points marked.

    **Arguments:** the branch; `ax`, a new figure if left out; `y` and `x`, names of the branch's
    arrays; `special`, whether to mark the special points (where `y` is a number of an orbit);
    options of `Axes.plot`.

    **Returns:** the axes.
    """
    ax = new_axes(ax)
    across, up = getattr(branch, x), getattr(branch, y)
    # The points where stability changes are among the branch's: there it is rounding's.
    inside = np.abs(branch.multipliers).max(axis=1) < 1 + 1e-6
    stable = inside[1:] & inside[:-1]
    label = style.pop("label", None)
    look = {"color": BLUE, "lw": 1.6, **style}
    for start, end, solid in _stretches(stable):
        part = slice(start, end)
        ax.plot(across[part], up[part], ls="-" if solid else "--", label=label, **look)
        label = None
    if special and x == "parameter":
        for point in branch.special:
            value = getattr(point.orbit, y, None)
            if value is not None and np.ndim(value) == 0:
                marker, color = MARKERS[point.kind]
                ax.plot(point.parameter, float(value), marker, color=color, ms=5, zorder=4)
    ax.set_xlabel("ζ" if x == "frequency_ratio" else axis_name(branch.name))
    ax.set_ylabel({"y_min": "min Y (a)", "y_max": "max Y (a)"}.get(y, y))
    return ax


def _stretches(stable: np.ndarray) -> list[tuple[int, int, bool]]:
    """First and last point (exclusive) and stability of each stretch of like segments."""
    edges = [0, *(np.flatnonzero(np.diff(stable.astype(int))) + 1), len(stable)]
    return [(int(a), int(b) + 1, bool(stable[a])) for a, b in itertools.pairwise(edges)]


def plot_sweep(
    sweep: Sweep, *, ax: Axes | None = None, y: str = "y_min", x: str = "values", **style: Any
) -> Axes:
    """A sweep as dots, one for each value.

    **Arguments:** one sweep; `ax`; names of its arrays; options of `Axes.plot`.

    **Returns:** the axes.
    """
    ax = new_axes(ax)
    across, up = np.asarray(getattr(sweep, x)), np.asarray(getattr(sweep, y))
    ax.plot(across, up, **{"marker": ".", "ms": 3, "ls": "none", "color": "0.3", **style})
    ax.set_xlabel(axis_name(sweep.parameter if x == "values" else x))
    ax.set_ylabel({"y_min": "min Y (a)", "y_max": "max Y (a)"}.get(y, y))
    return ax


def plot_boundary(curve: Boundary, *, ax: Axes | None = None, **style: Any) -> Axes:
    """A boundary curve in the plane of its two parameters.

    **Arguments:** the curve; `ax`; options of `Axes.plot`.

    **Returns:** the axes.
    """
    ax = new_axes(ax)
    color = MARKERS[curve.kind][1]
    ax.plot(*curve.parameters.T, **{"color": color, "lw": 1.6, "label": curve.kind, **style})
    ax.set_xlabel(axis_name(curve.names[0]))
    ax.set_ylabel(axis_name(curve.names[1]))
    return ax


def axis_name(name: str) -> str:
    """The field's symbol for a number of a scene."""
    symbols = {
        "frequency_ratio": "frequency ratio ζ",
        "restitution": "restitution k",
        "gap": "gap d (a)",
        "damping_ratio": "damping ratio ξ",
        "control": "motor control κ",
        "strength": "motor strength τ0",
    }
    return symbols.get(name.split(".")[-1], name)
