"""What a step may have met twice, so that its ends do not show it: bounds by their tangents."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from ..._types import Flag, Scalar, Scalars
from .._lane import Lane, Plan
from .guards import Crossing, Side
from .trial import Path
from .within import for_each, may_be_above

# A hump of a guard this close to an end of a step (as a share of it) is seen from there: a choice.
_BRIEF = 1e-3

# The polynomial of a guard is evaluated where so many parts of the step are over, and corrected by
# stages that are no closer to its ends than this share. Choices.
_PARTS = 16
_EDGE = 0.1

# Steps shorter than this (in s, for a cycle of about 2π) are not shortened any more, in double and
# in single precision, whose landings are that much coarser; and for a dip of the velocity.
_SHORTEST, _SHORTEST_SINGLE, _SHORTEST_DIP = 1e-6, 1e-3, 1e-3


def _corner(
    begin: tuple[Scalar, Scalar], end: tuple[Scalar, Scalar], h: Scalar, bent: Flag
) -> tuple[Scalar, Scalar, Scalar]:
    """Where the tangents at both ends of a step meet, from its begin on, and how high: no curve
    that is bent one way goes beyond. And where the curve is greatest, if its slope changes evenly.

    **Arguments:** `begin` and `end`, value and slope there; `h`, the step's length; `bent`, where
    the curve is bent.
    """
    (x0, v0), (x1, v1) = begin, end
    fall = jnp.where(bent, v0 - v1, 1.0)
    place = (x1 - v1 * h - x0) / fall
    return place, x0 + v0 * place, h * v0 / fall


def hump(plan: Plan, c: Crossing, h: Scalar) -> tuple[Flag, Scalar]:
    """Whether a guard that is negative at both ends may have been positive in between, and where
    it was greatest; or where one that falls at both, as of a body that has just passed through its
    standstill, has begun to rise, from where its greatest value shows."""
    begin, end = stop_gradient((c.begin, c.end))
    rises = (begin.x < 0) & (end.x < 0) & (begin.v > 0) & (end.v < 0)
    _, bound, place = _corner((begin.x, begin.v), (end.x, end.v), h, rises)
    brief = _BRIEF * h
    seen = rises & (bound > 0) & (place > brief) & (h - place > brief)
    dips = (begin.x <= 0) & (end.x < 0) & (begin.v < 0) & (end.v < 0) & (begin.a > 0)
    least = -begin.v / jnp.where(dips, begin.a, 1.0)
    dips = dips & (least < 0.5 * h) & _is_long(plan, h)
    return seen | dips, jnp.where(dips, jnp.maximum(1.5 * least, brief), place)


def crests(
    plan: Plan, sides: list[Side], below: list[Flag], shares: tuple[float, ...], h: Scalar
) -> list[tuple[Flag, Scalar]]:
    """Return of functions that end a step below zero whether each may have been positive within
    it, and the first place where.

    **Arguments:** `sides`, the functions; `below`, whether they end so, without which nothing is
    asked of one; `shares`, the places of the stages; `h`, the length of the step.
    """
    ends = [stop_gradient((x.begin.x, x.begin.v, x.end.x, x.end.v)) for x in sides]
    values = [stop_gradient(x.within) for x in sides]
    slack = [jnp.asarray(x.slack, h.dtype) for x in sides]
    find = partial(_crest, plan, shares, h)
    stacked = jtu.tree_map(lambda *x: jnp.stack(x), *zip(ends, values, slack, strict=True))

    def at_a_glance(given: Sequence[Any]) -> Flag:
        x, inner, zero = given
        return may_be_above(x[:2], x[2:], inner, shares, zero)

    no = jnp.zeros((), bool)
    doubtful = jnp.stack([
        flag & at_a_glance(x) if side.asked is None
        else jax.lax.cond(flag, at_a_glance, lambda _: no, x)
        for side, *x, flag in zip(sides, ends, values, slack, below, strict=True)
    ])  # fmt: skip

    def one(flag: Flag, side: tuple) -> tuple[Flag, Scalar]:
        none = jnp.zeros((), bool), jnp.zeros_like(h)
        return jax.lax.cond(flag, lambda x: find(*x), lambda _: none, side)

    nowhere = jnp.zeros(len(sides), bool), jnp.zeros(len(sides), h.dtype)
    asked = doubtful, stacked
    above, place = jax.lax.cond(
        jnp.any(doubtful), lambda x: for_each(one, x), lambda _: nowhere, asked
    )
    return [(above[n], place[n]) for n in range(len(sides))]


def _crest(
    plan: Plan, shares: tuple[float, ...], h: Scalar, ends: Scalars, values: Array, slack: Scalar
) -> tuple[Flag, Scalar]:
    """As `crests` for one function.

    The function is taken for the cubic through both ends of the step, plus what it is off at the
    stages: that is divided by the shape of the cubic's error and interpolated linearly. By how much
    it differs from stage to stage is the margin of doubt.

    **Arguments:** `ends`, value and slope where the step begins and ends; `values`, at the stages;
    `slack`, what counts as zero.
    """
    x0, v0, x1, v1 = ends
    over, rises, over_end, falls = x0 - slack, h * v0, x1 - slack, h * v1
    grid, inner = np.arange(_PARTS + 1) / _PARTS, _inner(shares)

    def cubic(theta: np.ndarray) -> Array:
        left = 1 - theta
        late, early = theta * theta * (1 + 2 * left), left * left * (1 + 2 * theta)
        slopes = rises * (theta * left * left) - falls * (theta * theta * left)
        return over * early + over_end * late + slopes

    heights = cubic(grid)
    if inner:
        places = np.asarray([shares[n] for n in inner])
        off = (values[np.asarray(inner)] - slack - cubic(places)) / _bump(places)
        left = np.clip(np.searchsorted(places, grid) - 1, 0, max(len(inner) - 2, 0))
        right = np.minimum(left + 1, len(inner) - 1)
        share = np.interp(grid, places, np.arange(len(inner))) - left
        doubt = jnp.max(jnp.abs(off[1:] - off[:-1])) if len(inner) > 1 else jnp.abs(off[0])
        heights = heights + _bump(grid) * (off[left] + share * (off[right] - off[left]) + doubt)
    above, place = _first_top(heights, rises / _PARTS, falls / _PARTS)
    first = jnp.min(jnp.where(values > slack, np.asarray(shares), 2.0))
    place = jnp.maximum(jnp.minimum(place, first), _BRIEF)
    return (above | (first < 1)) & _is_long(plan, h), place * h


def _is_long(plan: Plan, h: Scalar) -> Flag:
    """Whether a step is long enough to be shortened."""
    return h > plan.in_units(_SHORTEST if h.dtype == jnp.float64 else _SHORTEST_SINGLE)


def _inner(shares: tuple[float, ...]) -> list[int]:
    """Which stages are apart from the ends of the step and from each other, in their order."""
    found: dict[float, int] = {}
    for n, share in enumerate(shares):
        if _EDGE <= share <= 1 - _EDGE:
            found.setdefault(round(share, 6), n)
    return [found[share] for share in sorted(found)]


def _first_top(heights: Array, rise: Scalar, fall: Scalar) -> tuple[Flag, Scalar]:
    """Return whether a curve is positive between its ends, and where first, as a share of the way:
    by parabolas through its heights at equal distances, and through its slopes at the ends.

    **Arguments:** `heights`, ends included; `rise` and `fall`, the slopes at both ends, by that
    distance.
    """
    parts = heights.size - 1
    before, here, after = heights[:-2], heights[1:-1], heights[2:]
    bend, tilt = 2 * here - before - after, after - before
    top = (here >= before) & (here >= after) & (bend > 0)
    found = (here > 0) | top & (tilt * tilt > -8 * bend * here)
    at = np.arange(1, parts) + jnp.where(top, 0.5 * tilt / jnp.where(top, bend, 1.0), 0.0)
    place = jnp.min(jnp.where(found, at, parts + 1.0))

    def beside(height: Scalar, slope: Scalar, next_one: Scalar) -> Scalar:
        bend = height + slope - next_one
        found = (slope > 0) & (slope < 2 * bend) & (slope * slope > -4 * bend * height)
        return jnp.where(found, slope / jnp.where(found, 2 * bend, 1.0), parts + 1.0)

    place = jnp.minimum(place, beside(heights[0], rise, heights[1]))
    back = beside(heights[-1], -fall, heights[-2])
    place = jnp.minimum(place, jnp.where(back < parts, parts - back, parts + 1.0))
    return place < parts, place / parts


def _bump(share: np.ndarray) -> np.ndarray:
    """The shape of a cubic Hermite interpolant's error; 1 in the middle."""
    return (4 * share * (1 - share)) ** 2


def may_turn_twice(plan: Plan, direction: Scalar, path: Path, h: Scalar) -> Flag:
    """Whether the velocity, of one sign at both ends, dips so deep that it may have been zero.

    Such a step is halved until the turns lie apart or the dip is too short to matter. Where the
    force's rate of change is known, a force that sags between the ends is not taken for straight.
    """
    begin, end = path.begin, path.end
    a0, a1 = direction * begin.a, direction * end.a
    dips = (a0 < 0) & (a1 > 0) & (h > plan.in_units(_SHORTEST_DIP))
    if path.surge is None:
        # lowest < 0.1 (v0 + v1), times a1 - a0: without a division in each step.
        room = direction * (begin.v - 0.1 * (begin.v + end.v))
        return dips & (room * (a1 - a0) < 0.5 * h * a0 * a0)
    drop = 0.5 * h * a0 * (a0 / jnp.where(dips, a0 - a1, 1.0))
    j0, j1 = direction * path.surge[0], direction * path.surge[1]
    sags = dips & (j0 * h < a1 - a0) & (a1 - a0 < j1 * h)
    corner, low, _ = _corner((a0, j0), (a1, j1), h, sags)
    deep = 0.5 * corner * (a0 + low) - 0.5 * low * low / jnp.where(sags, j1, 1.0)
    flat = -0.5 * a0 * a0 / jnp.where(sags & (low >= 0), j0, 1.0)
    drop = jnp.where(sags, jnp.where(low < 0, deep, flat), drop)
    lowest = direction * begin.v + drop
    return dips & (lowest < 0.1 * direction * (begin.v + end.v))


def force_may_turn(lane: Lane, k: int, path: Path, h: Scalar) -> tuple[Flag, Scalar]:
    """Whether the force, of one sign at both ends, may have had the other in between for a body
    that is slow enough to notice, and where it turned.

    It releases a body at rest for a moment, or turns one twice that has just left the stop.
    """
    assert path.surge is not None
    begin, end, (rate0, rate1, brief) = path.begin, path.end, path.surge
    a0, a1 = begin.a, end.a
    bent = rate0 * rate1 < 0
    _, bound, place = _corner((a0, rate0), (a1, rate1), h, bent)
    turns = bent & (place > brief) & (h - place > brief)
    hidden = turns & (a0 * a1 >= 0) & (bound * (a0 + a1) < 0)
    if lane.contact is not None:
        # At rest the step may begin, to rounding, where the window does.
        direction = lane.direction[k]
        pressed = (lane.contact[k] > 0) & (direction * a1 >= 0) & (direction * bound < 0)
        hidden = hidden | (turns & pressed)
    largest = jnp.maximum(jnp.maximum(jnp.abs(a0), jnp.abs(a1)), jnp.abs(bound))
    slow = jnp.minimum(jnp.abs(begin.v), jnp.abs(end.v)) <= largest * h
    return hidden & slow, place
