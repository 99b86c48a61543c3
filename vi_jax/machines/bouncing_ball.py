"""A ball that bounces on a shaken table."""

from math import cos, pi
from typing import Any, ClassVar

import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, SHARE, number
from .._types import Number, Scalar
from ..machine import RigidStop, State
from ._base import ReadyMachine, number_field


class BouncingBall(ReadyMachine):
    """A ball under gravity on a table that moves as -(Γ g/ω²) cos ωt.

    The independent variable is ωt, a cycle 2π. The state is `height` and upward `speed`, relative
    to the table. The motion with one bounce in n cycles begins at Γ =
    nπ (1 - e)/(1 + e). Its period doubles at Γ² = [nπ (1 - e)/(1 + e)]² + [2 (1 + e²)/(1 + e)²]²
    (Holmes, Journal of Sound and Vibration 84, 1982; Luo and Han, Nonlinear Dynamics 10, 1996).

    **Arguments:** `acceleration` Γ, the table's largest acceleration (unit: g), not negative;
    `restitution` e in [0, 1].
    """

    acceleration: Any = number_field("acceleration", 1.2, NOT_NEGATIVE, "g")
    restitution: Any = number_field("restitution", 0.5, SHARE)
    cycle: ClassVar = 2 * pi
    quantity_units: ClassVar = {
        "height": "g/ω²", "speed": "g/ω", "rate": "ω", "time": "1/ω", "energy": "m g²/ω²",
        "power": "m g²/ω",
    }  # fmt: skip
    labels: ClassVar = ("height (g/ω²)", "speed from the table (g/ω)")  # pyright: ignore

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        return (RigidStop(0.0, self.restitution, "left", on=("height", "speed")),)

    def field(self, s: Scalar, state: Any) -> dict[str, Scalar]:
        """Return d(state)/d(ωt): free fall minus the table's acceleration."""
        return {"height": state.speed, "speed": -1 - self.acceleration * jnp.cos(s)}

    def start(self, *, height: Number = 1.0, speed: Number = 0.0) -> State:
        """Return a ball above the table at ωt = 0, when the table is lowest."""
        return State(height=number("height", height), speed=number("speed", speed))

    def sketch(self, pen: Any, state: Any, phase: float) -> None:
        radius, table = 0.3 * pen.size, -float(self.acceleration) * cos(phase)
        wide = 2.4 * pen.size
        pen.body(0.0, table - 0.15 * pen.size, width=wide, height=0.3 * pen.size, color=pen.green)
        pen.ball(0.0, table + radius + float(state.height), radius)
        pen.arrow((-0.7 * wide, 0.35 * pen.size), (-0.7 * wide, -0.35 * pen.size))
        pen.label(-0.7 * wide, 0.6 * pen.size, "$g$")
        pen.label(0.62 * wide, table, "$-\\Gamma\\,\\cos\\,\\omega t$", ha="left", color=pen.green)
