"""Period doublings, touches, folds and first impacts with the ideal drive, in closed form."""

from functools import partial
from typing import Any

import jax
import numpy as np
import vi_jax as vi
from scipy.optimize import brentq

Expected = dict[str, tuple[float, float]]
"""Values and tolerances by name."""
XI = float(vi.Parameters().scene(drive="ideal").damping_ratio)
# Tolerance of roots: both brentq and located points err by rounding of multiplier or clearance.
ROOT = 1e-8


@partial(jax.jit, static_argnames="cycles")
def closed(zeta: Any, k: Any, xi: Any, gap: Any, *, cycles: int) -> vi.ClosedFormOrbits:
    """Return the motions with one impact in `cycles` cycles."""
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=gap, damping_ratio=xi)
    return vi.closed_form_orbits(scene, cycles=cycles)


def doubling(k: float, xi: float, cycles: int, low: float, high: float) -> float:
    """Return ζ at which a multiplier is -1."""

    def test(zeta):
        found = closed(zeta, k, xi, 2.0, cycles=cycles)
        return float(np.real(np.prod(np.asarray(found.multipliers[0]) + 1)))

    return float(brentq(test, low, high, xtol=1e-13))


def touch(k: float, xi: float, low: float, high: float) -> float:
    """Return ζ at which the 4π motion touches the stop between its impacts."""

    def clearance(zeta):
        return float(closed(zeta, k, xi, 2.0, cycles=2).clearance[0])

    return float(brentq(clearance, low, high, xtol=1e-13))


def fold(k: float, xi: float, low: float, high: float) -> float:
    """Return ζ beyond which there is no 2π motion with an impact."""
    while high - low > 1e-10:
        middle = 0.5 * (low + high)
        there = bool(closed(middle, k, xi, 2.0, cycles=1).exists.any())
        low, high = (middle, high) if there else (low, middle)
    return low
