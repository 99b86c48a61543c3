"""Stops: rigid walls that the body may hit."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .._checks import REAL, SHARE, number, one_of, require_ranges


class RigidStop(eqx.Module):
    """A rigid wall with Newton's restitution law: at contact and approaching, V ← -k V.

    A stop on the right keeps Y ≤ gap, one on the left keeps Y ≥ -gap. The gap may be zero or
    negative (a body pressed on); the restitution is in [0, 1], both ends included.
    """

    gap: Float[Array, "..."] = eqx.field(converter=lambda x: number("gap", x))
    """d, distance of the stop from the unstretched position (unit: a)."""
    restitution: Float[Array, "..."] = eqx.field(converter=lambda x: number("restitution", x))
    """k, coefficient of restitution (dimensionless)."""
    side: str = eqx.field(static=True, default="right")
    """"right" or "left"."""
    ranges: ClassVar = {"gap": REAL, "restitution": SHARE}

    def __check_init__(self):
        require_ranges(self)
        one_of("side", self.side, ("right", "left"))

    @property
    def sign(self) -> int:
        """+1 on the right, -1 on the left: the body is inside while sign·Y ≤ gap."""
        return 1 if self.side == "right" else -1
