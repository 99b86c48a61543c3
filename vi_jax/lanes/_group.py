"""Whole arrays of a group of lanes: kept in memory and read again, chosen between, added."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ._arrays import each
from ._large import (
    MOST_IN_REGISTERS,
    Formula,
    Held,
    Large,
    Masked,
    Memory,
    Strided,
    Values,
    at,
    contiguous,
    fill,
    joined,
    kind_in,
    stored,
    uniform,
)
from ._operations import add, kind_of
from ._text import Text, Value


def tape_size(avals: list[Any], width: int) -> int:
    """Bytes that arrays of these shapes and types take; those of a number lie `8 * width` apart."""
    return sum(a.size for a in avals) * 8 * width


def tape_store(t: Text, pointer: str, offset: int, arrays: list[Held]) -> None:
    """Write arrays one after the other, from so many bytes behind a pointer on."""
    # What is computed from what is overwritten is computed first.
    arrays = [stored(t, x) if isinstance(x, Large) else x for x in arrays]
    n = 0
    for x in arrays:
        begin = offset + 8 * t.width * n
        if isinstance(x, Large):
            fill(t, _at(pointer, begin, x.shape, x.kind), x)
        else:
            _store_numbers(t, pointer, begin, x)
        n += x.size


def tape_add(t: Text, pointer: str, offset: int, avals: list[Any], arrays: list[Held]) -> None:
    """Add arrays to those that `tape_store` has written, of which they are no functions."""
    old, n = tape_load(t, pointer, offset, avals), 0
    rare: dict[Value, list[tuple[Strided, Held]]] = {}
    for x, more, new in zip(old, arrays, add_all(t, old, arrays), strict=True):
        if not isinstance(x, Strided):
            _store_numbers(t, pointer, offset + 8 * t.width * n, new)
        elif isinstance(more, Masked):
            rare.setdefault(more.mask, []).append((x, new))
        else:
            fill(t, x, new)
        n += x.size
    for mask, pairs in rare.items():  # the weights of a law matter in the iterations with an impact
        inside, after = t.label(), t.label()
        t.fork(t.any(mask), inside, after, rare=True)
        t.open(inside)
        for x, new in pairs:
            fill(t, x, new)
        t.line(f"br label %{after}")
        t.close()
        t.follow(after)


def _at(pointer: str, begin: int, shape: tuple[int, ...], kind: str) -> Strided:
    """A large array in memory, from so many bytes behind a pointer on."""
    return Strided(shape, kind, Memory((pointer, begin)), contiguous(shape))


def _store_numbers(t: Text, pointer: str, begin: int, x: Values) -> None:
    for n, value in enumerate(x.ravel()):
        if value.kind == "i1":
            value = t.cast("zext", value, "i8")
        where = t.raw(f"getelementptr i8, ptr {pointer}, i64 {begin + 8 * t.width * n}")
        t.store(f"store {t.vector(value.kind)} {value.text}, ptr {where}, align 8")


def tape_load(t: Text, pointer: str, offset: int, avals: list[Any]) -> list[Any]:
    """Read arrays of these shapes and types that `tape_store` has written; large ones stay where
    they are."""
    arrays, n = [], 0
    for aval in avals:
        kind, begin = kind_of(aval.dtype), offset + 8 * t.width * n
        n += aval.size
        if aval.size > MOST_IN_REGISTERS:
            arrays.append(_at(pointer, begin, aval.shape, kind))
            continue
        x, stored_as = np.empty(aval.shape, object), "i8" if kind == "i1" else kind
        for place, i in enumerate(np.ndindex(aval.shape)):
            where = t.raw(f"getelementptr i8, ptr {pointer}, i64 {begin + 8 * t.width * place}")
            value = Value(t.raw(f"load {t.vector(stored_as)}, ptr {where}, align 8"), stored_as)
            x[i] = t.cast("trunc", value, "i1") if kind == "i1" else value
        arrays.append(x)
    return arrays


def each_of(t: Text, function: Callable[..., Value], kind: str | None, *arrays: Held) -> Held:
    """A function of numbers, number by number; `kind` is its result's type if another."""
    if not any(isinstance(x, Large) for x in arrays):
        return each(function, *arrays)
    cuts = joined(*(x.cuts for x in arrays if isinstance(x, Large)))
    own = kind or kind_in(arrays[0])
    return Formula(
        arrays[0].shape, own, lambda i: function(*(at(t, x, i) for x in arrays)), cuts=cuts
    )


def only_in(t: Text, flag: Value, arrays: list[Held], avals: list[Any]) -> list[Held]:
    """The arrays in the lanes where the flag holds, else zeros; what is zero outside of some lanes
    must be so outside of these."""
    chosen = select_all(t, flag, arrays, zeros(t, avals))
    return [x if isinstance(x, Masked) else y for x, y in zip(arrays, chosen, strict=True)]


def select_all(t: Text, flag: Value, a: list[Held], b: list[Held]) -> list[Held]:
    """The arrays `a` in the lanes where the flag holds, else `b`."""
    choose = lambda x, y: t.select(flag, x, y)
    return [each_of(t, choose, None, x, y) for x, y in zip(a, b, strict=True)]


def add_all(t: Text, a: list[Held], b: list[Held]) -> list[Held]:
    """The sums of two lists of arrays."""
    total = lambda x, y: add(t, x, y)
    return [each_of(t, total, None, x, y) for x, y in zip(a, b, strict=True)]


def zeros(t: Text, avals: list[Any]) -> list[Any]:
    """Zeros of the given shapes and kinds: in registers, or in memory where they are many."""
    arrays = []
    for aval in avals:
        zero = t.zero(kind_of(aval.dtype))
        large = aval.size > MOST_IN_REGISTERS
        arrays.append(
            uniform(aval.shape, zero)
            if large
            else each(lambda _, zero=zero: zero, np.zeros(aval.shape))
        )
    return arrays


class Frame:
    """What a group of lanes keeps from one function of a kernel to the next, behind `%frame`.

    **Arguments:** the parts by name, each arrays of these shapes and types; the lanes of a group.
    """

    def __init__(self, parts: dict[str, list[Any]], width: int):
        self._parts, self.places, size = parts, {}, 0
        """Where each part begins, in bytes."""
        for name, avals in parts.items():
            self.places[name] = size
            size += tape_size(avals, width)
        # What is behind it begins on a line of the cache, as the frame does.
        self.size = -(-size // 64) * 64
        """Bytes of the frame."""

    def load(self, t: Text, part: str) -> list[Any]:
        """The arrays of a part."""
        return tape_load(t, "%frame", self.places[part], self._parts[part])

    def store(self, t: Text, part: str, arrays: list[Held]) -> None:
        """Write the arrays of a part."""
        tape_store(t, "%frame", self.places[part], arrays)

    def number(self, t: Text, part: str) -> Value:
        """The one number of a part."""
        return self.load(t, part)[0].item()

    def store_number(self, t: Text, part: str, value: Value) -> None:
        """Write the one number of a part."""
        self.store(t, part, [np.array(value, object)])
