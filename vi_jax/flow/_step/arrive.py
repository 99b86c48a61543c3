"""Where a step leads: rebounds, rest, changes of mode, and what is recorded of the way."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import (
    holds_anywhere,
    others_of,
    section_number,
    stops_of,
    struck_modes,
    switches_of,
)
from .._contact.impact import is_compound, strike_once
from .._contact.rest import Release
from .._contact.sequence import strike_in_turn
from .._contact.settle import settle, stilled
from .._flow_to_event import FlowToEvent
from .._lane import Lane, Plan, any_of, in_place, select, to_event, to_turn_of
from ..events import Rates, to_turn
from ..labelled import EventKind
from ..smooth import exact, holding
from .faults import may_end
from .guards import Crossing, furthest_landing
from .happen import disarmed_itself, happened, release_pulled, set_off, with_outcome
from .trial import Situation, Trial


def arrive(plan: Plan, lane: Lane, trial: Trial, taken: Flag) -> tuple[Lane, Flag]:
    """The lane after a step, with its event applied and recorded, and whether the interval is
    complete. If the step is not `taken`, the lane stays what it was."""
    position = plan.machine.position
    there = lane._replace(
        s=trial.s, state=trial.state, direction=_along(plan, lane, trial), below=trial.below,
        completed=trial.ends_interval,
    ).recording(integrals=trial.integrals)  # fmt: skip
    # Y where the step ends, and before the state jumps there, where something may move it.
    here = position(trial.state)
    places = (here, here) if others_of(plan.machine) else (here,)
    way = FlowToEvent(plan, trial.smooth, lane.part, (trial.s, trial.state, trial.integrals))
    at = Situation(plan, lane, trial, taken, way)
    if trial.crossings:
        leaves = [path.leaves.landed for path in trial.paths if path.leaves is not None]
        met = any_of(taken, [*(c.landed for c in trial.crossings), *leaves])
        # Rare: skipped where no lane of a group has met anything.
        there, places = jax.lax.cond(met, lambda x: _met(at, *x), lambda x: x, (there, places))
    there = there.recording(**_reached(at, places))
    assert there.completed is not None
    completed = taken & there.completed
    there = lane._replace(
        s=jnp.where(taken, there.s, lane.s),
        fault=jnp.where(taken, there.fault, lane.fault) if may_end(plan.machine) else lane.fault,
        record=there.record._replace(
            integrals=select(taken, there.record.integrals, lane.record.integrals)
        ),
        **{
            name: select(taken, getattr(there, name), getattr(lane, name))
            for name in ("state", "direction", "contact", "modes", "below")
        },
    )
    return there, completed


def _along(plan: Plan, lane: Lane, trial: Trial) -> Scalars:
    """The directions of all coordinates where a step ends, before its event."""
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
    return tuple(direction)


def _met(at: Situation, lane: Lane, places: Scalars) -> tuple[Lane, Scalars]:
    """The lane after the event that the step landed on, and Y there: first the last part of the
    way, then the jump. A step lands on one event; another one at the same instant is landed upon by
    the next step, which has no length.

    **Arguments:** `lane`, at the step's end; `places`, Y there, and before a jump.
    """
    plan, trial, way = at.plan, at.trial, at.way
    landed = {c.number: c.landed for c in trial.crossings}
    before = places[1:]
    if landed:
        offset = jnp.zeros_like(lane.s)
        for c in trial.crossings:
            offset = jnp.where(c.landed, _offset(at, c), offset)
        _, there, passed = way.drifted(offset)
        met = any_of(at.taken, landed.values())
        integrals = select(met, passed, lane.record.integrals)
        lane = lane._replace(s=lane.s + jnp.where(met, offset, 0.0))
        lane = lane.recording(integrals=integrals)
        before = tuple(jnp.where(met, plan.machine.position(there), Y) for Y in before)
        lane = _landed(at, lane, there)
    for k, path in enumerate(trial.paths):
        if path.leaves is not None:
            lane = _released(at, lane, k, path.leaves)
    places = (plan.machine.position(lane.state), *before)
    # Where a switch is met the field may have an infinite slope (Hertz's damper as it is touched),
    # which only derivatives along with the event do not see.
    fixed = plan.ticks(lane.state) and not switches_of(plan.machine)
    return (_at_fixed_clock(at, lane) if fixed else lane), places


def _landed(at: Situation, lane: Lane, there: State) -> Lane:
    """The lane after the event that the step landed on, and all that it sets off.

    **Arguments:** `lane`, at the event; `there`, the state in which it is met.
    """
    plan, machine, trial = at.plan, at.plan.machine, at.trial
    landed = {c.number: c.landed for c in trial.crossings}
    near = _near(at)
    off: dict[int, Flag] = {}
    if stops_of(machine):
        lane = _impact(at, lane, landed, there)
        for number, stop in enumerate(stops_of(machine)):
            if stop.ends_cycle:
                lane = lane.completing(landed[number])
            lane = with_outcome(machine, stop, lane, landed[number])
    if stops_of(machine) and others_of(machine):
        met = any_of(at.taken, (landed[n] for n in range(len(stops_of(machine)))))
        close = tuple(jnp.where(near[n], 1.0, 0.0) for n in near)
        # A stop may have changed the modes already.
        lane, off, _ = set_off(plan, lane, met, (there, at.old.modes), {}, close)
    due = {}
    for c in trial.crossings:
        if c.coordinate is None:
            lane = lane._replace(state=select(c.landed, there, lane.state))
            here = c.landed | off[c.number] if c.number in off else c.landed
            if c.number == section_number(machine):
                # What begins anew with a cycle does so at its end.
                lane = disarmed_itself(plan, lane.completing(here), c)
            else:
                due[c.number] = here
    return happened(plan, at.taken, lane, due, near) if due else lane


def _near(at: Situation) -> dict[int, Flag]:
    """Of each event that happens from below, whether its guard is at zero to rounding where the
    step landed on another event."""
    plan, trial = at.plan, at.trial
    numbers = plan.from_below(trial.state) if others_of(plan.machine) else []
    found = {}
    eps = float(jnp.finfo(trial.h.dtype).eps)
    for c in trial.crossings:
        if c.number in numbers:
            apart = jnp.full_like(trial.h, jnp.inf)
            for other in trial.crossings:
                if other.number != c.number:
                    apart = jnp.where(other.landed, jnp.abs(c.offset - other.offset), apart)
            slack = 64 * eps * (plan.unit + jnp.abs(trial.s))
            found[c.number] = c.near & (stop_gradient(apart) <= slack)
    return found


def _at_fixed_clock(at: Situation, lane: Lane) -> Lane:
    """The same lane with the derivatives that it has at a fixed reading of the clock. Behind an
    event that a parameter makes come sooner or later, s has a derivative; it is carried over to the
    state, so that the steps to come need none by `s`."""
    smooth = holding(at.plan.machine, lane.modes, lane.contact)
    bound = at.plan.end(lane.part)
    # The end of the interval may depend on what is differentiated by.
    moved = jnp.where(at.trial.ends_interval, bound - stop_gradient(bound), 0.0)
    s = stop_gradient(lane.s) + moved
    moving = lane.s, lane.state, lane.record.integrals
    way = FlowToEvent(at.plan, smooth, lane.part, moving)
    _, state, integrals = way.unmoved(s - lane.s)
    return lane._replace(s=s, state=state).recording(integrals=integrals)


def _released(at: Situation, lane: Lane, k: int, leaves: Release) -> Lane:
    """The lane with coordinate number k free, where the step ended at its release.

    **Arguments:** `leaves`, where the body leaves its stop.
    """
    plan, way, contact = at.plan, at.way, lane.contact
    assert contact is not None
    free, offset = leaves.landed, stop_gradient(leaves.offset)
    offset = way.met_after(way.force(k), offset)
    moving = lane.s, lane.state, lane.record.integrals
    _, state, integrals = way.drifted(offset, moving)
    if not exact(plan.machine, state):
        # While they were held their places were kept to the method's error.
        limited = sorted({stop.coordinate for stop in stops_of(plan.machine)})
        walls = {i: contact[i] for i in limited}
        put, _ = stilled(plan, lane.s, state, {i: walls[i] > 0 for i in limited}, walls)
        state = select(walls[k] > 0, put, state)
    direction = jnp.where(free, -at.old.direction[k], lane.direction[k])
    s, stop = lane.s + jnp.where(free, offset, 0.0), contact[k] - to_event(0)
    lane = lane.noting(at.taken & free, plan.clock(s, state), EventKind.release, stop, jnp.nan)
    lane = lane.recording(integrals=select(free, integrals, lane.record.integrals))
    return lane._replace(
        s=s,
        state=select(free, state, lane.state),
        direction=in_place(lane.direction, k, direction),
        contact=in_place(contact, k, jnp.where(free, 0.0, contact[k])),
    )


def _offset(at: Situation, c: Crossing) -> Scalar:
    """How far in s an event is from the step's end, with the derivatives of the time at which it is
    met; 0 in value where the step landed on another."""
    plan, trial, way = at.plan, at.trial, at.way
    # Of a motion so flat that the event's place is known worse than its surface, it is here.
    near = c.landed & (jnp.abs(c.offset) <= plan.in_units(furthest_landing(trial.h)))
    offset = stop_gradient(jnp.where(near, c.offset, 0.0))
    if plan.ticks(trial.state):
        # Met on the section it is not beyond it.
        beyond = trial.s + offset - plan.end(at.old.part)
        offset = offset - jnp.maximum(stop_gradient(beyond), 0.0)
    # With the derivatives of what is met, which mean nothing where nothing is.
    met = way.met_after(way.guard(c.number), offset)
    return met if c.sudden is None else jnp.where(c.sudden, 0.0, met)


def _impact(at: Situation, lane: Lane, landed: dict[int, Flag], there: State) -> Lane:
    """The lane after the rebound from a stop, or at rest on it.

    **Arguments:** `landed`, whether the step landed on the event of each number; `there`, the state
    in which the stop is met.
    """
    plan, machine, before = at.plan, at.plan.machine, at.old
    landed = {number: landed[number] for number in range(len(stops_of(machine)))}
    strike = strike_in_turn if is_compound(machine) else strike_once
    lane, blows = strike(plan, at.taken, lane, landed, there)
    met = any_of(at.taken, landed.values())
    lane = settle(at, lane, there, met, blows)
    direction = list(lane.direction)
    for k, body in enumerate(machine.coordinates):
        if k not in blows or len(blows) > 1:  # it may share a body with one that was hit
            v = stop_gradient(body.velocity(lane.state))
            direction[k] = jnp.where(met & (v != 0), jnp.sign(v), direction[k])
        if k in blows:  # what is left of an approach is rounding
            sign, _ = plan.wall(k, blows[k].struck)
            away = -sign
            if lane.contact is not None:
                away = jnp.where(lane.contact[k] > 0, sign, away)
            direction[k] = jnp.where(blows[k].struck > 0, away, direction[k])
    modes, contact = lane.modes, lane.contact or ()
    if modes and not is_compound(machine):
        for number, here in landed.items():
            given = machine, lane.s, there, lane.state, modes
            modes = select(here, stops_of(machine)[number].modes_after(*given), modes)
    if modes and (is_compound(machine) or (contact and holds_anywhere(machine))):
        # What friction has to hold depends on who rests now.
        new = struck_modes(machine, lane.s, lane.state, modes, contact=contact)
        modes = select(met, new, modes)
    lane = lane._replace(direction=tuple(direction), modes=modes)
    if lane.contact is None or len(blows) == 1:
        return lane
    # What rests on other stops may be let go of by it. A stop may have changed the modes already.
    return release_pulled(plan, lane, at.taken, met, (there, before.modes), before.contact)


def _reached(at: Situation, places: Scalars) -> dict[str, Scalar | None]:
    """Greatest and smallest Y so far in this interval, and the smallest distance to a stop at a
    turning point; each `None` if it is not recorded.

    **Arguments:** `places`, Y where the step leads, and before a jump.
    """
    plan, lane, trial, taken = at.plan, at.old, at.trial, at.taken
    record = lane.record
    y_max, y_min, clearance = record.y_max, record.y_min, record.clearance
    if y_max is None or y_min is None or not trial.paths:
        return {"y_max": y_max, "y_min": y_min, "clearance": clearance}
    tops = [_top(trial, k, at.way) for k in range(len(trial.paths))]
    reached = jnp.where(trial.paths[0].at_turn, tops[0], places[0])
    if clearance is not None:
        for stop in stops_of(plan.machine):
            k = stop.coordinate
            short = taken & trial.paths[k].at_turn & (lane.direction[k] == stop.sign)
            room = jnp.where(short, -stop.beyond(tops[k]), jnp.inf)
            clearance = jnp.minimum(clearance, room)
    for place in (*places[1:], reached):
        y_max = jnp.where(taken, jnp.maximum(y_max, place), y_max)
        y_min = jnp.where(taken, jnp.minimum(y_min, place), y_min)
    return {"y_max": y_max, "y_min": y_min, "clearance": clearance}


def _top(trial: Trial, k: int, way: FlowToEvent) -> Scalar:
    """The position of coordinate number k at the turning point that the step was aimed at; else
    where the step ends."""
    path = trial.paths[k]
    end: Rates = stop_gradient(path.end)
    bend = jnp.where(end.a == 0, 1.0, end.a)
    height = end.x - jnp.where(path.at_turn, 0.5 * end.v**2 / bend, 0.0)
    return way.height_of_turn(k, height, path.at_turn, to_turn(end))
