"""Where the next step should end, for a method that knows the motion before the step is taken."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..scene.trig import horner
from .aim import MARGIN, select
from .events import rising_root, slope
from .lane import FREE, SECTION, TURN, Lane, Plan
from .series import Series, at

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]


def _powers(series: Series, h: Scalar, zero: Scalar) -> tuple[Scalar, ...]:
    """Coefficients in θ = (s - s0)/h, so that the step is θ from 0 to 1."""
    out, power = [], None
    for c in series:
        out.append(zero if c is None else c if power is None else c * power)
        power = h if power is None else power * h
    return tuple(out)


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
    events: list[tuple[float, Series]] = []
    path: Series | None = None
    turn = none
    if plan.motion or scene.stops:
        path = along = motion.of(scene.position)
        speed = _slope(along)
        turn = lane.direction * _sum(speed, h, zero) < 0
        for i, stop in enumerate(scene.stops):
            events.append((1.0 + i, _shifted(along, float(stop.sign), stop_gradient(stop.gap))))
    if not plan.ticks(lane.state):
        bound = stop_gradient(plan.end(lane.part))
        events.append((SECTION, _shifted(motion.of(scene.clock), 1.0, bound)))
    if lane.contact is not None:  # a body at rest meets nothing
        turn = turn & (lane.contact == 0)
    crossed = none
    for _, series in events:
        crossed = crossed | (_sum(series, h, zero) > 0)

    def found(_):
        # The earliest of several is met first; the chord tells well enough which that is. What lies
        # beyond a turn is met from there.
        first, target, polynomial, facing_stop = jnp.full_like(h, jnp.inf), zero + FREE, None, none
        for name, series in events:
            begin, end = _sum(series[:1], h, zero), _sum(series, h, zero)
            over = end > 0
            place = jnp.maximum(-begin, 0.0) / jnp.where(over, end - begin, 1.0)
            place = jnp.where(over, place, jnp.inf)
            sooner, curve = place < first, _powers(series, h, zero)
            polynomial = curve if polynomial is None else select(sooner, curve, polynomial)
            target = jnp.where(sooner, name, target)
            first = jnp.where(sooner, place, first)
            if name > 0:
                sign = scene.stops[int(name) - 1].sign
                facing_stop = facing_stop | over & (lane.direction == sign)
        turns = turn & ~facing_stop
        if path is not None:
            facing = tuple(-lane.direction * c for c in _powers(_slope(path), h, zero))
            facing = (*facing, zero)
            polynomial = facing if polynomial is None else select(turns, facing, polynomial)
        assert polynomial is not None
        # The low orders lead near the root; what is left is a correction.
        theta = rising_root(polynomial[:7], iterations=3)
        derivative = slope(polynomial)[:-1]
        for _ in range(2):
            value, rate = horner(polynomial, theta), horner(derivative, theta)
            better = theta - value / jnp.where(rate > 0, rate, 1.0)
            theta = jnp.where((rate > 0) & (better > 0) & (better <= 1), better, theta)
        length = theta * h
        if path is not None:
            if not plan.motion:
                close, height = none, _sum(path, length, zero)
                for stop in scene.stops:
                    close = close | (stop.sign * height - stop_gradient(stop.gap) > -MARGIN)
                turns = turns & close
            target = jnp.where(turns, TURN, target)
        cut = turns | (jnp.isfinite(first) & ~turn) | (facing_stop & turn)
        return jnp.where(cut, length, h), jnp.where(cut, target, FREE)

    return jax.lax.cond(crossed | turn, found, lambda _: (h, jnp.full_like(h, FREE)), None)


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
