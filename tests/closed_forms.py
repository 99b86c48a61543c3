"""Motions with one impact per period in closed form, compiled once for all tests."""

import jax
import numpy as np
import vi_jax as vi
from scipy.optimize import brentq
from vi_jax.orbit.closed_form import one_impact_orbits

FIELDS = ("Y", "V", "impact_phase", "impact_speed", "y_min", "y_max", "clearance")
solve = jax.jit(one_impact_orbits, static_argnums=4)


def ideal(**changes):
    numbers = {"frequency_ratio": 0.9, "restitution": 0.5, "gap": 2.0, "damping_ratio": 0.0}
    return vi.Scene.ideal(**(numbers | changes))


def fold_by_eq_21(k, d, low, high):
    """Return the ζ at which Eq. 21, quadratic in the impact speed, has a double root."""

    def discriminant(zeta):
        steep = zeta * (1 + k) / np.tan(np.pi / zeta)
        return (1 - k) ** 2 * ((d * (1 - zeta**2)) ** 2 - 1) - steep**2

    return brentq(discriminant, low, high, xtol=1e-14)
