"""A body on a belt whose friction falls with the speed of sliding, for several packages' tests."""

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi


def level(speed):
    return 0.5 + 0.5 * jnp.exp(-2 * speed)


class Belt(vi.AbstractMachine):
    """x'' = -x - 0.1 x' + friction of a belt that runs at `speed`; a cycle ends where the body is
    furthest back."""

    speed: jax.Array | float = 1.5

    @property
    def contacts(self):
        return vi.DryFriction(level, on="V", slip=lambda x: x.V - self.speed)

    @property
    def cycle(self):
        return 2 * np.pi

    def section(self, state):
        return state.V

    def field(self, s, x):
        return vi.OscillatorState(x.V, -x.Y - 0.1 * x.V)


class Observed(Belt):
    """Also at equal intervals, and with starts."""

    every: jax.Array | float | None = None

    @property
    def cycle(self):
        return 2 * np.pi if self.every is None else self.every

    def section(self, state):
        return state.V if self.every is None else None

    def observed_every(self, interval):
        return type(self)(self.speed, every=jnp.asarray(interval))

    def start(self, *, Y=0.0, V=0.0):
        return vi.OscillatorState(jnp.asarray(Y, float), jnp.asarray(V, float))
