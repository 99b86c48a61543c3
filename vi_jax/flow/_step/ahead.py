"""Where the next step should end, for a method that knows the motion before the step is taken."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ...scene.event import section_number
from ...scene.trig import horner
from .._lane import FREE, Lane, Plan, to_event, to_turn_of
from ..events import Rates, rising_root, slope
from ..methods._series import Series, at
from .aim import MARGIN, may_matter, select

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

# A turn whose velocity is told no better than to this share of that at the step's ends.
_UNTOLD = 1e-3


def _powers(series: Series, h: Scalar, zero: Scalar) -> tuple[Scalar, ...]:
    """Coefficients in θ = (s - s0)/h, so that the step is θ from 0 to 1."""
    out, power = [], None
    for c in series:
        out.append(zero if c is None else c if power is None else c * power)
        power = h if power is None else power * h
    return tuple(out)


def _ends(path: Series, speed: Scalar, h: Scalar, zero: Scalar) -> tuple[Rates, Rates]:
    """Rates of a path at both ends of a step of length h, at whose end it has this speed."""
    bend = _slope(_slope(path))
    end = Rates(_sum(path, h, zero), speed, _sum(bend, h, zero))
    return Rates(*(_sum(x[:1], h, zero) for x in (path, path[1:], bend))), end


def _slope(series: Series) -> Series:
    return [None if c is None else c * float(n) for n, c in enumerate(series)][1:]


def _shifted(series: Series, sign: float, offset: Any) -> Series:
    """sign·x - offset."""
    turned = [None if c is None else sign * c for c in series]
    first = turned[0]
    turned[0] = -offset if first is None else first - offset
    return turned


def look(plan: Plan, lane: Lane, motion: Any, h: Scalar) -> tuple[Scalar, Scalar]:
    """Length and target of a free step of length h along `motion`, cut at its first event.

    The same events as `aim_at` looks for, but on the motion's own polynomials, so that the step
    lands on what it aims at.
    """
    scene = plan.scene
    zero, none = jnp.zeros_like(h), jnp.zeros_like(h, bool)
    events: list[tuple[int, Series]] = []
    paths, speeds, turns = [], [], []
    if plan.motion or scene.stops:
        for k, coordinate in enumerate(scene.coordinates):
            paths.append(motion.of(coordinate.position))
            speeds.append(_sum(_slope(paths[k]), h, zero))
            turn = lane.direction[k] * speeds[k] < 0
            turn = turn & may_matter(plan, lane, k, *_ends(paths[k], speeds[k], h, zero), h)
            # A body at rest meets nothing.
            turns.append(turn if lane.contact is None else turn & (lane.contact[k] == 0))
        for i, stop in enumerate(scene.stops):
            along, gap = paths[stop.coordinate], stop_gradient(stop.gap)
            events.append((i, _shifted(along, float(stop.sign), gap)))
    if scene.clock(lane.state) is not None:
        bound = stop_gradient(plan.end(lane.part))
        events.append((section_number(scene), _shifted(motion.of(scene.clock), 1.0, bound)))
    if not events and not turns:
        return h, jnp.full_like(h, FREE)
    crossed, turned = none, none
    for _, series in events:
        crossed = crossed | (_sum(series, h, zero) > 0)
    for turn in turns:
        turned = turned | turn

    def found(_):
        # The earliest of several is met first; the chord tells well enough which that is. What lies
        # beyond a turn is met from there.
        first, target, polynomial = jnp.full_like(h, jnp.inf), zero + FREE, None
        facing_stop = [none for _ in paths]
        for number, series in events:
            begin, end = _sum(series[:1], h, zero), _sum(series, h, zero)
            over = end > 0
            place = jnp.maximum(-begin, 0.0) / jnp.where(over, end - begin, 1.0)
            place = jnp.where(over, place, jnp.inf)
            sooner, curve = place < first, _powers(series, h, zero)
            polynomial = curve if polynomial is None else select(sooner, curve, polynomial)
            target = jnp.where(sooner, to_event(number), target)
            first = jnp.where(sooner, place, first)
            if number < len(scene.stops):
                stop = scene.stops[number]
                k = stop.coordinate
                facing_stop[k] = facing_stop[k] | over & (lane.direction[k] == stop.sign)
        cut, soonest = jnp.isfinite(first), jnp.full_like(h, jnp.inf)
        for k, path in enumerate(paths):
            facing = tuple(-lane.direction[k] * c for c in _powers(_slope(path), h, zero))
            facing = (*facing, zero)
            turn = turns[k] & ~facing_stop[k]
            if len(paths) > 1:  # of their turns that matter the earliest comes first
                place, rest = _root(facing)
                told = _is_told(rest, path, speeds[k], h)
                matters = _matters(plan, lane, k, path, told, place * h)
                turn = turn & (place < soonest) & matters
                soonest = jnp.where(turn, place, soonest)
                target, cut = jnp.where(turn, to_turn_of(k), target), cut | turn
            polynomial = facing if polynomial is None else select(turn, facing, polynomial)
        assert polynomial is not None
        theta, rest = _root(polynomial)
        length = theta * h
        if len(paths) == 1:
            turn = turns[0] & ~facing_stop[0]
            told = _is_told(rest, paths[0], speeds[0], h)
            matters = turn & _matters(plan, lane, 0, paths[0], told, length)
            target = jnp.where(matters, to_turn_of(0), target)
            cut = jnp.where(turn, matters, cut)
        return jnp.where(cut, length, h), jnp.where(cut, target, FREE)

    return jax.lax.cond(crossed | turned, found, lambda _: (h, jnp.full_like(h, FREE)), None)


def _root(polynomial: tuple[Scalar, ...]) -> tuple[Scalar, Scalar]:
    """Where a motion's polynomial in θ first rises through zero, and what was left of it before the
    last correction."""
    # The low orders lead near the root; what is left is a correction.
    theta = rising_root(polynomial[:7], iterations=3)
    derivative, value = slope(polynomial)[:-1], jnp.zeros_like(theta)
    for _ in range(2):
        value, rate = horner(polynomial, theta), horner(derivative, theta)
        better = theta - value / jnp.where(rate > 0, rate, 1.0)
        theta = jnp.where((rate > 0) & (better > 0) & (better <= 1), better, theta)
    return theta, value


def _is_told(rest: Scalar, path: Series, speed: Scalar, h: Scalar) -> Flag:
    """Whether the place of a turn is known well enough: by what is left of the velocity there (by
    θ), beside that at the step's ends."""
    begin = jnp.zeros_like(h) if path[1] is None else path[1]
    return jnp.abs(rest) <= _UNTOLD * h * jnp.maximum(jnp.abs(begin), jnp.abs(speed))


def _matters(plan: Plan, lane: Lane, k: int, path: Series, told: Flag, length: Scalar) -> Flag:
    """Whether a turn of coordinate number k has to be met: where only impacts matter, one far from
    the stops is passed by, unless its place could not be told."""
    everything = plan.meets_turns(lane.done)
    if everything is True:
        return jnp.ones_like(length, bool)
    close = ~told if everything is False else ~told | everything
    for stop in plan.scene.stops:
        if stop.coordinate == k:
            height = _sum(path, length, jnp.zeros_like(length))
            close = close | (stop.beyond(height) > -MARGIN)
    return close


def _sum(series: Series, h: Scalar, zero: Scalar) -> Scalar:
    total = at(series, h)
    return zero if total is None else total


def ahead(plan: Plan, lane: Lane, motion: Any) -> Lane:
    """The lane with its next step cut where its motion first meets something."""
    method: Any = plan.method
    limit = stop_gradient(jnp.asarray(plan.method.longest(plan.scene, lane.s, lane.state)))
    h = jnp.minimum(lane.attempt, method.reach(motion, limit))
    if plan.ticks(lane.state):
        h = jnp.minimum(h, stop_gradient(plan.end(lane.part) - lane.s))
    length, target = look(plan, lane, motion, stop_gradient(h))
    free = lane.target == FREE
    return dataclasses.replace(
        lane,
        attempt=jnp.where(free & (target != FREE), length, jnp.where(free, h, lane.attempt)),
        target=jnp.where(free, target, lane.target),
    )
