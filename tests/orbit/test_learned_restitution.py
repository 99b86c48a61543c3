"""Orbits differentiated by the weights of a network that is their restitution law."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from jax.flatten_util import ravel_pytree

from shaken_oscillator import Shaken


class Learned(Shaken):
    """Its restitution is a network of the speed of approach, between 0 and 1."""

    network: eqx.nn.MLP | None = None

    @property
    def stops(self):
        network = self.network
        assert network is not None
        return (vi.RigidStop(self.gap, Law(network)),)


class Law(eqx.Module):
    network: eqx.nn.MLP

    def __call__(self, v):
        return jax.nn.sigmoid(self.network(v))


@pytest.mark.exhaustive
def test_gradient_by_the_weights_of_a_restitution_law():
    """State, impact speed, extreme, average and multiplier at once, beside differences."""
    network = eqx.nn.MLP("scalar", "scalar", 8, 2, jnp.tanh, key=jax.random.key(0))
    weights, static = eqx.partition(network, eqx.is_inexact_array)

    def orbit_of(weights):
        machine = Learned(network=eqx.combine(weights, static))
        return vi.find_orbit(machine, guess, method=vi.FixedStep())

    def outputs(weights):
        orbit = orbit_of(weights)
        state = jnp.stack([orbit.state.Y, orbit.state.V])
        rest = [orbit.y_min, orbit.averages["taken"], jnp.abs(orbit.multipliers[0])]
        return jnp.concatenate([state, orbit.impact_speed.ravel()[:1], jnp.stack(rest)])

    machine = Learned(network=network)
    guess = vi.simulate(machine, machine.start(), 1, settle=100, method=vi.FixedStep()).last
    assert bool(orbit_of(weights).successful)
    values = vi.jit(outputs)
    shares = jnp.asarray([1.0, -0.7, 0.5, 0.3, 2.0, 0.4])
    gradient = vi.jit(jax.grad(lambda w: shares @ outputs(w)))(weights)
    slopes = np.concatenate([np.ravel(x) for x in jax.tree.leaves(gradient)])
    assert slopes.size == 97 and np.isfinite(slopes).all() and np.abs(slopes).max() > 1e-2
    flat, unflatten = ravel_pytree(weights)
    for key in jax.random.split(jax.random.key(1), 3):
        direction = jax.random.normal(key, flat.shape)
        direction = direction / jnp.linalg.norm(direction)

        def along(h, direction=direction):
            return float(shares @ values(unflatten(flat + h * direction)))

        h = 1e-3
        differences = (8 * (along(h) - along(-h)) - along(2 * h) + along(-2 * h)) / (12 * h)
        expected = float(slopes @ np.asarray(direction))
        # Measured: 1e-8 of the gradient's length, the search's own tolerance over 2h.
        assert abs(differences - expected) < 1e-7 * np.linalg.norm(slopes)
