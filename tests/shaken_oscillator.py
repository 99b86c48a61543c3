"""A driven oscillator with a stop, which defines averages and quantities."""

import jax
import jax.numpy as jnp
import vi_jax as vi


class Shaken(vi.AbstractMachine):
    """The independent variable s is the phase, so that it differs from time."""

    amplitude: jax.Array | float = 1.0
    frequency: jax.Array | float = 0.8
    gap: jax.Array | float = 0.5
    restitution: jax.Array | float = 0.6

    @property
    def units(self):
        return {"taken": "W", "energy": "J", "position": "m"}

    @property
    def contacts(self):
        return (vi.RigidStop(self.gap, self.restitution),)

    cycle = 2 * jnp.pi

    def pace(self, s, state):
        return 1 / self.frequency

    def field(self, s, state):
        push = self.amplitude * jnp.cos(s) - state.Y - 0.1 * state.V
        return vi.OscillatorState(state.V / self.frequency, push / self.frequency)

    def averages(self, s, state):
        return {"taken": self.amplitude * jnp.cos(s) * state.V, "lost": 0.1 * state.V**2}

    def quantities(self, s, state):
        return {"energy": 0.5 * (state.V**2 + state.Y**2), "push": jnp.cos(s)}

    def start(self):
        return vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(0.2))
