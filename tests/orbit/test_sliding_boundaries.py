"""A curve in two parameters along which a surface that slides is touched, beside a closed form."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from rough_floor import Rough

pytestmark = pytest.mark.slow


class Belted(Rough):
    """The same body on a belt, which runs faster than the body as long as it slips."""

    belt: Any = 2.0

    @property
    def contacts(self):
        return vi.DryFriction(self.level, on="V", mass=self.omega, slip=lambda x: x.V - self.belt)


def test_grazing_sliding_of_a_linear_motion():
    """As long as it slips, friction is constant and x' swings by ω/|1 - ω² + iδω|: the belt is just
    reached where it runs as fast."""
    damping = 0.3

    def reached(omega):
        return omega / np.hypot(1 - omega**2, damping * omega)

    machine = Belted(omega=0.75, level=0.2, damping=damping, belt=1.1 * reached(0.75))
    start = vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(0.0))
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 1, settle=200).last, throw=True)
    bounds = (0.2, 5.0)
    branch = vi.continue_orbit(orbit, parameter="belt", bounds=bounds, progress=False)
    (point,) = branch.special
    assert point.kind == "grazing-sliding" and point.touches
    assert point.parameter == pytest.approx(reached(0.75), abs=1e-10)
    curve = vi.boundary(point, parameter="omega", bounds=(bounds, (0.4, 1.6)))
    assert curve.kind == "grazing-sliding" and len(curve.parameters) > 10
    belt, omega = curve.parameters.T
    assert np.ptp(omega) == pytest.approx(1.2)
    np.testing.assert_allclose(belt, reached(omega), rtol=1e-9)
