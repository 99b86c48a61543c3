"""A machine's contacts and events, sorted into what a step asks for.

A user lists contacts (rigid and soft stops, dry friction) and events (switches, resets, kinds of
one's own), each with the coordinate that it acts on. A step asks for the stops, for the switches,
for the other events, and for the coordinates that stops limit, by number.
"""

import functools
from collections.abc import Callable
from typing import Any

try:
    from jax.extend.core import get_opaque_trace_state
except ImportError:  # JAX 0.9
    from jax.core import get_opaque_trace_state  # pyright: ignore

from .._types import Machine
from .coordinates import Coordinate
from .cycles import Turn, counter_of
from .event import AbstractEvent, AbstractSwitch
from .friction import ContactFriction
from .own import says, with_static
from .soft import SoftStop
from .stop import RigidStop
from .user_events import Reset


def listed(parts: object) -> tuple[Any, ...]:
    """Contacts or events as a tuple, of which one may be given without."""
    single = isinstance(parts, AbstractEvent)
    return (parts,) if single else tuple(parts) if isinstance(parts, list) else parts  # pyright: ignore


def once_a_trace(found: Callable[[Machine], Any]) -> Callable[[Machine], Any]:
    """A function of a machine that is called once while JAX traces a function. A step asks for the
    parts of a machine some hundred times, and each of a user's contacts takes a millisecond."""

    @functools.wraps(found)
    def kept(machine: Machine) -> Any:
        trace, memory = get_opaque_trace_state(), vars(machine).setdefault(MEMORY, {})
        known = memory.get(found)
        if known is None or known[0] != trace:
            known = memory[found] = trace, found(machine)
        return known[1]

    return kept


# Where a machine keeps what `once_a_trace` found; it is no field, and no part of a copy.
MEMORY = "_found_in_a_trace"


@once_a_trace
def contacts_in(machine: Machine) -> tuple[Any, ...]:
    """The contacts that a machine lists."""
    return listed(machine.contacts)


@once_a_trace
def stops_in(machine: Machine) -> tuple[RigidStop, ...]:
    """The rigid stops among a machine's contacts."""
    contacts = contacts_in(machine)
    places = _places(contacts)
    return tuple(_at(x, places) for x in contacts if isinstance(x, RigidStop))


@once_a_trace
def switches_in(machine: Machine) -> tuple[AbstractSwitch, ...]:
    """The soft stops and frictions among a machine's contacts, which act by themselves, and the
    switches among its events."""
    contacts, found, number = contacts_in(machine), [], 0
    places = _places(contacts)
    for x in contacts:
        if isinstance(x, RigidStop):
            if x.friction is not None:
                found.append(with_static(_friction_on(x, number, places), acts=True))
            number += 1
        elif isinstance(x, AbstractSwitch):
            found.append(with_static(_at(x, places) if isinstance(x, SoftStop) else x, acts=True))
    return *found, *(x for x in listed(machine.events) if isinstance(x, AbstractSwitch))


@once_a_trace
def other_events(machine: Machine) -> tuple[AbstractEvent, ...]:
    """The events of a machine that are no switches, and the turn that ends its cycles."""
    found = []
    for event in listed(machine.events):
        if not isinstance(event, AbstractSwitch):
            found += event.one_way() if isinstance(event, Reset) else (event,)
    counter = counter_of(machine)
    return (*found, counter.event()) if isinstance(counter, Turn) else tuple(found)


def coordinates_in(machine: Machine) -> tuple[Coordinate, ...]:
    """The coordinates on which a machine's contacts act, in the order of `_places`."""
    contacts = contacts_in(machine)
    stops = [x for x in contacts if isinstance(x, RigidStop | SoftStop) and x.mass is not None]
    masses = {x.on: x.mass for x in reversed(stops)}
    return tuple(machine._coordinate_on(on, masses.get(on)) for on in _places(contacts))


def _places(contacts: tuple[Any, ...]) -> dict[Any, int]:
    """The number of each coordinate by what names it: those of rigid stops, of soft ones, then
    those along which rigid ones rub."""
    rigid = [x for x in contacts if isinstance(x, RigidStop)]
    named = [x.on for x in rigid] + [x.on for x in contacts if isinstance(x, SoftStop)]
    named += [x.along for x in rigid if x.friction is not None]
    return {on: i for i, on in enumerate(dict.fromkeys(named or [None]))}


def number_on(machine: Machine, name: str) -> int | None:
    """The number of the coordinate that contacts name so, as one or by its position; `None` if no
    contact acts on it."""
    for on, number in _places(contacts_in(machine)).items():
        if on == name or (isinstance(on, tuple) and on[0] == name):
            return number
    return None


def names_on(machine: Machine, number: int) -> tuple[str, str] | None:
    """The names in the state of the position and the velocity of a coordinate, by its number;
    `None` where contacts do not name it by them."""
    if says(machine, "coordinates"):
        return None
    on = next((on for on, k in _places(contacts_in(machine)).items() if k == number), None)
    return machine._names_on(on)


def _at(stop: Any, places: dict[Any, int]) -> Any:
    """A stop with the number of its coordinate."""
    if stop.on is None and stop.coordinate:
        return stop
    return with_static(stop, coordinate=places[stop.on])


def _friction_on(stop: RigidStop, number: int, places: dict[Any, int]) -> ContactFriction:
    rebound = stop.tangential_restitution
    return ContactFriction(
        stop.friction,
        stop=number,
        along=places[stop.along],
        restitution=0.0 if rebound is None else rebound,
    )
