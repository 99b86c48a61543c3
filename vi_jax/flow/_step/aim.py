"""Where the next step should end: at the earliest event that a tried step ran past."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ...lanes import pin
from .._lane import FREE, Lane, Plan, to_release, to_turn_of
from ..events import Rates, highest, quintic, rising_root, slope, to_turn
from ..moving import exact
from .guards import Crossing, beyond
from .trial import Path, Trial

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

# A hump of a guard this close to an end of a step (as a share of it) is seen from there.
_BRIEF = 1e-3

# Turning points this far inside the gap (unit: a) are passed by where only impacts matter.
MARGIN = 0.02

# By so much a bound is wider, for what rounding makes of it.
_WIDER = 1.001


def select(condition: Flag, a: Any, b: Any) -> Any:
    """`jnp.where` for pytrees; what is the same in both is left as it is."""
    return jtu.tree_map(lambda x, y: x if x is y else jnp.where(condition, x, y), a, b)


def aim_at(plan: Plan, lane: Lane, trial: Trial) -> tuple[Flag, Scalar, Scalar]:
    """Whether to shorten the step, to what length, and at what it then aims."""
    h = stop_gradient(trial.h)
    nothing = jnp.zeros_like(trial.good), h, jnp.full_like(h, FREE)
    if not trial.paths and not trial.crossings:
        return nothing
    # Rare: skipped where no lane of a group has met anything.
    return jax.lax.cond(
        _met_something(plan, lane, trial), lambda _: _aimed(plan, lane, trial), lambda x: x, nothing
    )


def _met_something(plan: Plan, lane: Lane, trial: Trial) -> Flag:
    """Whether `_aimed` has anything to say, or may have."""
    met = trial.good & (lane.target != FREE) & ~at_a_turn(trial)
    for c in trial.crossings:
        met = met | trial.good & beyond(c) & ~c.landed | c.again
        if c.event.holds_mode:
            met = met | trial.good & _hump(c, stop_gradient(trial.h))[0]
    for k, (path, direction) in enumerate(zip(trial.paths, lane.direction, strict=False)):
        begin, end = stop_gradient((path.begin, path.end))
        if not plan.method.sees_ahead:
            turned = trial.good & (direction * end.v < 0) & ~path.at_turn
            met = met | turned & may_matter(plan, lane, k, begin, end, stop_gradient(trial.h))
        twice = _may_turn_twice(direction, path.surge, begin, end, stop_gradient(trial.h))
        met = met | trial.good & twice
    rests = any(path.leaves is not None for path in trial.paths)
    return jnp.ones_like(met) if rests else met


def at_a_turn(trial: Trial) -> Flag:
    """Whether the step met a turning point that it was aimed at."""
    met = jnp.zeros_like(trial.good)
    for path in trial.paths:
        met = met | path.at_turn
    return met


class _Goal(NamedTuple):
    """Where the next step ends."""

    aim: Flag
    """At an event that was crossed."""
    turn: Flag
    """At a turning point."""
    shorter: Flag
    """Short of where something may have happened twice."""
    length: Scalar
    target: Scalar

    def instead(self, when: Flag, length: Scalar, target: float, **flags: Any) -> "_Goal":
        """Another length and target where `when` holds."""
        return self._replace(
            length=jnp.where(when, length, self.length),
            target=jnp.where(when, target, self.target),
            **flags,
        )


def _aimed(plan: Plan, lane: Lane, trial: Trial) -> tuple[Flag, Scalar, Scalar]:
    h = stop_gradient(trial.h)
    none = jnp.zeros_like(trial.good)
    # The earliest of several events is met first. The chord tells well enough which that is: a
    # landing that lies beyond another event is not accepted.
    first, target = jnp.full_like(h, jnp.inf), jnp.full_like(h, FREE)
    polynomial, crossed, landed, at_once = None, none, none, none
    facing_stop = [none for _ in trial.paths]
    for c in trial.crossings:
        over = trial.good & beyond(c)
        rise = jnp.where(over, c.end.x - c.begin.x, 1.0)
        place = jnp.where(over, jnp.maximum(-c.begin.x, 0.0) / rise, jnp.inf)
        sooner = place < first
        curve = quintic(c.begin, c.end, h)
        polynomial = curve if polynomial is None else select(sooner, curve, polynomial)
        target = jnp.where(sooner, c.name, target)
        first = jnp.where(sooner, place, first)
        crossed, landed = crossed | over, landed | c.landed
        if c.slack is not None:
            # At rest on a surface and on its way through: the event is where the step begins.
            still = (jnp.abs(c.begin.x) <= c.slack) & (c.begin.v == 0) & (c.begin.a > 0)
            at_once = jnp.where(sooner, over & still, at_once)
        if c.coordinate is not None:
            k, sign = c.coordinate, plan.scene.stops[c.number].sign
            facing_stop[k] = facing_stop[k] | (over & (lane.direction[k] == sign))
    turns, curves = [], []
    everything, soonest = plan.meets_turns(lane.done), jnp.full_like(h, jnp.inf)
    several = len(trial.paths) > 1
    exactly = exact(plan.scene, lane.state)
    eps = float(jnp.finfo(h.dtype).eps)
    now = 4 * eps * (1 + stop_gradient(trial.s))
    for k, path in enumerate(trial.paths):
        curves.append(quintic(path.begin, path.end, h))
        facing = tuple(-lane.direction[k] * c for c in slope(curves[k]))
        # The motion turned within the step. Unless it went through a stop before, that comes
        # first: what lies beyond the turn is met from there.
        turned = trial.good & (lane.direction[k] * path.end.v < 0)
        turned = turned & ~path.at_turn & ~facing_stop[k]
        if not exactly:
            # One that is closer than the clock can tell, as of a body that a rounded difference
            # has all but stopped, has nothing before it that could be stepped to. Nor is it one if
            # all that moves is rounding, as between bodies that go on together.
            moves = jnp.abs(path.end.v) * h > eps * (1 + jnp.abs(path.end.x))
            turned = turned & (jnp.abs(to_turn(path.end)) > now) & moves
        ahead = turned
        if several:  # of their turns that matter the earliest comes first
            place = rising_root(stop_gradient(facing))
            if everything is not True:
                matters = _matters(plan, everything, k, curves[k], place)
                turned = turned & (crossed | landed | matters)
            ahead = turned & (place < soonest)
            soonest = jnp.where(ahead, place, soonest)
        turns.append(turned)
        polynomial = facing if polynomial is None else select(ahead, facing, polynomial)
        target, at_once = jnp.where(ahead, to_turn_of(k), target), at_once & ~ahead
    assert polynomial is not None
    theta = pin(rising_root(stop_gradient(polynomial)))
    if any(c.slack is not None for c in trial.crossings):
        theta = jnp.where(at_once, 0.0, theta)
    goal = _Goal(crossed & ~landed, none, none, theta * h, target)
    for k, path in enumerate(trial.paths):
        turn = turns[k]
        if everything is not True and not several:
            matters = _matters(plan, everything, k, curves[k], theta)
            turn = turn & (crossed | landed | matters)
        goal = goal._replace(turn=goal.turn | turn)
        # Newton's step is better than the quintic once it is short.
        shift = to_turn(path.end)
        again = turn & (lane.target == to_turn_of(k)) & (jnp.abs(shift) < 0.25 * h)
        if several:
            again = again & (goal.target == to_turn_of(k))
        goal = goal._replace(length=jnp.where(again, h + shift, goal.length))
    busy = goal.aim | goal.turn | landed | at_a_turn(trial)
    for k, path in enumerate(trial.paths):
        begin, end = stop_gradient((path.begin, path.end))
        twice = trial.good & _may_turn_twice(lane.direction[k], path.surge, begin, end, h)
        goal = goal._replace(shorter=goal.shorter | twice & ~busy)
    for c in trial.crossings:
        again = c.again & ~goal.turn
        goal = goal.instead(again, h + stop_gradient(c.offset), c.name, aim=goal.aim | again)
    goal = goal.instead(goal.shorter, 0.5 * h, FREE)
    for c in trial.crossings:
        if c.event.holds_mode:
            above, place = _hump(c, h)
            above = above & trial.good & ~(goal.aim | goal.shorter | landed)
            goal = goal.instead(
                above, place, FREE, turn=goal.turn & ~above, shorter=goal.shorter | above
            )
    for k, path in enumerate(trial.paths):
        goal = _at_rest(lane, trial, goal, k, path, landed)
    return goal.aim | goal.turn | goal.shorter, stop_gradient(goal.length), goal.target


def may_matter(plan: Plan, lane: Lane, k: int, begin: Rates, end: Rates, h: Scalar) -> Flag:
    """Whether a turn of coordinate number k within a step may have to be met: by a bound, where
    `_matters` looks at the turn itself."""
    everything = plan.meets_turns(lane.done)
    if everything is True:
        return jnp.ones_like(h, bool)
    close = jnp.zeros_like(h, bool) if everything is False else everything
    for stop in plan.scene.stops:
        if stop.coordinate == k:
            gap = stop_gradient(stop.gap)
            top = highest(begin.scaled(stop.sign, gap), end.scaled(stop.sign, gap), h)
            close = close | (top > -_WIDER * MARGIN)
    return close


def _hump(c: Crossing, h: Scalar) -> tuple[Flag, Scalar]:
    """Whether a guard that is negative at both ends may have been positive in between, and where
    it was greatest. The tangents at both ends bound a hump that is curved one way."""
    begin, end = stop_gradient((c.begin, c.end))
    rises = (begin.x < 0) & (end.x < 0) & (begin.v > 0) & (end.v < 0)
    fall = jnp.where(rises, begin.v - end.v, 1.0)
    place = h * begin.v / fall
    bound = begin.x + begin.v * (end.x - end.v * h - begin.x) / fall
    brief = _BRIEF * h
    return rises & (bound > 0) & (place > brief) & (h - place > brief), place


def _matters(plan: Plan, everything: Any, k: int, curve: tuple, theta: Scalar) -> Flag:
    """Whether a turn has to be met: if not every one has, then only one close to a stop."""
    height = stop_gradient(curve[0])
    for n in range(1, len(curve)):
        height = height + stop_gradient(curve[n]) * theta**n
    close = jnp.zeros_like(theta, bool) if everything is False else everything
    for stop in plan.scene.stops:
        if stop.coordinate == k:
            close = close | (stop.beyond(height) > -MARGIN)
    return close


def _at_rest(lane: Lane, trial: Trial, goal: _Goal, k: int, path: Path, landed: Flag) -> _Goal:
    """The goal, where the force on a body that can rest is what matters first."""
    h = stop_gradient(trial.h)
    if path.surge is not None:
        # What the step met may not have been the first: look at the turn of the force before.
        begin, end = stop_gradient((path.begin, path.end))
        hidden, place = _force_may_turn(lane, k, begin, end, *path.surge, h)
        hidden = hidden & trial.good & ~(landed | at_a_turn(trial))
        goal = goal.instead(
            hidden, place, FREE,
            aim=goal.aim & ~hidden, turn=goal.turn & ~hidden, shorter=goal.shorter | hidden,
        )  # fmt: skip
    if path.leaves is not None:
        left, released = path.leaves.left, path.leaves.landed
        goal = goal.instead(
            left, path.leaves.place, to_release(k),
            aim=goal.aim & ~released | left, turn=goal.turn & ~left, shorter=goal.shorter & ~left,
        )  # fmt: skip
    return goal


def _may_turn_twice(
    direction: Scalar, surge: tuple | None, begin: Rates, end: Rates, h: Scalar
) -> Flag:
    """Whether the velocity, of one sign at both ends, dips so deep that it may have been zero.

    Such a step is halved until the turns lie apart or the dip is too short to matter. Where the
    force's rate of change is known, a force that sags between the ends is not taken for straight.
    """
    a0, a1 = direction * begin.a, direction * end.a
    dips = (a0 < 0) & (a1 > 0) & (h > 1e-3)
    if surge is None:
        # lowest < 0.1 (v0 + v1), times a1 - a0: without a division in each step.
        room = direction * (begin.v - 0.1 * (begin.v + end.v))
        return dips & (room * (a1 - a0) < 0.5 * h * a0 * a0)
    drop = 0.5 * h * a0 * (a0 / jnp.where(dips, a0 - a1, 1.0))
    j0, j1 = direction * surge[0], direction * surge[1]
    sags = dips & (j0 * h < a1 - a0) & (a1 - a0 < j1 * h)
    corner = jnp.where(sags, a1 - j1 * h - a0, 0.0) / jnp.where(sags, j0 - j1, 1.0)
    low = a0 + j0 * corner
    deep = 0.5 * corner * (a0 + low) - 0.5 * low * low / jnp.where(sags, j1, 1.0)
    flat = -0.5 * a0 * a0 / jnp.where(sags & (low >= 0), j0, 1.0)
    drop = jnp.where(sags, jnp.where(low < 0, deep, flat), drop)
    lowest = direction * begin.v + drop
    return dips & (lowest < 0.1 * direction * (begin.v + end.v))


def _force_may_turn(
    lane: Lane,
    k: int,
    begin: Rates,
    end: Rates,
    rate0: Scalar,
    rate1: Scalar,
    brief: Scalar,
    h: Scalar,
) -> tuple[Flag, Scalar]:
    """Whether the force, of one sign at both ends, may have had the other in between for a body
    that is slow enough to notice, and where it turned.

    It releases a body at rest for a moment, or turns one twice that has just left the stop. The
    tangents at both ends bound a force that is curved one way.
    """
    a0, a1 = begin.a, end.a
    place = h * rate0 / jnp.where(rate0 == rate1, 1.0, rate0 - rate1)
    turns = (rate0 * rate1 < 0) & (place > brief) & (h - place > brief)
    corner = (a1 - rate1 * h - a0) / jnp.where(rate0 == rate1, 1.0, rate0 - rate1)
    bound = a0 + rate0 * corner
    hidden = turns & (a0 * a1 >= 0) & (bound * (a0 + a1) < 0)
    if lane.contact is not None:
        # At rest the step may begin, to rounding, where the window does.
        direction = lane.direction[k]
        pressed = (lane.contact[k] > 0) & (direction * a1 >= 0) & (direction * bound < 0)
        hidden = hidden | (turns & pressed)
    largest = jnp.maximum(jnp.maximum(jnp.abs(a0), jnp.abs(a1)), jnp.abs(bound))
    slow = jnp.minimum(jnp.abs(begin.v), jnp.abs(end.v)) <= largest * h
    return hidden & slow, place
