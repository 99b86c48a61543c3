"""Where the next step should end: at the earliest event that a tried step ran past."""

from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..lanes import pin
from .events import Rates, quintic, rising_root, slope
from .lane import FREE, RELEASE, TURN, Lane, Plan
from .trial import Trial, to_turn

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

# Turning points this far inside the gap (unit: a) are passed by where only impacts matter.
MARGIN = 0.02


def select(condition: Flag, a: Any, b: Any) -> Any:
    """`jnp.where` for pytrees."""
    return jtu.tree_map(lambda x, y: jnp.where(condition, x, y), a, b)


def aim_at(plan: Plan, lane: Lane, trial: Trial) -> tuple[Flag, Scalar, Scalar]:
    """Whether to shorten the step, to what length, and at what it then aims."""
    h = stop_gradient(trial.h)
    nothing = jnp.zeros_like(trial.good), h, jnp.full_like(h, FREE)
    if trial.position is None and not trial.crossings:
        return nothing
    # Rare: skipped where no lane of a group has met anything.
    return jax.lax.cond(
        _met_something(plan, lane, trial), lambda _: _aimed(plan, lane, trial), lambda x: x, nothing
    )


def _met_something(plan: Plan, lane: Lane, trial: Trial) -> Flag:
    """Whether `_aimed` has anything to say, or may have."""
    met = trial.good & (lane.target != FREE) & ~trial.at_turn
    for c in trial.crossings:
        met = met | trial.good & (c.end.x > 0) & ~c.landed | c.again
    if trial.position is not None:
        begin, end = stop_gradient(trial.position)
        if not plan.method.sees_ahead:
            met = met | trial.good & (lane.direction * end.v < 0) & ~trial.at_turn
        twice = _may_turn_twice(lane, trial, begin, end, stop_gradient(trial.h))
        met = met | trial.good & twice
    return jnp.ones_like(met) if trial.leaves is not None else met


def _aimed(plan: Plan, lane: Lane, trial: Trial) -> tuple[Flag, Scalar, Scalar]:
    h = stop_gradient(trial.h)
    none = jnp.zeros_like(trial.good)
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
    theta = pin(rising_root(stop_gradient(polynomial)))
    attempt = theta * h
    if path is not None and trial.position is not None:
        if not plan.motion:
            height = stop_gradient(path[0])
            for n in range(1, len(path)):
                height = height + stop_gradient(path[n]) * theta**n
            close = crossed | landed
            for stop in plan.scene.stops:
                close = close | (stop.sign * height - stop.gap > -MARGIN)
            turn = turn & close
        wiggle = trial.good & _may_turn_twice(lane, trial, *stop_gradient(trial.position), h)
        wiggle = wiggle & ~(aim | turn | landed | trial.at_turn)
        # Newton's step is better than the quintic once it is short.
        shift = to_turn(trial.position[1])
        again = turn & (lane.target == TURN) & (jnp.abs(shift) < 0.25 * h)
        attempt = jnp.where(again, h + shift, attempt)
    for c in trial.crossings:
        again = c.again & ~turn
        aim = aim | again
        attempt = jnp.where(again, h + stop_gradient(c.offset), attempt)
        target = jnp.where(again, c.name, target)
    target = jnp.where(turn, TURN, jnp.where(wiggle, FREE, target))
    attempt = jnp.where(wiggle, 0.5 * h, attempt)
    if trial.surge is not None and trial.position is not None:
        # What the step met may not have been the first: look at the turn of the force before.
        hidden, place = _force_may_turn(lane, *stop_gradient(trial.position), *trial.surge, h)
        hidden = hidden & trial.good & ~(landed | trial.at_turn)
        aim, turn, wiggle = aim & ~hidden, turn & ~hidden, wiggle | hidden
        attempt = jnp.where(hidden, place, attempt)
        target = jnp.where(hidden, FREE, target)
    if trial.leaves is not None:
        left, released, place, _ = trial.leaves
        aim, turn, wiggle = aim & ~released | left, turn & ~left, wiggle & ~left
        attempt = jnp.where(left, place, attempt)
        target = jnp.where(left, RELEASE, target)
    return aim | turn | wiggle, stop_gradient(attempt), target


def _may_turn_twice(lane: Lane, trial: Trial, begin: Rates, end: Rates, h: Scalar) -> Flag:
    """Whether the velocity, of one sign at both ends, dips so deep that it may have been zero.

    Such a step is halved until the turns lie apart or the dip is too short to matter. Where the
    force's rate of change is known, a force that sags between the ends is not taken for straight.
    """
    a0, a1 = lane.direction * begin.a, lane.direction * end.a
    dips = (a0 < 0) & (a1 > 0) & (h > 1e-3)
    drop = 0.5 * h * a0 * (a0 / jnp.where(dips, a0 - a1, 1.0))
    if trial.surge is not None:
        j0, j1 = lane.direction * trial.surge[0], lane.direction * trial.surge[1]
        sags = dips & (j0 * h < a1 - a0) & (a1 - a0 < j1 * h)
        corner = jnp.where(sags, a1 - j1 * h - a0, 0.0) / jnp.where(sags, j0 - j1, 1.0)
        low = a0 + j0 * corner
        deep = 0.5 * corner * (a0 + low) - 0.5 * low * low / jnp.where(sags, j1, 1.0)
        flat = -0.5 * a0 * a0 / jnp.where(sags & (low >= 0), j0, 1.0)
        drop = jnp.where(sags, jnp.where(low < 0, deep, flat), drop)
    lowest = lane.direction * begin.v + drop
    return dips & (lowest < 0.1 * lane.direction * (begin.v + end.v))


def _force_may_turn(
    lane: Lane, begin: Rates, end: Rates, rate0: Scalar, rate1: Scalar, brief: Scalar, h: Scalar
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
        pressed = (lane.contact > 0) & (lane.direction * a1 >= 0) & (lane.direction * bound < 0)
        hidden = hidden | (turns & pressed)
    largest = jnp.maximum(jnp.maximum(jnp.abs(a0), jnp.abs(a1)), jnp.abs(bound))
    slow = jnp.minimum(jnp.abs(begin.v), jnp.abs(end.v)) <= largest * h
    return hidden & slow, place
