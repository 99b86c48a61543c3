"""Planar rigid bodies whose corners touch a floor with friction."""

from typing import Any

import jax.numpy as jnp
import vi_jax as vi


class Block(vi.Mechanical):
    """A block on a floor at y = 0, with two corners; θ is positive counterclockwise."""

    half_width: Any = 0.2
    half_height: Any = 0.5
    mu: Any = 0.3
    restitution: Any = 0.0
    push: Any = 0.0
    """A force along the floor."""
    at_height: Any = 0.0
    """The height above the centre at which it acts."""
    weight: Any = 9.81
    cycle: Any = 0.2
    q = ("x", "y", "tilt")

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        return 1.0, 1.0, (self.half_width**2 + self.half_height**2) / 3

    @property
    def places(self):
        return dict(left=-self.half_width, right=self.half_width)

    @property
    def contacts(self):
        h, found = self.half_height, []
        for name, b in self.places.items():
            height = lambda q, b=b: q.y + b * jnp.sin(q.tilt) - h * jnp.cos(q.tilt)
            place = lambda q, b=b: q.x + b * jnp.cos(q.tilt) + h * jnp.sin(q.tilt)
            rubs = dict(friction=self.mu, along=place, name=name)
            found.append(vi.RigidStop(0.0, self.restitution, "left", on=height, **rubs))
        return tuple(found)

    def force(self, t, q, v):
        turn = -self.push * self.at_height * jnp.cos(q.tilt)
        return dict(x=self.push, y=-self.weight, tilt=turn)

    def start(self):
        return self.at(y=self.half_height)

    def energy(self, z):
        own = sum(m * w**2 for m, w in zip(self.mass(z), (z.v.x, z.v.y, z.v.tilt), strict=True))
        return 0.5 * own + self.weight * z.y


class Rod(vi.Mechanical):
    """A rod of length 2 and mass 1, whose lower end is on a floor; θ is its angle to the floor."""

    mu: Any = 0.3
    restitution: Any = 0.0
    weight: Any = 9.81
    cycle: Any = 0.02
    inertia: Any = 1 / 3
    q = ("x", "y", "theta")

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        return 1.0, 1.0, self.inertia

    @property
    def contacts(self):
        tip = lambda q: q.x - jnp.cos(q.theta)
        height = lambda q: q.y - jnp.sin(q.theta)
        rubs = dict(friction=self.mu, along=tip)
        return vi.RigidStop(0.0, self.restitution, "left", on=height, **rubs)

    def force(self, t, q, v):
        return dict(x=0.0, y=-self.weight, theta=0.0)

    def sliding(self, theta, slip, turning):
        """Return the state in which the tip slides on the floor."""
        s, c = jnp.sin(theta), jnp.cos(theta)
        speeds = dict(x=slip - turning * s, y=turning * c, theta=turning)
        return self.at(y=s, theta=theta, v=speeds)

    def energy(self, z):
        own = z.v.x**2 + z.v.y**2 + self.inertia * z.v.theta**2
        return 0.5 * own + self.weight * z.y
