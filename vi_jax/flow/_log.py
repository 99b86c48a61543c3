"""What is listed of the events that a lane has met."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Flag, Scalar, State
from ._lane import Plan

Log = Float[Array, "rows size"] | None


def clock_at(plan: Plan, s: Scalar, state: State) -> Scalar:
    """What counts the cycles, `s` itself or the machine's clock."""
    clock = plan.machine.clock(state)
    return s if clock is None else clock


def logged(
    log: Log, hit: Flag, place: Scalar, clock: Scalar, approach: Scalar, stop: Scalar | int
) -> Log:
    """The log of impacts with this one in its place, if there is room.

    **Arguments:** `log`, (3, size), `None` where none is kept; `hit`, whether there was an impact;
    `place`, the number of those before it in this interval; `approach`, V⁻; `stop`, the stop's
    number.
    """
    if log is None:
        return None
    return _written(log, hit, place, clock, approach, stop)


def noted(
    events: Log, when: Flag, clock: Scalar, kind: Scalar | float, number: Scalar | float | int,
    value: object,
) -> Log:  # fmt: skip
    """The log of all events with this one behind those that it holds, if there is room.

    **Arguments:** `events`, (4, size), `None` where none is kept; `when`, whether the event
    happened; `kind`, its place in `results.EVENTS`; `number` and `value` as in `EventLog`.
    """
    if events is None:
        return None
    place = jnp.sum(jnp.where(jnp.isnan(events[1]), 0.0, 1.0))
    return _written(events, when, place, clock, kind, number, value)


def _written(log: Array, when: Flag, place: Scalar, *entry: Any) -> Array:
    """A log with an entry at this place, if it has one."""
    here = when & (jnp.arange(log.shape[1], dtype=log.dtype) == place)
    column = jnp.stack([jnp.asarray(x, log.dtype) for x in entry])
    return jnp.where(here, column[:, None], log)
