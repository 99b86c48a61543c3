"""The end of the next step: the first event that a tried step passed, or that a motion known in
advance will meet."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from ..._types import Flag, Scalar, Scalars
from ...lanes import pin
from ...machine import RigidStop, clock_of, events_of, horner, section_number, stops_of, switches_of
from ..lane import FREE, Lane, any_of, select, to_event, to_release, to_turn_of
from ..methods import Foreseen
from ..plan import Plan
from ..smooth import stops_are_exact
from .guards import Crossing, Side, at_stops, beyond, for_each, may_be_above
from .roots import Rates, highest, offset_to_turn, quintic, rising_root, slope
from .trial import Path, Trial

# A hump of a guard this close to an end of a step (as a share of it) is visible there: a choice.
_BRIEF = 1e-3

# The polynomial of a guard is evaluated at the ends of this many parts of the step. It is corrected
# by stages that are no closer to its ends than this share. Choices; the 15 heights between the ends
# fit in a kernel's registers, without which a friction takes a fifth longer.
_PARTS = 16
_EDGE = 0.1

# Steps shorter than this (in s, for a cycle of about 2π) are not shortened any more: in double
# precision; in single precision, which lands less accurately; and for a dip of the velocity.
_SHORTEST, _SHORTEST_SINGLE, _SHORTEST_DIP = 1e-6, 1e-3, 1e-3


def _corner(
    begin: tuple[Scalar, Scalar], end: tuple[Scalar, Scalar], h: Scalar, bent: Flag
) -> tuple[Scalar, Scalar, Scalar]:
    """Return the place, from the start of a step, where the tangents at both ends meet, and their
    height there, which no curve bent one way exceeds; and the place of the maximum if the slope
    changes linearly. `begin` and `end` are value and slope at the ends."""
    (x0, v0), (x1, v1) = begin, end
    fall = jnp.where(bent, v0 - v1, 1.0)
    place = (x1 - v1 * h - x0) / fall
    return place, x0 + v0 * place, h * v0 / fall


def hump(plan: Plan, c: Crossing, h: Scalar) -> tuple[Flag, Scalar]:
    """Return whether a guard that is negative at both ends may have been positive in between, and
    the place of its maximum. For a guard that falls at both ends but has risen in between, as after
    a standstill of a body, it is a place from which the maximum is visible."""
    begin, end = stop_gradient((c.begin, c.end))
    rises = (begin.x < 0) & (end.x < 0) & (begin.v > 0) & (end.v < 0)
    _, bound, place = _corner((begin.x, begin.v), (end.x, end.v), h, rises)
    brief = _BRIEF * h
    visible = rises & (bound > 0) & (place > brief) & (h - place > brief)
    dips = (begin.x <= 0) & (end.x < 0) & (begin.v < 0) & (end.v < 0) & (begin.a > 0)
    least = -begin.v / jnp.where(dips, begin.a, 1.0)
    dips = dips & (least < 0.5 * h) & _may_be_shortened(plan, h)
    return visible | dips, jnp.where(dips, jnp.maximum(1.5 * least, brief), place)


def crests(
    plan: Plan, sides: list[Side], below: list[Flag], shares: tuple[float, ...], h: Scalar
) -> list[tuple[Flag, Scalar]]:
    """Return for each function whether it may have been positive within a step, and the first such
    place. Functions with a false flag in `below` are skipped. `shares` are the stages' places."""
    ends = [stop_gradient((x.begin.x, x.begin.v, x.end.x, x.end.v)) for x in sides]
    values = [stop_gradient(x.within) for x in sides]
    slack = [jnp.asarray(x.slack, h.dtype) for x in sides]
    find = partial(_crest, plan, shares, h)
    stacked = jtu.tree_map(lambda *x: jnp.stack(x), *zip(ends, values, slack, strict=True))

    @jax.jit  # so that its code is written once
    def quick_test(given: Sequence[Any]) -> Flag:
        x, inner, zero = given
        return may_be_above(x[:2], x[2:], inner, shares, zero)

    no = jnp.zeros((), bool)
    doubtful = jnp.stack([
        flag & quick_test(x) if side.is_used is None
        else jax.lax.cond(flag, quick_test, lambda _: no, x)
        for side, *x, flag in zip(sides, ends, values, slack, below, strict=True)
    ])  # fmt: skip

    def one(flag: Flag, side: tuple) -> tuple[Flag, Scalar]:
        no_place = jnp.zeros((), bool), jnp.zeros_like(h)
        return jax.lax.cond(flag, lambda x: find(*x), lambda _: no_place, side)

    no_places = jnp.zeros(len(sides), bool), jnp.zeros(len(sides), h.dtype)
    arguments = doubtful, stacked
    above, place = jax.lax.cond(
        jnp.any(doubtful), lambda x: for_each(one, x), lambda _: no_places, arguments
    )
    return [(above[n], place[n]) for n in range(len(sides))]


def _crest(
    plan: Plan, shares: tuple[float, ...], h: Scalar, ends: Scalars, values: Array, slack: Scalar
) -> tuple[Flag, Scalar]:
    """Return `crests` of one function from value and slope at the `ends`, and `values` at stages.
    The function is replaced by the cubic through both ends plus a correction, exact at the stages.
    The correction is the shape of the cubic's error times a factor, interpolated linearly. The
    factor's greatest change from stage to stage is a margin."""
    x0, v0, x1, v1 = ends
    height0, rises, height1, falls = x0 - slack, h * v0, x1 - slack, h * v1
    grid, inner = np.arange(1, _PARTS) / _PARTS, _inner(shares)

    def cubic(theta: np.ndarray) -> Array:
        left = 1 - theta
        late, early = theta * theta * (1 + 2 * left), left * left * (1 + 2 * theta)
        slopes = rises * (theta * left * left) - falls * (theta * theta * left)
        return height0 * early + height1 * late + slopes

    heights = cubic(grid)
    if inner:
        places = np.asarray([shares[n] for n in inner])
        err = (values[np.asarray(inner)] - slack - cubic(places)) / _bump(places)
        left = np.clip(np.searchsorted(places, grid) - 1, 0, max(len(inner) - 2, 0))
        right = np.minimum(left + 1, len(inner) - 1)
        share = np.interp(grid, places, np.arange(len(inner))) - left
        margin = jnp.max(jnp.abs(err[1:] - err[:-1])) if len(inner) > 1 else jnp.abs(err[0])
        heights = heights + _bump(grid) * (err[left] + share * (err[right] - err[left]) + margin)
    begin, end = (height0, rises / _PARTS), (height1, falls / _PARTS)
    above, place = _first_top(heights, begin, end)
    first = jnp.min(jnp.where(values > slack, np.asarray(shares), 2.0))
    place = jnp.maximum(jnp.minimum(place, first), _BRIEF)
    return (above | (first < 1)) & _may_be_shortened(plan, h), place * h


def _may_be_shortened(plan: Plan, h: Scalar) -> Flag:
    return h > plan.in_units(_SHORTEST if h.dtype == jnp.float64 else _SHORTEST_SINGLE)


def _inner(shares: tuple[float, ...]) -> list[int]:
    """Return the stages that are apart from the ends of the step and from each other, in order."""
    found: dict[float, int] = {}
    for n, share in enumerate(shares):
        if _EDGE <= share <= 1 - _EDGE:
            found.setdefault(round(share, 6), n)
    return [found[share] for share in sorted(found)]


def _first_top(
    heights: Array, begin: tuple[Scalar, Scalar], end: tuple[Scalar, Scalar]
) -> tuple[Flag, Scalar]:
    """Return whether a curve is positive between its ends, and the first such place as a share. The
    curve consists of parabolas through its heights at equal distances, between the ends and at
    them, and through the slopes at the ends, per distance; `begin` and `end` are height and slope.
    """
    parts, (first, rise), (last, fall) = heights.size + 1, begin, end
    before = jnp.concatenate([first[None], heights[:-1]])
    after = jnp.concatenate([heights[1:], last[None]])
    bend, tilt = 2 * heights - before - after, after - before
    top = (heights >= before) & (heights >= after) & (bend > 0)
    found = (heights > 0) | top & (tilt * tilt > -8 * bend * heights)
    at = np.arange(1, parts) + jnp.where(top, 0.5 * tilt / jnp.where(top, bend, 1.0), 0.0)
    place = jnp.min(jnp.where(found, at, parts + 1.0))

    def top_near_end(height: Scalar, slope: Scalar, next_one: Scalar) -> Scalar:
        bend = height + slope - next_one
        found = (slope > 0) & (slope < 2 * bend) & (slope * slope > -4 * bend * height)
        return jnp.where(found, slope / jnp.where(found, 2 * bend, 1.0), parts + 1.0)

    place = jnp.minimum(place, top_near_end(first, rise, heights[0]))
    late = top_near_end(last, -fall, heights[-1])
    place = jnp.minimum(place, jnp.where(late < parts, parts - late, parts + 1.0))
    return place < parts, place / parts


def _bump(share: np.ndarray) -> np.ndarray:
    """Return the shape of a cubic Hermite interpolant's error; 1 in the middle."""
    return (4 * share * (1 - share)) ** 2


def may_turn_twice(plan: Plan, direction: Scalar, path: Path, h: Scalar) -> Flag:
    """Return whether the velocity, of one sign at both ends, may have been zero in between. Then
    the step is halved, until each step has one turning point or the dip is too short to matter. The
    rates of the force show whether it sags; where they are unknown, it counts as linear."""
    begin, end = path.begin, path.end
    a0, a1 = direction * begin.a, direction * end.a
    dips = (a0 < 0) & (a1 > 0) & (h > plan.in_units(_SHORTEST_DIP))
    # lowest < 0.1 (v0 + v1), times a1 - a0: without a division in each step.
    room = direction * (begin.v - 0.1 * (begin.v + end.v))
    linear = dips & (room * (a1 - a0) < 0.5 * h * a0 * a0)
    if path.near is None:
        return linear
    j0, j1 = direction * path.near.begin, direction * path.near.end
    sags = dips & (j0 * h < a1 - a0) & (a1 - a0 < j1 * h)

    def sagging(_: object) -> Flag:
        corner, low, _ = _corner((a0, j0), (a1, j1), h, sags)
        deep = 0.5 * corner * (a0 + low) - 0.5 * low * low / jnp.where(sags, j1, 1.0)
        flat = -0.5 * a0 * a0 / jnp.where(sags & (low >= 0), j0, 1.0)
        return jnp.where(low < 0, deep, flat) < -room

    return jax.lax.cond(sags, sagging, lambda _: linear, None)


def force_may_turn(lane: Lane, k: int, path: Path, h: Scalar) -> tuple[Flag, Scalar]:
    """Return whether the force, of one sign at both ends, may have changed sign in between for a
    body slow enough to be affected, and the place of its extremum. Such a force releases a body at
    rest for a moment, or turns a body twice that has just left the stop."""
    assert path.near is not None and lane.contact is not None
    begin, end, (_, rate0, rate1, brief) = path.begin, path.end, path.near
    a0, a1 = begin.a, end.a
    bent = rate0 * rate1 < 0
    _, bound, place = _corner((a0, rate0), (a1, rate1), h, bent)
    turns = bent & (place > brief) & (h - place > brief)
    hidden = turns & (a0 * a1 >= 0) & (bound * (a0 + a1) < 0)
    # The step may begin at rest, to rounding, where the window of force begins.
    direction = lane.direction[k]
    pressed = (lane.contact[k] > 0) & (direction * a1 >= 0) & (direction * bound < 0)
    hidden = hidden | (turns & pressed)
    largest = jnp.maximum(jnp.maximum(jnp.abs(a0), jnp.abs(a1)), jnp.abs(bound))
    slow = jnp.minimum(jnp.abs(begin.v), jnp.abs(end.v)) <= largest * h
    return hidden & slow, place


# Coefficients in θ, which goes from 0 to 1 along a step.
Curve = Scalars

# An event, whether a step ends beyond it, and its guard along the step. For a coordinate, whether
# it turned within the step, and its path along it. Curves are computed only if an event is met.
Passed = tuple[Crossing, Flag, Callable[[], Curve]]
Course = tuple[Flag, Callable[[], Curve]]

# Turning points this far inside the gap (in units of `Plan.extent`) are not located if only impacts
# matter. A choice: the quintic through a step's ends has to be accurate to this.
_MARGIN = 0.02

# Factor that widens a bound to cover rounding.
_WIDER = 1.001

# After this many attempts at an event a step is this much shorter, so that the event comes within a
# thousandth of it: choices.
_PATIENCE, _SHORT = 8.0, 0.999

# A turn's place is uncertain if the velocity there is above this share of that at the ends.
_UNCERTAIN = 1e-3


class FirstEvent(NamedTuple):
    """The first event of a step."""

    crossed: Flag
    """True if the step ends beyond an event."""
    turned: Flag
    """True if a turning point that matters comes before any event."""
    theta: Scalar
    """The place of the event or turn within the step, if there is one."""
    target: Scalar


def first_event(
    plan: Plan, lane: Lane, guards: list[Passed], turns: list[Course], met: Flag, corrections: int
) -> FirstEvent:
    """Return the first event of a step, by the `guards` of events and the `turns` of coordinates
    (not both empty). `met` is whether the step landed on its target. A root is corrected
    `corrections` times; a quintic through a step's ends needs none: its root is only the next
    target."""
    found, crossed, any_turn = [], jnp.zeros_like(met), jnp.zeros_like(met)
    for guard, over, curve in guards:
        # The chord is accurate enough to find the first event: a landing that lies beyond another
        # event is not accepted.
        begin, end = guard.begin.x, guard.end.x
        # An event that lies behind a step of length zero is met at its start.
        rise = jnp.where(end > begin, end - begin, 1.0)
        place = jnp.where(over, jnp.maximum(-begin, 0.0) / rise, jnp.inf)
        if guard.above is not None:  # before any turn
            place = jnp.where(guard.above, -3.0, place)
        found.append((place, to_event(guard.number), curve(), guard.at_once))
        crossed = crossed | over
    event_met = crossed | met
    paths = [curve() for _, curve in turns]

    def matters(k: int, turned: Flag, theta: Scalar, certain: Flag | None) -> Flag:
        if plan.meets_every_turn:
            return turned
        height = horner(paths[k], theta)
        close = _must_end_at_turn(plan, lane, k, lambda stop: stop.beyond(height), _MARGIN)
        return turned & (event_met | close if certain is None else event_met | ~certain | close)

    for k, (turned, _) in enumerate(turns):
        facing = tuple(-lane.direction[k] * c for c in slope(paths[k]))
        # The motion turned within the step. Unless it went through a stop before, that comes first:
        # events beyond the turn are met by the next steps.
        turned, place = turned & ~_passed_stop(plan, lane, guards, k), -1.0
        if len(turns) > 1:  # of the turns that matter the earliest comes first
            theta, certain = _root(facing, corrections)
            turned, place = matters(k, turned, theta, certain), theta - 2
        found.append((jnp.where(turned, place, jnp.inf), to_turn_of(k), facing, None))
        any_turn = any_turn | turned
    target, curve, at_once = _earliest(lane, found)
    theta, certain = _root(curve, corrections)
    if len(turns) == 1:  # one root serves for the turn as well
        any_turn = matters(0, any_turn, theta, certain)
    if at_once is not None:
        theta = jnp.where(at_once, 0.0, theta)
    return FirstEvent(crossed, any_turn, theta, target)


def _earliest(lane: Lane, found: list[tuple]) -> tuple[Scalar, Curve, Flag | None]:
    """Return the earliest event of a step: its target, the curve that rises through zero there, and
    whether it lies at the start of the step (`None` if it cannot). In `found` the place comes
    before these: infinite if the event was not met, negative if it comes before any other."""
    (soonest, target, curve, at_once), *others = found
    target = jnp.full_like(lane.s, target)
    for place, its_target, its_curve, its_at_once in others:
        sooner = place < soonest
        soonest = jnp.where(sooner, place, soonest)
        target = jnp.where(sooner, its_target, target)
        curve = select(sooner, its_curve, curve)
        if at_once is not None:
            at_once = jnp.where(sooner, False if its_at_once is None else its_at_once, at_once)
    return target, curve, at_once


def _passed_stop(plan: Plan, lane: Lane, guards: list[Passed], k: int) -> Flag:
    through = jnp.zeros_like(lane.s, bool)
    for guard, over, _ in guards:
        if guard.coordinate == k:
            sign = stops_of(plan.machine)[guard.number].sign
            through = through | over & (lane.direction[k] == sign)
    return through


def _root(curve: Curve, corrections: int) -> tuple[Scalar, Flag | None]:
    """Return the place where a curve first rises through zero. If it was corrected, also return
    whether the value before the last correction was small relative to the curve's ends."""
    # The low orders dominate near the root; the rest is a correction.
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
    """Return whether a step of length h may have to end at a turning point of coordinate number k.
    The test is a bound, before the place of the turn is known."""

    def bound(stop: RigidStop) -> Scalar:
        gap = stop_gradient(stop.gap)
        return highest(begin.scaled(stop.sign, gap), end.scaled(stop.sign, gap), h)

    return _must_end_at_turn(plan, lane, k, bound, _WIDER * _MARGIN)


def _must_end_at_turn(
    plan: Plan, lane: Lane, k: int, depth: Callable[[RigidStop], Scalar], margin: float
) -> Flag:
    """Return whether a step has to end at a turning point of coordinate number k: at each one (see
    `Plan.meets_turns`), or if its `depth` beyond a stop is greater than -`margin`, in extents."""
    close = plan.meets_turns(lane.done)
    if plan.meets_every_turn:
        return close
    for stop in stops_of(plan.machine):
        if stop.coordinate == k:
            close = close | (depth(stop) > -margin * plan.extent(k))
    return close


def aim_ahead(plan: Plan, lane: Lane, motion: Foreseen) -> Lane:
    """Return the lane with its next step cut at the first event of `motion`, for a method that
    computes it before the step (`Taylor`). It finds stops, turning points and a clock in the state;
    `aim_at` finds other events."""
    limit = stop_gradient(jnp.asarray(plan.method.longest(plan.machine, lane.s, lane.state)))
    h = jnp.minimum(lane.attempt, motion.reach(limit))
    if plan.s_counts_cycles(lane.state):
        h = jnp.minimum(h, plan.end(lane.part) - lane.s)
    h = stop_gradient(h)
    guards, turns = _foreseen(plan, lane, motion, h)
    nothing, uncut = jnp.zeros_like(h, bool), (h, jnp.full_like(h, FREE))

    def cut(uncut: tuple) -> tuple:
        first = first_event(plan, lane, guards, turns, nothing, corrections=2)
        return select(first.crossed | first.turned, (first.theta * h, first.target), uncut)

    met = nothing
    for flag in (*(over for _, over, _ in guards), *(turned for turned, _ in turns)):
        met = met | flag
    nothing_to_meet = not guards and not turns
    length, target = uncut if nothing_to_meet else jax.lax.cond(met, cut, lambda x: x, uncut)
    free = lane.target == FREE
    return lane._replace(
        attempt=jnp.where(free, length, lane.attempt),
        target=jnp.where(free, target, lane.target),
    )


def _foreseen(
    plan: Plan, lane: Lane, motion: Foreseen, h: Scalar
) -> tuple[list[Passed], list[Course]]:
    """Return the arguments of `first_event` for a step of length h along `motion`."""
    machine, turns, ends, paths = plan.machine, [], [], []
    if plan.records_motion or stops_of(machine):
        paths = [motion.of(coordinate.position) for coordinate in machine.coordinates]
    if not stops_are_exact(machine, lane.state):
        shortest = 64 * float(jnp.finfo(h.dtype).eps) * (plan.unit + stop_gradient(lane.s))
        paths = [path.without_rounding_after_release(shortest) for path in paths]
    for k, path in enumerate(paths):
        begin, end = path.ends(h)
        turned = (lane.direction[k] * end.v < 0) & may_matter(plan, lane, k, begin, end, h)
        if lane.contact is not None:  # a body at rest meets nothing
            turned = turned & (lane.contact[k] == 0)
        turns.append((turned, partial(path.over, h)))
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
    return guards, turns


def aim_at(plan: Plan, lane: Lane, trial: Trial, foreseen: bool) -> tuple[Flag, Scalar, Scalar]:
    """Return whether a tried step has to be shortened to end at an event, to what length, and its
    target (see `Lane.target`). If the motion is `foreseen`, `aim_ahead` has found its turns."""
    # The result only directs the search, so that it needs no derivatives.
    trial = trial._replace(h=stop_gradient(trial.h), paths=stop_gradient(trial.paths))
    no_goal = jnp.zeros_like(trial.good), trial.h, jnp.full_like(trial.h, FREE)
    if not trial.paths and not trial.crossings:
        return no_goal
    found = _find_events(plan, lane, trial)
    # Rare: skipped if no lane of a group has met anything.
    return jax.lax.cond(
        _may_have_met(plan, lane, trial, found, foreseen),
        lambda _: _next_goal(plan, lane, trial, found),
        lambda x: x,
        no_goal,
    )


def is_at_turn(trial: Trial) -> Flag:
    return any_of(trial.good, (path.at_turn for path in trial.paths))


class _Found(NamedTuple):
    """The events between the ends of a tried step, as found from its ends and stages."""

    guards: list[Passed]
    turns: list[Course]
    """Both are arguments of `first_event`: quintics through the step's ends."""
    humps: list[tuple[Flag, Scalar]]
    """For each guard that holds a mode, whether and where it may have been positive between."""
    rises: list[tuple[Flag, Scalar]]
    """The same for guards that were evaluated at stages and for forces on resting bodies, also
    before an event on which the step landed."""
    windows: dict[int, tuple[Flag, Scalar]]
    """The same for the force on each coordinate that can rest (`force_may_turn`)."""
    twice: Flag
    """True if a motion may have turned twice."""


def _may_have_met(plan: Plan, lane: Lane, trial: Trial, found: _Found, foreseen: bool) -> Flag:
    """Return whether a step may have met anything; if not, `_next_goal` need not be evaluated."""
    met = trial.good & ((lane.target != FREE) & ~is_at_turn(trial) | found.twice)
    for k, path in enumerate(trial.paths):
        if path.near is not None:
            met = met | found.windows[k][0] | path.near.release.left
    for crossing, over, _ in found.guards:
        met = met | over & ~crossing.landed | crossing.again
    for above, _ in (*found.humps, *found.rises):
        met = met | above
    for k, ((turned, _), path) in enumerate(zip(found.turns, trial.paths, strict=True)):
        if not foreseen:
            met = met | turned & may_matter(plan, lane, k, path.begin, path.end, trial.h)
    return met if trial.clear is None else met & ~trial.clear


class _Goal(NamedTuple):
    """The end of the next step."""

    event: Flag
    """True if it is at an event that was met."""
    before: Flag
    """True at a turning point, or if something may have happened twice: before any event."""
    length: Scalar
    target: Scalar

    def cut(self, condition: Flag, length: Scalar) -> "_Goal":
        """Return the goal at this length where `condition` is true, without a target."""
        return _Goal(
            self.event & ~condition,
            self.before | condition,
            jnp.where(condition, length, self.length),
            jnp.where(condition, FREE, self.target),
        )


def _next_goal(plan: Plan, lane: Lane, trial: Trial, found: _Found) -> tuple[Flag, Scalar, Scalar]:
    h, landed = trial.h, any_of(trial.good, (c.landed for c in trial.crossings))
    first = first_event(plan, lane, found.guards, found.turns, landed, corrections=0)
    met = landed | is_at_turn(trial)
    goal = _Goal(first.crossed & ~landed, first.turned, pin(first.theta) * h, first.target)
    goal = _by_newton(lane, trial, goal)
    for above, place in reversed(found.humps):  # of several the first listed
        goal = goal.cut(above & ~(goal.event | landed), place)
    nothing_else = trial.good & ~(first.crossed | first.turned | met)
    goal = goal.cut(found.twice & nothing_else, 0.5 * h)
    for k, path in enumerate(trial.paths):
        if path.near is not None:
            # An event may have come before the one that was met: step to the force's extremum.
            hidden, place = found.windows[k]
            goal = goal.cut(hidden & ~met, place)
            release = path.near.release
            goal = _Goal(
                event=goal.event & ~release.landed | release.left,
                before=goal.before & ~release.left,
                length=jnp.where(release.left, release.place, goal.length),
                target=jnp.where(release.left, to_release(k), goal.target),
            )
    for above, place in reversed(found.rises):
        goal = goal.cut(above & ~goal.event, place)
    return goal.event | goal.before, stop_gradient(goal.length), goal.target


def _find_events(plan: Plan, lane: Lane, trial: Trial) -> _Found:
    h, good, guards, turns, humps = trial.h, trial.good, [], [], []
    sides, below, windows = [], [], {}
    for c in trial.crossings:
        guards.append((c, good & beyond(c), partial(quintic, c.begin, c.end, h)))
        if c.event.holds_mode:
            above, place = hump(plan, c, h)
            humps.append((good & above, place))
        for side in c.sides:
            slack = 0.0 if c.slack is None else c.slack
            sides.append(side._replace(slack=slack))
            below.append((side.end.x <= slack) | c.landed)
    stops_exact, twice = stops_are_exact(plan.machine, lane.state), jnp.zeros_like(good)
    eps = float(jnp.finfo(h.dtype).eps)
    for k, path in enumerate(trial.paths):
        if path.near is not None:
            left, landed = path.near.release.left, path.near.release.landed
            hidden, place = force_may_turn(lane, k, path, h)
            windows[k] = good & hidden, place
            if path.pull is not None and path.pull.is_used is not None:
                sides.append(path.pull)
                below.append(~left & ((path.pull.end.x <= 0) | landed) & path.pull.is_used)
        end, twice = path.end, twice | may_turn_twice(plan, lane.direction[k], path, h)
        turned = good & (lane.direction[k] * end.v < 0) & ~path.at_turn
        if lane.contact is not None:  # at rest a velocity is the error of the landing
            turned = turned & (lane.contact[k] == 0)
        if not stops_exact or any(x.blends for x in switches_of(plan.machine)):
            # A turn that is closer than the clock resolves, as of a body that a rounded difference
            # has almost stopped, has nothing before it to step to. Nor does it count if all that
            # moves is rounding, as between bodies that move together.
            resolution = 4 * eps * (plan.unit + stop_gradient(trial.s))
            is_moving = jnp.abs(end.v) * h > eps * (plan.extent(k) + jnp.abs(end.x))
            turned = turned & (jnp.abs(offset_to_turn(end)) > resolution) & is_moving
        turns.append((turned, partial(quintic, path.begin, end, h)))
    rises = []
    if sides:
        below = [good & x for x in below]
        found = crests(plan, sides, below, trial.shares, h)
        rises = [(x & y, at) for (x, at), y in zip(found, below, strict=True)]
    return _Found(guards, turns, humps, rises, windows, twice)


def _by_newton(lane: Lane, trial: Trial, goal: _Goal) -> _Goal:
    """Return the goal with lengths by Newton's method, which is better close to an event."""
    turns, h = goal.before, trial.h
    for k, path in enumerate(trial.paths):
        shift, turn = offset_to_turn(path.end), to_turn_of(k)
        again = turns & (goal.target == turn) & (lane.target == turn) & (jnp.abs(shift) < 0.25 * h)
        goal = goal._replace(length=jnp.where(again, h + shift, goal.length))
    for c in reversed(trial.crossings):  # of several the first listed
        again = c.again & ~turns
        goal = goal._replace(
            event=goal.event | again,
            length=jnp.where(again, h + stop_gradient(c.offset), goal.length),
            target=jnp.where(again, to_event(c.number), goal.target),
        )
    for c in trial.crossings:
        if c.event.is_plain and c.above is not None:
            # Attempts may all lie beyond a guard without a slope: then one falls short.
            stuck = goal.event & ~c.again & (lane.attempts >= _PATIENCE)
            stuck = stuck & (goal.target == to_event(c.number)) & (lane.target == goal.target)
            goal = goal._replace(length=jnp.where(stuck, _SHORT * goal.length, goal.length))
    return goal
