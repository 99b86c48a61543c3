"""Where a step leads, while what it met is applied."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Flag, Scalar, Scalars, State
from .beside import Beside


class Tally(NamedTuple):
    """What has been recorded of the events of an interval: the fields of `Record` that an event
    changes."""

    impacts: Scalar
    speed: Scalar | None
    loss: Scalar | None
    rests: Scalar | None
    log: Float[Array, "3 size"] | None
    events: Float[Array, "4 listed"] | None


class Onward(NamedTuple):
    """How a motion goes on behind an event: the fields of `Lane` of the same names."""

    direction: Scalars
    contact: Scalars | None
    modes: Scalars
    below: Scalars


class Arrival(NamedTuple):
    """Where a step leads, while its events are applied.

    `arrive` begins with the end of the step; each event makes another `Arrival` of it, and the lane
    takes over what the last one says.
    """

    s: Scalar
    state: State
    time: Beside | None
    place: Scalar
    """Y there: on the stop, with the stop's derivatives, where one is met."""
    before: Scalar | None
    """Y before a jump; absent where none can move it."""
    onward: Onward
    tally: Tally
    completed: Flag
    """Whether the interval is complete."""
    fault: Scalar | None
    """As in `Lane`; absent where no event can end it."""

    @property
    def direction(self) -> Scalars:
        """Of each coordinate, the way that it goes on: the sign of its velocity."""
        return self.onward.direction

    @property
    def contact(self) -> Scalars | None:
        """The stops rested on, as in `Lane`."""
        return self.onward.contact

    @property
    def modes(self) -> Scalars:
        """The modes of the machine behind what was met, as in `Lane`."""
        return self.onward.modes

    def going(self, **onward: Any) -> "Arrival":
        """A copy with another direction, contact or modes."""
        return self._replace(onward=self.onward._replace(**onward))

    def counting(self, **tally: Any) -> "Arrival":
        """A copy in which something else is recorded: fields of `Tally`."""
        return self._replace(tally=self.tally._replace(**tally))


def ended(arrival: Arrival, where: Flag, when: Flag | None, reason: int | float) -> Arrival:
    """The arrival, with a reason for its lane to end there.

    **Arguments:** `where`, whether the event was met; `when`, whether it ends the lane, `None` if
    it never can; `reason`, a code of `results`.
    """
    if when is None or arrival.fault is None:
        return arrival
    return arrival._replace(fault=jnp.where(where & when, float(reason), arrival.fault))
