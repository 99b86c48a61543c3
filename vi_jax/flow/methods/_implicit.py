"""Stages of a diagonally implicit Runge–Kutta solver, for fields that are stiff."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from ..._types import Scalar

Vector = Float[Array, " n"]

# Newton's steps after which a stage is given up, so that the step is tried again shorter: a choice.
_MOST = 12


def implicit_stages(
    tableau: Any,
    field: Callable[[Scalar, Vector], Vector],
    s0: Any,
    h: Any,
    y0: Vector,
    tolerance: Scalar | float,
) -> tuple[list[Vector], Scalar]:
    """The slopes of all stages, and what the last steps of Newton's method still changed.

    All stages share one matrix 1 - hγJ, with the Jacobian at the start of the step (Kværnø, BIT
    Numerical Mathematics 44, 2004). Each is solved to `tolerance` relative to 1 + |y|; where that
    fails what is left is infinite. Derivatives are those of the solution, by the implicit function
    theorem.

    **Arguments:** `tableau`, diffrax's Butcher tableau; `field`, dy/ds; `s0`, `h` and `y0`, where
    the step begins, its length and the state, flattened.
    """
    gamma = float(tableau.a_diagonal[-1])
    still = stop_gradient((s0, y0))
    jacobian = jax.jacfwd(field, argnums=1)(*still)
    inverse = inverse_of(jnp.eye(y0.size, dtype=y0.dtype) - stop_gradient(h) * gamma * jacobian)
    stages, left = [field(s0, y0)], jnp.zeros_like(h)
    for row, predictor, c in zip(tableau.a_lower, tableau.a_predictor, tableau.c, strict=True):
        base = y0 + h * weighted(row, stages)
        s = s0 + float(c) * h

        def lacks(k: Vector, s: Scalar = s, base: Vector = base) -> Vector:
            return k - field(s, base + h * gamma * k)

        def solve(lacks: Callable[[Vector], Vector], k: Vector) -> tuple[Vector, Scalar]:
            def goes_on(carry):
                _, size, i = carry
                return (size > tolerance) & (i < _MOST)

            def newton(carry):
                k, _, i = carry
                change = dot(inverse, lacks(k))
                return k - change, change_of(h * gamma * change, y0), i + 1

            start = (k, jnp.full_like(h, jnp.inf), jnp.zeros_like(h))
            k, size, _ = jax.lax.while_loop(goes_on, newton, start)
            return k, jnp.where(size <= tolerance, size, jnp.inf)

        guess = stop_gradient(weighted(predictor, stages))
        k, size = jax.lax.custom_root(lacks, guess, solve, _tangent, has_aux=True)
        stages.append(k)
        left = jnp.maximum(left, stop_gradient(size))
    return stages, left


def change_of(change: Vector, y: Vector) -> Scalar:
    """The largest component of a change, relative to 1 + |y|; infinite if there is a NaN."""
    size = jnp.max(jnp.abs(change) / (1 + jnp.abs(y)))
    return jnp.where(jnp.isfinite(size), size, jnp.inf)


def weighted(weights: np.ndarray, stages: list, base: object = None) -> Any:
    """base + Σ weight·stage, leaf by leaf, without the zero weights."""
    used = [(float(w), stage) for w, stage in zip(weights, stages, strict=False) if w != 0]

    def leaf(*leaves: jax.Array) -> jax.Array:
        return functools.reduce(jnp.add, [w * x for (w, _), x in zip(used, leaves, strict=True)])

    change = jtu.tree_map(leaf, *(stage for _, stage in used))
    return change if base is None else jtu.tree_map(jnp.add, base, change)


def dot(matrix: Float[Array, "n n"], vector: Vector) -> Vector:
    """The product of a small matrix and a vector, written out number by number."""
    return jnp.sum(matrix * vector, axis=1)


def inverse_of(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a small matrix, by elimination written out with row pivots."""
    n = matrix.shape[0]
    rows = [jnp.concatenate([matrix[i], jnp.eye(n, dtype=matrix.dtype)[i]]) for i in range(n)]
    for i in range(n):
        for j in range(i + 1, n):  # the greatest pivot comes up
            swap = jnp.abs(rows[j][i]) > jnp.abs(rows[i][i])
            rows[i], rows[j] = jnp.where(swap, rows[j], rows[i]), jnp.where(swap, rows[i], rows[j])
        rows[i] = rows[i] / rows[i][i]
        for j in range(n):
            if j != i:
                rows[j] = rows[j] - rows[j][i] * rows[i]
    return jnp.stack([row[n:] for row in rows])


def _tangent(linear: Callable[[Vector], Vector], right: Vector) -> Vector:
    """The solution of a linear equation, the function given and the right side: how `custom_root`
    carries derivatives over."""
    unit = jnp.eye(right.size, dtype=right.dtype)
    columns = jnp.stack([linear(unit[i]) for i in range(right.size)], axis=1)
    return dot(inverse_of(columns), right)
