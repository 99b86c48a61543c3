"""Linear algebra of small matrices by NumPy, within compiled programs."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..lanes import call_numpy

Matrix = Float[Array, "n n"]


def svd(matrix: Any) -> tuple[Any, Any, Any]:
    """Return `np.linalg.svd(matrix)` of arrays (..., n, n); NaN for one that is not finite."""
    known = np.isfinite(matrix).all(axis=(-2, -1))
    if not known.all():
        matrix = np.where(known[..., None, None], matrix, 0.0)
    left, values, right = np.linalg.svd(matrix)
    nan = np.where(known, 1.0, np.nan).astype(matrix.dtype)[..., None]
    return left * nan[..., None], values * nan, right * nan[..., None]


def solve(matrix: Matrix, right_side: Array) -> Array:
    """Return `jnp.linalg.solve(matrix, right_side)`; NaN for a singular matrix."""

    def solved(matrix: Matrix, right_side: Array) -> Array:
        columns = right_side.reshape(len(matrix), -1)
        return call_numpy(_solved, [columns.shape], matrix, columns)[0].reshape(right_side.shape)

    return jax.lax.custom_linear_solve(
        functools.partial(jnp.matmul, matrix), right_side,
        lambda _, b: solved(matrix, b), lambda _, b: solved(matrix.T, b),
    )  # fmt: skip


def _solved(matrix: np.ndarray, right: np.ndarray) -> list[np.ndarray]:
    try:
        return [np.linalg.solve(matrix, right)]
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return [np.full_like(right, np.nan)]
        return [np.concatenate([_solved(m, r) for m, r in zip(matrix, right, strict=True)])]
