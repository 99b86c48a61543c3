"""The outcome of a grazing for a machine whose state is an array."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


class InOneArray(eqx.Module):
    z: jax.Array  # position and velocity


class Shaken(vi.AbstractMachine):
    gap: jax.Array | float = 1.2

    @property
    def contacts(self):
        return (vi.RigidStop(self.gap, 0.76),)

    cycle = 2 * np.pi / 0.31

    def position(self, state):
        return state.z[0]

    def velocity(self, state):
        return state.z[1]

    def placed(self, state, Y, V):
        return InOneArray(jnp.stack([Y, V]))

    def field(self, s, state):
        Y, V = state.z
        return InOneArray(jnp.stack([V, jnp.cos(0.31 * s) - Y - 0.5 * V]))


@pytest.mark.slow
def test_forecast_and_simulation_agree_for_an_array_state():
    """The motion without impacts has amplitude 1/√((1 - ω²)² + (2ξω)²). This is the gap at the
    grazing; the second derivative of a touch is ω² times the amplitude."""
    orbit = vi.find_orbit(Shaken(), InOneArray(jnp.zeros(2)), throw=True)
    branch = vi.continue_orbit(orbit, parameter="gap", bounds=(1.0, 1.25))
    (point,) = (p for p in branch.special if p.kind == "grazing" and p.impact is None)
    found = vi.grazing(point)
    amplitude = 1 / np.hypot(1 - 0.31**2, 0.5 * 0.31)
    assert found.value == pytest.approx(amplitude, abs=1e-10)
    assert found.rate[0] == pytest.approx(0.31**2 * amplitude, abs=1e-9)
    assert found.checked is not None and found.agreement > 0.9
    assert found.machine.position.shape[0] == 97
