"""A body at rest on a stop: how it comes there, stays there, and leaves.

With small impact speeds and a force that presses the body on, impacts follow each other ever
faster, their speeds a geometric series in k, and end in rest after a finite time (chatter). The
series is completed at once where what is left of it is brief. The body is held while it is pressed
on, and leaves when its acceleration changes sign. The drive goes on turning, with the reaction of
a spring whose end is held.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ...lanes import pin, pin_flag
from ...scene import AbstractScene, RigidStop
from .._lane import Lane, Plan, to_event, to_release
from ..events import Rates, rates

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]


class _Precision(NamedTuple):
    """What a precision allows."""

    # A release is approached by steps taken from the pressed side, each this share short of where
    # the last one says that it is, until one is so short that the force is straight over it; it is
    # met if it is this close then.
    short: float
    straight: float
    close: float
    # How much of a chatter may be left when it is completed, as a share of the longest step: its
    # error is of second order.
    brief: float


_DOUBLE = _Precision(short=1e-3, straight=1e-5, close=1e-9, brief=8e-6)
_SINGLE = _Precision(short=1e-2, straight=1e-3, close=1e-4, brief=8e-3)


def _allowed(s: Scalar) -> _Precision:
    return _DOUBLE if s.dtype == jnp.float64 else _SINGLE


def settled(
    plan: Plan, lane: Lane, free: AbstractScene, stop: RigidStop, speed: Scalar, growth: Scalar,
    s: Scalar, there: Any,
) -> tuple[Flag, Scalar]:  # fmt: skip
    """Whether an impact is one of the endless last ones before rest, and the time they take.

    **Arguments:** the machine with nothing held, the stop, the speed of approach by s, how fast the
    force on the body grows, and s and the state of the impact.
    """
    coordinate = plan.scene.coordinates[stop.coordinate]
    # What presses a body at rest on: with its velocity goes its damping.
    rested = coordinate.placed(there, jnp.asarray(stop.place), jnp.zeros_like(s))
    pressing = stop.sign * rates(free.field, coordinate.position, s, rested).a
    speed = jnp.maximum(speed, 0.0)
    left = stop.remaining(speed, pressing)
    limit = stop_gradient(jnp.asarray(plan.scene.step_limit(s, there), s.dtype))
    # Hops no higher than rounding cannot be followed, however long they last.
    rebound = stop.share(speed) * speed
    height = rebound**2 / jnp.where(pressing > 0, 2 * pressing, 1.0)
    height, left = _before_it_presses(rebound, pressing, stop.sign * growth, (height, left))
    flat = height <= 16 * float(jnp.finfo(s.dtype).eps) * (1 + jnp.abs(stop.gap))
    ends = stop_gradient(left <= jnp.where(flat, 0.1, _allowed(s).brief) * limit)
    if plan.ticks(lane.state):
        ends = ends & (stop_gradient(s + left) < stop_gradient(plan.end(lane.part)))
    return ends, left


def _before_it_presses(
    rebound: Scalar, pressing: Scalar, growth: Scalar, pressed: tuple[Scalar, Scalar]
) -> tuple[Scalar, Scalar]:
    """Height of the next hop, and the time until the body is pressed on, where it is not yet but
    will be, since its force grows; else those of a body that is `pressed` on.

    A hop that begins against a force f, growing at the rate j, is over within 3 |f|/j + √(6 v/j).
    """
    v, pull, grows = stop_gradient((rebound, -pressing, growth))
    not_yet = (pull >= 0) & (grows > 0)
    rate = jnp.where(not_yet, grows, 1.0)
    wait = jnp.where(not_yet, pull, 0.0) / rate
    hop = 3 * wait + jnp.sqrt(6 * jnp.where(not_yet, v, 0.0) / rate)
    height = v * hop + 0.5 * pull * hop * hop
    return jnp.where(not_yet, height, pressed[0]), jnp.where(not_yet, wait, pressed[1])


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
    lane: Lane, k: int, stops: tuple, begin: Rates, end: Rates, good: Flag, h: Scalar
) -> Release:
    """Where coordinate number k leaves the stop that it rests on, if it does.

    The force is the acceleration that a free body would have there.
    """
    assert lane.contact is not None
    allowed = _allowed(h)
    sign = jnp.zeros_like(h)
    for i, stop in enumerate(stops):
        if stop.coordinate == k:
            sign = jnp.where(lane.contact[k] == to_event(i), float(stop.sign), sign)
    before, after = pin((-sign * begin.a, -sign * end.a))
    rise = stop_gradient(after - before)
    held = good & (sign != 0)
    rising = held & (rise > 0)
    offset = -after * h / jnp.where(rising, rise, 1.0)
    close = jnp.abs(stop_gradient(offset)) <= allowed.close
    landed = rising & (lane.target == to_release(k)) & (h <= 2 * allowed.straight) & close
    left = rising & (after > 0) & ~landed
    place = stop_gradient(h + offset)
    place = jnp.where(h > allowed.straight, (1 - allowed.short) * place, place)
    landed = pin_flag(landed, h)
    # By rounding's measure late rather than early, when it would be pressed on again; and no step
    # towards it is so short that it would not move on.
    late = 8 * float(jnp.finfo(h.dtype).eps) * (1 + stop_gradient(lane.s + h))
    place = jnp.maximum(place, 2 * late)
    return Release(pin_flag(left, h), landed, place, jnp.where(landed, offset + late, 0.0))
