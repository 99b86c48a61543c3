"""Periodic motions of machines other than the ideally driven scene: families and motors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


class Sledges(eqx.Module):
    """Positions and velocities of two bodies."""

    x: jax.Array
    v: jax.Array
    y: jax.Array
    w: jax.Array


class Coupled(vi.AbstractMachine):
    """Two bodies joined by a spring: x'' = y - x - c x' + cos s, y'' = x - y - c y' + push. Their
    mean position is arbitrary."""

    damping: jax.Array = eqx.field(default=0.3, converter=jnp.asarray)
    push: jax.Array = eqx.field(default=0.0, converter=jnp.asarray)
    cycle = 2 * np.pi

    def field(self, s, z):
        pull = z.y - z.x
        force = pull - self.damping * z.v + jnp.cos(s)
        return Sledges(z.v, force, z.w, self.push - pull - self.damping * z.w)

    def position(self, z):
        return z.x

    def velocity(self, z):
        return z.v


def sledge_speeds(damping):
    """Return both velocities at s = 0, from the responses of sum and difference."""
    both, apart = 1 / (1j + damping), 1j / (1 + 1j * damping)
    return (both + apart).real / 2, (both - apart).real / 2


@pytest.mark.exhaustive
def test_a_motion_of_arbitrary_position_is_found_near_the_guess():
    """A multiplier is 1 to rounding, so that the equations of the orbit are singular."""
    guess = Sledges(*map(jnp.asarray, (0.35, 0.1, 0.35, -0.2)))  # equal positions
    orbit = vi.find_orbit(Coupled(), guess)
    assert bool(orbit.successful) and orbit.stability == vi.STABILITY.neutral
    assert not bool(orbit.stable)
    speeds = [float(orbit.state.v), float(orbit.state.w)]
    assert speeds == pytest.approx(sledge_speeds(0.3), abs=1e-10)
    assert float(orbit.state.x + orbit.state.y) == pytest.approx(0.7, abs=1e-10)
    with pytest.raises(ValueError, match="has a multiplier of exactly 1"):
        vi.continue_orbit(orbit, parameter="damping", bounds=(0.2, 0.5))
    found = jax.jacrev(lambda c: vi.find_orbit(Coupled(c), guess).state)(jnp.asarray(0.3))
    h = 1e-6
    wanted = np.subtract(sledge_speeds(0.3 + h), sledge_speeds(0.3 - h)) / (2 * h)
    assert [float(found.v), float(found.w)] == pytest.approx(wanted, abs=1e-8)
    assert float(found.x + found.y) == pytest.approx(0, abs=1e-10)
    drifting = vi.find_orbit(Coupled(push=0.01), guess)
    assert drifting.result == vi.ORBIT_RESULTS.drifts and "drifts" in str(drifting)
