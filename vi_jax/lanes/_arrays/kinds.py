"""The kinds of arrays: in registers, a formula, pieces of others, or regular places in memory."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._text import Block, Text, Value
from .index import (
    NO_CUTS,
    Cuts,
    Index,
    in_lanes,
    place_of,
    plus,
    range_of,
    splat,
)

# Arrays of more numbers than this live in memory. A choice: the registers of AVX-512 are 32.
MOST_IN_REGISTERS = 16

_BYTES = {"double": 8, "float": 4, "i1": 1, "i8": 1, "i16": 2, "i32": 4, "i64": 8}


class Array:
    """An array of a lane, as a kernel holds it."""

    shape: tuple[int, ...]
    kind: str
    cuts: Cuts = NO_CUTS

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return int(np.prod(self.shape, dtype=int))

    @property
    def ndim(self) -> int:
        """How many axes it has."""
        return len(self.shape)

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        """The number at a place of each axis, which must be within the array in every slot."""
        raise TypeError(type(self).__name__)


class Registers(Array):
    """An array whose numbers are in registers: at most `MOST_IN_REGISTERS` of them.

    **Arguments:** an object array of `Value`s; their type, by default that of the first.
    """

    def __init__(self, values: np.ndarray, kind: str | None = None):
        self.values: Any = values
        self.shape = values.shape
        self.kind = next(values.flat).kind if kind is None else kind

    @classmethod
    def of(cls, shape: Sequence[int], kind: str, number: Callable[[tuple[int, ...]], Value]):
        """An array of this shape with a number for each index."""
        values = np.empty(tuple(shape), object)
        for i in np.ndindex(values.shape):
            values[i] = number(i)
        return cls(values, kind)

    @classmethod
    def one(cls, value: Value) -> "Registers":
        """An array without axes that holds one value."""
        values = np.empty((), object)
        values[()] = value
        return cls(values, value.kind)

    def item(self) -> Value:
        """The value of an array without axes."""
        return self.values.item()

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        for axis, i in enumerate(index):
            if not isinstance(i, int):
                ways = [(*index[:axis], n, *index[axis + 1 :]) for n in range(self.shape[axis])]
                found = self.at(t, ways[0])
                for n, way in enumerate(ways[1:], start=1):
                    here = t.binary("icmp eq", in_lanes(t, i), t.constant(n, "i64"), "i1")
                    found = t.select(here, self.at(t, way), found)
                return found
        return self.values[tuple(index)]


@dataclass(eq=False)
class Formula(Array):
    """An array whose numbers are computed where they are asked for."""

    shape: tuple[int, ...]
    kind: str
    function: Callable[[tuple[Index, ...]], Value]
    cheap: bool = False
    """Whether it may be computed again wherever it is asked for."""
    value: Value | None = None
    """The number, if it is the same everywhere."""
    cuts: Cuts = field(default_factory=lambda: NO_CUTS)

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        return self.function(tuple(index))


def uniform(shape: Sequence[int], value: Value) -> Formula:
    """An array of one number."""
    return Formula(tuple(shape), value.kind, lambda index: value, True, value)


@dataclass(eq=False)
class Pieces(Array):
    """Arrays one after the other along an axis."""

    shape: tuple[int, ...]
    kind: str
    axis: int
    parts: tuple[Array, ...]

    def __post_init__(self) -> None:
        cuts: dict[int, set[int]] = {self.axis: set()}
        for begin, part in zip(self._begins(), self.parts, strict=True):
            cuts[self.axis].add(begin)
            if isinstance(part, Registers):  # its numbers are asked for one by one
                cuts[self.axis].update(range(begin, begin + part.shape[self.axis]))
                continue
            for axis, places in part.cuts.items():
                more = {begin + n for n in places} if axis == self.axis else places
                cuts.setdefault(axis, set()).update(more)
        self.cuts = {axis: frozenset(places) for axis, places in cuts.items()}

    def _begins(self) -> list[int]:
        sizes = [part.shape[self.axis] for part in self.parts]
        return [sum(sizes[:i]) for i in range(len(sizes))]

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        i = index[self.axis]
        low, high = range_of(t, i, self.shape[self.axis])
        found: Value | None = None
        for begin, part in zip(self._begins(), self.parts, strict=True):
            size = part.shape[self.axis]
            if begin > high or begin + size <= low:
                continue
            alone = begin <= low and high < begin + size
            place = plus(t, i, -begin) if alone else _clamped(t, plus(t, i, -begin), size - 1)
            value = part.at(t, (*index[: self.axis], place, *index[self.axis + 1 :]))
            if found is not None:
                there = t.binary("icmp sge", in_lanes(t, i), t.constant(begin, "i64"), "i1")
                value = t.select(there, value, found)
            found = value
        assert found is not None
        return found


def _clamped(t: Text, place: Index, last: int) -> Value:
    wide, zero, end = in_lanes(t, place), t.zero("i64"), t.constant(last, "i64")
    wide = t.select(t.binary("icmp slt", wide, zero, "i1"), zero, wide)
    return t.select(t.binary("icmp sgt", wide, end, "i1"), end, wide)


def joined(*cuts: Cuts) -> Cuts:
    """The cuts of several arrays of one shape together."""
    axes = {axis for c in cuts for axis in c}
    return {a: frozenset().union(*(c.get(a, frozenset()) for c in cuts)) for a in axes}


@dataclass(frozen=True)
class Table:
    """Numbers that all lanes share, by the name of a pointer to them."""

    pointer: str

    def load(self, t: Text, place: Index, kind: str) -> Value:
        """The number at a place, in every lane."""
        stored = stored_kind(kind)
        if isinstance(place, Value):
            return gathered(t, self.pointer, place, kind)
        where = t.once(f"getelementptr {stored}, ptr {self.pointer}, i64 {place}")
        number = t.once(f"load {stored}, ptr {where}")  # nothing is ever stored there
        return _flag_if(t, splat(t, number, stored), kind)


@dataclass(frozen=True)
class Memory:
    """Numbers of every lane, in a block of the kernel's memory, or at a place given to it."""

    block: Block | tuple[str, int]
    """The block; or the name of a pointer, and the bytes from there."""

    def load(self, t: Text, place: Index, kind: str) -> Value:
        """Each lane's number at a place."""
        if isinstance(place, Value):
            return gathered(t, self._base(t), self._of_slots(t, place), kind)
        stored = stored_kind(kind)
        aligned = f"align {self._alignment(t, stored)}"
        where = self._address(t, place, stored)
        value = t.load(f"load {t.vector(stored)}, ptr {where}, {aligned}", stored)
        return _flag_if(t, value, kind)

    def store(self, t: Text, place: Index, value: Value, mask: Value | None = None) -> None:
        """Put each lane's number at a place; where `mask` holds, if a place is each lane's own."""
        if isinstance(place, Value):
            scattered(t, self._base(t), self._of_slots(t, place), value, mask)
            return
        value = _as_stored(t, value)
        kind = value.kind
        where, aligned = self._address(t, place, kind), f"align {self._alignment(t, kind)}"
        t.store(f"store {t.vector(kind)} {value.text}, ptr {where}, {aligned}")

    def _base(self, t: Text) -> str:
        if isinstance(self.block, Block):
            return t.once(f"getelementptr i8, ptr %arena, i64 {self.block.start * t.width * 8}")
        pointer, begin = self.block
        return t.once(f"getelementptr i8, ptr {pointer}, i64 {begin}")

    def _address(self, t: Text, place: Index, kind: str) -> str:
        if isinstance(place, int) and not isinstance(self.block, Block):
            pointer, begin = self.block
            place = begin + t.width * _BYTES[kind] * place
            return t.once(f"getelementptr i8, ptr {pointer}, i64 {place}")
        return t.once(f"getelementptr {t.vector(kind)}, ptr {self._base(t)}, i64 {place}")

    def _alignment(self, t: Text, kind: str) -> int:
        return min(64, t.width * _BYTES[kind]) if isinstance(self.block, Block) else 8

    def _of_slots(self, t: Text, place: Value) -> Value:
        """Of each slot, the number of its own among all those of the block."""
        slots = ", ".join(f"i64 {i}" for i in range(t.width))
        own = Value(f"<{slots}>", "i64")
        return t.binary("add", t.binary("mul", place, t.constant(t.width, "i64")), own)


@dataclass(eq=False)
class Strided(Array):
    """An array whose numbers lie at regular places of a block or of a table."""

    shape: tuple[int, ...]
    kind: str
    source: Memory | Table
    strides: tuple[int, ...]
    offset: Index = 0

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        return self.source.load(t, place_of(t, index, self.strides, self.offset), self.kind)

    def viewed(self, shape: Sequence[int], strides: Sequence[int], more: Index = 0) -> "Strided":
        """Other numbers of the same block or table."""
        assert isinstance(self.offset, int) and isinstance(more, int)
        return Strided(tuple(shape), self.kind, self.source, tuple(strides), self.offset + more)


@dataclass(eq=False)
class Masked(Array):
    """An array that is zero but in the lanes of a mask: numbers in memory to which nothing is
    written where the mask has no lane."""

    shape: tuple[int, ...]
    kind: str
    numbers: Strided
    mask: Value

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        return t.select(self.mask, self.numbers.at(t, index), t.zero(self.kind))


def stored_kind(kind: str) -> str:
    return "i8" if kind == "i1" else kind  # XLA keeps truth values in bytes


def _as_stored(t: Text, value: Value) -> Value:
    return t.cast("zext", value, "i8") if value.kind == "i1" else value


def _flag_if(t: Text, value: Value, kind: str) -> Value:
    return t.binary("icmp ne", value, t.zero("i8"), "i1") if kind == "i1" else value


def _addresses(t: Text, pointer: str, place: Value, kind: str) -> str:
    return t.raw(f"getelementptr {kind}, ptr {pointer}, {t.vector('i64')} {place.text}")


def gathered(t: Text, pointer: str, place: Value, kind: str, mask: Value | None = None) -> Value:
    """The number at a place of each slot behind a pointer, zero where `mask` does not hold."""
    stored, mask = stored_kind(kind), t.constant(True, "i1") if mask is None else mask
    where = _addresses(t, pointer, place, stored)
    v, p, flags = t.vector(stored), f"<{t.width} x ptr>", t.vector("i1")
    name = f"@llvm.masked.gather.{t.suffix(stored)}.v{t.width}p0"
    t.declared[name] = f"declare {v} {name}({p}, i32, {flags}, {v})"
    call = f"{p} {where}, i32 {_BYTES[stored]}, {flags} {mask.text}, {v} zeroinitializer"
    return _flag_if(t, Value(t.raw(f"call {v} {name}({call})"), stored), kind)


def scattered(t: Text, pointer: str, place: Value, value: Value, mask: Value | None = None) -> None:
    """Store a number at a place of each slot behind a pointer, where `mask` holds."""
    value, mask = _as_stored(t, value), t.constant(True, "i1") if mask is None else mask
    where = _addresses(t, pointer, place, value.kind)
    v, p, flags = t.vector(value.kind), f"<{t.width} x ptr>", t.vector("i1")
    name = f"@llvm.masked.scatter.{t.suffix(value.kind)}.v{t.width}p0"
    t.declared[name] = f"declare void {name}({v}, {p}, i32, {flags})"
    call = f"{v} {value.text}, {p} {where}, i32 {_BYTES[value.kind]}, {flags} {mask.text}"
    t.store(f"call void {name}({call})")
