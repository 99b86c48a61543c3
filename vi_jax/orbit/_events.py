"""The events of a periodic motion, in their order: the unknowns of `Shooting` belong to them."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from .._types import Scalar, State
from ..machine import (
    AbstractEvent,
    AbstractMachine,
    SoftStop,
    events_of,
    guard_of,
    section_number,
)


class Event(NamedTuple):
    """One of the machine's events, met in the course of a periodic motion."""

    number: int
    """Its place among the machine's events, in the order of `events_of(machine)`."""
    cycle: int | None = None
    """The number, from 0, of the cycle of the period that begins with it; `None` if none does."""

    def called(self, machine: AbstractMachine) -> str:
        """What messages call it: its name, or its kind and place among the machine's events of
        that kind."""
        event, events = self.of(machine), events_of(machine)
        if isinstance(event, SoftStop):
            return event.name or f"{event.side} soft stop"
        place = sum(other.word == event.word for other in events[: self.number])
        return event.name or f"{event.word} {place}"

    def later(self, cycles: int) -> "Event":
        """The same event so many cycles later in the motion."""
        return self if self.cycle is None else self._replace(cycle=self.cycle + cycles)

    def of(self, machine: AbstractMachine) -> AbstractEvent:
        """The machine's event of this number."""
        return events_of(machine)[self.number]


def section_of(machine: AbstractMachine, cycle: int) -> Event:
    """The section with which a cycle begins."""
    return Event(section_number(machine), cycle)


def guard_at(
    machine: AbstractMachine, event: Event, s: Scalar, state: State, modes: tuple[Array, ...]
) -> Scalar:
    """The guard of an event in the course of a motion, zero there and rising.

    **Arguments:** `s`, the clock since the beginning of the period; `state` and `modes`, those
    before the event.
    """
    if event.cycle is not None:
        s = s - jnp.asarray(machine.cycle, s.dtype) * (event.cycle - 1)
    return guard_of(machine, event.number, s, state, modes)
