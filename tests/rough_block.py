"""A machine of one's own: a block that falls on a rough floor and is pulled along it."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import vi_jax as vi


class Plane(eqx.Module):
    x: Any
    y: Any
    u: Any
    v: Any


def on_plane(*numbers):
    """A state: places along the floor and above it, and their rates."""
    return Plane(*(jnp.asarray(float(x)) for x in numbers))


ABOVE_AND_ALONG = (
    vi.Coordinate(lambda z: z.y, lambda z: z.v, lambda z, Y, V: Plane(z.x, Y, z.u, V)),
    vi.Coordinate(lambda z: z.x, lambda z: z.u, lambda z, Y, V: Plane(Y, z.y, V, z.v)),
)


class Block(vi.AbstractMachine):
    """A particle above a floor at y = 0, pulled along it."""

    friction: Any = 0.3
    restitution: Any = 0.0
    along: Any = 0.0
    """Tangential restitution."""
    pull: Any = 0.0
    """Amplitude of a force cos s along the floor."""
    lift: Any = 0.0
    """Amplitude of a force sin 2s up."""

    @property
    def coordinates(self):
        return ABOVE_AND_ALONG

    @property
    def contacts(self):
        floor = vi.RigidStop(0.0, self.restitution, "left")
        rubs = vi.ContactFriction(self.friction, stop=0, along=1, restitution=self.along)
        return floor, rubs

    @property
    def cycle(self):
        return 2 * jnp.pi

    def field(self, s, z):
        return Plane(z.u, z.v, self.pull * jnp.cos(s), -1 + self.lift * jnp.sin(2 * s))
