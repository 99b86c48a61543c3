"""A body thrown against a compliant stop, for the tests of stops and of laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi

CLOSE = vi.Adaptive(rtol=1e-13, atol=1e-15)


class Body(eqx.Module):
    Y: jax.Array
    V: jax.Array


class Thrown(vi.AbstractMachine):
    """A body on which nothing acts but its stop."""

    stop: vi.SoftStop
    length: jax.Array
    stops: tuple = ()

    @property
    def switches(self):
        return (self.stop,)

    @property
    def cycle(self):
        return self.length

    def field(self, s, state, mode):
        return Body(state.V, self.stop.contribution(self, s, state, mode))

    def step_limit(self, s, state):
        return jnp.minimum(self.length / 5, self.stop.longest_step(self, state))


def thrown(stop, speed, length, **options):
    """The run of a body that starts from zero."""
    options = {"method": CLOSE, **options}
    start = Body(jnp.zeros_like(speed), speed)
    return vi.simulate(Thrown(stop, length), start, 1, **options)
