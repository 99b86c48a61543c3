"""A body on a belt with velocity-weakening friction."""

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi


def level(speed):
    return 0.5 + 0.5 * jnp.exp(-2 * speed)


class Belt(vi.AbstractMachine):
    """x'' = -x - 0.1 x' + friction of a belt at `speed`; a cycle ends at the minimum of x."""

    speed: jax.Array | float = 1.5

    @property
    def contacts(self):
        return vi.DryFriction(level, on="V", slip=lambda x: x.V - self.speed)

    cycle = vi.rising("V", usual=2 * np.pi)

    def field(self, s, x):
        return vi.OscillatorState(x.V, -x.Y - 0.1 * x.V)

    def start(self, *, Y=0.0, V=0.0):
        return vi.OscillatorState(jnp.asarray(Y, float), jnp.asarray(V, float))
