"""What the ready machines share: their fields, pairs of stops, and kinds of drive."""

import dataclasses
from collections.abc import Mapping
from math import pi
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._checks import POSITIVE, REAL, Range, number, optional_real, real, require, require_ranges
from .._types import Scalar, State
from ..machine import AbstractMachine, RigidStop


def number_field(name: str, default: float | None, allowed: Range = REAL, unit: str = "") -> Any:
    """A field of a machine that holds a real number in a range, given by keyword; where the default
    is `None`, it may be left out."""
    converter = real(name) if default is not None else optional_real(name)
    about = {"range": allowed, "unit": unit}
    return eqx.field(kw_only=True, default=default, converter=converter, metadata=about)


def stops_at(gap: Scalar, restitution: Scalar, *, two_sided: bool = True) -> tuple[RigidStop, ...]:
    """Equal stops at this distance from zero: on the right, and if two-sided then on the left."""
    sides = ("right", "left") if two_sided else ("right",)
    return tuple(RigidStop(gap, restitution, side) for side in sides)


class ReadyMachine(AbstractMachine):
    """A machine whose numbers are in their ranges; what is not in `quantity_units` and has no unit
    in its field is without."""

    quantity_units: ClassVar[Mapping[str, str]] = {}
    """The units of components of the state and of time, rates, energy and power."""

    def __check_init__(self):
        require_ranges(self)

    @property
    def units(self) -> Mapping[str, str]:
        """The units of its numbers and states."""
        return {**super().units, **self.quantity_units, "": "1"}


class PhaseMachine(ReadyMachine):
    """A machine whose independent variable is the phase of its drive."""

    @property
    def cycle(self) -> float:
        """A cycle is 2π of the drive's phase."""
        return 2 * pi


class ForcedMachine(PhaseMachine):
    """A machine shaken at an angular frequency ω, its number `frequency`, with the phase ωt as the
    independent variable."""

    frequency: eqx.AbstractVar[Scalar]

    @property
    def period(self) -> Scalar:
        """2π/ω, the time that a cycle takes."""
        return 2 * pi / self.frequency

    def pace(self, s: Scalar, state: State) -> Scalar:
        """dt/ds = 1/ω, the time that a unit of phase takes."""
        return 1 / self.frequency


class AutonomousMachine(ReadyMachine):
    """A machine without a drive, whose independent variable is time. A cycle ends where
    `event` rises through zero; if `interval` is given (positive), at
    equal times instead."""

    interval: Any = number_field("interval", None, POSITIVE, "s")

    def event(self, state: State) -> Scalar:
        """A function of the state that rises through zero once in a cycle."""
        raise NotImplementedError

    @property
    def usual(self) -> Scalar | float:
        """About how long a cycle is: steps are sized by it."""
        raise NotImplementedError

    @property
    def cycle(self) -> Scalar | float:
        """The interval between observations, or the usual time from event to event."""
        return self.usual if self.interval is None else self.interval

    def section(self, state: State) -> Scalar | None:
        """The event, unless time ends the cycles."""
        return self.event(state) if self.interval is None else None

    def step_limit(self, s: Scalar, state: State) -> Scalar | float:
        """A fifth of the usual cycle, however rarely it is observed."""
        if self.interval is None:
            return self.usual / 5
        return jnp.minimum(self.usual, self.interval) / 5

    def observed_every(self, interval: Any) -> "AutonomousMachine":
        """The same machine observed at equal intervals of time, positive.

        **Raises:** `ValueError` for an interval that is not.
        """
        require("interval", number("interval", interval), low=0.0, open_low=True)
        return dataclasses.replace(self, interval=interval)
