"""Functions whose best form differs between the backends."""

import functools
from collections.abc import Callable, Sequence
from math import factorial, pi
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Bool, Float

# For |x| <= pi/4 the first omitted terms are below 5e-17.
_SIN = tuple((-1) ** n / factorial(2 * n + 1) for n in range(8))
_COS = tuple((-1) ** n / factorial(2 * n) for n in range(9))


def horner(coefficients: tuple, x):
    """Return the polynomial with these coefficients (constant term first) at `x`."""
    value = coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value


def run_outside_jit(primitive: Primitive) -> None:
    """Let a primitive run outside `jit`, too: by a compiled program for each set of parameters."""

    @functools.lru_cache(64)
    def compiled(**params):
        return jax.jit(functools.partial(primitive.bind, **params))

    @primitive.def_impl
    def _(*args, **params):
        with jax.disable_jit(False):  # else the program would be this function again
            return compiled(**params)(*args)


def elementwise_primitive(
    name: str, function: Callable[..., Any], jvp: Callable[..., Any] | None = None, results: int = 1
) -> Primitive:
    """Return an elementwise primitive of arrays of one shape, which also runs outside `jit`. Its
    results have the type of the last argument."""
    primitive = Primitive(name)
    primitive.multiple_results = several = results > 1

    def shaped(*args, **params):
        weak = all(x.weak_type for x in args)
        shape = jnp.broadcast_shapes(*(x.shape for x in args))  # scalars are broadcast
        aval = ShapedArray(shape, args[-1].dtype, weak_type=weak)
        return [aval] * results if several else aval

    def batched(args, dims, **params):
        if all(d == 0 for d in dims) and len({x.shape for x in args}) == 1:
            out = primitive.bind(*args, **params)
            return out, [0] * results if several else 0
        front = [
            x[None] if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)
        ]
        out = primitive.bind(*jnp.broadcast_arrays(*front), **params)
        return out, [0] * results if several else 0

    primitive.def_abstract_eval(shaped)
    run_outside_jit(primitive)
    mlir.register_lowering(primitive, mlir.lower_fun(function, multiple_results=several))
    batching.primitive_batchers[primitive] = batched
    if jvp is not None:
        ad.primitive_jvps[primitive] = jvp
    return primitive


def sincos(phase: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return the sine and cosine of `phase` (radians, any shape; best within a few turns of zero).

    The absolute error is a few units of rounding. Differentiable to any order. XLA's CPU backend
    calls the scalar library for float64 `sin` and `cos`; these are polynomials on either backend.
    """
    sine, cosine = sincos_p.bind(jnp.asarray(phase))
    return sine, cosine


def _by_tangent(phase):
    """Sum Taylor series about zero at a quarter of the argument, then double the angle twice."""
    turns = jnp.round(phase * (0.5 / pi))
    quarter = 0.25 * (phase - (2 * pi) * turns)
    square = quarter * quarter
    # XLA copies cheap producers into each of their consumers, but not divisions. Because of the
    # tangent the polynomials are evaluated once.
    tangent = quarter * horner(_SIN, square) / horner(_COS, square)
    share = 1 / (1 + tangent * tangent)
    sine, cosine = 2 * tangent * share, (1 - tangent * tangent) * share
    # 1 - 2 sin² keeps the cosine's absolute error from growing in the doubling.
    return 2 * sine * cosine, 1 - 2 * sine * sine


def _sincos_jvp(primals, tangents):
    (phase,), (rate,) = primals, tangents
    sine, cosine = sincos(phase)
    if type(rate) is ad.Zero:
        return [sine, cosine], [rate, rate]
    return [sine, cosine], [cosine * rate, -sine * rate]


sincos_p = elementwise_primitive("sincos", _by_tangent, _sincos_jvp, results=2)


def weighted_sum(weights: Sequence[float], terms: Sequence[Array]) -> Array:
    """Return Σ weight·term of arrays of one shape: one operation, to trace it quickly."""
    return weighted_sum_p.bind(*terms, weights=tuple(map(float, weights)))


def _sum_of_products(*terms, weights):
    products = (lax.mul(x, lax.full_like(x, w)) for x, w in zip(terms, weights, strict=True))
    return functools.reduce(lax.add, products)


def _weighted_sum_jvp(primals, tangents, *, weights):
    both = zip(weights, tangents, strict=True)
    varied = [(w, t) for w, t in both if type(t) is not ad.Zero]
    change = weighted_sum(*zip(*varied, strict=True)) if varied else tangents[0]
    return weighted_sum(weights, primals), change


weighted_sum_p = elementwise_primitive("weighted_sum", _sum_of_products, _weighted_sum_jvp)


def _weighted_sum_transpose(cotangent: Any, *terms: Any, weights: Sequence[float]) -> list[Any]:
    if type(cotangent) is ad.Zero:
        return [None for _ in terms]
    return [
        weighted_sum([weight], [cotangent]) if ad.is_undefined_primal(x) else None
        for weight, x in zip(weights, terms, strict=True)
    ]


ad.primitive_transposes[weighted_sum_p] = _weighted_sum_transpose


def pin(tree: object) -> Any:
    """Return the same values, which XLA's CPU backend computes only once.

    Its fusion copies cheap producers into each of their consumers, which multiplies the work of a
    long step. It does not copy divisions, so on that backend this is a division by one.
    """
    return jtu.tree_map(pin_p.bind, tree)


def pin_flag(flag: Bool[Array, ""], like: Float[Array, ""]) -> Bool[Array, ""]:
    """Apply `pin` to a boolean, in the precision of `like`."""
    return pin(jnp.where(flag, jnp.ones_like(like), 0.0)) > 0.5


def _divided(x):
    # The compiler keeps this division, since it does not use that NaN / NaN is NaN.
    return x / jnp.where(x == x, jnp.ones_like(x), jnp.nan)


pin_p = elementwise_primitive("pin", _divided)
ad.deflinear2(pin_p, lambda t, x: [t])
