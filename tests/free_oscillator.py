"""A damped free oscillator, whose response to noise is known in closed form."""

import jax.numpy as jnp
import vi_jax as vi


class Free(vi.AbstractMachine):
    """x'' + 0.2 x' + x = σ dW, with stationary variance σ²/0.4."""

    cycle = 2 * jnp.pi

    def field(self, s, x):
        return vi.OscillatorState(x.V, -x.Y - 0.2 * x.V)
