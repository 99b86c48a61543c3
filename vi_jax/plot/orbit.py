"""Pictures of periodic motions: Floquet multipliers in the unit circle."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._checks import instance_of, tuple_of
from ..orbit import Orbit, check_multipliers
from .colors import BLUE
from .motion import new_axes


def plot_multipliers(
    orbits: Orbit | Sequence[Orbit], *, ax: Axes | None = None, **style: Any
) -> Axes:
    """Draw Floquet multipliers in the complex plane with the unit circle: stable if all lie inside.

    **Arguments:** an `Orbit` (or a batch of them, or a list); `ax`, axes to draw into, a new
    figure if left out; options of `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `TypeError` or `ValueError` for an argument without multipliers.
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
