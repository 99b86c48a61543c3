"""Why a lane ends before its time: by what its steps come to, or by an event that has no answer."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, State
from ...machine import AbstractMachine, events_of, guard_of
from .. import results
from .._lane import FREE, Lane, Plan, Record, to_event, total
from ..events import guard_rates
from ..smooth import in_modes
from .trial import Trial

# A lane that has aimed this often without landing is lost; after so many impacts in one interval
# it was chattering. Both are choices: a smooth flow needs two or three aims.
_LOST, _MANY = 64.0, 16.0

# Nothing that a lane could do in one interval takes so many steps; a power of two, by choice.
_STUCK = 65536.0


class Progress(NamedTuple):
    """How far a lane has come, and how hard that was."""

    length: Scalar
    """Length proposed for its next ordinary step."""
    record: Record
    """Of the interval on its way."""
    steps: Scalar
    """Steps tried since the lane began."""
    spent: Scalar
    """Steps tried in this interval."""
    aims: Scalar
    """Times aimed since the last step taken."""


def faults(
    plan: Plan,
    lane: Lane,
    trial: Trial,
    taken: Flag,
    rejected: Flag,
    progress: Progress,
    target: Scalar,
) -> list[tuple[Flag, Scalar | float]]:
    """What ends a lane, the first that holds being the reason.

    **Arguments:** `taken` and `rejected`, whether the trial was; `progress` and `target`, how far
    the lane has come and what it aims at, after the trial.

    **Returns:** pairs of a condition and a reason, a code of `RESULTS`.
    """
    length, record, steps, spent, aims = progress
    broken = results.NOT_FINITE
    if plan.machine.alive(trial.state) is not None:
        # A clock that breaks down makes the steps shrink to nothing.
        broken = results.STALLED
    ends = [
        (record.impacts > plan.max_impacts, float(results.CHATTER)),
        (((aims >= _LOST) | (spent >= _STUCK)) & (record.impacts > _MANY), float(results.CHATTER)),
        (aims >= _LOST, _lost(plan, lane, target)),
        (steps >= plan.max_steps, float(results.MAX_STEPS)),
        (spent >= _STUCK, float(results.MAX_STEPS)),
    ]
    if plan.method.may_be_unstable(plan.machine, lane.s, lane.state):
        ends = [(taken & (trial.error > 1), float(results.UNSTABLE)), *ends]
    if not plan.method.adaptive:
        return [(rejected, float(broken)), *ends]
    eps = float(jnp.finfo(length.dtype).eps)
    gone = rejected & (length < 4 * eps * jnp.maximum(1.0, plan.machine.cycle))
    numeric = jnp.isfinite(total(trial.state, length))
    tiny = results.UNDERFLOW if broken == results.NOT_FINITE else broken
    return [(gone & ~numeric, float(broken)), (gone, float(tiny)), *ends]


def _lost(plan: Plan, lane: Lane, target: Scalar) -> Scalar | float:
    """The reason of a lane that has aimed too often, by what it aimed at."""
    machine, reason = plan.machine, float(results.UNRESOLVED)
    if plan.motion or machine.stops:
        reason = jnp.where(target < FREE, float(results.TURN_UNRESOLVED), reason)
    first = len(machine.stops)
    if machine.switches:
        others = target >= to_event(first)
        reason = jnp.where(others, float(results.SWITCH_UNRESOLVED), reason)
    if machine.others:
        others = target >= to_event(first + len(machine.switches))
        reason = jnp.where(others, float(results.RESET_UNRESOLVED), reason)
    if not plan.ticks(lane.state):
        ends = target == plan.to_section
        reason = jnp.where(ends, float(results.SECTION_UNRESOLVED), reason)
    return reason


def may_end(machine: AbstractMachine) -> bool:
    """Whether an event may end a lane; static."""
    laws = any(not stop.is_one_number for stop in machine.stops)
    slides = any(event.may_slide for event in events_of(machine))
    several = bool(machine.stops) and (len(machine.coordinates) > 1 or bool(machine.others))
    chain = len(machine.switches) + len(machine.others) > 1
    return laws or slides or several or chain or bool(machine.outcomes)


def comes_back(
    machine: AbstractMachine, i: int, modes: tuple, s: Scalar, state: State
) -> Flag | None:
    """Whether the field behind a switch points back at its surface, as that before it did: the
    motion would slide along it. `None` for a kind of switch whose motion cannot.

    **Arguments:** `i`, the number of the event; `modes`, `s` and `state` behind it.
    """
    if not events_of(machine)[i].may_slide:
        return None
    smooth = in_modes(machine, modes)

    def guard(s: Scalar, state: State) -> Scalar:
        return guard_of(machine, i, s, state, modes)

    here = stop_gradient(guard_rates(smooth.field, guard, s, state))
    slack = 1e4 * float(jnp.finfo(s.dtype).eps) * (1 + jnp.abs(here.v))
    return (jnp.abs(here.x) <= slack) & (here.v > slack)
