"""Derivatives of guards along a step, and the places of impacts and turning points in it.

Position and its first two derivatives are known at both ends of a step. The root of the quintic
through them is the target of the next step. That step then meets the event with the solver's
accuracy, and a Taylor expansion about its end removes the remaining offset.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ..._types import Flag, Scalar, Scalars, State
from ...machine import Coordinate, horner, size_of
from ..smooth import SmoothMachine

# d(state)/ds as a function of s and the state.
Field = Callable[[Scalar, State], State]


class Rates(NamedTuple):
    """A coordinate and its first two derivatives with respect to s."""

    x: Scalar
    v: Scalar
    a: Scalar

    def scaled(self, factor: int, offset: Scalar) -> "Rates":
        return Rates(factor * self.x - offset, factor * self.v, factor * self.a)


def rates(field: Field, coordinate: Coordinate, s: Scalar, state: State) -> Rates:
    """Return the rates of a coordinate along the flow of `field`."""
    if not coordinate.moves_at_velocity:
        return guard_rates(field, lambda _, state: coordinate.position(state), s, state)
    # Without a derivative of the field.
    v, a = jax.jvp(coordinate.velocity, (state,), (field(s, state),))
    return Rates(coordinate.position(state), v, a)


def rate_of_position(field: Field, coordinate: Coordinate, s: Scalar, state: State) -> Scalar:
    """Return the rate of a coordinate alone along the flow of `field`."""
    if coordinate.moves_at_velocity:
        return coordinate.velocity(state)
    return jax.jvp(coordinate.position, (state,), (field(s, state),))[1]


def guard_rates(
    field: Field, guard: Callable[[Scalar, State], Any], s: Scalar, state: State
) -> Rates:
    """Return the `Rates` of `guard(s, state)` along the flow of `field`, by two forward
    derivatives. For a tree of guards they are rates of trees."""
    one = jnp.ones_like(s)

    def first(s, state):
        return jax.jvp(guard, (s, state), (one, field(s, state)))

    (x, v), (_, a) = jax.jvp(first, (s, state), (one, field(s, state)))
    return Rates(x, v, a)


# A force on a body is rounding below this share of its terms: a choice, far above rounding.
_CANCELS = 1e-9


def force_rounding(field: Field, coordinate: Coordinate, s: Scalar, state: State) -> Scalar:
    """Return the acceleration of a coordinate up to which it counts as zero: the forces on bodies
    that fall together cancel."""
    s, state = jax.lax.stop_gradient((s, state))
    terms = size_of(coordinate.velocity, state, jtu.tree_map(jnp.abs, field(s, state)))
    return max(_CANCELS, 64 * float(jnp.finfo(terms.dtype).eps)) * jax.lax.stop_gradient(terms)


def force_rate(
    machine: SmoothMachine, coordinate: Coordinate, holding: SmoothMachine, s: Scalar, state: State
) -> Scalar:  # fmt: skip
    """Return d/ds of the acceleration that a body would have if it were free, as it is in
    `machine`, along the flow of `holding`, in which it may be held. It is a constant for
    differentiation, since it is only used to search for events."""
    s, state = jax.lax.stop_gradient((s, state))

    def force(s, state):
        return rates(machine.field, coordinate, s, state).a

    flow = holding.field(s, state)
    return jax.lax.stop_gradient(jax.jvp(force, (s, state), (jnp.ones_like(s), flow))[1])


def quintic(begin: Rates, end: Rates, h: Scalar) -> Scalars:
    """Return the coefficients in θ ∈ [0, 1] of the quintic Hermite interpolant of a step h."""
    v0, v1 = h * begin.v, h * end.v
    a0, a1 = 0.5 * h * h * begin.a, 0.5 * h * h * end.a
    rise = end.x - begin.x
    p = rise - v0 - a0
    q = v1 - v0 - 2 * a0
    r = a1 - a0
    return (
        begin.x, v0, a0,
        10 * p - 4 * q + r,
        -15 * p + 7 * q - 2 * r,
        6 * p - 3 * q + r,
    )  # fmt: skip


def highest(begin: Rates, end: Rates, h: Scalar) -> Scalar:
    """Return an upper bound of the quintic through both ends of a step: the largest of its
    coefficients in Bernstein's basis."""
    v0, v1 = 0.2 * h * begin.v, 0.2 * h * end.v
    a0, a1 = 0.05 * h * h * begin.a, 0.05 * h * h * end.a
    from_begin = jnp.maximum(jnp.maximum(begin.x, begin.x + v0), begin.x + 2 * v0 + a0)
    from_end = jnp.maximum(jnp.maximum(end.x, end.x - v1), end.x - 2 * v1 + a1)
    return jnp.maximum(from_begin, from_end)


def slope(c: Scalars) -> Scalars:
    """Return the coefficients of the derivative, padded to the same length."""
    return (*(n * c[n] for n in range(1, len(c))), jnp.zeros_like(c[0]))


def rising_root(c: Scalars, *, iterations: int = 3) -> Scalar:
    """Return the θ in [0, 1] where a polynomial that ends positive first rises through zero, by
    Newton's method inside a bracket. If the polynomial starts at zero and falls (the body leaves
    the stop), its root comes later. If it falls at a value above that, its root lies before."""
    derivative = slope(c)[:-1]
    low, high = jnp.zeros_like(c[0]), jnp.ones_like(c[0])
    end, end_rate = sum(c[1:], c[0]), sum(derivative[1:], derivative[0])
    # The tangent at the start of a hump lies short of the root; otherwise the chord is close.
    rise = jnp.where(end_rate > 0, end - c[0], c[1])
    theta = jnp.where(rise > 0, -c[0] / jnp.where(rise > 0, rise, 1.0), 0.5)
    theta = jnp.clip(theta, 0.0, 1.0)
    floor = jnp.maximum(c[0], 0.0)
    for _ in range(iterations):
        value, rate = horner(c, theta), horner(derivative, theta)
        is_left = (value < 0) | ((rate <= 0) & (value <= floor))
        low, high = jnp.where(is_left, theta, low), jnp.where(is_left, high, theta)
        newton = theta - value / jnp.where(rate > 0, rate, 1.0)
        inside = (rate > 0) & (newton >= low) & (newton <= high)
        theta = jnp.where(inside, newton, 0.5 * (low + high))
    return theta


def landing(gap: Rates) -> tuple[Scalar, Scalar]:
    """Return the offset δ at which gap + gap'·δ + ½ gap''·δ² rises through zero, and the squared
    slope there. If the square is not positive, the coordinate turns short of the stop: δ = ∞."""
    square = gap.v * gap.v - 2 * gap.x * gap.a
    real = square > 0
    root = jnp.sqrt(jnp.where(real, square, 1.0))
    approaching = gap.v > 0
    sum_ = jnp.where(approaching, gap.v + root, 1.0)
    bend = jnp.where(approaching | (gap.a == 0), 1.0, gap.a)
    delta = jnp.where(approaching, -2 * gap.x / sum_, (root - gap.v) / bend)
    return jnp.where(real, delta, jnp.inf), square


def offset_to_turn(end: Rates) -> Scalar:
    """Return the offset from a step's end to the turning point near it."""
    bend = jax.lax.stop_gradient(end.a)
    return -jax.lax.stop_gradient(end.v) / jnp.where(bend == 0, 1.0, bend)


def turns_within(length: Scalar, end: Rates) -> Flag:
    """Return whether |`offset_to_turn`| ≤ `length`, without a division: each step calls it."""
    bend = jax.lax.stop_gradient(end.a)
    return jnp.abs(jax.lax.stop_gradient(end.v)) <= length * jnp.where(
        bend == 0, 1.0, jnp.abs(bend)
    )
