"""What is observed of a periodic motion beside its unknowns, at each point of a branch."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from .._types import Scalar, State
from ..machine import AbstractMachine, events_of, guard_of, section_number
from ._flight import Event
from ._turns import Nearest

# A distance or a speed is zero within this share of the largest of a motion: a choice, a hundred
# times the corrector's tolerance.
ROUNDING = 1e-9


class Observed(NamedTuple):
    """What is said about a solution of the equations of an orbit, at one point of a branch."""

    multipliers: Complex[Array, " states"]
    """Eigenvalues of the monodromy matrix, the largest modulus first."""
    monodromy: Float[Array, "states states"]
    """Derivative by the state just before the first event of the state a period later."""
    approach: Float[Array, " events"]
    """V⁻ at each impact, and how fast the guard rises at each other event; negative where it has
    become impossible."""
    y_min: Scalar
    """Smallest position of the first coordinate over the period."""
    y_max: Scalar
    nearest: Nearest
    """Of all its turning points; its `room` is the clearance."""
    pull: Nearest
    """Where the force on a body that rests has its least turn; that force is its `room`."""
    order: Scalar
    """1 where each switch goes into the mode that is its next one here, else -1."""
    apart: Scalar
    """How far its events are from coming in another order; see `apart`."""
    duration: Scalar
    """The period in time."""
    averages: dict[str, Scalar]
    """The machine's own, over the period."""
    largest: Float[Array, " states"]
    """The largest modulus of each number of the state over the period; NaN where not known."""
    escape: Float[Array, " landings"] | None = None
    """χ of each chatter that ends in a rest: negative as long as it does before its release."""

    @property
    def length(self) -> float:
        """How far the body goes: the scale by which distances are judged; host-side."""
        y_min, y_max = float(self.y_min), float(self.y_max)
        return max(y_max - y_min, abs(y_min), abs(y_max))

    def admissible(self, events: Sequence[int]) -> bool:
        """Whether the motion stays inside its stops and approaches each of these events;
        host-side."""
        inside = float(self.nearest.room) >= -ROUNDING * self.length
        slowest = np.asarray(self.approach)[list(events)].min(initial=0.0)
        return bool(inside and slowest >= -ROUNDING * self.fastest)

    @property
    def fastest(self) -> float:
        """How fast events are approached: the scale by which that is judged; host-side."""
        usual = 2 * np.pi * self.length / float(self.duration)
        return max(usual, np.abs(np.asarray(self.approach)).max(initial=0.0))


def apart(
    machine: AbstractMachine,
    events: tuple[Event, ...],
    modes: tuple[tuple[float, ...], ...],
    contacts: tuple[tuple[float, ...], ...],
    clock: Float[Array, " legs"],
    lengths: Float[Array, " legs"],
    states: list[State],
) -> Scalar:
    """How far the events are from coming in another order: the least time between two that follow
    each other, or the least distance, where one is met, of those that are not met there. Negative
    where the motion is none of the machine's.

    **Arguments:** `events` in their order; of each, `modes` and `contacts` of the flight that
    it begins, its `clock`, in `lengths` the time to the next one, in `states` the state just before
    it.
    """
    least = jnp.asarray(jnp.inf, clock.dtype)
    for i, event in enumerate(events):
        least = jnp.minimum(least, lengths[i])
        before, contact = (
            tuple(jnp.asarray(mode, clock.dtype) for mode in each[i - 1])
            for each in (modes, contacts)
        )
        for number, other in enumerate(events_of(machine)):
            if number == event.number or number == section_number(machine):
                continue
            if 1.0 + number in contacts[i - 1]:
                continue
            room = -guard_of(machine, number, clock[i], states[i], before, contact)
            if other.from_below:  # beyond it the motion may be, until it comes from below again
                room = jnp.where(room > 0, room, jnp.inf)
            least = jnp.minimum(least, room)
    return least
