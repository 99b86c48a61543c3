"""Where a step leads, while what it met is applied."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from .._types import Flag, Scalar
from .beside import Beside


class Arrival(NamedTuple):
    """The lane where a step leads, and what is kept of its way there."""

    s: Scalar
    state: Any
    place: Scalar
    """Y there: on the stop, with the stop's derivatives, where one is met."""
    before: Scalar | None
    """Y before a jump; absent where none can move it."""
    time: Beside | None
    direction: tuple[Scalar, ...]
    contact: tuple[Scalar, ...] | None
    """As in `Lane`, the stops rested on."""
    modes: tuple[Scalar, ...]
    impacts: Scalar
    speed: Scalar | None
    loss: Scalar | None
    rests: Scalar | None
    log: Any
    events: Any
    completed: Flag
    """Whether the interval is complete."""
    fault: Scalar | None
    """As in `Lane`; absent where no event can end it."""


def ended(arrival: Arrival, where: Flag, when: Flag | None, reason: int) -> Arrival:
    """With this reason to end, `where` it was met and `when` it holds; `None` where it cannot."""
    if when is None or arrival.fault is None:
        return arrival
    return arrival._replace(fault=jnp.where(where & when, float(reason), arrival.fault))
