"""Where the next step should end: at the first event that a tried step ran past, or that a motion
known beforehand comes to."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar
from ...lanes import pin
from ...machine import clock_of, events_of, section_number, stops_of
from .._lane import FREE, Lane, Plan, any_of, select, to_event, to_release, to_turn_of
from ..events import quintic, to_turn
from ..methods import Foreseen
from ..smooth import exact
from .guards import Crossing, at_stops, beyond
from .hidden import crests, force_may_turn, hump, may_turn_twice
from .search import Course, Passed, first_event, may_matter
from .trial import Trial


def aim_ahead(plan: Plan, lane: Lane, motion: Foreseen) -> Lane:
    """The lane with its next step cut at the first event of `motion`, of a method that knows the
    motion before it takes a step (`Taylor`).

    Only steps that are not aimed already are cut, at stops and at a clock in the state; other
    events are found by `aim_at`, once the step was tried.
    """
    limit = stop_gradient(jnp.asarray(plan.method.longest(plan.machine, lane.s, lane.state)))
    h = jnp.minimum(lane.attempt, motion.reach(limit))
    if plan.ticks(lane.state):
        h = jnp.minimum(h, plan.end(lane.part) - lane.s)
    h = stop_gradient(h)
    guards, courses = _foreseen(plan, lane, motion, h)
    none, whole = jnp.zeros_like(h, bool), (h, jnp.full_like(h, FREE))

    def cut(whole: tuple) -> tuple:
        first = first_event(plan, lane, guards, courses, none, corrections=2)
        return select(first.crossed | first.turned, (first.theta * h, first.target), whole)

    met = none
    for flag in (*(over for _, over, _ in guards), *(turned for turned, _ in courses)):
        met = met | flag
    nothing_to_meet = not guards and not courses
    length, target = whole if nothing_to_meet else jax.lax.cond(met, cut, lambda x: x, whole)
    free = lane.target == FREE
    return lane._replace(
        attempt=jnp.where(free, length, lane.attempt),
        target=jnp.where(free, target, lane.target),
    )


def _foreseen(
    plan: Plan, lane: Lane, motion: Foreseen, h: Scalar
) -> tuple[list[Passed], list[Course]]:
    """What `first_event` asks about a step of length h along `motion`."""
    machine, courses, ends, paths = plan.machine, [], [], []
    if plan.motion or stops_of(machine):
        paths = [motion.of(coordinate.position) for coordinate in machine.coordinates]
    if not exact(machine, lane.state):
        shortest = 64 * float(jnp.finfo(h.dtype).eps) * (plan.unit + stop_gradient(lane.s))
        paths = [path.without_flutter(shortest) for path in paths]
    for k, path in enumerate(paths):
        begin, end = path.ends(h)
        turned = (lane.direction[k] * end.v < 0) & may_matter(plan, lane, k, begin, end, h)
        if lane.contact is not None:  # a body at rest meets nothing
            turned = turned & (lane.contact[k] == 0)
        courses.append((turned, partial(path.over, h)))
        ends.append((begin, end))
    guards = []
    for guard in at_stops(plan, ends):
        stop = stops_of(machine)[guard.number]
        curve = partial(paths[stop.coordinate].over, h, stop.sign, stop_gradient(stop.gap))
        over = guard.end.x > 0
        if lane.contact is not None:  # a body at rest is beyond its stop by rounding only
            over = over & (lane.contact[stop.coordinate] == 0)
        guards.append((guard, over, curve))
    if clock_of(machine, lane.state) is not None:
        clock, bound = motion.of(partial(clock_of, machine)), stop_gradient(plan.end(lane.part))
        begin, end = (x.scaled(1, bound) for x in clock.ends(h))
        guard = Crossing(events_of(machine)[-1], section_number(machine), begin, end, bound)
        guards.append((guard, guard.end.x > 0, partial(clock.over, h, 1, bound)))
    return guards, courses


def aim_at(plan: Plan, lane: Lane, trial: Trial, foreseen: bool) -> tuple[Flag, Scalar, Scalar]:
    """Whether a tried step has to be shortened to end at an event, to what length, and its target
    (see `Lane.target`).

    **Arguments:** `foreseen`, whether the motion was known before the step (see `aim_ahead`);
    static.
    """
    # What is found out here is only where to look.
    trial = trial._replace(h=stop_gradient(trial.h), paths=stop_gradient(trial.paths))
    nothing = jnp.zeros_like(trial.good), trial.h, jnp.full_like(trial.h, FREE)
    if not trial.paths and not trial.crossings:
        return nothing
    seen = _seen(plan, lane, trial)
    # Rare: skipped where no lane of a group has met anything.
    return jax.lax.cond(
        _met_something(plan, lane, trial, seen, foreseen),
        lambda _: _aimed(plan, lane, trial, seen),
        lambda x: x,
        nothing,
    )


def at_a_turn(trial: Trial) -> Flag:
    """Whether the step met a turning point that it was aimed at."""
    return any_of(trial.good, (path.at_turn for path in trial.paths))


class _Seen(NamedTuple):
    """What both ends of a tried step say of the events between them."""

    guards: list[Passed]
    courses: list[Course]
    """Both as `first_event` asks for them: quintics through the step's ends."""
    humps: list[tuple[Flag, Scalar]]
    """Of the guards that hold a mode, where they may have been positive in between."""
    rises: list[tuple[Flag, Scalar]]
    """Of those that were evaluated at stages, and of the forces on bodies that rest, likewise,
    also before what was landed upon."""
    twice: Flag
    """A motion may have turned twice."""


def _met_something(plan: Plan, lane: Lane, trial: Trial, seen: _Seen, foreseen: bool) -> Flag:
    """Whether a step may have met anything; if not, `_aimed` need not be evaluated.

    **Arguments:** `seen`, what the step's ends say; `foreseen` as for `aim_at`.
    """
    if any(path.leaves is not None for path in trial.paths):
        anything = jnp.ones_like(trial.good)
        return anything if trial.clear is None else ~trial.clear
    met = trial.good & ((lane.target != FREE) & ~at_a_turn(trial) | seen.twice)
    for c, over, _ in seen.guards:
        met = met | over & ~c.landed | c.again
    for above, _ in (*seen.humps, *seen.rises):
        met = met | above
    for k, ((turned, _), path) in enumerate(zip(seen.courses, trial.paths, strict=True)):
        if not foreseen:
            met = met | turned & may_matter(plan, lane, k, path.begin, path.end, trial.h)
    return met if trial.clear is None else met & ~trial.clear


class _Goal(NamedTuple):
    """Where the next step ends."""

    event: Flag
    """At an event that was met."""
    before: Flag
    """At a turning point, or where something may have happened twice: before any event."""
    length: Scalar
    target: Scalar

    def cut(self, when: Flag, length: Scalar) -> "_Goal":
        """At this length where `when` holds, whatever may be met there."""
        return _Goal(
            self.event & ~when,
            self.before | when,
            jnp.where(when, length, self.length),
            jnp.where(when, FREE, self.target),
        )


def _aimed(plan: Plan, lane: Lane, trial: Trial, seen: _Seen) -> tuple[Flag, Scalar, Scalar]:
    """What `aim_at` returns for a step that may have met something."""
    h, landed = trial.h, any_of(trial.good, (c.landed for c in trial.crossings))
    first = first_event(plan, lane, seen.guards, seen.courses, landed, corrections=0)
    met = landed | at_a_turn(trial)
    goal = _Goal(first.crossed & ~landed, first.turned, pin(first.theta) * h, first.target)
    goal = _by_newton(lane, trial, goal)
    for above, place in reversed(seen.humps):  # of several the first listed
        goal = goal.cut(above & ~(goal.event | landed), place)
    nothing_else = trial.good & ~(first.crossed | first.turned | met)
    goal = goal.cut(seen.twice & nothing_else, 0.5 * h)
    for k, path in enumerate(trial.paths):
        if path.surge is not None:
            # What the step met may not have been the first: look at the turn of the force before.
            hidden, place = force_may_turn(lane, k, path, h)
            goal = goal.cut(trial.good & hidden & ~met, place)
        if path.leaves is not None:
            left, place, released = path.leaves.left, path.leaves.place, path.leaves.landed
            goal = _Goal(
                event=goal.event & ~released | left,
                before=goal.before & ~left,
                length=jnp.where(left, place, goal.length),
                target=jnp.where(left, to_release(k), goal.target),
            )
    for above, place in reversed(seen.rises):
        goal = goal.cut(above & ~goal.event, place)
    return goal.event | goal.before, stop_gradient(goal.length), goal.target


def _seen(plan: Plan, lane: Lane, trial: Trial) -> _Seen:
    """What both ends of a tried step say of the events between them."""
    h, good, guards, courses, humps = trial.h, trial.good, [], [], []
    sides, below = [], []
    for c in trial.crossings:
        guards.append((c, good & beyond(c), partial(quintic, c.begin, c.end, h)))
        if c.event.holds_mode:
            above, place = hump(plan, c, h)
            humps.append((good & above, place))
        for side in c.sides:
            slack = 0.0 if c.slack is None else c.slack
            sides.append(side._replace(slack=slack))
            below.append((side.end.x <= slack) | c.landed)
    exactly, twice = exact(plan.machine, lane.state), jnp.zeros_like(good)
    eps = float(jnp.finfo(h.dtype).eps)
    for k, path in enumerate(trial.paths):
        if path.pull is not None and path.leaves is not None:
            sides.append(path.pull)
            same = (path.pull.end.x <= 0) | path.leaves.landed
            asked = same if path.pull.asked is None else same & path.pull.asked
            below.append(~path.leaves.left & asked)
        end, twice = path.end, twice | may_turn_twice(plan, lane.direction[k], path, h)
        turned = good & (lane.direction[k] * end.v < 0) & ~path.at_turn
        if not exactly:
            # One that is closer than the clock can tell, as of a body that a rounded difference
            # has all but stopped, has nothing before it that could be stepped to. Nor is it one if
            # all that moves is rounding, as between bodies that go on together.
            now = 4 * eps * (plan.unit + stop_gradient(trial.s))
            moves = jnp.abs(end.v) * h > eps * (plan.extent(k) + jnp.abs(end.x))
            turned = turned & (jnp.abs(to_turn(end)) > now) & moves
        courses.append((turned, partial(quintic, path.begin, end, h)))
    rises = []
    if sides:
        below = [good & x for x in below]
        found = crests(plan, sides, below, trial.shares, h)
        rises = [(x & y, at) for (x, at), y in zip(found, below, strict=True)]
    return _Seen(guards, courses, humps, rises, twice)


def _by_newton(lane: Lane, trial: Trial, goal: _Goal) -> _Goal:
    """The goal, where a step aimed at it came so close that Newton's step from its end is better
    than a root of the quintic."""
    turns, h = goal.before, trial.h
    for k, path in enumerate(trial.paths):
        shift, turn = to_turn(path.end), to_turn_of(k)
        again = turns & (goal.target == turn) & (lane.target == turn) & (jnp.abs(shift) < 0.25 * h)
        goal = goal._replace(length=jnp.where(again, h + shift, goal.length))
    for c in reversed(trial.crossings):  # of several the first listed
        again = c.again & ~turns
        goal = goal._replace(
            event=goal.event | again,
            length=jnp.where(again, h + stop_gradient(c.offset), goal.length),
            target=jnp.where(again, to_event(c.number), goal.target),
        )
    return goal
