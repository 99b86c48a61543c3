"""Whole arrays of a group of lanes: kept in memory and read again, chosen between, added."""

from typing import Any

from ._arrays import (
    Array,
    Masked,
    Memory,
    Registers,
    Strided,
    contiguous,
    fill,
    held,
    mapped,
    selected,
    stored,
    uniform,
)
from ._operations import add, kind_of
from ._text import Text, Value


def tape_size(avals: list[Any], width: int) -> int:
    """Bytes that arrays of these shapes and types take; those of a number lie `8 * width` apart."""
    return sum(a.size for a in avals) * 8 * width


def _places(pointer: str, offset: int, width: int, avals: list[Any]) -> list[Strided]:
    """Where arrays of these shapes and types lie one after the other, from so many bytes behind a
    pointer on."""
    found, n = [], 0
    for aval in avals:
        memory = Memory((pointer, offset + 8 * width * n))
        kind = aval.kind if isinstance(aval, Array) else kind_of(aval.dtype)
        found.append(Strided(tuple(aval.shape), kind, memory, contiguous(aval.shape)))
        n += aval.size
    return found


def tape_store(t: Text, pointer: str, offset: int, arrays: list[Array]) -> None:
    """Write arrays one after the other, from so many bytes behind a pointer on."""
    # What is computed from what is overwritten is computed first.
    arrays = [x if isinstance(x, Registers) else stored(t, x) for x in arrays]
    for place, x in zip(_places(pointer, offset, t.width, arrays), arrays, strict=True):
        fill(t, place, x)


def tape_load(t: Text, pointer: str, offset: int, avals: list[Any]) -> list[Any]:
    """Read arrays of these shapes and types that `tape_store` has written; large ones stay where
    they are."""
    return [held(t, x) for x in _places(pointer, offset, t.width, avals)]


def tape_add(t: Text, pointer: str, offset: int, avals: list[Any], arrays: list[Array]) -> None:
    """Add arrays to those that `tape_store` has written, of which they are no functions."""
    places = _places(pointer, offset, t.width, avals)
    rare: dict[Value, list[tuple[Strided, Array]]] = {}
    sums = add_all(t, [held(t, x) for x in places], arrays)
    for place, more, new in zip(places, arrays, sums, strict=True):
        if isinstance(more, Masked):
            rare.setdefault(more.mask, []).append((place, new))
        else:
            fill(t, place, new)
    for mask, pairs in rare.items():  # the weights of a law matter in the iterations with an impact
        with t.skipped_unless(mask, rare=True):
            for place, new in pairs:
                fill(t, place, new)


def only_in(t: Text, flag: Value, arrays: list[Array], avals: list[Any]) -> list[Array]:
    """The arrays in the lanes where the flag holds, else zeros; what is zero outside of some lanes
    must be so outside of these."""
    chosen = select_all(t, flag, arrays, zeros(t, avals))
    return [x if isinstance(x, Masked) else y for x, y in zip(arrays, chosen, strict=True)]


def select_all(t: Text, flag: Value, a: list[Array], b: list[Array]) -> list[Array]:
    """The arrays `a` in the lanes where the flag holds, else `b`."""
    return [selected(t, flag, x, y) for x, y in zip(a, b, strict=True)]


def add_all(t: Text, a: list[Array], b: list[Array]) -> list[Array]:
    """The sums of two lists of arrays."""
    return [mapped(t, lambda x, y: add(t, x, y), x, y) for x, y in zip(a, b, strict=True)]


def zeros(t: Text, avals: list[Any]) -> list[Array]:
    """Zeros of the given shapes and kinds."""
    return [held(t, uniform(aval.shape, t.zero(kind_of(aval.dtype)))) for aval in avals]


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

    def store(self, t: Text, part: str, arrays: list[Array]) -> None:
        """Write the arrays of a part."""
        tape_store(t, "%frame", self.places[part], arrays)

    def number(self, t: Text, part: str) -> Value:
        """The one number of a part."""
        return self.load(t, part)[0].item()

    def store_number(self, t: Text, part: str, value: Value) -> None:
        """Write the one number of a part."""
        self.store(t, part, [Registers.one(value)])
