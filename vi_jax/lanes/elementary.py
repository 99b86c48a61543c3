"""Functions that either backend has its own best form of."""

from collections.abc import Callable
from math import factorial, pi
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Float

# On |x| <= pi/4 the first omitted terms are below 5e-17.
_SIN = tuple((-1) ** n / factorial(2 * n + 1) for n in range(8))
_COS = tuple((-1) ** n / factorial(2 * n) for n in range(9))


def horner(coefficients: tuple, x):
    """The polynomial with these coefficients (constant term first) at `x`."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


sincos_p = Primitive("sincos")
sincos_p.multiple_results = True


def sincos(phase: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Sine and cosine of `phase` (radians, any shape; best within a few turns of zero).

    The absolute error is a few units of rounding. Differentiable to any order. XLA's CPU backend
    calls the scalar library for float64 `sin` and `cos`; these are polynomials on either backend.
    """
    sine, cosine = sincos_p.bind(jnp.asarray(phase))
    return sine, cosine


@sincos_p.def_abstract_eval
def _(phase):
    return [phase, phase]


def _by_tangent(phase):
    """Taylor series about zero on a quarter of the argument, then two angle doublings."""
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


def _sincos_jvp(primals, tangents):
    (phase,), (rate,) = primals, tangents
    sine, cosine = sincos(phase)
    if type(rate) is ad.Zero:
        return [sine, cosine], [rate, rate]
    return [sine, cosine], [cosine * rate, -sine * rate]


def _sincos_batched(args, dims):
    return sincos_p.bind(*args), [dims[0], dims[0]]


pin_p = Primitive("pin")


def pin(tree: object) -> Any:
    """The same values, which XLA's CPU backend computes once.

    When it fuses it copies cheap producers into each of their consumers, which multiplies the work
    of a long step; it does not copy divisions. So on that backend this is a division by one.
    """
    return jtu.tree_map(pin_p.bind, tree)


def pin_flag(flag: Bool[Array, ""], like: Float[Array, ""]) -> Bool[Array, ""]:
    """`pin` for a truth value, in the precision of `like`."""
    return pin(jnp.where(flag, jnp.ones_like(like), 0.0)) > 0.5


@pin_p.def_abstract_eval
def _(x):
    return x


def _divided(x):
    # Not a number would stay one whatever it is divided by; the compiler cannot know that.
    return x / jnp.where(x == x, jnp.ones_like(x), jnp.nan)


def jitted(primitive: Primitive, function: Callable) -> None:
    """What a primitive with a lowering needs: that it runs outside of `jit` too."""
    several = primitive.multiple_results
    primitive.def_impl(jax.jit(function))
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=several))


jitted(sincos_p, _by_tangent)
jitted(pin_p, _divided)
ad.primitive_jvps[sincos_p] = _sincos_jvp
batching.primitive_batchers[sincos_p] = _sincos_batched
ad.deflinear2(pin_p, lambda t, x: [t])
batching.defvectorized(pin_p)
