"""A body at rest on a stop: how it leaves.

It is held while it is pressed on, and leaves when its acceleration changes sign. The drive goes on
turning, with the reaction of a spring whose end is held.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar
from ...lanes import pin, pin_flag
from .._lane import Lane, Plan, to_release
from ..events import Rates


class _Precision(NamedTuple):
    """Thresholds of coming to rest and of release, for one floating-point type."""

    # A release is approached by steps taken from the pressed side, each this share short of where
    # the last one says that it is, until one is so short that the force is straight over it; it is
    # met if it is this close then.
    short: float
    straight: float
    close: float
    # How much of a chatter may be left when it is completed, as a share of the longest step: its
    # error is of second order, 6e-11 of that step in double precision.
    brief: float


# `close` is the tolerance of landings (`guards`). The others are choices.
_DOUBLE = _Precision(short=1e-3, straight=1e-5, close=1e-9, brief=8e-6)
_SINGLE = _Precision(short=1e-2, straight=1e-3, close=1e-4, brief=8e-3)


# After so many aims at a release in turn its place is halved: a choice, three or four are usual.
_PATIENCE = 8.0


def allowed(s: Scalar) -> _Precision:
    """The thresholds of rest and release for the precision of `s`."""
    return _DOUBLE if s.dtype == jnp.float64 else _SINGLE


class Release(NamedTuple):
    """Where a body at rest leaves its stop."""

    left: Flag
    """It did so within the step."""
    landed: Flag
    """The step ended there."""
    place: Scalar
    """Length of the next step towards it."""
    offset: Scalar
    """To it from the step's end."""


def release(
    plan: Plan, lane: Lane, k: int, begin: Rates, end: Rates, good: Flag, h: Scalar
) -> Release:
    """Where coordinate number k leaves the stop that it rests on, if it does.

    The force is the acceleration that a free body would have there.

    **Arguments:** `begin` and `end`, the free coordinate's rates at the ends of the step; `good`,
    whether the step was; `h`, its length.
    """
    assert lane.contact is not None
    known = allowed(h)
    close, straight = plan.in_units(known.close), plan.in_units(known.straight)
    away = plan.away(k, lane.contact[k])
    before, after = pin((away * begin.a, away * end.a))
    rise = stop_gradient(after - before)
    held = good & (away != 0)
    rising = held & (rise > 0)
    offset = -after * h / jnp.where(rising, rise, 1.0)
    near = jnp.abs(stop_gradient(offset)) <= close
    aimed = held & (lane.target == to_release(k))
    met = rising & aimed & (h <= 2 * straight) & near
    # A step that short was aimed at a force that is all rounding where it begins, and may be still:
    # that of a stack let go of as one, say, whose bodies part by what comes later.
    landed = met | aimed & (h <= close)
    left = rising & (after > 0) & ~landed
    place = stop_gradient(h + offset)
    # Over a force that is hardly positive, but for long, chords do not get on: half the way does.
    share = jnp.where(lane.aims >= _PATIENCE, 0.5, 1 - known.short)
    place = jnp.where(h > straight, share * place, place)
    # By rounding's measure late rather than early, when it would be pressed on again; and no step
    # towards it is so short that it would not move on.
    late = 8 * float(jnp.finfo(h.dtype).eps) * (plan.unit + stop_gradient(lane.s + h))
    place = jnp.maximum(place, 2 * late)
    landed, offset = pin_flag(landed, h), jnp.where(met, offset, 0.0)
    return Release(pin_flag(left, h), landed, place, jnp.where(landed, offset + late, 0.0))
