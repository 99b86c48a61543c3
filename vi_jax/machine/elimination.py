"""Elimination in small systems of linear equations whose entries may be known zeros and ones.

A matrix is rows of traced numbers, arrays, and Python numbers. Zeros and ones among the latter are
known while a step is traced: operations with them are left out.
"""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._types import Flag

# A matrix as rows of numbers.
Matrix = list[list[Any]]


def is_known(x: Any, value: float = 0.0) -> bool:
    """Return whether a number is a Python number equal to `value`."""
    return isinstance(x, int | float) and x == value


def _inverse(pivot: Any) -> Any:
    return 1 / pivot


def solved(
    M: Matrix, right: Sequence[Any], inverse: Callable[[Any], Any] = _inverse
) -> list[Any]:  # fmt: skip
    """Return M⁻¹ right for a matrix whose elimination needs no pivoting, such as a symmetric
    positive definite one. The inverses of its pivots do not change in a step if masses are
    constant."""
    n = len(M)
    if n > 2 and any(not is_known(M[i][j]) for i in range(n) for j in range(i)):
        return _substituted_once(*_eliminated_once(M, inverse), list(right))
    return _substituted(*_eliminated(M, inverse), list(right))


def _substituted(rows: Matrix, inverses: list[Any], right: list[Any]) -> list[Any]:
    """Return the solution for a right side, which changes, from the results of `_eliminated`."""
    n = len(rows)
    for i in range(n):
        right[i] = times(inverses[i], right[i])
        for k in range(i + 1, n):
            right[k] = minus_product(right[k], rows[k][i], right[i])
    for i in reversed(range(n)):
        for j in reversed(range(i + 1, n)):
            right[i] = minus_product(right[i], rows[i][j], right[j])
    return right


def is_definite(M: Matrix) -> Flag:
    """Return whether a symmetric matrix is positive definite, by the pivots of elimination."""
    flags = [jnp.all(jnp.asarray(x) > 0) for x in _eliminated(M)[1]]
    return functools.reduce(operator.and_, flags)


def _eliminated(
    M: Matrix, inverse: Callable[[Any], Any] = _inverse
) -> tuple[Matrix, list[Any]]:  # fmt: skip
    """Return the factors of a matrix in one: the lower one, and above its diagonal the upper one,
    whose diagonal is 1; and the inverse pivots."""
    n, rows, inverses = len(M), [list(row) for row in M], []
    for i in range(n):
        inverses.append(inverse(rows[i][i]))
        for j in range(i + 1, n):
            rows[i][j] = times(inverses[i], rows[i][j])
            for k in range(i + 1, n):
                rows[k][j] = minus_product(rows[k][j], rows[k][i], rows[i][j])
    return rows, inverses


# Traced once for all contacts and states, and written inline, where constant masses are eliminated
# once. 12 bodies with a full matrix took 18 s to trace.
_eliminated_once = eqx.filter_jit(_eliminated, inline=True)  # pyright: ignore
_substituted_once = eqx.filter_jit(_substituted, inline=True)  # pyright: ignore


def minus_product(x: Any, factor: Any, y: Any) -> Any:
    """Return x - factor·y, without known zeros and ones."""
    return x if is_known(factor) or is_known(y) else x - times(factor, y)


def dot(xs: Sequence[Any], ys: Sequence[Any]) -> Any:
    """Return the sum of the products of numbers and arrays, without known zeros."""
    both = [(x, y) for x, y in zip(xs, ys, strict=True) if not is_known(x)]
    return sum_of(jnp.sum(x * y) if jnp.ndim(x) else x * y for x, y in both)


def sum_of(xs: Iterable[Any]) -> Any:
    """Return a sum without known zeros: the compiler must not omit an addition of 0."""
    return functools.reduce(operator.add, [x for x in xs if not is_known(x)] or [0.0])


def times(factor: Any, y: Any) -> Any:
    """Return factor·y, without known zeros and ones."""
    return y if is_known(factor, 1.0) or is_known(y) else factor * y
