"""A body with dry friction, and a block on a floor."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import vi_jax as vi


class Rubbing(vi.AbstractMachine):
    """x'' = force(machine, s, x) - level · load(machine, s, x) · friction."""

    force: Callable = eqx.field(static=True)
    level: Any = 1.0
    numbers: dict[str, Any] = eqx.field(default_factory=dict)
    load: Callable | None = eqx.field(static=True, default=None)
    cycle: float = 2 * np.pi

    @property
    def contacts(self):
        return vi.DryFriction(self.level, on="V", load=self.load)

    def field(self, s, x):
        return vi.OscillatorState(x.V, self.force(self, s, x))


class Block(vi.Mechanical):
    """A particle above a floor at y = 0, pulled along it."""

    friction: Any = 0.3
    restitution: Any = 0.0
    tangential: Any = 0.0
    pull: Any = 0.0
    """Amplitude of a force cos t along the floor."""
    lift: Any = 0.0
    """Amplitude of an upward force sin 2t."""
    weight: Any = 1.0
    q = ("x", "y")
    cycle = 2 * jnp.pi

    @property
    def contacts(self):
        rubs = dict(friction=self.friction, along="x", tangential_restitution=self.tangential)
        return vi.RigidStop(0.0, self.restitution, "left", on="y", **rubs)

    def mass(self, q):
        return self.weight, self.weight

    def force(self, t, q, v):
        up = -1 + self.lift * jnp.sin(2 * t)
        return dict(x=self.weight * self.pull * jnp.cos(t), y=self.weight * up)
