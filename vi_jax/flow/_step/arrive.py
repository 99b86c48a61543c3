"""Where a step leads: rebounds, rest, changes of mode, and what is recorded of the way."""

import dataclasses

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, State
from ...machine import holds_anywhere, section_number, struck_modes
from .._arrival import Arrival, Onward, Tally
from .._contact.impact import is_compound, strike
from .._contact.rest import Release
from .._contact.settle import Approach, settle, stilled
from .._flow_to_event import FlowToEvent
from .._lane import LEAVES, Lane, Plan, Record, in_place, select, to_event, to_turn_of
from .._log import clock_at, noted
from ..drift import drifted, height_of_turn, met_after, unmoved
from ..events import Rates, to_turn
from ..smooth import exact, holding
from .faults import may_end
from .guards import Crossing, furthest_landing
from .happen import happened, let_go, set_off, with_outcome
from .jump import disarmed_itself
from .trial import Trial


def arrive(plan: Plan, lane: Lane, trial: Trial, taken: Flag) -> tuple[Lane, Flag]:
    """The lane after a step, with its event applied and recorded, and whether the interval is
    complete. If the step is not `taken`, the lane stays what it was."""
    old = lane.record
    direction = []
    for k, along in enumerate(lane.direction):
        if trial.paths:
            v = stop_gradient(trial.paths[k].end.v)
            turned = jnp.where(v == 0, along, jnp.sign(v))
            # At a turn the sign of the velocity is rounding's.
            away = -along
            if plan.others(lane.state) or len(trial.paths) > 1:
                # Where a turn is another event too, it may have been met before.
                met_before = lane.target != to_turn_of(k)
                away = jnp.where(met_before, stop_gradient(jnp.sign(trial.paths[k].end.a)), away)
            along = jnp.where(trial.paths[k].at_turn, away, turned)
        direction.append(along)
    here = plan.machine.position(trial.state)
    arrival = Arrival(
        trial.s, trial.state, trial.end.time, here, here if plan.machine.others else None,
        Onward(tuple(direction), lane.contact, lane.modes, trial.seen.below),
        Tally(old.impacts, old.speed, old.loss, old.rests, old.log, old.events),
        trial.ends_interval, lane.fault if may_end(plan.machine) else None,
    )  # fmt: skip
    way = FlowToEvent(plan, trial.smooth, lane.part, (trial.s, trial.state, trial.end.time))
    if trial.crossings:
        met = jnp.zeros_like(taken)
        for c in trial.crossings:
            met = met | c.landed
        for path in trial.paths:
            if path.leaves is not None:
                met = met | path.leaves.landed
        # Rare: skipped where no lane of a group has met anything.
        arrival = jax.lax.cond(
            met, lambda x: _met(plan, lane, trial, taken, way, x), lambda x: x, arrival
        )
    y_max, y_min, clearance = _reached(plan, lane, trial, taken, way, arrival)
    time = select(taken, arrival.time, old.time)
    there = dataclasses.replace(
        lane,
        s=jnp.where(taken, arrival.s, lane.s),
        state=select(taken, arrival.state, lane.state),
        direction=select(taken, arrival.direction, lane.direction),
        contact=select(taken, arrival.contact, lane.contact),
        modes=select(taken, arrival.modes, lane.modes),
        below=select(taken, arrival.onward.below, lane.below),
        fault=lane.fault if arrival.fault is None else jnp.where(taken, arrival.fault, lane.fault),
        record=Record(
            time=time, y_max=y_max, y_min=y_min, clearance=clearance, **arrival.tally._asdict()
        ),
    )  # fmt: skip
    return there, taken & arrival.completed


def _met(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, way: FlowToEvent, arrival: Arrival
) -> Arrival:
    """The arrival after the event that the step landed on: first the last part of the way, then the
    jump. A step lands on one event; another one at the same instant is landed upon by the next
    step, which has no length.

    **Arguments:** `taken`, whether the step is taken; `way`, the motion from the step's end on;
    `arrival`, the step's end.
    """
    landed = {c.number: c.landed for c in trial.crossings}
    if landed:
        offset = jnp.zeros_like(arrival.s)
        for c in trial.crossings:
            offset = jnp.where(c.landed, _offset(plan, lane, trial, way, c), offset)
        _, there, passed = drifted(way.rate, offset, way.moving, way.fixed, way.rest)
        met = jnp.zeros_like(taken)
        for here in landed.values():
            met = met | here
        time = select(met, passed, arrival.time)
        arrival = arrival._replace(s=arrival.s + jnp.where(met, offset, 0.0), time=time)
        if arrival.before is not None:
            before = jnp.where(met, plan.machine.position(there), arrival.before)
            arrival = arrival._replace(before=before)
        arrival = _landed(plan, lane, trial, taken, arrival, there)
    for k, path in enumerate(trial.paths):
        if path.leaves is not None:
            arrival = _released(plan, lane, taken, arrival, way, k, path.leaves)
    arrival = arrival._replace(place=plan.machine.position(arrival.state))
    # Where a switch is met the field may have an infinite slope (Hertz's damper as it is touched),
    # which only derivatives along with the event do not see.
    fixed = plan.ticks(lane.state) and not plan.machine.switches
    return _at_fixed_clock(plan, lane, trial, arrival) if fixed else arrival


def _landed(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, arrival: Arrival, there: State
) -> Arrival:
    """The arrival after the event that the step landed on, and all that it sets off.

    **Arguments:** `taken`, whether the step is taken; `arrival`, at the event; `there`, the state
    in which it is met.
    """
    machine = plan.machine
    landed = {c.number: c.landed for c in trial.crossings}
    near = _near(plan, lane, trial)
    off: dict[int, Flag] = {}
    if machine.stops:
        arrival = _impact(plan, lane, trial, taken, arrival, landed, there)
        for number, stop in enumerate(machine.stops):
            if stop.ends_cycle:
                arrival = arrival._replace(completed=arrival.completed | landed[number])
            arrival = with_outcome(machine, stop, arrival, landed[number])
    if machine.stops and machine.others:
        met = jnp.zeros_like(taken)
        for number in range(len(machine.stops)):
            met = met | landed[number]
        close = tuple(jnp.where(near[n], 1.0, 0.0) for n in near)
        # A stop may have changed the modes already.
        arrival, off, _ = set_off(plan, arrival, met, (there, lane.modes), {}, close)
    due = {}
    for c in trial.crossings:
        if c.coordinate is None:
            arrival = arrival._replace(state=select(c.landed, there, arrival.state))
            here = c.landed | off[c.number] if c.number in off else c.landed
            if c.number == section_number(machine):
                # What begins anew with a cycle does so at its end.
                arrival = arrival._replace(completed=arrival.completed | here)
                arrival = disarmed_itself(plan, arrival, c)
            else:
                due[c.number] = here
    return happened(plan, taken, arrival, due, near) if due else arrival


def _near(plan: Plan, lane: Lane, trial: Trial) -> dict[int, Flag]:
    """Of each event that happens from below, whether its guard is at zero to rounding where the
    step landed on another event."""
    numbers = plan.from_below(lane.state) if plan.machine.others else []
    found = {}
    eps = float(jnp.finfo(trial.h.dtype).eps)
    for c in trial.crossings:
        if c.number in numbers:
            apart = jnp.full_like(trial.h, jnp.inf)
            for other in trial.crossings:
                if other.number != c.number:
                    apart = jnp.where(other.landed, jnp.abs(c.offset - other.offset), apart)
            slack = 64 * eps * (1 + jnp.abs(trial.s))
            found[c.number] = c.near & (stop_gradient(apart) <= slack)
    return found


def _at_fixed_clock(plan: Plan, lane: Lane, trial: Trial, arrival: Arrival) -> Arrival:
    """The same arrival with the derivatives that it has at a fixed reading of the clock. Behind an
    event that a parameter makes come sooner or later, s has a derivative; it is carried over to the
    state, so that the steps to come need none by `s`."""
    smooth = holding(plan.machine, arrival.modes, arrival.contact)
    bound = plan.end(lane.part)
    # The end of the interval may depend on what is differentiated by.
    moved = jnp.where(trial.ends_interval, bound - stop_gradient(bound), 0.0)
    s = stop_gradient(arrival.s) + moved
    way = FlowToEvent(plan, smooth, lane.part, (arrival.s, arrival.state, arrival.time))
    _, state, time = unmoved(way.rate, s - arrival.s, way.moving, way.fixed, way.rest)
    return arrival._replace(s=s, state=state, time=time)


def _released(
    plan: Plan, lane: Lane, taken: Flag, arrival: Arrival, way: FlowToEvent, k: int, leaves: Release
) -> Arrival:
    """The arrival with coordinate number k free, where the step ended at its release.

    **Arguments:** `taken`, whether the step is taken; `way`, the motion from the step's end on;
    `leaves`, where the body leaves its stop.
    """
    contact = arrival.contact
    assert contact is not None
    free, offset = leaves.landed, stop_gradient(leaves.offset)
    offset = met_after(way.rate, way.force(k), offset, way.moving, way.fixed, way.rest)
    moving = arrival.s, arrival.state, arrival.time
    _, state, time = drifted(way.rate, offset, moving, way.fixed, way.rest)
    if not exact(plan.machine, state):
        # While they were held their places were kept to the method's error.
        limited = sorted({stop.coordinate for stop in plan.machine.stops})
        walls = {i: contact[i] for i in limited}
        put, _ = stilled(plan, arrival.s, state, {i: walls[i] > 0 for i in limited}, walls)
        state = select(walls[k] > 0, put, state)
    direction = jnp.where(free, -lane.direction[k], arrival.direction[k])
    clock = clock_at(plan, arrival.s + jnp.where(free, offset, 0.0), state)
    stop = contact[k] - to_event(0)
    events = noted(arrival.tally.events, taken & free, clock, LEAVES, stop, jnp.nan)
    arrival = arrival._replace(
        s=arrival.s + jnp.where(free, offset, 0.0),
        state=select(free, state, arrival.state),
        time=select(free, time, arrival.time),
    )
    return arrival.counting(events=events).going(
        direction=in_place(arrival.direction, k, direction),
        contact=in_place(contact, k, jnp.where(free, 0.0, contact[k])),
    )


def _offset(plan: Plan, lane: Lane, trial: Trial, way: FlowToEvent, c: Crossing) -> Scalar:
    """How far in s the event is from the step's end, with the derivatives of the time at which it
    is met; 0 in value where the step landed on another.

    **Arguments:** `way`, the motion from the step's end on; `c`, the event.
    """
    # Of a motion so flat that the event's place is known worse than its surface, it is here.
    near = c.landed & (jnp.abs(c.offset) <= furthest_landing(trial.h))
    offset = stop_gradient(jnp.where(near, c.offset, 0.0))
    if plan.ticks(lane.state):
        # Met on the section it is not beyond it.
        beyond = trial.s + offset - plan.end(lane.part)
        offset = offset - jnp.maximum(stop_gradient(beyond), 0.0)
    # With the derivatives of what is met, which mean nothing where nothing is.
    met = met_after(way.rate, way.guard(c.number), offset, way.moving, way.fixed, way.rest)
    return met if c.sudden is None else jnp.where(c.sudden, 0.0, met)


def _impact(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, arrival: Arrival,
    landed: dict[int, Flag], there: State,
) -> Arrival:  # fmt: skip
    """The arrival after the rebound from a stop, or at rest on it.

    **Arguments:** `taken`, whether the step is taken; `landed`, whether the step landed on the
    event of each number; `there`, the state in which the stop is met.
    """
    machine, stops = plan.machine, range(len(plan.machine.stops))
    landed = {number: landed[number] for number in stops}
    arrival, blows = strike(plan, taken, arrival, landed, there)
    both = enumerate(zip(trial.paths, trial.alone, strict=True))
    approaches = {
        k: Approach(path.end.v, None if path.surge is None else path.surge[1], alone)
        for k, (path, alone) in both
    }
    met = jnp.zeros_like(taken)
    for here in landed.values():
        met = met | here
    arrival = settle(plan, lane, approaches, taken, arrival, there, met, blows)
    direction = list(arrival.direction)
    for k, body in enumerate(machine.coordinates):
        if k not in blows or len(blows) > 1:  # it may share a body with one that was hit
            v = stop_gradient(body.velocity(arrival.state))
            direction[k] = jnp.where(met & (v != 0), jnp.sign(v), direction[k])
        if k in blows:  # what is left of an approach is rounding
            sign, _ = plan.wall(k, blows[k].struck)
            away = -sign
            if arrival.contact is not None:
                away = jnp.where(arrival.contact[k] > 0, sign, away)
            direction[k] = jnp.where(blows[k].struck > 0, away, direction[k])
    modes = arrival.modes
    if modes and is_compound(machine):
        contact = arrival.contact or ()
        new = struck_modes(machine, arrival.s, arrival.state, modes, contact=contact)
        modes = select(met, new, modes)
    elif modes:
        for number, here in landed.items():
            given = machine, arrival.s, there, arrival.state, modes
            modes = select(here, machine.stops[number].modes_after(*given), modes)
        if arrival.contact is not None and holds_anywhere(machine):
            # What friction has to hold depends on who rests now.
            new = struck_modes(machine, arrival.s, arrival.state, modes, contact=arrival.contact)
            modes = select(met, new, modes)
    arrival = arrival.going(direction=tuple(direction), modes=modes)
    before = there, lane.modes  # a stop may have changed them already
    # What rests on other stops may be let go of by it.
    several = arrival.contact is not None and len(blows) > 1
    return let_go(plan, arrival, taken, met, before, lane.contact) if several else arrival


def _reached(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, way: FlowToEvent, arrival: Arrival
) -> tuple[Scalar | None, Scalar | None, Scalar | None]:
    """Greatest and smallest Y so far in this interval, and the smallest distance to a stop at a
    turning point; each `None` if it is not recorded.

    **Arguments:** `taken`, whether the step is taken; `way`, the motion from the step's end on;
    `arrival`, where the step leads.
    """
    record = lane.record
    y_max, y_min, clearance = record.y_max, record.y_min, record.clearance
    if y_max is None or y_min is None or not trial.paths:
        return y_max, y_min, clearance
    tops = [_top(trial, k, way) for k in range(len(trial.paths))]
    at_turn = trial.paths[0].at_turn
    reached = jnp.where(at_turn, tops[0], arrival.place)
    if clearance is not None:
        for stop in plan.machine.stops:
            k = stop.coordinate
            short = taken & trial.paths[k].at_turn & (lane.direction[k] == stop.sign)
            room = jnp.where(short, -stop.beyond(tops[k]), jnp.inf)
            clearance = jnp.minimum(clearance, room)
    for place in (reached,) if arrival.before is None else (arrival.before, reached):
        y_max = jnp.where(taken, jnp.maximum(y_max, place), y_max)
        y_min = jnp.where(taken, jnp.minimum(y_min, place), y_min)
    return y_max, y_min, clearance


def _top(trial: Trial, k: int, way: FlowToEvent) -> Scalar:
    """The position of coordinate number k at the turning point that the step was aimed at; else
    where the step ends."""
    path = trial.paths[k]
    end: Rates = stop_gradient(path.end)
    bend = jnp.where(end.a == 0, 1.0, end.a)
    height = end.x - jnp.where(path.at_turn, 0.5 * end.v**2 / bend, 0.0)
    return height_of_turn(
        way.rate, way.place(k), height, path.at_turn, to_turn(end), way.moving, way.fixed, way.rest
    )
