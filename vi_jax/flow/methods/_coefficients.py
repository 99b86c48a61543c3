"""Taylor coefficients and their arithmetic; those that are zero by structure cost nothing."""

from collections.abc import Callable
from typing import Any

Coefficient = Any
"""An array, or `None` for zero."""
Series = list[Coefficient]


class NoSeries(Exception):
    """A field without a recursion; the argument is the primitive's name."""


class NotSmooth(Exception):
    """A field with a kink or a jump where the state says; the argument is what makes it."""


def nth(series: Series, n: int) -> Coefficient:
    """The n-th coefficient, zero beyond those known."""
    return series[n] if n < len(series) else None


def plus(a: Coefficient, b: Coefficient) -> Coefficient:
    """The sum a + b of two power series."""
    if a is None or b is None:
        return b if a is None else a
    return a + b


def minus(a: Coefficient, b: Coefficient) -> Coefficient:
    """The difference a - b of two power series."""
    if b is None:
        return a
    return -b if a is None else a - b


def times(a: Coefficient, b: Coefficient) -> Coefficient:
    """The product a b of two power series, as far as both are known."""
    return None if a is None or b is None else a * b


def scaled(c: float, a: Coefficient) -> Coefficient:
    """The power series a times a number c."""
    return None if a is None else a if c == 1 else a * c


def convolution(
    a: Series, b: Series, n: int, begin: int = 0, weight: Callable[[int], float] | None = None
) -> Coefficient:
    """The n-th coefficient of a product of two series, or a part of that sum: Σ weight(j) a_j
    b_{n-j} over j from `begin` to n.

    **Arguments:** `weight`, 1 if left out.
    """
    terms = []
    # What is known longest comes first: only the last products wait for the newest coefficients.
    for j in sorted(range(begin, n + 1), key=lambda j: max(j, n - j)):
        term = times(nth(a, j), nth(b, n - j))
        terms.append(term if weight is None else scaled(weight(j), term))
    return sum_of(terms)


def sum_of(terms: list[Coefficient]) -> Coefficient:
    """Their sum, by two chains of additions that do not wait for each other."""
    chains: list[Coefficient] = [None, None]
    for i, term in enumerate(t for t in terms if t is not None):
        chains[i % 2] = plus(chains[i % 2], term)
    return plus(*chains)


def square(a: Series, n: int) -> Coefficient:
    """Of a series with itself: each mixed product once."""
    pairs = [times(nth(a, j), nth(a, n - j)) for j in reversed(range((n + 1) // 2))]
    total = scaled(2.0, sum_of(pairs))
    return plus(total, times(nth(a, n // 2), nth(a, n // 2))) if n % 2 == 0 else total
