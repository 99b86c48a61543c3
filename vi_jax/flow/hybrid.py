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

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from . import results
from .events import Rates, landing, quintic, rates, rising_root, slope
from .fusion import pin, pin_flag
from .lane import FREE, SECTION, TURN, Lane, Plan, Record

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

# Newton's method on a smooth flow needs two or three aims. Where rounding keeps it from gaining
# more, a lane that has aimed this often accepts a thousand times the tolerance, and one that has
# aimed much more often is lost.
_PATIENCE, _LOST = 12.0, 64.0
# A lane that is lost after so many impacts in one interval was chattering.
_MANY = 16.0
# Turning points this far inside the gap (unit: a) are passed by where only impacts matter.
_MARGIN = 0.02


class Crossing(NamedTuple):
    """An event g = 0 seen by a step: g at both ends, and how a step aimed at it landed."""

    name: float
    begin: Rates
    end: Rates
    offset: Scalar
    """δ to the event from the step's end."""
    landed: Flag
    again: Flag
    """The step was aimed at it and has to be corrected by δ."""


class Trial(NamedTuple):
    """A step that was tried, and what it met."""

    s: Scalar
    h: Scalar
    state: Any
    time: Scalar | None
    error: Scalar
    good: Flag
    ends_interval: Flag
    crossings: tuple[Crossing, ...]
    position: tuple[Rates, Rates] | None
    at_turn: Flag
    """It was aimed at a turning point and met it."""


def select(condition: Flag, a: Any, b: Any) -> Any:
    """`jnp.where` for pytrees."""
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), a, b)


def iterate(plan: Plan, lane: Lane) -> Lane:
    """One step of one lane: advance, aim or land. A lane that has ended is left as it is."""
    active = (lane.done < plan.intervals) & (lane.fault == 0)
    trial = _try(plan, lane, active)
    aim, attempt, target = _aim(plan, lane, trial)
    one = lane.one
    aim = pin_flag(active & aim, one)
    taken = pin_flag(active & trial.good & ~aim, one)
    rejected = active & ~trial.good
    length = _resized(plan, lane, trial, taken, rejected)
    s, state, direction, record, completed = _arrive(plan, lane, trial, taken)
    completed = pin_flag(completed, one)

    done, part = lane.done + jnp.where(completed, 1.0, 0.0), lane.part
    turned = completed
    if plan.parts > 1:
        part = part + jnp.where(completed, 1.0, 0.0)
        turned = completed & (part >= plan.parts)
        part = jnp.where(turned, 0.0, part)
    s = jnp.where(turned, 0.0, s)
    if not plan.ticks(state):
        state = select(turned, plan.scene.rewound(state), state)
    kept_state = select(completed, state, lane.kept_state)
    kept = select(completed, record, lane.kept)
    record = select(completed, plan.fresh(state), record)

    steps = lane.steps + jnp.where(active, 1.0, 0.0)
    fault = lane.fault
    aims = jnp.where(aim, lane.aims + 1, 0.0)
    for condition, code in _faults(plan, trial, rejected, length, record, steps, aims):
        stops_here = active & (fault == 0) & condition & (done < plan.intervals)
        fault = jnp.where(stops_here, float(code), fault)
    return Lane(
        s=s,
        state=state,
        record=record,
        direction=direction,
        length=length,
        attempt=jnp.where(aim, attempt, length),
        target=jnp.where(aim, target, FREE),
        aims=aims,
        part=part,
        done=done,
        fault=fault,
        steps=steps,
        rejected=lane.rejected + jnp.where(rejected, 1.0, 0.0),
        one=one,
        kept_state=kept_state,
        kept=kept,
    )


def _try(plan: Plan, lane: Lane, active: Flag) -> Trial:
    """Try the next step and see what it meets; of length zero for a lane that has ended."""
    scene, method = plan.scene, plan.method
    free = lane.target == FREE
    bound = scene.cycle * (lane.part + 1) / plan.parts if plan.parts > 1 else scene.cycle
    limit = method.limited(scene, scene.step_limit(lane.s, lane.state))
    h = stop_gradient(jnp.where(free, jnp.minimum(lane.attempt, limit), lane.attempt))
    s1, last = lane.s + h, jnp.zeros_like(free)
    if plan.ticks(lane.state):
        # The margin spares a step for the last sliver that rounding leaves.
        last = free & (stop_gradient(bound - lane.s) <= h * (1 + 1e-6))
        s1 = jnp.where(last, bound, s1)
    s1 = jnp.where(active, s1, lane.s)
    s1 = pin(s1, lane.one)
    h = s1 - lane.s

    paced = plan.motion and scene.pace(lane.s, lane.state) is not None
    time = lane.record.time if paced else None
    new, time, error = method.step(scene, lane.s, s1, lane.state, time, lane.one)
    if not paced and lane.record.time is not None:
        time = lane.record.time + h
    new = pin(new, lane.one)
    good = jnp.isfinite(sum(jtu.tree_leaves(new), jnp.zeros_like(h)))
    alive = scene.alive(new)
    if alive is not None:
        good = good & alive
    if method.adaptive:
        error = pin(error, lane.one)
        good = good & (error <= 1)
    good = pin_flag(good, lane.one)

    crossings, position = [], None
    at_turn = jnp.zeros_like(free)
    if plan.motion or scene.stops:
        begin = rates(scene.field, scene.position, lane.s, lane.state)
        end = rates(scene.field, scene.position, s1, new)
        position = begin, end
        shift = _to_turn(end)
        met = jnp.abs(shift) <= _turn_tolerance(h) * _leniency(lane)
        at_turn = good & (lane.target == TURN) & met
        for i, stop in enumerate(scene.stops):
            ends = begin.scaled(stop.sign, stop.gap), end.scaled(stop.sign, stop.gap)
            crossings.append((1.0 + i, *ends, 1 + jnp.abs(stop.gap)))
    if not plan.ticks(lane.state):

        def clock(state: Any) -> Scalar:
            return jnp.asarray(scene.clock(state))

        ends = (
            rates(scene.field, clock, lane.s, lane.state).scaled(1, bound),
            rates(scene.field, clock, s1, new).scaled(1, bound),
        )
        crossings.append((SECTION, *ends, bound))
    seen = tuple(_seen(lane, good, h, crossing, crossings) for crossing in crossings)
    return Trial(s1, h, new, time, error, good, last, seen, position, at_turn)


def _seen(lane: Lane, good: Flag, h: Scalar, crossing: tuple, all_of_them: list) -> Crossing:
    """Whether a step that was aimed at this event met it."""
    name, begin, end, scale = crossing
    aimed = good & (lane.target == name)
    for other, _, beyond, _ in all_of_them:
        if other != name:  # what lies beyond another stop was not reached
            aimed = aimed & (beyond.x <= 0)
    offset, square = landing(end)
    size = stop_gradient(jnp.abs(offset))
    eps = float(jnp.finfo(h.dtype).eps)
    # Two ways of being there to rounding: in place along the path, or, near grazing, in position.
    close = size <= _landing_tolerance(h) * _leniency(lane)
    close = close | ((jnp.abs(end.x) <= 4 * eps * scale) & (end.v >= 0))
    real = stop_gradient(square) > 0
    landed = pin_flag(aimed & close & real, lane.one)
    again = aimed & ~close & real & (size < 0.25 * h)
    return Crossing(name, begin, end, offset, landed, again)


def _leniency(lane: Lane) -> Scalar:
    return jnp.where(lane.aims >= _PATIENCE, 1e3, jnp.ones_like(lane.aims))


def _landing_tolerance(x: Scalar) -> float:
    """Largest accepted |δ|: a derivative's error is of its order, the state's of its square."""
    return 1e-9 if x.dtype == jnp.float64 else 1e-4


def _turn_tolerance(x: Scalar) -> float:
    """Largest accepted offset from a turning point, whose height it enters in third order."""
    return 1e-5 if x.dtype == jnp.float64 else 1e-2


def _to_turn(end: Rates) -> Scalar:
    """Offset from a step's end to the turning point near it."""
    bend = stop_gradient(end.a)
    return -stop_gradient(end.v) / jnp.where(bend == 0, 1.0, bend)


def _aim(plan: Plan, lane: Lane, trial: Trial) -> tuple[Flag, Scalar, Scalar]:
    """Whether to shorten the step, to what length, and at what it then aims."""
    h = stop_gradient(trial.h)
    none = jnp.zeros_like(trial.good)
    if trial.position is None and not trial.crossings:
        return none, h, jnp.full_like(h, FREE)
    # The earliest of several events is met first. The chord tells well enough which that is: a
    # landing that lies beyond another stop is not accepted.
    first, target = jnp.full_like(h, jnp.inf), jnp.full_like(h, TURN)
    polynomial, crossed, landed, facing_stop = None, none, none, none
    for c in trial.crossings:
        over = trial.good & (c.end.x > 0)
        rise = jnp.where(over, c.end.x - c.begin.x, 1.0)
        place = jnp.where(over, jnp.maximum(-c.begin.x, 0.0) / rise, jnp.inf)
        sooner = place < first
        curve = quintic(c.begin, c.end, h)
        polynomial = curve if polynomial is None else select(sooner, curve, polynomial)
        target = jnp.where(sooner, c.name, target)
        first = jnp.where(sooner, place, first)
        crossed, landed = crossed | over, landed | c.landed
        if c.name > 0:
            sign = plan.scene.stops[int(c.name) - 1].sign
            facing_stop = facing_stop | (over & (lane.direction == sign))
    aim, turn, path, wiggle = crossed & ~landed, none, None, none
    if trial.position is not None:
        begin, end = trial.position
        path = quintic(begin, end, h)
        facing = tuple(-lane.direction * c for c in slope(path))
        # The motion turned within the step. Unless it went through a stop before, that comes
        # first: what lies beyond the turn is met from there.
        turn = trial.good & (lane.direction * end.v < 0) & ~trial.at_turn & ~facing_stop
        polynomial = facing if polynomial is None else select(turn, facing, polynomial)
    assert polynomial is not None
    theta = pin(rising_root(stop_gradient(polynomial)), lane.one)
    attempt = theta * h
    if path is not None and trial.position is not None:
        if not plan.motion:
            height = stop_gradient(path[0])
            for n in range(1, len(path)):
                height = height + stop_gradient(path[n]) * theta**n
            close = crossed | landed
            for stop in plan.scene.stops:
                close = close | (stop.sign * height - stop.gap > -_MARGIN)
            turn = turn & close
        wiggle = trial.good & _may_turn_twice(lane, *stop_gradient(trial.position), h)
        wiggle = wiggle & ~(aim | turn | landed | trial.at_turn)
        # Newton's step is better than the quintic once it is short.
        shift = _to_turn(trial.position[1])
        again = turn & (lane.target == TURN) & (jnp.abs(shift) < 0.25 * h)
        attempt = jnp.where(again, h + shift, attempt)
    for c in trial.crossings:
        again = c.again & ~turn
        aim = aim | again
        attempt = jnp.where(again, h + stop_gradient(c.offset), attempt)
        target = jnp.where(again, c.name, target)
    target = jnp.where(turn, TURN, jnp.where(wiggle, FREE, target))
    attempt = jnp.where(wiggle, 0.5 * h, attempt)
    return aim | turn | wiggle, stop_gradient(attempt), target


def _may_turn_twice(lane: Lane, begin: Rates, end: Rates, h: Scalar) -> Flag:
    """Whether the velocity, of one sign at both ends, dips so deep that it may have been zero.

    Such a step is halved until the turns lie apart or the dip is too short to matter.
    """
    a0, a1 = lane.direction * begin.a, lane.direction * end.a
    dips = (a0 < 0) & (a1 > 0) & (h > 1e-3)
    lowest = lane.direction * begin.v + 0.5 * h * a0 * (a0 / jnp.where(dips, a0 - a1, 1.0))
    return dips & (lowest < 0.1 * lane.direction * (begin.v + end.v))


def _arrive(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag
) -> tuple[Scalar, Any, Scalar, Record, Flag]:
    """Where the step leads: s, the state with its jump, the direction, the record, whether the
    interval is complete."""
    scene = plan.scene
    s, state, time, direction = trial.s, trial.state, trial.time, lane.direction
    record = lane.record
    impacts, speed, log = record.impacts, record.speed, record.log
    completed = trial.ends_interval
    if trial.position is not None:
        v = stop_gradient(trial.position[1].v)
        direction = jnp.where(v == 0, direction, jnp.sign(v))
        # Here the sign of the velocity is rounding's.
        direction = jnp.where(trial.at_turn, -lane.direction, direction)
    flow: Any = None
    pace = None
    if trial.crossings:
        flow = scene.field(trial.s, trial.state)
        pace = None if time is None else scene.pace(trial.s, trial.state)
    for c in trial.crossings:
        offset = jnp.where(c.landed, c.offset, 0.0)
        # First order suffices for the rest of the state: the offset is tiny.
        there = jtu.tree_map(lambda x, dx, d=offset: x + d * dx, trial.state, flow)
        s = s + offset
        if time is not None:
            time = time + (offset if pace is None else offset * pace)
        if c.name == SECTION:
            completed = completed | c.landed
            state = select(c.landed, there, state)
            continue
        index = int(c.name) - 1
        stop = scene.stops[index]
        approach = jnp.maximum(stop.sign * scene.velocity(there), 0.0)
        rebound = -stop.sign * stop.restitution * approach
        state = select(c.landed, scene.placed(there, stop.sign * stop.gap, rebound), state)
        direction = jnp.where(c.landed, -float(stop.sign), direction)
        hit = taken & c.landed
        impacts = impacts + jnp.where(hit, 1.0, 0.0)
        if speed is not None:
            speed = jnp.where(hit, jnp.maximum(speed, approach), speed)
        clock = scene.clock(there)
        log = _logged(log, hit, s if clock is None else clock, approach, float(index))
    y_max, y_min = record.y_max, record.y_min
    if y_max is not None and y_min is not None and trial.position is not None:
        end = trial.position[1]
        bend = jnp.where(end.a == 0, 1.0, end.a)
        top = end.x - jnp.where(trial.at_turn, 0.5 * end.v**2 / bend, 0.0)
        reached = jnp.where(trial.at_turn, top, scene.position(state))
        y_max = jnp.where(taken, jnp.maximum(y_max, reached), y_max)
        y_min = jnp.where(taken, jnp.minimum(y_min, reached), y_min)
    if time is not None and record.time is not None:
        time = jnp.where(taken, time, record.time)
    return (
        jnp.where(taken, s, lane.s),
        select(taken, state, lane.state),
        jnp.where(taken, direction, lane.direction),
        Record(time, y_max, y_min, impacts, speed, log),
        taken & completed,
    )


def _logged(log: tuple, hit: Flag, clock: Scalar, approach: Scalar, stop: float) -> tuple:
    """The log with this impact in its first unused place."""
    entries = []
    for entry in log:
        here = hit & (entry[2] < 0)
        entries.append(select(here, (clock, approach, jnp.full_like(clock, stop)), entry))
        hit = hit & ~here
    return tuple(entries)


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
    trial: Trial,
    rejected: Flag,
    length: Scalar,
    record: Record,
    steps: Scalar,
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
    ]
    if not plan.method.adaptive:
        return [(rejected, broken), *ends]
    eps = float(jnp.finfo(length.dtype).eps)
    gone = rejected & (length < 4 * eps * jnp.maximum(1.0, plan.scene.cycle))
    numeric = jnp.isfinite(sum(jtu.tree_leaves(trial.state), length))
    tiny = results.UNDERFLOW if broken == results.NOT_FINITE else broken
    return [(gone & ~numeric, broken), (gone, tiny), *ends]
