"""The state of the flat loop: one trajectory, its record, and the targets of its steps."""

import functools
import operator
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._types import Flag, Scalar, Scalars, State
from .results import EventKind, code
from .smooth import Integrals

# Targets of the next step, as numbers, which the loop carries: none, or one of the following.
FREE = 0.0


def to_event(number: int) -> float:
    """Return the target of a step to the event of this number (see `events_of`); it is positive.
    `Lane.contact` uses the same numbers for stops. All other targets are negative."""
    return 1.0 + number


def to_turn_of(k: int) -> float:
    """Return the target of a step to a turning point of coordinate number k."""
    return -1.0 - 2 * k


def to_release(k: int) -> float:
    """Return the target of a step to the release of coordinate number k from its stop."""
    return -2.0 - 2 * k


def total(tree: object, start: Scalar) -> Scalar:
    """Return the sum of all numbers in a tree and of `start`. It is finite if all of them are."""
    for leaf in jtu.tree_leaves(tree):
        start = start + jnp.sum(leaf)
    return start


def any_of(like: Flag, flags: Iterable[Flag]) -> Flag:
    """Return whether any of the flags is true, as an array like `like`."""
    return functools.reduce(operator.or_, flags, jnp.zeros_like(like))


def select(condition: Flag, a: object, b: object) -> Any:
    """`jnp.where` for pytrees; leaves that are the same object in both are returned unchanged."""
    return jtu.tree_map(lambda x, y: x if x is y else jnp.where(condition, x, y), a, b)


def with_item(values: tuple, k: int, value: object) -> tuple:
    return (*values[:k], value, *values[k + 1 :])


class Record(NamedTuple):
    """The record of an interval between two record points; `None` for what is not recorded."""

    integrals: Integrals
    y_max: Scalar | None
    y_min: Scalar | None
    impacts: Scalar
    impact_speed: Scalar | None
    impact_energy: Scalar | None
    rests: Scalar | None
    """Number of times that a body came to rest on a stop."""
    reduced: Scalar | None
    """Number of impacts with less than their restitution, since they would gain energy."""
    log: Float[Array, "5 size"] | None
    """Clock, V⁻, stop and impulses of each impact; unused columns are NaN."""
    clearance: Scalars | None
    """For each coordinate that stops limit, the smallest distance at a turn before one of them;
    one number without stops."""
    events: Float[Array, "4 listed"] | None
    """Clock, kind, number and value of each event; unused columns are NaN."""


class Lane(NamedTuple):
    """The state of the loop for one trajectory. All components are floats, since other types would
    prevent the loop from fusing. Each step, and each event in it, returns a new lane."""

    s: Scalar
    state: State
    record: Record
    direction: Scalars
    """For each coordinate, the sign of its velocity since the last turning point or impact."""
    contact: Scalars | None
    """For each coordinate, 1 + i while it rests on stop number i, else 0; `None` without rests. A
    contact that others hold, such as that of a table's fourth leg, is spare: negative."""
    modes: Scalars
    """The mode of each switch, then the machine's own modes."""
    below: Scalars
    """For each event with `AbstractEvent.from_below`: 1 if its guard was negative at some time
    since the last jump, else 0; -1 as long as neither has happened since the start."""
    length: Scalar
    """Length proposed for an ordinary step."""
    attempt: Scalar
    """Length of the next step."""
    target: Scalar
    """The target of the next step."""
    attempts: Scalar
    """Number of attempts to reach a target since the last accepted step."""
    part: Scalar
    """Index of the interval within its cycle."""
    done: Scalar
    """Number of completed intervals."""
    fault: Scalar
    """Reason why the lane ended early (see `results`), or 0."""
    steps: Scalar
    spent: Scalar
    """Steps tried in the current interval."""
    rejected: Scalar
    last_impulse: Scalar | None = None
    """Time since the start of the interval at the last impulse of noise; `None` if the impulses
    come at times known in advance."""
    completed: Flag | None = None
    """True if the interval is complete, while events are applied; `None` between steps."""
    history: Any = None
    """The history of a machine with delays, between steps (see `history.py`)."""
    slip: Scalar | None = None
    """A number of value 0 with the derivative of the last event's time relative to `s`, in a step
    of a machine with delays."""

    def end_if(self, happened: Flag, condition: Flag | None, reason: str | float) -> "Lane":
        """Return the lane, ended with `reason` (a name in `RESULTS` or its number) if an event
        `happened` and the `condition` is true under which it ends the lane (`None`: never)."""
        if condition is None:
            return self
        number = code(reason) if isinstance(reason, str) else reason
        return self._replace(fault=jnp.where(happened & condition, number, self.fault))

    def complete_interval(self, when: Flag) -> "Lane":
        """Return the lane with its interval marked as complete where `when` is true."""
        assert self.completed is not None
        return self._replace(completed=self.completed | when)

    def update_record(self, **changes: Any) -> "Lane":
        return self._replace(record=self.record._replace(**changes))

    def log_event(
        self, when: Flag, clock: Scalar, kind: EventKind | Scalar, number: Any, value: Any
    ) -> "Lane":
        """Return the lane with an entry added to the event log if `when` is true and there is room;
        `kind`, `number` and `value` as in `EventLog`."""
        events = self.record.events
        if events is None:
            return self
        used = jnp.sum(jnp.where(jnp.isnan(events[1]), 0.0, 1.0))
        return self.update_record(events=add_entry(events, when, used, clock, kind, number, value))


def add_entry(log: Array, when: Flag, column: Scalar, *entry: Any) -> Array:
    """Return a log with an entry in column `column` where `when` is true, if it has that column."""
    is_column = when & (jnp.arange(log.shape[1], dtype=log.dtype) == column)
    entries = jnp.stack([jnp.asarray(x, log.dtype) for x in entry])
    return jnp.where(is_column, entries[:, None], log)
