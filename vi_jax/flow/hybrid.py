"""The hybrid step: one flat loop in which every lane advances, aims or lands by itself.

Each iteration tries one step of one lane:

- *advance*: the step holds no event and is taken;
- *aim*: it crosses a stop (or a section of the time clock, or a turning point that matters); it is
  not taken, and the next one is shortened to end there;
- *land*: the shortened step ends within rounding of the event; the second-order Taylor offset
  δ = t* - t puts the state on it, and the jump is applied. Otherwise it is aimed once more.

The length of an aimed step is a constant for differentiation, while δ carries dt*/dp, so that
forward and reverse derivatives through an impact are exact (the saltation matrix).
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..lanes import pin, pin_flag
from . import results
from .ahead import ahead
from .aim import aim_at, select
from .lane import FREE, SECTION, Lane, Plan, Record, total
from .rest import settled
from .taylor import Taylor
from .trial import Crossing, Trial, attempt, held, timing

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

# A lane that has aimed this often without landing is lost; after so many impacts in one interval
# it was chattering.
_LOST, _MANY = 64.0, 16.0

# Nothing that a lane could do in one interval takes so many steps.
_STUCK = 65536.0


class Step(NamedTuple):
    """What a step made of a lane."""

    lane: Lane
    completed: Flag
    """Whether an interval ended with it."""
    state: Any
    record: Record
    """Of that interval."""


def iterate(plan: Plan, lane: Lane) -> Step:
    """One step of one lane: advance, aim or land. A lane that has ended is left as it is."""
    active = (lane.done < plan.intervals) & (lane.fault == 0)
    holding, motion = held(plan, lane), None
    if isinstance(plan.method, Taylor):
        motion = plan.method.expand(holding, lane.s, lane.state, timing(plan, lane))
        lane = ahead(plan, lane, motion)
    trial = attempt(plan, lane, active, holding, motion)
    aim, goal, target = aim_at(plan, lane, trial)
    aim = pin_flag(active & aim, lane.s)
    taken = pin_flag(active & trial.good & ~aim, lane.s)
    rejected = active & ~trial.good
    length = _resized(plan, lane, trial, taken, rejected)
    there, completed = _arrive(plan, lane, trial, taken)
    completed = pin_flag(completed, lane.s)
    s, state, record = there.s, there.state, there.record

    done, part = lane.done + jnp.where(completed, 1.0, 0.0), lane.part
    turned = completed
    if plan.parts > 1:
        part = part + jnp.where(completed, 1.0, 0.0)
        turned = completed & (part >= plan.parts)
        part = jnp.where(turned, 0.0, part)
    s = jnp.where(turned, 0.0, s)
    if not plan.ticks(state):
        state = select(turned, plan.scene.rewound(state), state)
    of_interval = record
    record = select(completed, plan.fresh(state), record)

    steps = lane.steps + jnp.where(active, 1.0, 0.0)
    # Counted anew in each interval: in single precision the sum of all stands still at 2²⁴.
    spent = jnp.where(completed, 0.0, lane.spent + 1.0)
    fault = lane.fault
    aims = jnp.where(aim, lane.aims + 1, 0.0)
    for condition, code in _faults(plan, lane, trial, rejected, length, record, steps, spent, aims):
        stops_here = active & (fault == 0) & condition & (done < plan.intervals)
        fault = jnp.where(stops_here, float(code), fault)
    new = dataclasses.replace(
        there,
        s=s,
        state=state,
        record=record,
        length=length,
        attempt=jnp.where(aim, goal, length),
        target=jnp.where(aim, target, FREE),
        aims=aims,
        part=part,
        done=done,
        fault=fault,
        steps=steps,
        spent=spent,
        rejected=lane.rejected + jnp.where(rejected, 1.0, 0.0),
    )
    return Step(new, completed, state, of_interval)


class Arrival(NamedTuple):
    """Where a step leads."""

    s: Scalar
    state: Any
    time: Scalar | None
    direction: Scalar
    contact: Scalar | None
    """The stop rested on."""
    impacts: Scalar
    speed: Scalar | None
    loss: Scalar | None
    rests: Scalar | None
    log: Any
    completed: Flag
    """Whether the interval is complete."""


def _arrive(plan: Plan, lane: Lane, trial: Trial, taken: Flag) -> tuple[Lane, Flag]:
    """The lane where the step leads, its record kept, and whether the interval is complete."""
    old, direction = lane.record, lane.direction
    if trial.position is not None:
        v = stop_gradient(trial.position[1].v)
        direction = jnp.where(v == 0, direction, jnp.sign(v))
        # Here the sign of the velocity is rounding's.
        direction = jnp.where(trial.at_turn, -lane.direction, direction)
    arrival = Arrival(
        trial.s, trial.state, trial.time, direction, lane.contact,
        old.impacts, old.speed, old.loss, old.rests, old.log, trial.ends_interval,
    )  # fmt: skip
    if trial.crossings:
        met = jnp.zeros_like(taken)
        for c in trial.crossings:
            met = met | c.landed
        if trial.leaves is not None:
            met = met | trial.leaves[1]
        # Rare: skipped where no lane of a group has met anything.
        arrival = jax.lax.cond(
            met, lambda x: _met(plan, lane, trial, taken, x), lambda x: x, arrival
        )
    y_max, y_min, clearance = _reached(plan, lane, trial, taken, arrival.state)
    time = arrival.time
    if time is not None and old.time is not None:
        time = jnp.where(taken, time, old.time)
    contact = arrival.contact
    there = dataclasses.replace(
        lane,
        s=jnp.where(taken, arrival.s, lane.s),
        state=select(taken, arrival.state, lane.state),
        direction=jnp.where(taken, arrival.direction, lane.direction),
        contact=None if contact is None else select(taken, contact, lane.contact),
        record=Record(
            time, y_max, y_min, arrival.impacts, arrival.speed, arrival.loss, arrival.rests,
            arrival.log, clearance,
        ),
    )  # fmt: skip
    return there, taken & arrival.completed


def _met(plan: Plan, lane: Lane, trial: Trial, taken: Flag, arrival: Arrival) -> Arrival:
    """What the event makes of a step that met one: the last part of its way, and the jump."""
    flow, bend = _flow_and_bend(trial.holding, arrival.time is not None, trial.s, trial.state)
    for c in trial.crossings:
        offset = jnp.where(c.landed, c.offset, 0.0)
        if c.name != SECTION and plan.ticks(lane.state):
            # Met on the section it is not beyond it.
            beyond = stop_gradient(trial.s + offset - plan.end(lane.part))
            offset = offset - jnp.maximum(beyond, 0.0)
        there, passed = jtu.tree_map(
            lambda x, dx, ddx, d=offset: x + d * dx + _second(d, ddx),
            (trial.state, arrival.time), flow, bend,
        )  # fmt: skip
        arrival = arrival._replace(s=arrival.s + offset, time=passed)
        if c.name == SECTION:
            arrival = arrival._replace(
                completed=arrival.completed | c.landed,
                state=select(c.landed, there, arrival.state),
            )
        else:
            arrival = _impact(plan, lane, trial, taken, arrival, c, there, flow)
    if trial.leaves is None:
        return arrival
    assert arrival.contact is not None
    _, released, _, offset = trial.leaves
    state, time = jtu.tree_map(lambda x, dx: x + offset * dx, (arrival.state, arrival.time), flow)
    return arrival._replace(
        s=arrival.s + offset,
        state=state,
        time=time,
        direction=jnp.where(released, -lane.direction, arrival.direction),
        contact=jnp.where(released, 0.0, arrival.contact),
    )


def _impact(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, arrival: Arrival,
    c: Crossing, there: Any, flow: Any,
) -> Arrival:  # fmt: skip
    """The rebound from a stop in `there`, the state of the impact; or coming to rest on it."""
    scene, index = plan.scene, int(c.name) - 1
    stop = scene.stops[index]
    s, state, time, direction = arrival.s, arrival.state, arrival.time, arrival.direction
    contact, rests, met = arrival.contact, arrival.rests, s
    approach = jnp.maximum(stop.sign * scene.velocity(there), 0.0)
    rebound = -stop.sign * stop.restitution * approach
    state = select(c.landed, scene.placed(there, stop.sign * stop.gap, rebound), state)
    direction = jnp.where(c.landed, -float(stop.sign), direction)
    hit = taken & c.landed
    lost = 0.5 * (1 - stop.restitution**2) * approach**2
    if contact is not None and trial.position is not None:
        arriving = stop.sign * trial.position[1].v
        last, left = settled(plan, lane, stop, arriving, s, there)
        ends = pin_flag(c.landed & last, s)
        lost = jnp.where(ends, 0.5 * approach**2, lost)
        wait = pin(jnp.where(ends, left, 0.0))
        (later, passed) = jtu.tree_map(lambda x, dx: x + wait * dx, (state, time), flow)
        still = scene.placed(later, stop.sign * stop.gap, jnp.zeros_like(s))
        state = select(ends, still, state)
        time = select(ends, passed, time)
        s = s + wait
        contact = jnp.where(ends, float(c.name), contact)
        direction = jnp.where(ends, float(stop.sign), direction)
        if rests is not None:
            rests = rests + jnp.where(taken & ends, 1.0, 0.0)
    clock, speed, loss = scene.clock(there), arrival.speed, arrival.loss
    log = _logged(
        arrival.log, hit, arrival.impacts, met if clock is None else clock, approach, index
    )
    return arrival._replace(
        s=s,
        state=state,
        time=time,
        direction=direction,
        contact=contact,
        impacts=arrival.impacts + jnp.where(hit, 1.0, 0.0),
        speed=None if speed is None else jnp.where(hit, jnp.maximum(speed, approach), speed),
        loss=None if loss is None else loss + jnp.where(hit, lost, 0.0),
        rests=rests,
        log=log,
    )


def _reached(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, state: Any
) -> tuple[Scalar | None, Scalar | None, Scalar | None]:
    """Greatest and smallest Y so far, and the smallest distance at a turn that met no stop."""
    record = lane.record
    y_max, y_min, clearance = record.y_max, record.y_min, record.clearance
    if y_max is None or y_min is None or trial.position is None:
        return y_max, y_min, clearance
    end = trial.position[1]
    bend = jnp.where(end.a == 0, 1.0, end.a)
    top = end.x - jnp.where(trial.at_turn, 0.5 * end.v**2 / bend, 0.0)
    reached = jnp.where(trial.at_turn, top, plan.scene.position(state))
    if clearance is not None:
        for stop in plan.scene.stops:
            short = taken & trial.at_turn & (lane.direction == stop.sign)
            room = jnp.where(short, stop.gap - stop.sign * top, jnp.inf)
            clearance = jnp.minimum(clearance, room)
    y_max = jnp.where(taken, jnp.maximum(y_max, reached), y_max)
    y_min = jnp.where(taken, jnp.minimum(y_min, reached), y_min)
    return y_max, y_min, clearance


@jax.custom_jvp
def _second(offset: Scalar, bend: Float[Array, "..."]) -> Float[Array, "..."]:
    """½δ² x'', which is below rounding and left out; only its derivatives count."""
    return jnp.zeros_like(bend)


@_second.defjvp
def _(primals, tangents):
    (offset, bend), (rate, _) = primals, tangents
    return jnp.zeros_like(bend), offset * rate * bend


def _flow_and_bend(scene: Any, timed: bool, s: Scalar, state: Any) -> tuple[Any, Any]:
    """First and second derivatives by s of the state and of the elapsed time."""

    def field(s, state):
        pace = scene.pace(s, state) if timed else None
        if timed and pace is None:
            pace = jnp.ones_like(s)
        return scene.field(s, state), pace

    flow = field(s, state)
    return flow, jax.jvp(field, (s, state), (jnp.ones_like(s), flow[0]))[1]


def _logged(log: Any, hit: Flag, place: Scalar, clock: Scalar, approach: Scalar, stop: int) -> Any:
    """The log with this impact, the `place`-th of its interval."""
    if log is None:
        return None
    here = hit & (jnp.arange(log.shape[1], dtype=log.dtype) == place)
    entry = jnp.stack([clock, approach, jnp.full_like(clock, stop)])
    return jnp.where(here, entry[:, None], log)


def _resized(plan: Plan, lane: Lane, trial: Trial, taken: Flag, rejected: Flag) -> Scalar:
    """The length proposed for the next ordinary step."""
    if not plan.method.adaptive:
        return lane.length
    h = stop_gradient(trial.h)
    factor = plan.method.resize(trial.error)
    # A step cut short by an event says little about how long the next may be.
    grown = jnp.where(h < lane.length, jnp.maximum(lane.length, h * factor), h * factor)
    shrunk = h * jnp.where(trial.error > 1, jnp.minimum(factor, 0.7), 0.2)
    return jnp.where(taken, grown, jnp.where(rejected, shrunk, lane.length))


def _faults(
    plan: Plan,
    lane: Lane,
    trial: Trial,
    rejected: Flag,
    length: Scalar,
    record: Record,
    steps: Scalar,
    spent: Scalar,
    aims: Scalar,
) -> list[tuple[Flag, int]]:
    """What ends a lane, the first that holds being the reason."""
    broken = results.NOT_FINITE
    if plan.scene.alive(trial.state) is not None:
        # A clock that breaks down makes the steps shrink to nothing.
        broken = results.STALLED
    ends = [
        (record.impacts > plan.max_impacts, results.CHATTER),
        ((aims >= _LOST) & (record.impacts > _MANY), results.CHATTER),
        (aims >= _LOST, results.UNRESOLVED),
        (steps >= plan.max_steps, results.MAX_STEPS),
        (spent >= _STUCK, results.MAX_STEPS),
    ]
    if not plan.method.adaptive:
        return [(rejected, broken), *ends]
    eps = float(jnp.finfo(length.dtype).eps)
    gone = rejected & (length < 4 * eps * jnp.maximum(1.0, plan.scene.cycle))
    numeric = jnp.isfinite(total(trial.state, length))
    tiny = results.UNDERFLOW if broken == results.NOT_FINITE else broken
    return [(gone & ~numeric, broken), (gone, tiny), *ends]
