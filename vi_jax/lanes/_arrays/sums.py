"""Sums, extremes and products: number by number of arrays in registers, else as loops."""

import functools
from collections.abc import Callable, Sequence

import jax
import numpy as np

from .._operations import Rule, add, extreme, is_unsigned, kind_of, mul, weighted
from .._text import Text, Value
from .held import addressable, held, mapped, room, settled, store_at, stored
from .index import Index, counted, over, plus, times
from .kinds import MOST_IN_REGISTERS, Array, Formula, Registers
from .moved import STRUCTURAL, reshaped, structural, transposed

# Sums at once of a long sum, each of which waits for itself: a fused multiply-add takes four cycles
# and two begin in each.
_SUMS = 8


# --- sums and the like


def in_one(t: Text, x: Array) -> Array:
    """An array that is asked for at places of which no more is known than that they are in it."""
    return stored(t, x) if x.cuts else settled(t, x)


def _each_output(t: Text, shape: Sequence[int], kind: str, number: Callable) -> Array:
    """An array each of whose numbers takes a loop of its own, which are written one after the other
    if they are few."""
    formula = Formula(tuple(shape), kind, number)
    return formula if formula.size <= _FEW else stored(t, formula)


# A bound on the length of what is written, and thereby on the time of compilation.
_FEW = 4


def reduced(
    t: Text, number: int, term: Callable[[Index], Value], how: Callable, empty: Value,
    *, in_order: bool = False,
) -> Value:  # fmt: skip
    """All terms put together, several chains at once.

    **Arguments:** the text; how many terms; each by its number; of two values one; that of none;
    whether the terms are written one after the other instead.
    """
    if number == 0:
        return empty
    if in_order:
        return functools.reduce(how, map(term, range(number)))
    chains = _SUMS if number >= 2 * _SUMS else 1
    turns, rest = divmod(number, chains)
    first = [term(j) for j in range(chains)]

    def turn(i: Index, carry: list[Value]) -> list[Value]:
        begin = times(t, plus(t, i, 1), chains)
        return [how(c, term(plus(t, begin, j))) for j, c in enumerate(carry)]

    found = counted(t, turns - 1, turn, first)
    found = [*found, *(term(turns * chains + j) for j in range(rest))]
    while len(found) > 1:
        pairs = [how(a, b) for a, b in zip(found[::2], found[1::2], strict=False)]
        found = pairs + found[len(pairs) * 2 :]
    return found[0]


def _reduce(t: Text, axes: tuple[int, ...], aval, x: Array, how: Callable, empty: Value) -> Array:
    kept, in_order = [a for a in range(x.ndim) if a not in axes], isinstance(x, Registers)
    x = _grouped(t, x, (*([a] for a in kept), list(axes)))

    def number(index):
        term = lambda i: x.at(t, (*index, i))
        return reduced(t, x.shape[-1], term, how, empty, in_order=in_order)

    if in_order:
        return Registers.of(aval.shape, kind_of(aval.dtype), number)
    return _each_output(t, aval.shape, kind_of(aval.dtype), number)


def _grouped(t: Text, x: Array, groups: Sequence[Sequence[int]]) -> Array:
    """An array with its axes in another order, each group of them made one."""
    x = stored(t, x) if x.cuts else x
    order = [a for group in groups for a in group]
    if order != list(range(x.ndim)):
        x = held(t, transposed(t, x, order))
    sizes = iter(x.shape)
    shape = tuple(int(np.prod([next(sizes) for _ in group], dtype=int)) for group in groups)
    return reshaped(t, x, shape)


def _cumulated(t: Text, p: dict, x: Array, how: Callable) -> Array:
    """Each number put together with all before it along an axis."""
    if isinstance(x, Registers):
        out = np.moveaxis(x.values, p["axis"], 0).copy()
        out = out[::-1] if p["reverse"] else out
        for i in range(1, len(out)):
            before, here = (Registers(out[n : n + 1], x.kind) for n in (i - 1, i))
            out[i : i + 1] = mapped(t, how, before, here).values
        out = out[::-1] if p["reverse"] else out
        return Registers(np.moveaxis(out, 0, p["axis"]), x.kind)
    x = in_one(t, x)
    axis, out = p["axis"], room(t, x.shape, x.kind)
    length = x.shape[axis]
    others = [1 if a == axis else n for a, n in enumerate(x.shape)]

    def along(index: tuple[Index, ...]) -> None:
        def put(i: Index, before: Value | None) -> Value:
            place = plus(t, length - 1, times(t, i, -1)) if p["reverse"] else i
            whole = (*index[:axis], place, *index[axis + 1 :])
            value = x.at(t, whole)
            value = value if before is None else how(before, value)
            store_at(t, out, whole, value)
            return value

        first = put(0, None)
        counted(t, length - 1, lambda i, carry: [put(plus(t, i, 1), carry[0])], [first])

    over(t, others, along)
    return out


_REDUCTIONS: dict[str, tuple[Callable[..., Value], int]] = {
    "sum": (lambda t, a, b, unsigned: add(t, a, b), 0),
    "prod": (lambda t, a, b, unsigned: mul(t, a, b), 1),
    "max": (lambda t, a, b, unsigned: extreme(t, "gt", a, b, unsigned), 0),
    "min": (lambda t, a, b, unsigned: extreme(t, "lt", a, b, unsigned), 0),
    "and": (lambda t, a, b, unsigned: t.binary("and", a, b), 1),
    "or": (lambda t, a, b, unsigned: t.binary("or", a, b), 0),
}
"""How two numbers become one, by whether they are unsigned, and what stands for none; after
`reduce_` and `cum` in names."""


def _reduction(name: str) -> Rule:
    def rule(t, p, avals, x):
        dtype, (how, empty) = avals[0].dtype, _REDUCTIONS[name]
        both = lambda a, b: how(t, a, b, is_unsigned(dtype))
        none = t.constant(empty, kind_of(dtype))
        return _reduce(t, tuple(map(int, p["axes"])), avals[0], x, both, none)

    return rule


def _cumulation(name: str) -> Rule:
    how = _REDUCTIONS[name][0]
    return lambda t, p, avals, x: _cumulated(
        t, p, x, lambda a, b: how(t, a, b, is_unsigned(avals[0].dtype))
    )


STRUCTURAL.update({"reduce_" + name: _reduction(name) for name in _REDUCTIONS})
STRUCTURAL.update({"cum" + name: _cumulation(name) for name in ("sum", "prod", "max", "min")})


def any_in(t: Text, x: Array) -> Value:
    """Whether any flag of an array holds."""
    if not x.ndim:
        return x.at(t, ())
    axes, flag = {"axes": tuple(range(x.ndim))}, jax.ShapeDtypeStruct((), bool)
    return held(t, STRUCTURAL["reduce_or"](t, axes, [flag], x)).at(t, ())


# --- products


def _dot(t: Text, p: dict, avals, a: Array, b: Array, product: Callable) -> Array:
    """A product of arrays; `product` says what that of two numbers is."""
    (over_a, over_b), (batch_a, batch_b) = p["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*over_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*over_b, *batch_b)]
    kind, groups = kind_of(avals[0].dtype), ((batch_a, free_a, over_a), (batch_b, free_b, over_b))
    small = avals[0].size <= MOST_IN_REGISTERS
    if small and isinstance(a, Registers) and isinstance(b, Registers):
        left, right = (_grouped(t, x, group) for x, group in zip((a, b), groups, strict=True))
        zero, together = t.zero(kind), lambda x, y: add(t, x, y)

        def element(i: tuple[int, ...]) -> Value:
            term = lambda k: product(t, left.at(t, (i[0], i[1], k)), right.at(t, (i[0], i[2], k)))
            return reduced(t, left.shape[2], term, together, zero, in_order=True)

        whole = Registers.of((left.shape[0], left.shape[1], right.shape[1]), kind, element)
        return reshaped(t, whole, avals[0].shape)
    # Of a product with a vector each number of the matrix is asked for once.
    once_a, once_b = (
        int(np.prod([x.shape[i] for i in free], dtype=int)) == 1
        for x, free in ((b, free_b), (a, free_a))
    )
    left, right = (
        _grouped(t, addressable(t, x if once else settled(t, x)), group)
        for x, once, group in zip((a, b), (once_a, once_b), groups, strict=True)
    )
    shape = (left.shape[0], left.shape[1], right.shape[1])
    if left.shape[2] == 1:  # nothing is added up

        def number(i: tuple[Index, ...]) -> Value:
            found = product(t, left.at(t, (i[0], i[1], 0)), right.at(t, (i[0], i[2], 0)))
            return t.opaque(found)

        return reshaped(t, Formula(shape, kind, number), avals[0].shape)
    found = _product(t, left, right, shape, kind, product)
    return reshaped(t, found, avals[0].shape)


def _product(t: Text, left: Array, right: Array, shape, kind: str, product: Callable) -> Array:
    """(batch, n, k) times (batch, m, k): sums of several rows at once, so that none waits for
    itself and a number of the other side is read once for all of them."""
    batch, rows, columns = shape
    turned = columns > rows
    if turned:
        left, right, rows, columns = right, left, columns, rows

    def multiplied(x: Value, y: Value) -> Value:
        return product(t, y, x) if turned else product(t, x, y)

    out, length, zero = room(t, shape, kind), left.shape[2], t.zero(kind)

    def block(first: Index, number: int, z: Index, column: Index) -> None:
        if number < _SUMS // 2 and length >= 2 * _SUMS:
            sums = []
            for j in range(number):
                row = plus(t, first, j)
                sums.append(
                    reduced(
                        t,
                        length,
                        lambda i, row=row: multiplied(
                            left.at(t, (z, row, i)), right.at(t, (z, column, i))
                        ),
                        lambda x, y: add(t, x, y),
                        zero,
                    )
                )
        else:

            def turn(i: Index, carry: list[Value]) -> list[Value]:
                other = right.at(t, (z, column, i))
                return [
                    add(t, c, multiplied(left.at(t, (z, plus(t, first, j), i)), other))
                    for j, c in enumerate(carry)
                ]

            sums = counted(t, length, turn, [zero] * number)
        for j, value in enumerate(sums):
            row = plus(t, first, j)
            index = (z, column, row) if turned else (z, row, column)
            store_at(t, out, index, value)

    whole, rest = divmod(rows, _SUMS)
    for number, first, turns in ((_SUMS, 0, whole), (rest, whole * _SUMS, 1)):
        if not number:
            continue
        over(
            t,
            (batch, columns, turns),
            lambda i, number=number, first=first: block(
                plus(t, times(t, i[2], _SUMS), first), number, i[0], i[1]
            ),
        )
    return out


structural("dot_general")(lambda t, p, avals, a, b: _dot(t, p, avals, a, b, mul))


@structural("weighted_dot")
def _(t, p, avals, weight, slope):
    def product(t: Text, weight: Value, slope: Value) -> Value:
        return weighted(t, weight, mul(t, weight, slope))

    if p["weight_first"]:
        return _dot(t, p, avals, weight, slope, product)
    return _dot(t, p, avals, slope, weight, lambda t, a, b: product(t, b, a))
