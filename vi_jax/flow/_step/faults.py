"""Why a lane ends before its time: by what its steps come to, or by an event that has no answer."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, State
from ...machine import (
    AbstractMachine,
    events_of,
    guard_of,
    is_alive,
    others_of,
    outcomes_of,
    stops_of,
    switches_of,
)
from .._lane import FREE, Lane, Plan, to_event, total
from ..events import guard_rates
from ..results import code
from ..smooth import in_modes
from .trial import Trial

# A lane that has aimed this often without landing is lost; after so many impacts in one interval
# it was chattering. Both are choices: a smooth flow needs two or three aims.
_LOST, _MANY = 64.0, 16.0

# Nothing that a lane could do in one interval takes so many steps; a power of two, by choice.
_STUCK = 65536.0


def faults(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, rejected: Flag, new: Lane
) -> list[tuple[Flag, Scalar | float]]:
    """What ends a lane, the first that holds being the reason.

    **Arguments:** `taken` and `rejected`, whether the trial was; `new`, the lane after it.

    **Returns:** pairs of a condition and a reason, a code of `RESULTS`.
    """
    impacts, broken = new.record.impacts, code("not_finite")
    many = impacts > _MANY
    if is_alive(plan.machine, trial.state) is not None:
        # A clock that breaks down makes the steps shrink to nothing.
        broken = code("stalled")
    ends = [
        (impacts > plan.max_impacts, code("chatter")),
        (((new.aims >= _LOST) | (new.spent >= _STUCK)) & many, code("chatter")),
        (new.aims >= _LOST, _lost(plan, lane, new.target)),
        (new.steps >= plan.max_steps, code("max_steps")),
        (new.spent >= _STUCK, code("max_steps")),
    ]
    if plan.method.may_be_unstable(plan.machine, lane.s, lane.state):
        ends = [(taken & (trial.error > 1), code("unstable")), *ends]
    if not plan.method.adaptive:
        return [(rejected, broken), *ends]
    eps = float(jnp.finfo(new.length.dtype).eps)
    gone = rejected & (new.length < 4 * eps * jnp.maximum(plan.unit, plan.machine.cycle))
    numeric = jnp.isfinite(total(trial.state, new.length))
    tiny = code("underflow") if broken == code("not_finite") else broken
    return [(gone & ~numeric, broken), (gone, tiny), *ends]


def _lost(plan: Plan, lane: Lane, target: Scalar) -> Scalar | float:
    """The reason of a lane that has aimed too often, by what it aimed at."""
    machine, reason = plan.machine, code("unresolved")
    if plan.motion or stops_of(machine):
        reason = jnp.where(target < FREE, code("turn_unresolved"), reason)
    first = len(stops_of(machine))
    if switches_of(machine):
        others = target >= to_event(first)
        reason = jnp.where(others, code("switch_unresolved"), reason)
    if others_of(machine):
        others = target >= to_event(first + len(switches_of(machine)))
        reason = jnp.where(others, code("reset_unresolved"), reason)
    if not plan.ticks(lane.state):
        ends = target == plan.to_section
        reason = jnp.where(ends, code("section_unresolved"), reason)
    return reason


def may_end(machine: AbstractMachine) -> bool:
    """Whether an event may end a lane; static."""
    laws = any(not stop.is_one_number for stop in stops_of(machine))
    slides = any(event.may_slide for event in events_of(machine))
    several = bool(stops_of(machine)) and (len(machine.coordinates) > 1 or bool(others_of(machine)))
    chain = len(switches_of(machine)) + len(others_of(machine)) > 1
    return laws or slides or several or chain or bool(outcomes_of(machine))


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
