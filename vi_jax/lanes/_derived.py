"""Primitives that are written in JAX itself: factorisations of small matrices, sorting, arguments
of extremes."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr


def _lu(a):
    """A = P⁻¹LU with the largest pivot of each column, of matrices (…, n, m)."""
    n, m = a.shape[-2:]
    rows = jnp.arange(n)
    order = jnp.broadcast_to(rows, a.shape[:-1])
    pivots = []
    for k in range(min(n, m)):
        column = jnp.where(rows >= k, jnp.abs(a[..., k]), -1.0)
        greatest = jnp.max(column, axis=-1, keepdims=True)
        pivot = jnp.min(jnp.where(column == greatest, rows, n - 1), axis=-1, keepdims=True)
        pivots.append(pivot)
        here = rows == pivot

        def exchanged(x, here=here, k=k):
            """Row k and the pivot's, each in the other's place."""
            wide = here.reshape(*here.shape, *(1,) * (x.ndim - here.ndim))
            first = x[..., k : k + 1, :] if x.ndim > here.ndim else x[..., k : k + 1]
            other = jnp.sum(jnp.where(wide, x, 0), axis=here.ndim - 1, keepdims=True)
            moved = jnp.where(wide, first, x)
            at_k = (rows == k).reshape(n, *(1,) * (x.ndim - here.ndim))
            return jnp.where(at_k, other, moved)

        a, order = exchanged(a), exchanged(order)
        largest = a[..., k : k + 1, k : k + 1]
        # A column of zeros stays one: the matrix is singular.
        factor = a[..., k : k + 1] / jnp.where(largest == 0, 1, largest)
        below, right = (rows > k)[:, None], jnp.arange(m) > k
        a = jnp.where(below & (jnp.arange(m) == k), factor, a)
        a = jnp.where(below & right, a - factor * a[..., k : k + 1, :], a)
    pivot = jnp.concatenate(pivots, axis=-1)
    return a, pivot.astype(jnp.int32), order.astype(jnp.int32)


def _triangular_solve(a, b, *, left_side, lower, transpose_a, unit_diagonal, **_):
    """X of A X = B or X A = B with a triangular A."""
    if not left_side:  # the same equation transposed
        a, b = jnp.swapaxes(a, -1, -2), jnp.swapaxes(b, -1, -2)
        lower = not lower
    if transpose_a:
        a, lower = jnp.swapaxes(a, -1, -2), not lower
    n = a.shape[-1]
    rows: dict[int, Any] = {}
    for k in range(n) if lower else range(n)[::-1]:
        row = b[..., k, :]
        for j, known in rows.items():
            row = row - a[..., k, j, None] * known
        rows[k] = row if unit_diagonal else row / a[..., k, k, None]
    x = jnp.stack([rows[k] for k in range(n)], axis=-2)
    return [x if left_side else jnp.swapaxes(x, -1, -2)]


def _cholesky(a, **_):
    """L of A = L Lᵀ; not a number where A is not positive definite."""
    n = a.shape[-1]
    out = jnp.zeros_like(a)
    for k in range(n):
        column = a[..., k] - jnp.sum(out * out[..., k : k + 1, :], axis=-1)
        column = column / jnp.sqrt(column[..., k : k + 1])
        column = jnp.where(jnp.arange(n) >= k, column, 0.0)
        out = jnp.where(jnp.arange(n) == k, column[..., None], out)
    return [out]


def _sort(*xs, dimension, num_keys, **_):
    """Arrays in the order of the first, or of several; equal ones keep theirs."""
    xs = [jnp.moveaxis(x, dimension, -1) for x in xs]
    n = xs[0].shape[-1]
    places = jnp.arange(n)
    before = jnp.broadcast_to(places[None, :] < places[:, None], (*xs[0].shape, n))
    for x in xs[:num_keys][::-1]:
        one, other = x[..., :, None], x[..., None, :]
        one, other = jnp.broadcast_arrays(one, other)
        # What is not a number comes last, and is as great as any other such.
        less, same = other < one, one == other
        if _is_float(x):
            less, same = (
                less | (one != one) & (other == other),
                same | (one != one) & (other != other),
            )
        before = less | same & before
    rank = jnp.sum(before, axis=-1, dtype=places.dtype)
    there = rank[..., None, :] == places[:, None]

    def placed(x):
        found = jnp.sum(jnp.where(there, x[..., None, :], 0), axis=-1, dtype=x.dtype)
        if not _is_float(x):
            return found
        # A sum has lost the sign of -0.
        negative = jnp.any(there & (1 / x < 0)[..., None, :], axis=-1)
        return jnp.where((found == 0) & negative, -0.0, found)

    sorted_ = [placed(x) for x in xs]
    return [jnp.moveaxis(x, -1, dimension) for x in sorted_]


def _is_float(x) -> bool:
    return jnp.issubdtype(x.dtype, jnp.floating)


def _first_extreme(extreme: Callable, x, *, axes, index_dtype, **_):
    (axis,) = axes
    n = x.shape[axis]
    places = lax.broadcasted_iota(index_dtype, x.shape, axis)
    best = extreme(x, axis=axis, keepdims=True)
    here = (x == best) | (x != x)
    return [jnp.min(jnp.where(here, places, n - 1), axis=axis)]


def _tile(x, *, reps):
    wide = jnp.broadcast_to(
        x.reshape([n for m in x.shape for n in (1, m)]),
        [n for r, m in zip(reps, x.shape, strict=True) for n in (r, m)],
    )
    return [wide.reshape([r * m for r, m in zip(reps, x.shape, strict=True)])]


DERIVED: dict[str, Callable[..., Any]] = {
    "lu": lambda a, **_: _lu(a),
    "triangular_solve": _triangular_solve,
    "cholesky": _cholesky,
    "sort": _sort,
    "tile": _tile,
    "argmin": functools.partial(_first_extreme, jnp.min),
    "argmax": functools.partial(_first_extreme, jnp.max),
}
"""Functions of a primitive's arguments and parameters that give its results."""


def derived(name: str, avals: list[Any], params: dict[str, Any]) -> ClosedJaxpr:
    """What a primitive does, as a jaxpr of others."""
    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals]
    return jax.make_jaxpr(lambda *args: DERIVED[name](*args, **params))(*shapes)
