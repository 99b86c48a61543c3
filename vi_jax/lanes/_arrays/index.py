"""Places within an array: known while the code is written, the same for all lanes, or each lane's
own."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType

import numpy as np

from .._text import Text, Value

Index = int | str | Value
"""A number; the name of a scalar `i64`, the same for all lanes; or an `i64` of each lane."""


def splat(t: Text, scalar: str, kind: str) -> Value:
    """A scalar of the kernel in every lane of the group."""
    v = t.vector(kind)
    one = t.raw(f"insertelement {v} poison, {kind} {scalar}, i32 0")
    mask = f"<{t.width} x i32> zeroinitializer"
    return Value(t.raw(f"shufflevector {v} {one}, {v} poison, {mask}"), kind)


def in_lanes(t: Text, place: Index) -> Value:
    """A place as an `i64` of each lane."""
    if isinstance(place, Value):
        return place
    return t.constant(place, "i64") if isinstance(place, int) else splat(t, place, "i64")


def plus(t: Text, a: Index, b: Index) -> Index:
    """The sum of two places."""
    if isinstance(a, int) and isinstance(b, int):
        return a + b
    if a == 0 or b == 0:
        return b if a == 0 else a
    if isinstance(a, Value) or isinstance(b, Value):
        return t.binary("add", in_lanes(t, a), in_lanes(t, b))
    found = t.once(f"add i64 {a}, {b}")
    name, number = (b, a) if isinstance(a, int) else (a, b)
    if isinstance(number, int) and name in t.ranges:
        low, high = t.ranges[name]
        t.ranges[found] = low + number, high + number
    return found


def times(t: Text, a: Index, number: int) -> Index:
    """A place times a number."""
    if isinstance(a, int):
        return a * number
    if number in (0, 1):
        return a if number else 0
    if isinstance(a, Value):
        return t.binary("mul", a, t.constant(number, "i64"))
    return t.once(f"mul i64 {a}, {number}")


def place_of(t: Text, index: Sequence[Index], strides: Sequence[int], offset: Index = 0) -> Index:
    """The place of an element among an array's numbers."""
    total = offset
    for i, stride in zip(index, strides, strict=True):
        total = plus(t, total, times(t, i, stride))
    return total


def contiguous(shape: Sequence[int]) -> tuple[int, ...]:
    """The strides of an array whose numbers lie in order, the last axis fastest."""
    return tuple(int(np.prod(shape[i + 1 :], dtype=int)) for i in range(len(shape)))


def counted(
    t: Text,
    number: int,
    turn: Callable[[Index, list[Value]], list[Value]],
    first: list[Value],
) -> list[Value]:
    """A loop of a known number of turns, with a scalar counter.

    **Arguments:** the text; the number; what a turn does with its number and what the turn before
    gave; what the first one is given.

    **Returns:** what the last turn gave.
    """
    if number < 2:
        return turn(0, first) if number else first
    inside, after = t.label(), t.label()
    before = t.block
    t.line(f"br label %{inside}")
    t.open(inside)
    place = len(t.lines)
    carry = [Value(t.fresh(), a.kind) for a in first]
    count, following = t.fresh(), t.fresh()
    t.ranges[count] = 0, number - 1
    new = turn(count, carry)
    end = t.block
    t.line(f"{following} = add i64 {count}, 1")
    more = t.raw(f"icmp slt i64 {following}, {number}")
    t.join(carry, (first, before), (new, end), at=place)
    t.lines.insert(place, f"  {count} = phi i64 [ 0, %{before} ], [ {following}, %{end} ]")
    t.fork(more, inside, after)
    t.close()
    t.follow(after)
    return new


Cuts = Mapping[int, frozenset[int]]
"""Of some axes, the places at which an array's numbers begin to be known in another way."""

NO_CUTS: Cuts = MappingProxyType({})


def over(
    t: Text,
    shape: Sequence[int],
    body: Callable[[tuple[Index, ...]], None],
    cuts: Cuts = NO_CUTS,
) -> None:
    """Loops over all elements of an array of this shape, a loop for each part between `cuts`."""

    def nest(index: tuple[Index, ...]) -> None:
        axis = len(index)
        if axis == len(shape):
            body(index)
            return
        bounds = sorted({0, shape[axis], *cuts.get(axis, ())})
        for begin, end in pairwise(bounds):

            def turn(i: Index, _: list[Value], begin: int = begin) -> list[Value]:
                nest((*index, plus(t, i, begin)))
                return []

            counted(t, end - begin, turn, [])

    nest(())


def range_of(t: Text, i: Index, size: int) -> tuple[int, int]:
    """The least and the greatest number that a place along an axis of this size can be."""
    if isinstance(i, int):
        return i, i
    return t.ranges.get(i, (0, size - 1)) if isinstance(i, str) else (0, size - 1)
