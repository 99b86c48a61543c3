"""The first event on the way of a step: a guard that rises, or a turning point that matters."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars
from ...machine import RigidStop, horner, stops_of
from .._lane import Lane, Plan, select, to_event, to_turn_of
from ..events import Rates, highest, rising_root, slope
from .guards import Crossing

# Coefficients in θ, which goes from 0 to 1 along a step.
Curve = Scalars

# An event, whether a step ends beyond it, and its guard along the step; of a coordinate whether it
# turned within the step, and itself along it. Curves are asked for only where something is met.
Passed = tuple[Crossing, Flag, Callable[[], Curve]]
Course = tuple[Flag, Callable[[], Curve]]

# Turning points this far inside the gap (in units of `Plan.extent`) are passed by where only
# impacts matter. A choice: the quintic through a step's ends has to be right to this.
_MARGIN = 0.02

# By so much a bound is wider, for what rounding makes of it.
_WIDER = 1.001

# A turn whose velocity is known no better than to this share of that at the step's ends: a choice.
_UNCERTAIN = 1e-3


class First(NamedTuple):
    """What a step meets first."""

    crossed: Flag
    """The step ends beyond an event."""
    turned: Flag
    """There is a turn that matters, which comes before."""
    theta: Scalar
    """Where it lies, if there is one."""
    target: Scalar


def first_event(
    plan: Plan, lane: Lane, guards: list[Passed], courses: list[Course], met: Flag, corrections: int
) -> First:
    """The first event of a step.

    **Arguments:** `guards` and `courses`, what is known of the events and of each coordinate, not
    both empty; `met`, whether the step landed on an event that it was aimed at; `corrections`, how
    often a root is corrected: a motion's own polynomial is worth it, one through a step's ends only
    says where to aim.
    """
    found, crossed, any_turn = [], jnp.zeros_like(met), jnp.zeros_like(met)
    for guard, over, curve in guards:
        # The chord tells well enough which event is the first: a landing that lies beyond another
        # one is not accepted.
        begin, end = guard.begin.x, guard.end.x
        # One that a step without length is beyond is met where it begins.
        rise = jnp.where(end > begin, end - begin, 1.0)
        place = jnp.where(over, jnp.maximum(-begin, 0.0) / rise, jnp.inf)
        if guard.above is not None:  # before any turn
            place = jnp.where(guard.above, -3.0, place)
        found.append((place, to_event(guard.number), curve(), guard.at_once))
        crossed = crossed | over
    behind = crossed | met
    paths = [curve() for _, curve in courses]

    def that_matter(k: int, turned: Flag, theta: Scalar, known: Flag | None) -> Flag:
        if plan.meets_every_turn:
            return turned
        height = horner(paths[k], theta)
        close = _has_to_be_met(plan, lane, k, lambda stop: stop.beyond(height), _MARGIN)
        return turned & (behind | close if known is None else behind | ~known | close)

    for k, (turned, _) in enumerate(courses):
        facing = tuple(-lane.direction[k] * c for c in slope(paths[k]))
        # The motion turned within the step. Unless it went through a stop before, that comes
        # first: what lies beyond the turn is met from there.
        turned, place = turned & ~_through_a_stop(plan, lane, guards, k), -1.0
        if len(courses) > 1:  # of their turns that matter the earliest comes first
            theta, known = _root(facing, corrections)
            turned, place = that_matter(k, turned, theta, known), theta - 2
        found.append((jnp.where(turned, place, jnp.inf), to_turn_of(k), facing, None))
        any_turn = any_turn | turned
    target, curve, at_once = _earliest(lane, found)
    theta, known = _root(curve, corrections)
    if len(courses) == 1:  # one root serves for the turn as well
        any_turn = that_matter(0, any_turn, theta, known)
    if at_once is not None:
        theta = jnp.where(at_once, 0.0, theta)
    return First(crossed, any_turn, theta, target)


def _earliest(lane: Lane, found: list[tuple]) -> tuple[Scalar, Curve, Flag | None]:
    """The earliest of what a step met: its target, the curve that rises through zero there, and
    whether that is where the step begins (`None` if it cannot be).

    **Arguments:** `found`, of each of these before the three its place: infinite if it was not met,
    below zero if it comes before any event.
    """
    (soonest, target, curve, at_once), *others = found
    target = jnp.full_like(lane.s, target)
    for place, its_target, its_curve, begins in others:
        sooner = place < soonest
        soonest = jnp.where(sooner, place, soonest)
        target = jnp.where(sooner, its_target, target)
        curve = select(sooner, its_curve, curve)
        if at_once is not None:
            at_once = jnp.where(sooner, False if begins is None else begins, at_once)
    return target, curve, at_once


def _through_a_stop(plan: Plan, lane: Lane, guards: list[Passed], k: int) -> Flag:
    """Whether coordinate number k, as it went when the step began, ran into a stop."""
    through = jnp.zeros_like(lane.s, bool)
    for guard, over, _ in guards:
        if guard.coordinate == k:
            sign = stops_of(plan.machine)[guard.number].sign
            through = through | over & (lane.direction[k] == sign)
    return through


def _root(curve: Curve, corrections: int) -> tuple[Scalar, Flag | None]:
    """Where a curve first rises through zero; and, where the root was corrected, whether it is
    known well enough: by what was left before the last correction, beside the curve at its ends."""
    # The low orders lead near the root; what is left is a correction.
    theta, value = rising_root(stop_gradient(curve[:7])), jnp.zeros_like(curve[0])
    if not corrections:
        return theta, None
    derivative = slope(curve)[:-1]
    for _ in range(corrections):
        value, rate = horner(curve, theta), horner(derivative, theta)
        better = theta - value / jnp.where(rate > 0, rate, 1.0)
        theta = jnp.where((rate > 0) & (better > 0) & (better <= 1), better, theta)
    ends = jnp.maximum(jnp.abs(curve[0]), jnp.abs(sum(curve[1:], curve[0])))
    return theta, jnp.abs(value) <= _UNCERTAIN * ends


def may_matter(plan: Plan, lane: Lane, k: int, begin: Rates, end: Rates, h: Scalar) -> Flag:
    """Whether a step may have to end at a turning point of coordinate number k: by a bound, before
    the place of the turn is known.

    **Arguments:** `begin` and `end`, the coordinate's rates at the ends of the step, `h` its
    length.
    """

    def bound(stop: RigidStop) -> Scalar:
        gap = stop_gradient(stop.gap)
        return highest(begin.scaled(stop.sign, gap), end.scaled(stop.sign, gap), h)

    return _has_to_be_met(plan, lane, k, bound, _WIDER * _MARGIN)


def _has_to_be_met(
    plan: Plan, lane: Lane, k: int, depth: Callable[[RigidStop], Scalar], margin: float
) -> Flag:
    """Whether a step has to end at a turning point of coordinate number k: at each one (see
    `Plan.meets_turns`), or if it is close to a stop.

    **Arguments:** `depth`, how far the turn is beyond a stop; `margin`, how far short of a stop is
    close.
    """
    close = plan.meets_turns(lane.done)
    if plan.meets_every_turn:
        return close
    for stop in stops_of(plan.machine):
        if stop.coordinate == k:
            close = close | (depth(stop) > -margin * plan.extent(k))
    return close
