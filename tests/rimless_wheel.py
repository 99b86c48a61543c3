"""A rimless wheel that walks down a slope."""

import jax.numpy as jnp
import numpy as np
import vi_jax as vi

ALPHA = 0.3
"""Half the angle between two spokes."""

MULTIPLIER = np.cos(2 * ALPHA) ** 2
"""Multiplier of a step at any slope: the part of the energy that is left after a heel strike."""


class Wheel(vi.AbstractMachine):
    """An inverted pendulum; a step ends when the next spoke touches the ground."""

    slope: float = 0.08

    cycle = vi.rising(lambda m, z: z.Y - m.slope - ALPHA, usual=1.4)

    def renewed(self, state):
        return vi.OscillatorState(state.Y - 2 * ALPHA, jnp.cos(2 * ALPHA) * state.V)

    def field(self, s, state):
        return vi.OscillatorState(state.V, jnp.sin(state.Y))

    def start(self):
        return vi.OscillatorState(jnp.array(self.slope - ALPHA), jnp.array(0.5))
