"""What is seen of a periodic motion, its events' distance from another order among it."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ..machine import AbstractMachine
from ..machine.event import events_of, guard_of, section_number
from ._events import Event


class Observed(NamedTuple):
    """What is said about a solution."""

    multipliers: Complex[Array, " states"]
    monodromy: Float[Array, "states states"]
    approach: Float[Array, " events"]
    """V⁻ at each impact, and how fast the guard rises at each other event; negative where it has
    become impossible."""
    y_min: Float[Array, ""]
    y_max: Float[Array, ""]
    clearance: Float[Array, ""]
    """Distance to the stop at the turn nearest to one, or of another guard below zero where it is
    greatest; negative where it is passed through."""
    touch: Float[Array, ""]
    """Clock of that turn."""
    touched: Float[Array, ""]
    """The number of that event."""
    order: Float[Array, ""]
    """1 where each switch goes into the mode that is its next one here, else -1."""
    apart: Float[Array, ""]
    """How far its events are from coming in another order; see `apart`."""
    duration: Float[Array, ""]
    averages: dict[str, Float[Array, ""]]
    """The machine's own, over the period."""


def apart(
    machine: AbstractMachine,
    events: tuple[Event, ...],
    modes: tuple[tuple[float, ...], ...],
    clock: Float[Array, " legs"],
    lengths: Float[Array, " legs"],
    states: list[Any],
) -> Float[Array, ""]:
    """How far the events are from coming in another order: the least time between two that follow
    each other, or the least distance, where one is met, of those that are not met there. Negative
    where the motion is none of the machine's.

    **Arguments:** the machine; its events in their order, the modes of the flight that each begins,
    its clock, the time to the next one, and the state just before it.
    """
    least = jnp.asarray(jnp.inf, clock.dtype)
    for i, event in enumerate(events):
        least = jnp.minimum(least, lengths[i])
        before = tuple(jnp.asarray(mode, clock.dtype) for mode in modes[i - 1])
        for number, other in enumerate(events_of(machine)):
            if number == event.number or number == section_number(machine):
                continue
            room = -guard_of(machine, number, clock[i], states[i], before)
            if other.from_below:  # beyond it the motion may be, until it comes from below again
                room = jnp.where(room > 0, room, jnp.inf)
            least = jnp.minimum(least, room)
    return least
