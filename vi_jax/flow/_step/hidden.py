"""What a step may have met twice, so that its ends do not show it: bounds by their tangents."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar
from ...machine import horner
from .._lane import Lane
from ..events import quintic
from .guards import WITHIN, Crossing
from .trial import Path

# A hump of a guard this close to an end of a step (as a share of it) is seen from there: a choice.
_BRIEF = 1e-3

# A guard's quintic is looked at where it has gone through so many parts of the step, and doubted by
# so many times what it is off in between. Choices, measured on balls that fly over ramps with up to
# five waves in a step (`tests/flow/test_hidden_resets.py`).
_PARTS = 8
_DOUBT = 4.0

# Steps shorter than this (in s) are not shortened any more.
_SHORTEST = 1e-6


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


def hump(c: Crossing, h: Scalar) -> tuple[Flag, Scalar]:
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
    dips = dips & (least < 0.5 * h) & (h > _SHORTEST)
    return seen | dips, jnp.where(dips, jnp.maximum(1.5 * least, brief), place)


def rise(c: Crossing, h: Scalar) -> tuple[Flag, Scalar]:
    """Whether a guard of any shape may have been positive before the end of a step that it does not
    end beyond, or that landed on it, and where first: by the quintic through the step's ends, and
    by how far the guard is off it at `WITHIN`, which says how little the quintic knows.

    Looked at where the guard falls from its surface as well, as behind a reset.
    """
    begin, end, within = stop_gradient((c.begin, c.end, c.within))
    curve = quintic(begin, end, h)
    unknown = jnp.zeros_like(end.x)
    for share, value in zip(WITHIN, within, strict=True):
        off = jnp.abs(value - horner(curve, jnp.asarray(share)))
        unknown = jnp.maximum(unknown, _DOUBT / _bump(share) * off)
    above, place = jnp.zeros_like(end.x, bool), h
    for n in range(_PARTS - 1, 0, -1):
        share = n / _PARTS
        over = horner(curve, jnp.asarray(share)) + _bump(share) * unknown > 0
        above, place = above | over, jnp.where(over, share * h, place)
    return above & ((end.x < 0) | c.landed) & (h > _SHORTEST), place


def _bump(share: float) -> float:
    """The shape of a Hermite interpolant's error, of third order at both ends; 1 in the middle."""
    return (4 * share * (1 - share)) ** 3


def may_turn_twice(direction: Scalar, path: Path, h: Scalar) -> Flag:
    """Whether the velocity, of one sign at both ends, dips so deep that it may have been zero.

    Such a step is halved until the turns lie apart or the dip is too short to matter. Where the
    force's rate of change is known, a force that sags between the ends is not taken for straight.
    """
    begin, end = path.begin, path.end
    a0, a1 = direction * begin.a, direction * end.a
    dips = (a0 < 0) & (a1 > 0) & (h > 1e-3)
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
