"""Motions with one impact in closed form, compiled once for the tests that ask for them."""

import jax
import vi_jax as vi
from vi_jax.orbit.closed_form import one_impact_orbits

FIELDS = ("Y", "V", "impact_phase", "impact_speed", "y_min", "y_max", "clearance")
solve = jax.jit(one_impact_orbits, static_argnums=4)


def ideal(**changes):
    numbers = {"frequency_ratio": 0.9, "restitution": 0.5, "gap": 2.0, "damping_ratio": 0.0}
    return vi.Scene.ideal(**(numbers | changes))
