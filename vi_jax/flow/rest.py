"""A body at rest on a stop: how it comes there, stays there, and leaves.

With small impact speeds and a force that presses the body on, impacts follow each other ever
faster, their speeds a geometric series in k, and end in rest after a finite time (chatter). The
series is completed at once where what is left of it is brief. The body is held while it is pressed
on, and leaves when its acceleration changes sign. The drive goes on turning, with the reaction of
a spring whose end is held.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..lanes import pin, pin_flag
from ..scene import AbstractScene, RigidStop
from .events import Rates, rates
from .lane import RELEASE, Lane, Plan

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


class Holding(AbstractScene):
    """A scene whose body is held where `held` says so: all that a step asks of a scene."""

    scene: AbstractScene
    held: Flag

    stops: tuple[RigidStop, ...]

    @property
    def cycle(self):
        """That of the scene."""
        return self.scene.cycle

    def field(self, s: Scalar, state: Any) -> Any:
        """d(state)/ds, without motion of a body that is held."""
        free = self.scene.field(s, state)
        zero = jnp.zeros_like(s)
        still = self.scene.placed(free, zero, zero)
        return jtu.tree_map(lambda a, b: jnp.where(self.held, a, b), still, free)

    def pace(self, s: Scalar, state: Any) -> Scalar | None:
        """That of the scene."""
        return self.scene.pace(s, state)


def remaining(restitution: Scalar, approach: Scalar, pressing: Scalar) -> Scalar:
    """Time (in s) from an impact to rest: Σ 2 kⁿ V⁻ / a = 2 k V⁻ / (a (1 - k)).

    **Arguments:** k; speed of approach and acceleration towards the stop, by s. Infinite where the
    body is not pressed on, or loses nothing.
    """
    force = pressing * (1 - restitution)
    ends = force > 0
    return jnp.where(ends, 2 * restitution * approach / jnp.where(ends, force, 1.0), jnp.inf)


def settled(
    plan: Plan, lane: Lane, stop: RigidStop, speed: Scalar, s: Scalar, there: Any
) -> tuple[Flag, Scalar]:
    """Whether an impact is one of the endless last ones before rest, and the time they take.

    **Arguments:** the stop, the speed of approach by s, and s and the state of the impact.
    """
    scene = plan.scene
    # What presses a body at rest on: with its velocity goes its damping.
    rested = scene.placed(there, jnp.asarray(stop.sign * stop.gap), jnp.zeros_like(s))
    pressing = stop.sign * rates(scene.field, scene.position, s, rested).a
    speed = jnp.maximum(speed, 0.0)
    left = remaining(stop.restitution, speed, pressing)
    limit = stop_gradient(jnp.asarray(scene.step_limit(s, there), s.dtype))
    # Hops no higher than rounding cannot be followed, however long they last.
    height = (stop.restitution * speed) ** 2 / jnp.where(pressing > 0, 2 * pressing, 1.0)
    flat = height <= 16 * float(jnp.finfo(s.dtype).eps) * (1 + jnp.abs(stop.gap))
    ends = stop_gradient(left <= jnp.where(flat, 0.1, _allowed(s).brief) * limit)
    if plan.ticks(lane.state):
        ends = ends & (stop_gradient(s + left) < stop_gradient(plan.end(lane.part)))
    return ends, left


def release(
    lane: Lane, stops: tuple, begin: Rates, end: Rates, good: Flag, h: Scalar
) -> tuple[Flag, Flag, Scalar, Scalar]:
    """Whether a held body left within the step, whether the step landed on that, where to end the
    next step, and the offset from the step's end.

    The force is the acceleration that a free body would have there.
    """
    assert lane.contact is not None
    allowed = _allowed(h)
    sign = jnp.zeros_like(h)
    for i, stop in enumerate(stops):
        sign = jnp.where(lane.contact == 1.0 + i, float(stop.sign), sign)
    before, after = pin((-sign * begin.a, -sign * end.a))
    rise = stop_gradient(after - before)
    held = good & (sign != 0)
    rising = held & (rise > 0)
    offset = -after * h / jnp.where(rising, rise, 1.0)
    close = jnp.abs(stop_gradient(offset)) <= allowed.close
    landed = rising & (lane.target == RELEASE) & (h <= 2 * allowed.straight) & close
    left = rising & (after > 0) & ~landed
    place = stop_gradient(h + offset)
    place = jnp.where(h > allowed.straight, (1 - allowed.short) * place, place)
    landed = pin_flag(landed, h)
    # By rounding's measure late rather than early, when it would be pressed on again; and no step
    # towards it is so short that it would not move on.
    late = 8 * float(jnp.finfo(h.dtype).eps) * (1 + stop_gradient(lane.s + h))
    place = jnp.maximum(place, 2 * late)
    return pin_flag(left, h), landed, place, jnp.where(landed, offset + late, 0.0)
