"""A machine of one's own with several impacting coordinates, for the tests of several packages."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import vi_jax as vi


class Pair(eqx.Module):
    x1: jax.Array
    v1: jax.Array
    x2: jax.Array
    v2: jax.Array


class TwoBodies(vi.AbstractMachine):
    """Two bodies on springs, the first shaken: it has a wall on its right, the second one on its
    left, and they hit each other where they are 0.4 apart."""

    gap: Any = 0.6
    restitution: Any = 0.7
    force: Any = 0.8
    ratio: Any = 1.0
    """Mass of the second over that of the first."""
    damping: Any = 0.1
    """Of the first; that of the second is 0.05."""

    @property
    def contacts(self):
        return (
            vi.RigidStop(self.gap, self.restitution),
            vi.RigidStop(self.gap, self.restitution, "left", coordinate=1),
            vi.RigidStop(0.4, self.restitution, coordinate=2),
        )

    @property
    def coordinates(self):
        share = self.ratio / (1 + self.ratio)  # of what they gain relative to each other

        def met(x, Y, V):
            far, fast = Y - (x.x1 - x.x2), V - (x.v1 - x.v2)
            return Pair(
                x.x1 + share * far, x.v1 + share * fast,
                x.x2 - (1 - share) * far, x.v2 - (1 - share) * fast,
            )  # fmt: skip

        return (
            vi.Coordinate(lambda x: x.x1, lambda x: x.v1, lambda x, Y, V: Pair(Y, V, x.x2, x.v2)),
            vi.Coordinate(
                lambda x: x.x2, lambda x: x.v2, lambda x, Y, V: Pair(x.x1, x.v1, Y, V), self.ratio
            ),
            vi.Coordinate(lambda x: x.x1 - x.x2, lambda x: x.v1 - x.v2, met, share),
        )

    @property
    def cycle(self):
        return 2 * jnp.pi

    def position(self, x):
        return x.x1

    def velocity(self, x):
        return x.v1

    def field(self, s, x):
        spring = 0.5 * (x.x1 - x.x2)
        first = self.force * jnp.cos(s) - x.x1 - spring - self.damping * x.v1
        return Pair(x.v1, first, x.v2, (spring - x.x2 - 0.05 * x.v2) / self.ratio)

    def start(self):
        return Pair(*map(jnp.asarray, (0.1, 0.0, -0.1, 0.0)))
