"""The parts of a machine, for this package: stops and switches by coordinate, modes, its clock."""

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import jax.numpy as jnp

from .._types import Machine, Scalar, State


def declared_modes(machine: Any) -> Mapping[str, Any]:
    """Return the initial discrete modes, by name, that the machine's class defines."""
    modes = machine.modes
    return modes if isinstance(modes, Mapping) else {}  # for a beam `modes` is a number of modes


def has_own_modes(machine: Any) -> bool:
    """Return whether a machine defines discrete modes."""
    return bool(declared_modes(machine)) or callable(machine.modes)


# The members of a machine that only this package uses. Rigid stops are in the order in which logs
# number them; switches are the parts with a mode: soft stops, frictions, switches.
stops_of, switches_of, others_of = map(attrgetter, ("_stops", "_switches", "_others"))


def events_of(machine: Machine) -> tuple[Any, ...]:
    """Return all events by number: stops, switches, other events, and the section."""
    return (*stops_of(machine), *switches_of(machine), *others_of(machine), machine._end)


def mode_number(machine: Machine, number: int) -> int:
    """Return the index of an event's mode among the machine's modes."""
    return sum(event.holds_mode for event in events_of(machine)[:number])


def limited_in(machine: Machine) -> list[int]:
    """Return the numbers of the coordinates that stops limit."""
    return sorted({stop.coordinate for stop in stops_of(machine)})


def stops_on(machine: Machine, k: int) -> list[int]:
    """Return the numbers of the stops that limit coordinate number k."""
    return [i for i, stop in enumerate(stops_of(machine)) if stop.coordinate == k]


def chosen_stop(machine: Machine, k: int, chosen: Mapping[int, Any], contact: Any) -> Any:
    """Return the contact of coordinate number k (as in `EventContext`) with that of its stops that
    is `chosen`; else `contact`."""
    for i in stops_on(machine, k):
        contact = jnp.where(chosen[i], 1.0 + i, contact)
    return contact


def at_stop(
    machine: Machine, k: int, contact: Any, value_of: Callable[[Any], Any], value: Any = None
) -> Any:
    """Return `value_of` of the stop in `contact` (as in `EventContext`) of coordinate number k. If
    the coordinate touches no stop, return `value`, by default that of its first stop."""
    numbers, stops = stops_on(machine, k), stops_of(machine)
    if value is None:
        value, numbers = value_of(stops[numbers[0]]), numbers[1:]
    for i in numbers:
        value = jnp.where(contact == 1.0 + i, value_of(stops[i]), value)
    return value


def friction_on(machine: Machine, number: int) -> Any:
    """Return the friction on stop number `number`, or `None`."""
    return next((x for x in switches_of(machine) if x.friction_stop == number), None)


def clock_of(machine: Machine, state: State) -> Scalar | None:
    """Return the component of the state that counts cycles; `None` if `s` does."""
    return machine._clock(state)


def with_earlier_clock(machine: Machine, state: State) -> State:
    """Return the state with its clock, or the angle of `turn_of`, set back by one cycle."""
    return machine._with_earlier_clock(state)


def section_in(machine: Machine, state: State) -> Scalar | None:
    """Return the function that rises through zero at the end of a cycle (see `rising` and
    `turn_of`); `None` if `s`, a clock or an event ends cycles."""
    return machine._section(state)


def outcomes_of(machine: Machine) -> tuple[str, ...]:
    """Return the names of the outcomes with which events and stops of a machine end a motion."""
    events = (*switches_of(machine), *others_of(machine), *stops_of(machine))
    return tuple(dict.fromkeys(x.ends for x in events if x.ends))
