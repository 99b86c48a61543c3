"""A pressure relief valve that chatters on its seat without a drive."""

from math import pi
from typing import Any, ClassVar

import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, SHARE
from .._types import Scalar, State
from ..machine import RigidStop, falling
from ..machine import State as NamedState
from ._base import ReadyMachine, number_field


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

    def field(self, s: Scalar, state: State) -> dict[str, Scalar]:
        spring = state.lift + self.precompression
        force = state.pressure - self.damping * state.speed - spring
        outflow = state.lift * jnp.sqrt(state.pressure)
        rate = self.compressibility * (self.flow_rate - outflow)
        return dict(lift=state.speed, speed=force, pressure=rate)

    def relaxation(self, s: Scalar, state: State) -> Scalar:
        """Return the shorter time constant, of the motion or of the pressure."""
        outflow_rate = self.compressibility * jnp.abs(state.lift) / (2 * jnp.sqrt(state.pressure))
        return 1 / jnp.maximum(jnp.maximum(self.damping, outflow_rate), 1e-6)

    def start(self, *, lift: Any = 1.0, speed: Any = 0.0, pressure: Any = 12.0) -> Any:
        """Return a state; by default an open valve whose lift begins to decrease."""
        return NamedState(lift=lift, speed=speed, pressure=pressure)
