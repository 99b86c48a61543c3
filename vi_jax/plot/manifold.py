"""Pictures of the manifolds of a saddle."""

from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from ..robust import Manifold
from .colors import BLUE, RED, thick
from .motion import new_axes


def plot_manifold(found: Manifold, *, ax: Axes | None = None, **style: Any) -> Axes:
    """Draw a manifold of a saddle over position and velocity: stable blue, unstable red.

    The saddle is a cross.

    **Arguments:** what `manifold` found; `ax`, axes to draw into, as those of `plot_basins`, a new
    figure if left out; options of `Axes.plot`.

    **Returns:** the axes.
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
