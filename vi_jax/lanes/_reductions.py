"""Sums, products and extremes of many numbers, for arrays in registers and in memory."""

from collections.abc import Callable
from typing import Any

from ._operations import Rule, add, extreme, is_unsigned, kind_of, mul, weighted
from ._text import Text, Value

REDUCTIONS: dict[str, tuple[Callable[..., Value], int]] = {
    "sum": (lambda t, a, b, unsigned: add(t, a, b), 0),
    "prod": (lambda t, a, b, unsigned: mul(t, a, b), 1),
    "max": (lambda t, a, b, unsigned: extreme(t, "gt", a, b, unsigned), 0),
    "min": (lambda t, a, b, unsigned: extreme(t, "lt", a, b, unsigned), 0),
    "and": (lambda t, a, b, unsigned: t.binary("and", a, b), 1),
    "or": (lambda t, a, b, unsigned: t.binary("or", a, b), 0),
}
"""How two numbers become one, by whether they are unsigned, and what stands for none; after
`reduce_` and `cum` in names."""


def register_reductions(table: dict[str, Rule], reduce: Rule, cumulate: Rule) -> None:
    """Put the rules for sums, products and extremes into a table.

    **Arguments:** the table; functions of the text, the axes that are reduced or the equation's
    parameters, its results' shapes and types, an array, how two numbers become one, and, of
    `reduce`, what stands for none.
    """

    def put_together(t: Text, how: Callable[..., Value], avals: Any) -> Callable[..., Value]:
        return lambda a, b: how(t, a, b, is_unsigned(avals[0].dtype))

    for name, (how, empty) in REDUCTIONS.items():
        table["reduce_" + name] = lambda t, p, avals, x, how=how, empty=empty: reduce(
            t, tuple(map(int, p["axes"])), avals, x, put_together(t, how, avals),
            t.constant(empty, kind_of(avals[0].dtype)),
        )  # fmt: skip
        if name not in ("and", "or"):
            table["cum" + name] = lambda t, p, avals, x, how=how: cumulate(
                t, p, avals, x, put_together(t, how, avals)
            )


def register_products(table: dict[str, Rule], dot: Rule) -> None:
    """Put the rules for products of arrays into a table.

    **Arguments:** the table; a rule for `dot_general` that takes, last, what the product of two
    numbers is.
    """
    table["dot_general"] = lambda t, p, avals, a, b: dot(t, p, avals, a, b, mul)

    def product(t: Text, weight: Value, slope: Value) -> Value:
        return weighted(t, weight, mul(t, weight, slope))

    def weighted_dot(t, p, avals, weight, slope):
        if p["weight_first"]:
            return dot(t, p, avals, weight, slope, product)
        return dot(t, p, avals, slope, weight, lambda t, a, b: product(t, b, a))

    table["weighted_dot"] = weighted_dot
