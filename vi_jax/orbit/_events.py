"""The events of a periodic motion, in their order."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from ..machine import AbstractEvent, AbstractMachine
from ..machine.event import events_of, guard_of, section_number


class Event(NamedTuple):
    """What begins a flight: one of the machine's events."""

    number: int
    """By which it goes among the machine's events, in the order of `events_of(machine)`."""
    cycle: int | None = None
    """Number of the cycle that it begins, if it begins one."""

    def called(self, machine: AbstractMachine) -> str:
        """What messages call it: its name, or its kind and place among the machine's events of
        that kind."""
        event, events = self.of(machine), events_of(machine)
        place = sum(other.word == event.word for other in events[: self.number])
        return event.name or f"{event.word} {place}"

    def later(self, cycles: int) -> "Event":
        """The same so many cycles later."""
        return self if self.cycle is None else self._replace(cycle=self.cycle + cycles)

    def of(self, machine: AbstractMachine) -> AbstractEvent:
        """The machine's event of this number."""
        return events_of(machine)[self.number]


def section_of(machine: AbstractMachine, cycle: int) -> Event:
    """The section with which a cycle begins."""
    return Event(section_number(machine), cycle)


def guard_at(machine: AbstractMachine, event: Event, s: Any, state: Any, modes: Any) -> Any:
    """What is zero at an event, and rises there; `s` counts from the first cycle on."""
    if event.cycle is not None:
        s = s - jnp.asarray(machine.cycle, s.dtype) * (event.cycle - 1)
    return guard_of(machine, event.number, s, state, modes)
