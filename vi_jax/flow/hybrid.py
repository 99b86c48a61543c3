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
from .lane import FREE, Lane, Plan, Record, to_stop, to_turn_of, total
from .moving import struck_modes
from .rest import Release, settled
from .taylor import Taylor
from .trial import Crossing, Path, Trial, attempt, held, timing

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
    renewed = plan.scene.renewed(state)
    if renewed is not state:
        state = select(turned, renewed, state)
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
    direction: tuple[Scalar, ...]
    contact: tuple[Scalar, ...] | None
    """The stops rested on."""
    modes: tuple[Scalar, ...]
    impacts: Scalar
    speed: Scalar | None
    loss: Scalar | None
    rests: Scalar | None
    log: Any
    completed: Flag
    """Whether the interval is complete."""


def _arrive(plan: Plan, lane: Lane, trial: Trial, taken: Flag) -> tuple[Lane, Flag]:
    """The lane where the step leads, its record kept, and whether the interval is complete."""
    old = lane.record
    direction = []
    for k, along in enumerate(lane.direction):
        if trial.paths:
            v = stop_gradient(trial.paths[k].end.v)
            turned = jnp.where(v == 0, along, jnp.sign(v))
            # At a turn the sign of the velocity is rounding's.
            away = -along
            several = plan.scene.switches or len(trial.paths) > 1
            if several or plan.scene.section(lane.state) is not None:
                # Where a turn is another event too, it may have been met before.
                met_before = lane.target != to_turn_of(k)
                away = jnp.where(met_before, stop_gradient(jnp.sign(trial.paths[k].end.a)), away)
            along = jnp.where(trial.paths[k].at_turn, away, turned)
        direction.append(along)
    arrival = Arrival(
        trial.s, trial.state, trial.time, tuple(direction), lane.contact, lane.modes,
        old.impacts, old.speed, old.loss, old.rests, old.log, trial.ends_interval,
    )  # fmt: skip
    if trial.crossings:
        met = jnp.zeros_like(taken)
        for c in trial.crossings:
            met = met | c.landed
        for path in trial.paths:
            if path.leaves is not None:
                met = met | path.leaves.landed
        # Rare: skipped where no lane of a group has met anything.
        arrival = jax.lax.cond(
            met, lambda x: _met(plan, lane, trial, taken, x), lambda x: x, arrival
        )
    y_max, y_min, clearance = _reached(plan, lane, trial, taken, arrival.state)
    time = arrival.time
    if time is not None and old.time is not None:
        time = jnp.where(taken, time, old.time)
    there = dataclasses.replace(
        lane,
        s=jnp.where(taken, arrival.s, lane.s),
        state=select(taken, arrival.state, lane.state),
        direction=select(taken, arrival.direction, lane.direction),
        contact=select(taken, arrival.contact, lane.contact),
        modes=select(taken, arrival.modes, lane.modes),
        below=_below(lane, trial, taken, arrival.completed),
        record=Record(
            time, y_max, y_min, arrival.impacts, arrival.speed, arrival.loss, arrival.rests,
            arrival.log, clearance,
        ),
    )  # fmt: skip
    return there, taken & arrival.completed


def _met(plan: Plan, lane: Lane, trial: Trial, taken: Flag, arrival: Arrival) -> Arrival:
    """What the event makes of a step that met one: the last part of its way, and the jump.

    Of events met together the stops come first, in their order, then the switches, then the
    section.
    """
    flow, bend = _flow_and_bend(trial.holding, arrival.time is not None, trial.s, trial.state)
    for c in trial.crossings:
        offset = jnp.where(c.landed, c.offset, 0.0)
        if c.kind != "section" and plan.ticks(lane.state):
            # Met on the section it is not beyond it.
            beyond = stop_gradient(trial.s + offset - plan.end(lane.part))
            offset = offset - jnp.maximum(beyond, 0.0)
        there, passed = jtu.tree_map(
            lambda x, dx, ddx, d=offset: x + d * dx + _second(d, ddx),
            (trial.state, arrival.time), flow, bend,
        )  # fmt: skip
        arrival = arrival._replace(s=arrival.s + offset, time=passed)
        if c.kind == "section":
            arrival = arrival._replace(
                completed=arrival.completed | c.landed,
                state=select(c.landed, there, arrival.state),
            )
        elif c.kind == "switch":
            arrival = _switched(plan, lane, trial, taken, arrival, c, there)
        else:
            arrival = _impact(plan, lane, trial, taken, arrival, c, there, flow)
    for k, path in enumerate(trial.paths):
        if path.leaves is not None:
            arrival = _released(lane, arrival, k, path.leaves, flow)
    return arrival


def _released(lane: Lane, arrival: Arrival, k: int, leaves: Release, flow: Any) -> Arrival:
    """Coordinate number k free again."""
    assert arrival.contact is not None
    offset, free = leaves.offset, leaves.landed
    state, time = jtu.tree_map(lambda x, dx: x + offset * dx, (arrival.state, arrival.time), flow)
    direction = jnp.where(free, -lane.direction[k], arrival.direction[k])
    return arrival._replace(
        s=arrival.s + offset,
        state=state,
        time=time,
        direction=_put(arrival.direction, k, direction),
        contact=_put(arrival.contact, k, jnp.where(free, 0.0, arrival.contact[k])),
    )


def _below(lane: Lane, trial: Trial, taken: Flag, completed: Flag) -> Scalar | None:
    if trial.below is None or lane.below is None:
        return None
    return jnp.where(taken, jnp.where(completed, 0.0, trial.below), lane.below)


def _put(values: tuple, k: int, value: Any) -> tuple:
    return (*values[:k], value, *values[k + 1 :])


def _switched(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, arrival: Arrival, c: Crossing, there: Any
) -> Arrival:
    """The next mode of a switch that changed in the state `there`."""
    scene, j = plan.scene, c.number
    state, mode = scene.switches[j].after(scene, arrival.s, there, lane.modes[j])
    mode = stop_gradient(jnp.asarray(mode, arrival.s.dtype))
    log = arrival.log
    if plan.log_switches:
        clock = scene.clock(there)
        log = _logged(
            log, taken & c.landed, arrival.impacts, arrival.s if clock is None else clock,
            jnp.zeros_like(arrival.s), len(scene.stops) + j,
        )  # fmt: skip
        # Listed as an impact is, and so counted.
        count = jnp.where(taken & c.landed, 1.0, 0.0)
        arrival = arrival._replace(impacts=arrival.impacts + count)
    return arrival._replace(
        state=select(c.landed, state, arrival.state),
        modes=_put(arrival.modes, j, jnp.where(c.landed, mode, arrival.modes[j])),
        log=log,
    )


def _impact(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, arrival: Arrival,
    c: Crossing, there: Any, flow: Any,
) -> Arrival:  # fmt: skip
    """The rebound from a stop in `there`, the state of the impact; or coming to rest on it."""
    scene, stop = plan.scene, plan.scene.stops[c.number]
    k = stop.coordinate
    body = scene.coordinates[k]
    s, state, time, direction = arrival.s, arrival.state, arrival.time, arrival.direction[k]
    contact, rests, met = arrival.contact, arrival.rests, s
    approach = jnp.maximum(stop.approach(body.velocity(there)), 0.0)
    # A speed whose square is no number ends here: a body may die out on a stop.
    least = 100 * float(jnp.finfo(s.dtype).tiny) ** 0.5
    rebound = stop.rebound(stop.sign * jnp.where(approach > least, approach, 0.0))
    state = select(c.landed, body.placed(there, stop.place, rebound), state)
    direction = jnp.where(c.landed, -float(stop.sign), direction)
    hit = taken & c.landed
    lost = stop.loss(approach)
    if contact is not None:
        arriving = stop.approach(trial.paths[k].end.v)
        last, left = settled(plan, lane, trial.alone[k], stop, arriving, s, there)
        ends = pin_flag(c.landed & last, s)
        lost = jnp.where(ends, 0.5 * approach**2, lost)
        wait = pin(jnp.where(ends, left, 0.0))
        (later, passed) = jtu.tree_map(lambda x, dx: x + wait * dx, (state, time), flow)
        still = body.placed(later, stop.place, jnp.zeros_like(s))
        state = select(ends, still, state)
        time = select(ends, passed, time)
        s = s + wait
        contact = _put(contact, k, jnp.where(ends, to_stop(c.number), contact[k]))
        direction = jnp.where(ends, float(stop.sign), direction)
        if rests is not None:
            rests = rests + jnp.where(taken & ends, 1.0, 0.0)
    if not _is_one(body.mass):
        lost = body.mass * lost
    directions = _put(arrival.direction, k, direction)
    for j, other in enumerate(scene.coordinates):
        if j != k:  # it may share a body with the one that was hit
            v = stop_gradient(other.velocity(state))
            struck = c.landed & (v != 0)
            turned = jnp.where(struck, jnp.sign(v), directions[j])
            directions = _put(directions, j, turned)
            if contact is not None:
                contact = _put(contact, j, jnp.where(struck, 0.0, contact[j]))
    modes = arrival.modes
    if modes:
        modes = select(c.landed, struck_modes(scene, s, state, modes), modes)
    clock, speed, loss = scene.clock(there), arrival.speed, arrival.loss
    log = _logged(
        arrival.log, hit, arrival.impacts, met if clock is None else clock, approach, c.number
    )
    return arrival._replace(
        s=s,
        state=state,
        time=time,
        direction=directions,
        contact=contact,
        modes=modes,
        impacts=arrival.impacts + jnp.where(hit, 1.0, 0.0),
        speed=None if speed is None else jnp.where(hit, jnp.maximum(speed, approach), speed),
        loss=None if loss is None else loss + jnp.where(hit, lost, 0.0),
        rests=rests,
        log=log,
    )


def _is_one(mass: Any) -> bool:
    return isinstance(mass, float) and mass == 1.0


def _reached(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, state: Any
) -> tuple[Scalar | None, Scalar | None, Scalar | None]:
    """Greatest and smallest Y so far, and the smallest distance at a turn that met no stop."""
    record = lane.record
    y_max, y_min, clearance = record.y_max, record.y_min, record.clearance
    if y_max is None or y_min is None or not trial.paths:
        return y_max, y_min, clearance
    tops = [_top(path) for path in trial.paths]
    at_turn = trial.paths[0].at_turn
    reached = jnp.where(at_turn, tops[0], plan.scene.position(state))
    if clearance is not None:
        for stop in plan.scene.stops:
            k = stop.coordinate
            short = taken & trial.paths[k].at_turn & (lane.direction[k] == stop.sign)
            room = jnp.where(short, -stop.beyond(tops[k]), jnp.inf)
            clearance = jnp.minimum(clearance, room)
    y_max = jnp.where(taken, jnp.maximum(y_max, reached), y_max)
    y_min = jnp.where(taken, jnp.minimum(y_min, reached), y_min)
    return y_max, y_min, clearance


def _top(path: Path) -> Scalar:
    """The coordinate at the turning point that a step was aimed at, or else at its end."""
    end = path.end
    bend = jnp.where(end.a == 0, 1.0, end.a)
    return end.x - jnp.where(path.at_turn, 0.5 * end.v**2 / bend, 0.0)


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
