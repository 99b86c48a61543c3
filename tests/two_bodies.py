"""Two bodies with three contacts."""

from typing import Any

import jax.numpy as jnp
import vi_jax as vi


class TwoBodies(vi.Mechanical):
    """Bodies on springs; the first one is driven. It has a stop on its right, the second on its
    left, and they hit each other at x - y = 0.4."""

    gap: Any = 0.6
    restitution: Any = 0.7
    drive: Any = 0.8
    ratio: Any = 1.0
    """Mass of the second body relative to that of the first."""
    damping: Any = 0.1
    """Damping of the first body; that of the second is 0.05."""
    q = ("x", "y")
    cycle = 2 * jnp.pi

    @property
    def mass(self):
        return 1.0, self.ratio

    @property
    def contacts(self):
        return (
            vi.RigidStop(self.gap, self.restitution, on="x"),
            vi.RigidStop(self.gap, self.restitution, "left", on="y"),
            vi.RigidStop(0.4, self.restitution, on=lambda q: q.x - q.y),
        )

    def force(self, t, q, v):
        spring = 0.5 * (q.x - q.y)
        first = self.drive * jnp.cos(t) - q.x - spring - self.damping * v.x
        return dict(x=first, y=spring - q.y - 0.05 * v.y)

    def start(self):
        return self.at(x=0.1, y=-0.1)
