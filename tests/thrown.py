"""A body thrown against a compliant stop."""

import jax
import jax.numpy as jnp
import vi_jax as vi

CLOSE = vi.Adaptive(rtol=1e-13, atol=1e-15)


class Thrown(vi.AbstractMachine):
    """A body without forces except for that of its stop."""

    stop: vi.SoftStop
    length: jax.Array

    @property
    def contacts(self):
        return self.stop

    @property
    def cycle(self):
        return self.length

    def field(self, s, state):
        return vi.OscillatorState(state.V, 0 * state.V)


def thrown(stop, speed, length, **options):
    """Return the run of a body that starts at zero with this speed."""
    options = {"method": CLOSE, **options}
    start = vi.OscillatorState(jnp.zeros_like(speed), speed)
    return vi.simulate(Thrown(stop, length), start, 1, **options)
