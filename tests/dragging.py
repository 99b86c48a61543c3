"""A driven pendulum that strikes a stop, or is pressed on it, and drags a stiffening spring."""

import jax.numpy as jnp
import numpy as np
import vi_jax as vi


class Dragging(vi.Mechanical):
    amplitude: float
    frequency: float
    gap: float
    restitution: float
    push: float = 0.0
    second: float = 0.0
    """The second harmonic of the drive, relative to the first."""
    q, mass = ("x", "y"), (1.0, 0.6)

    @property
    def cycle(self):
        return 2 * np.pi / self.frequency

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, self.restitution, on="x")

    def force(self, t, q, v):
        turn, spring = self.frequency * t, 0.35 * (q.x - q.y) + 0.04 * (v.x - v.y)
        push = self.push + self.amplitude * (jnp.cos(turn) + self.second * jnp.sin(2 * turn))
        return dict(
            x=push - jnp.sin(q.x) - 0.08 * v.x - spring,
            y=spring - 0.9 * q.y - 0.3 * q.y**3 - 0.05 * v.y,
        )
