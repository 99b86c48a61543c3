"""Sine and cosine of a phase, written so that they fuse and vectorise in double precision.

XLA's CPU backend calls the scalar library for float64 `sin` and `cos`. On a phase, reduced to one
turn, a short polynomial does the same to rounding: Taylor series about zero on a quarter of the
argument, followed by two angle doublings.
"""

from math import factorial, pi

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# On |x| <= pi/4 the first omitted terms are below 5e-17.
_SIN = tuple((-1) ** n / factorial(2 * n + 1) for n in range(8))
_COS = tuple((-1) ** n / factorial(2 * n) for n in range(9))


def horner(coefficients: tuple, x):
    """The polynomial with these coefficients (constant term first) at `x`."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


@jax.custom_jvp
def sincos(phase: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Sine and cosine of `phase` (radians, any shape; best within a few turns of zero).

    The absolute error is a few units of rounding. Differentiable to any order.
    """
    turns = jnp.round(phase * (0.5 / pi))
    quarter = 0.25 * (phase - (2 * pi) * turns)
    square = quarter * quarter
    # XLA copies cheap producers into each of their consumers, but no division: through the tangent
    # the polynomials are evaluated once.
    tangent = quarter * horner(_SIN, square) / horner(_COS, square)
    share = 1 / (1 + tangent * tangent)
    sine, cosine = 2 * tangent * share, (1 - tangent * tangent) * share
    # 1 - 2 sin^2 keeps the cosine's absolute error from growing with the doubling.
    return 2 * sine * cosine, 1 - 2 * sine * sine


@sincos.defjvp
def _(primals, tangents):
    (phase,), (rate,) = primals, tangents
    sine, cosine = sincos(phase)
    return (sine, cosine), (cosine * rate, -sine * rate)
