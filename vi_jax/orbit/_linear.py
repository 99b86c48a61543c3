"""Linear algebra of small matrices, written in JAX. JAX's own calls LAPACK through SciPy, whose
loading takes longer than a search for an orbit."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Matrix = Float[Array, "n n"]

# Larger matrices go to LAPACK. A choice: the loops here have one rotation or row in each iteration.
_SMALL = 8

# Sweeps of Jacobi's rotations; five to eight were needed for random matrices.
_SWEEPS = 15


def svd(matrix: Matrix) -> tuple[Matrix, Float[Array, " n"], Matrix]:
    """Return `jnp.linalg.svd(matrix)`: left vectors in columns, values, right vectors in rows."""
    n = len(matrix)
    if n > _SMALL:
        left, values, right = jnp.linalg.svd(matrix)
        return left, values, right
    (images, _), (right, left) = jax.vmap(_rotated)(jnp.stack([matrix.T, matrix]))
    values = jnp.linalg.norm(images, axis=1)
    # The image of a direction with value zero is rounding; the transpose has its left vector.
    is_zero = values <= n * jnp.finfo(matrix.dtype).eps * values[0]
    left = jnp.where(is_zero[:, None], left, images / jnp.where(is_zero, 1.0, values)[:, None])
    return left.T, values, right


def _rotated(rows: Matrix) -> tuple[Matrix, Matrix]:
    """Return the rows, made orthogonal by Jacobi's rotations, the longest first, and the product of
    the rotations (Hestenes 1958)."""
    first, second = map(jnp.asarray, np.triu_indices(len(rows), 1))
    eps = float(jnp.finfo(rows.dtype).eps)
    least = 4 * eps**2 * jnp.sum(rows**2)

    def rotate(k, carry):
        both, is_done = carry
        a, b = both[first[k]], both[second[k]]
        product, a_square, b_square = jnp.sum(a[0] * b[0]), jnp.sum(a[0] ** 2), jnp.sum(b[0] ** 2)
        is_small = ~(jnp.abs(product) > jnp.maximum(eps * jnp.sqrt(a_square * b_square), least))
        zeta = (b_square - a_square) / jnp.where(is_small, 1.0, 2 * product)
        tangent = jnp.where(zeta < 0, -1.0, 1.0) / (jnp.abs(zeta) + jnp.sqrt(1 + zeta**2))
        tangent = jnp.where(is_small, 0.0, tangent)
        cosine = 1 / jnp.sqrt(1 + tangent**2)
        both = both.at[first[k]].set(cosine * (a - tangent * b))
        return both.at[second[k]].set(cosine * (b + tangent * a)), is_done & is_small

    def sweep(carry):
        both, _, count = carry
        return *jax.lax.fori_loop(0, first.size, rotate, (both, jnp.ones((), bool))), count + 1

    both = jnp.stack([rows, jnp.eye(len(rows), dtype=rows.dtype)], axis=1)
    if first.size:
        unfinished = lambda carry: ~carry[1] & (carry[2] < _SWEEPS)
        both, *_ = jax.lax.while_loop(unfinished, sweep, (both, jnp.zeros((), bool), 0))
    both = both[jnp.argsort(-jnp.sum(both[:, 0] ** 2, axis=1))]
    return both[:, 0], both[:, 1]


def solve(matrix: Matrix, right_side: Array) -> Array:
    """Return `jnp.linalg.solve(matrix, right_side)`."""
    if len(matrix) > _SMALL:
        return jnp.linalg.solve(matrix, right_side)
    return jax.lax.custom_linear_solve(
        functools.partial(jnp.matmul, matrix), right_side,
        lambda _, b: _eliminated(matrix, b), lambda _, b: _eliminated(matrix.T, b),
    )  # fmt: skip


def _eliminated(matrix: Matrix, right_side: Any) -> Any:
    """Return the solution by Gauss–Jordan elimination with row pivots."""
    n = len(matrix)
    columns = right_side.reshape(n, -1)

    def eliminate(i, rows):
        sizes = jnp.where(jnp.arange(n) >= i, jnp.abs(rows[:, i]), -1.0)
        pivot = jnp.argmax(sizes)
        top, chosen = rows[i], rows[pivot] / rows[pivot, i]
        rows = rows.at[pivot].set(top)
        return (rows - rows[:, i, None] * chosen).at[i].set(chosen)

    rows = jax.lax.fori_loop(0, n, eliminate, jnp.concatenate([matrix, columns], axis=1))
    return rows[:, n:].reshape(right_side.shape)
