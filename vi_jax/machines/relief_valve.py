"""A pressure relief valve that chatters on its seat without a drive."""

from math import pi
from typing import Any, ClassVar

import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, SHARE, number
from .._types import Number, Scalar
from ..machine import RigidStop, Shown, falling
from ._base import ReadyMachine, number_field


class ValveState(Shown):
    """The valve's body and the vessel under it; dimensionless, as the numbers of `ReliefValve`."""

    ranges: ClassVar = {"pressure": POSITIVE}

    lift: Scalar
    """Distance of the body from its seat (dimensionless)."""
    speed: Scalar
    """Speed of the body, positive when the valve opens."""
    pressure: Scalar
    """Pressure in the vessel above the ambient one; positive."""


class ReliefValve(ReadyMachine):
    """A vessel filled at a steady rate, and the valve that relieves it: a body on a spring that the
    pressure lifts off its seat.

        lift'' = pressure - κ lift' - (lift + δ),    pressure' = β (q - lift √pressure)

    with impacts on the seat at lift = 0 (Hős and Champneys, Physica D 241, 2012). It has no drive:
    a cycle ends at the greatest lift (the speed falls through zero), after a varying time. Above
    q = 8.491 (with the other defaults) the open valve stands still, without a next cycle. Observe
    it at equal times then, by `observed_every`.

    **Arguments:** `flow_rate` q, positive; `damping` κ, `precompression` δ of the spring, both not
    negative; `compressibility` β, positive; `restitution` r on the seat, in [0, 1].
    """

    flow_rate: Any = number_field("flow_rate", 3.0, POSITIVE)
    damping: Any = number_field("damping", 1.25, NOT_NEGATIVE)
    precompression: Any = number_field("precompression", 10.0, NOT_NEGATIVE)
    compressibility: Any = number_field("compressibility", 20.0, POSITIVE)
    restitution: Any = number_field("restitution", 0.8, SHARE)
    cycle: ClassVar = falling("speed", usual=pi / 2)  # cycles take between 0.5 and 3 units of time
    labels: ClassVar = ("lift", "speed of opening")  # pyright: ignore
    units: ClassVar = {"": "1"}  # pyright: ignore

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        return (RigidStop(0.0, self.restitution, "left", on=("lift", "speed")),)

    def field(self, s: Scalar, state: ValveState) -> ValveState:
        spring = state.lift + self.precompression
        force = state.pressure - self.damping * state.speed - spring
        outflow = state.lift * jnp.sqrt(state.pressure)
        return ValveState(state.speed, force, self.compressibility * (self.flow_rate - outflow))

    def relaxation(self, s: Scalar, state: ValveState) -> Scalar:
        """Return the shorter time constant, of the motion or of the pressure."""
        outflow_rate = self.compressibility * jnp.abs(state.lift) / (2 * jnp.sqrt(state.pressure))
        return 1 / jnp.maximum(jnp.maximum(self.damping, outflow_rate), 1e-6)

    def start(
        self, *, lift: Number = 1.0, speed: Number = 0.0, pressure: Number = 12.0
    ) -> ValveState:
        """Return a state; by default an open valve whose lift begins to decrease."""
        return ValveState(
            number("lift", lift), number("speed", speed), number("pressure", pressure)
        )
