"""Sums, extremes and products of large arrays, as loops."""

from collections.abc import Callable, Sequence

import numpy as np

from .._operations import add, kind_of
from .._reductions import register_products, register_reductions
from .._text import Text, Value
from .held import as_large, room, settled, store_at, stored
from .index import Index, counted, over, plus, times
from .kinds import Formula, Held, Large, at
from .moved import LARGE, reshaped, transposed

# Sums at once of a long sum, each of which waits for itself: a fused multiply-add takes four cycles
# and two begin in each.
_SUMS = 8


# --- sums and the like


def in_one(t: Text, x: Held) -> Held:
    """An array that is asked for at places of which no more is known than that they are in it."""
    return stored(t, x) if isinstance(x, Large) and x.cuts else settled(t, x)


def _each_output(t: Text, shape: Sequence[int], kind: str, number: Callable) -> Large:
    """An array each of whose numbers takes a loop of its own, which are written one after the other
    if they are few."""
    formula = Formula(tuple(shape), kind, number)
    return formula if formula.size <= _FEW else stored(t, formula)


# A bound on the length of what is written, and thereby on the time of compilation.
_FEW = 4


def reduced(
    t: Text, number: int, term: Callable[[Index], Value], how: Callable, empty: Value
) -> Value:
    """All terms put together, several chains at once.

    **Arguments:** the text; how many terms; each by its number; of two values one; that of none.
    """
    if number == 0:
        return empty
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


def _reduce(t: Text, x: Held, axes: tuple[int, ...], aval, how: Callable, empty: Value) -> Held:
    kept = [a for a in range(x.ndim) if a not in axes]
    x = _grouped(t, x, (*([a] for a in kept), list(axes)))

    def number(index):
        return reduced(t, x.shape[-1], lambda i: at(t, x, (*index, i)), how, empty)

    return _each_output(t, aval.shape, kind_of(aval.dtype), number)


def _grouped(t: Text, x: Held, groups: Sequence[Sequence[int]]) -> Large:
    """An array with its axes in another order, each group of them made one."""
    x = as_large(t, stored(t, x) if isinstance(x, Large) and x.cuts else x)
    order = [a for group in groups for a in group]
    if order != list(range(x.ndim)):
        x = transposed(t, x, order)
    sizes = iter(x.shape)
    shape = tuple(int(np.prod([next(sizes) for _ in group], dtype=int)) for group in groups)
    return reshaped(t, x, shape)


def _cumulated(t: Text, p: dict, avals, x: Held, how: Callable) -> Held:
    """Each number put together with all before it along an axis."""
    x = as_large(t, in_one(t, x))
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


register_reductions(
    LARGE,
    lambda t, axes, avals, x, how, empty: _reduce(t, x, axes, avals[0], how, empty),
    _cumulated,
)


# --- products


def _dot(t: Text, p: dict, avals, a: Held, b: Held, product: Callable) -> Large:
    """A product of arrays; `product` says what that of two numbers is."""
    (over_a, over_b), (batch_a, batch_b) = p["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*over_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*over_b, *batch_b)]
    # Of a product with a vector each number of the matrix is asked for once.
    once_a, once_b = (
        int(np.prod([x.shape[i] for i in free], dtype=int)) == 1
        for x, free in ((b, free_b), (a, free_a))
    )
    left = _grouped(t, a if once_a else settled(t, a), (batch_a, free_a, over_a))
    right = _grouped(t, b if once_b else settled(t, b), (batch_b, free_b, over_b))
    shape = (left.shape[0], left.shape[1], right.shape[1])
    kind = kind_of(avals[0].dtype)
    if left.shape[2] == 1:  # nothing is added up

        def number(i: tuple[Index, ...]) -> Value:
            found = product(t, left.at(t, (i[0], i[1], 0)), right.at(t, (i[0], i[2], 0)))
            return t.opaque(found)

        return reshaped(t, Formula(shape, kind, number), avals[0].shape)
    found = _product(t, left, right, shape, kind, product)
    return reshaped(t, found, avals[0].shape)


def _product(t: Text, left: Large, right: Large, shape, kind: str, product: Callable) -> Large:
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


register_products(LARGE, _dot)
