"""Arrays within a lane: in registers, in memory, or as formulas.

An array of at most `MOST_IN_REGISTERS` numbers is in registers. Elementwise operations on a larger
one stay a formula until its numbers are used. So consecutive operations become one loop, and unused
numbers are not computed.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np

from ._text import Block, Text, Value, literal

# --- indices

Index = int | str | Value
"""An index within an array: a Python integer, known while the text is written; the name of a scalar
`i64`, equal in all lanes; or an `i64` of each lane."""


def splat(t: Text, scalar: str, kind: str) -> Value:
    v = t.vector(kind)
    one = t.raw(f"insertelement {v} poison, {kind} {scalar}, i32 0")
    mask = f"<{t.width} x i32> zeroinitializer"
    return Value(t.raw(f"shufflevector {v} {one}, {v} poison, {mask}"), kind)


def in_lanes(t: Text, place: Index) -> Value:
    """Return an index as an `i64` of each lane."""
    if isinstance(place, Value):
        return place
    return t.constant(place, "i64") if isinstance(place, int) else splat(t, place, "i64")


def plus(t: Text, a: Index, b: Index) -> Index:
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
    if isinstance(a, int):
        return a * number
    if number in (0, 1):
        return a if number else 0
    if isinstance(a, Value):
        return t.binary("mul", a, t.constant(number, "i64"))
    return t.once(f"mul i64 {a}, {number}")


def place_of(t: Text, index: Sequence[Index], strides: Sequence[int], offset: Index = 0) -> Index:
    total = offset
    for i, stride in zip(index, strides, strict=True):
        total = plus(t, total, times(t, i, stride))
    return total


def contiguous(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the strides of an array in row-major order."""
    return tuple(int(np.prod(shape[i + 1 :], dtype=int)) for i in range(len(shape)))


def write_loop(
    t: Text, number: int, body: Callable[[Index, list[Value]], list[Value]], first: list[Value]
) -> list[Value]:
    """Write a loop with a known number of iterations and a scalar counter. Return the final carry.
    `body` maps the iteration's number and the carry to the next carry."""
    if number < 2:
        return body(0, first) if number else first
    inside, after = t.label(), t.label()
    before = t.block
    t.line(f"br label %{inside}")
    t.open(inside)
    place = len(t.lines)
    carry = [Value(t.fresh(), a.kind) for a in first]
    count, following = t.fresh(), t.fresh()
    t.ranges[count] = 0, number - 1
    new = body(count, carry)
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
"""For some axes, the indices at which an array's numbers change their representation."""

NO_CUTS: Cuts = MappingProxyType({})


def write_loops(
    t: Text,
    shape: Sequence[int],
    body: Callable[[tuple[Index, ...]], None],
    cuts: Cuts = NO_CUTS,
    index: tuple[Index, ...] = (),
) -> None:
    """Write loops over all elements of an array of this shape, with a loop for each part between
    `cuts`. `index` has the indices along the first axes, which are fixed."""
    axis = len(index)
    if axis == len(shape):
        return body(index)
    for begin, end in pairwise(sorted({0, shape[axis], *cuts.get(axis, ())})):

        def iteration(i: Index, _: list[Value], begin: int = begin) -> list[Value]:
            write_loops(t, shape, body, cuts, (*index, plus(t, i, begin)))
            return []

        write_loop(t, end - begin, iteration, [])


def range_of(t: Text, i: Index, size: int) -> tuple[int, int]:
    """Return the least and the greatest value of an index along an axis of this size."""
    if isinstance(i, int):
        return i, i
    return t.ranges.get(i, (0, size - 1)) if isinstance(i, str) else (0, size - 1)


# --- kinds of arrays

# Larger arrays are in memory. A choice: AVX-512 has 32 registers.
MOST_IN_REGISTERS = 16

_BYTES = {"double": 8, "float": 4, "i1": 1, "i8": 1, "i16": 2, "i32": 4, "i64": 8}


class Array:
    """An array of each lane, as a kernel represents it."""

    shape: tuple[int, ...]
    kind: str
    cuts: Cuts = NO_CUTS

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=int))

    @property
    def ndim(self) -> int:
        return len(self.shape)

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        """Return the number at an index, which must be within the array in every slot."""
        raise TypeError(type(self).__name__)


class Registers(Array):
    """An array in registers: at most `MOST_IN_REGISTERS` `Value`s."""

    def __init__(self, values: np.ndarray, kind: str | None = None):
        self.values: Any = values
        self.shape = values.shape
        self.kind = next(values.flat).kind if kind is None else kind

    @classmethod
    def of(cls, shape: Sequence[int], kind: str, number: Callable[[tuple[int, ...]], Value]):
        values = np.empty(tuple(shape), object)
        for i in np.ndindex(values.shape):
            values[i] = number(i)
        return cls(values, kind)

    @classmethod
    def one(cls, value: Value) -> "Registers":
        values = np.empty((), object)
        values[()] = value
        return cls(values, value.kind)

    def item(self) -> Value:
        return self.values.item()

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        for axis, i in enumerate(index):
            if not isinstance(i, int):
                choices = [(*index[:axis], n, *index[axis + 1 :]) for n in range(self.shape[axis])]
                found = self.at(t, choices[0])
                for n, choice in enumerate(choices[1:], start=1):
                    match = t.binary("icmp eq", in_lanes(t, i), t.constant(n, "i64"), "i1")
                    found = t.select(match, self.at(t, choice), found)
                return found
        return self.values[tuple(index)]


@dataclass(eq=False)
class Formula(Array):
    """An array whose numbers are computed at each use."""

    shape: tuple[int, ...]
    kind: str
    function: Callable[[tuple[Index, ...]], Value]
    cheap: bool = False
    """True if its numbers may be computed again at each use."""
    value: Value | None = None
    """The number, if all are equal."""
    cuts: Cuts = field(default_factory=lambda: NO_CUTS)

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        return self.function(tuple(index))


def uniform(shape: Sequence[int], value: Value) -> Formula:
    return Formula(tuple(shape), value.kind, lambda index: value, True, value)


@dataclass(eq=False)
class Pieces(Array):
    """Arrays concatenated along an axis."""

    shape: tuple[int, ...]
    kind: str
    axis: int
    parts: tuple[Array, ...]

    def __post_init__(self) -> None:
        cuts: dict[int, set[int]] = {self.axis: set()}
        for begin, part in zip(self._begins(), self.parts, strict=True):
            cuts[self.axis].add(begin)
            if isinstance(part, Registers):  # numbers in registers are selected one by one
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
            is_sure = begin <= low and high < begin + size
            place = plus(t, i, -begin) if is_sure else _clamped(t, plus(t, i, -begin), size - 1)
            value = part.at(t, (*index[: self.axis], place, *index[self.axis + 1 :]))
            if found is not None:
                is_reached = t.binary("icmp sge", in_lanes(t, i), t.constant(begin, "i64"), "i1")
                value = t.select(is_reached, value, found)
            found = value
        assert found is not None
        return found


def _clamped(t: Text, place: Index, last: int) -> Value:
    index, zero, end = in_lanes(t, place), t.zero("i64"), t.constant(last, "i64")
    index = t.select(t.binary("icmp slt", index, zero, "i1"), zero, index)
    return t.select(t.binary("icmp sgt", index, end, "i1"), end, index)


def joined_cuts(*cuts: Cuts) -> Cuts:
    axes = {axis for c in cuts for axis in c}
    return {a: frozenset().union(*(c.get(a, frozenset()) for c in cuts)) for a in axes}


@dataclass(frozen=True)
class Table:
    """Read-only numbers that all lanes share; `pointer` is the name of their address."""

    pointer: str

    def load(self, t: Text, place: Index, kind: str) -> Value:
        stored = stored_kind(kind)
        if isinstance(place, Value):
            return gathered(t, self.pointer, place, kind)
        where = t.once(f"getelementptr {stored}, ptr {self.pointer}, i64 {place}")
        number = t.once(f"load {stored}, ptr {where}")  # merged, since no store changes it
        return _flag_if(t, splat(t, number, stored), kind)


@dataclass(frozen=True)
class Memory:
    """Numbers of every lane, in a block of the kernel's memory or at another address."""

    block: Block | tuple[str, int]
    """The block, or the name of a pointer and an offset in bytes."""

    def load(self, t: Text, place: Index, kind: str) -> Value:
        if isinstance(place, Value):
            return gathered(t, self.pointer(t), self._of_slots(t, place), kind)
        stored = stored_kind(kind)
        aligned = f"align {self._alignment(t, stored)}"
        where = self._address(t, place, stored)
        value = t.load(f"load {t.vector(stored)}, ptr {where}, {aligned}", stored)
        return _flag_if(t, value, kind)

    def store(self, t: Text, place: Index, value: Value, mask: Value | None = None) -> None:
        """Store a number where the mask, if one is given, holds."""
        if isinstance(place, Value):
            return scattered(t, self.pointer(t), self._of_slots(t, place), value, mask)
        if mask is not None:
            value = t.select(mask, value, self.load(t, place, value.kind))
        value = _as_stored(t, value)
        kind = value.kind
        where, aligned = self._address(t, place, kind), f"align {self._alignment(t, kind)}"
        t.store(f"store {t.vector(kind)} {value.text}, ptr {where}, {aligned}")

    def pointer(self, t: Text) -> str:
        if isinstance(self.block, Block):
            return t.once(f"getelementptr i8, ptr %arena, i64 {self.block.start * t.width * 8}")
        pointer, begin = self.block
        return t.once(f"getelementptr i8, ptr {pointer}, i64 {begin}")

    def _address(self, t: Text, place: Index, kind: str) -> str:
        if isinstance(place, int) and not isinstance(self.block, Block):
            pointer, begin = self.block
            place = begin + t.width * _BYTES[kind] * place
            return t.once(f"getelementptr i8, ptr {pointer}, i64 {place}")
        return t.once(f"getelementptr {t.vector(kind)}, ptr {self.pointer(t)}, i64 {place}")

    def _alignment(self, t: Text, kind: str) -> int:
        return min(64, t.width * _BYTES[kind]) if isinstance(self.block, Block) else 8

    def _of_slots(self, t: Text, place: Value) -> Value:
        """Return the index of each slot's number among those of all slots."""
        slots = ", ".join(f"i64 {i}" for i in range(t.width))
        slot = Value(f"<{slots}>", "i64")
        return t.binary("add", t.binary("mul", place, t.constant(t.width, "i64")), slot)


@dataclass(eq=False)
class Strided(Array):
    """An array in memory or in a table, with a stride along each axis."""

    shape: tuple[int, ...]
    kind: str
    source: Memory | Table
    strides: tuple[int, ...]
    offset: Index = 0

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        return self.source.load(t, place_of(t, index, self.strides, self.offset), self.kind)

    def put(self, t: Text, index: Sequence[Index], value: Value, mask: Value | None = None) -> None:
        assert isinstance(self.source, Memory)
        self.source.store(t, place_of(t, index, self.strides, self.offset), value, mask)

    def viewed(
        self, t: Text, shape: Sequence[int], strides: Sequence[int], more: Index = 0
    ) -> "Strided":
        offset = plus(t, self.offset, more)
        return Strided(tuple(shape), self.kind, self.source, tuple(strides), offset)


@dataclass(eq=False)
class Masked(Array):
    """An array that is zero except in the lanes of a mask. Nothing is written to its memory if no
    lane is in the mask."""

    shape: tuple[int, ...]
    kind: str
    numbers: Strided
    mask: Value

    def at(self, t: Text, index: Sequence[Index]) -> Value:
        return t.select(self.mask, self.numbers.at(t, index), t.zero(self.kind))


def stored_kind(kind: str) -> str:
    return "i8" if kind == "i1" else kind  # XLA stores booleans as bytes


def _as_stored(t: Text, value: Value) -> Value:
    return t.cast("zext", value, "i8") if value.kind == "i1" else value


def _flag_if(t: Text, value: Value, kind: str) -> Value:
    return t.binary("icmp ne", value, t.zero("i8"), "i1") if kind == "i1" else value


def _addresses(t: Text, pointer: str, place: Value, kind: str) -> str:
    return t.raw(f"getelementptr {kind}, ptr {pointer}, {t.vector('i64')} {place.text}")


def gathered(t: Text, pointer: str, place: Value, kind: str, mask: Value | None = None) -> Value:
    """Return each slot's number at a place behind a pointer, or zero where `mask` is false."""
    stored, mask = stored_kind(kind), t.constant(True, "i1") if mask is None else mask
    where = _addresses(t, pointer, place, stored)
    v, p, flags = t.vector(stored), f"<{t.width} x ptr>", t.vector("i1")
    name = f"@llvm.masked.gather.{t.suffix(stored)}.v{t.width}p0"
    t.declared[name] = f"declare {v} {name}({p}, i32, {flags}, {v})"
    call = f"{p} {where}, i32 {_BYTES[stored]}, {flags} {mask.text}, {v} zeroinitializer"
    return _flag_if(t, Value(t.raw(f"call {v} {name}({call})"), stored), kind)


def scattered(t: Text, pointer: str, place: Value, value: Value, mask: Value | None = None) -> None:
    """Store a number at a place behind a pointer, for each slot where `mask` holds."""
    value, mask = _as_stored(t, value), t.constant(True, "i1") if mask is None else mask
    where = _addresses(t, pointer, place, value.kind)
    v, p, flags = t.vector(value.kind), f"<{t.width} x ptr>", t.vector("i1")
    name = f"@llvm.masked.scatter.{t.suffix(value.kind)}.v{t.width}p0"
    t.declared[name] = f"declare void {name}({v}, {p}, i32, {flags})"
    call = f"{v} {value.text}, {p} {where}, i32 {_BYTES[value.kind]}, {flags} {mask.text}"
    t.store(f"call void {name}({call})")


# --- arrays computed, stored, selected, replaced


def addressable(t: Text, x: Array) -> Array:
    """Return an array that can be indexed with values known only at run time."""
    if not isinstance(x, Registers):
        return x
    return uniform(x.shape, x.item()) if x.size == 1 else stored(t, x)


def to_registers(t: Text, x: Array) -> Any:
    """Return an array in registers if it is small enough, else unchanged."""
    if isinstance(x, Registers) or x.size > MOST_IN_REGISTERS:
        return x
    return Registers.of(x.shape, x.kind, lambda i: x.at(t, i))


def mapped(t: Text, function: Callable[..., Value], *arrays: Array, kind: str | None = None) -> Any:
    """Apply a function elementwise; `kind` is the result's type, by default the first array's."""
    first, kind = arrays[0], kind or arrays[0].kind
    if not first.shape:
        return Registers.one(function(*(x.at(t, ()) for x in arrays)))
    if all(isinstance(x, Registers) for x in arrays):
        numbers = zip(*(x.values.flat for x in arrays), strict=True)  # pyright: ignore
        out: Any = np.empty(first.shape, object)
        out.flat = [function(*each) for each in numbers]
        return Registers(out, kind)
    number = lambda i: function(*(x.at(t, i) for x in arrays))
    return Formula(first.shape, kind, number, cuts=joined_cuts(*(x.cuts for x in arrays)))


def write_for_each(t: Text, x: Array, body: Callable[[tuple[Index, ...]], None]) -> None:
    """Write `body` for each element: in sequence if the array is in registers, else in loops."""
    if isinstance(x, Registers):
        for i in np.ndindex(x.shape):
            body(i)
    else:
        write_loops(t, x.shape, body, x.cuts)


def reserve(t: Text, shape: Sequence[int], kind: str) -> Strided:
    """Allocate an array in memory. Its numbers must be stored before use."""
    numbers = int(np.prod(shape, dtype=int))
    source = Memory(t.arena.take(max(1, numbers)))
    return Strided(tuple(shape), kind, source, contiguous(shape))


def fill(t: Text, out: Strided, x: Array) -> None:
    write_for_each(t, x, lambda i: out.put(t, i, x.at(t, i)))


def stored(t: Text, x: Array) -> Strided:
    out = reserve(t, x.shape, x.kind)
    fill(t, out, x)
    return out


def computed(t: Text, x: Array) -> Array:
    """Return an array whose numbers are computed; a formula that is not cheap is stored."""
    return x if is_cheap(x) else stored(t, x)


def without_cuts(t: Text, x: Array) -> Array:
    """Return an array without cuts, for indices known only at run time."""
    return stored(t, x) if x.cuts else computed(t, x)


def is_cheap(x: Array) -> bool:
    """Return whether the numbers of an array may be used repeatedly without storing them."""
    if isinstance(x, Pieces):
        return all(map(is_cheap, x.parts))
    return not isinstance(x, Formula) or x.cheap


def selected(t: Text, mask: Value, a: Array, b: Array) -> Any:
    return mapped(t, lambda x, y: t.select(mask, x, y), a, b)


def replace(t: Text, old: Sequence[Array], new: Sequence[Array], mask: Value | None = None) -> None:
    """Overwrite large old arrays by new ones where `mask` holds. The new ones may depend on any of
    the old ones. Arrays in registers are ignored."""
    pairs = [
        (a, b) for a, b in zip(old, new, strict=True) if isinstance(a, Strided) and not same(a, b)
    ]
    changed = [a for a, _ in pairs]
    for a, b in [(a, separate(t, b, changed)) for a, b in pairs]:
        fill(t, a, b if mask is None else selected(t, mask, b, a))


def separate(t: Text, x: Array, changed: Sequence[Strided]) -> Array:
    """Return an array that does not change if others in memory do."""
    blocks = [a.source.block for a in changed if isinstance(a.source, Memory)]
    is_separate = isinstance(x, Strided) and not (
        isinstance(x.source, Memory) and any(x.source.block is b for b in blocks)
    )
    is_constant = isinstance(x, Formula) and x.value is not None
    return x if is_separate or is_constant else stored(t, x)


def same(a: Array, b: Array) -> bool:
    """Return whether two large arrays are the same view of the same memory."""
    if a is b:
        return True
    if not (isinstance(a, Strided) and isinstance(b, Strided)):
        return False
    in_memory = isinstance(a.source, Memory) and isinstance(b.source, Memory)
    same_source = a.source.block is b.source.block if in_memory else a.source == b.source  # pyright: ignore[reportAttributeAccessIssue]
    return same_source and (a.shape, a.strides, a.offset) == (b.shape, b.strides, b.offset)


def table(t: Text, array: object, kind: str) -> Array:
    """Return a large constant array, stored in the module's text."""
    array = np.asarray(array)
    numbers = array.reshape(-1)
    stored_type = stored_kind(kind)
    if all(x.tobytes() == numbers[0].tobytes() for x in numbers):
        return uniform(array.shape, t.constant(numbers[0], kind))
    body = ", ".join(f"{stored_type} {literal(x, stored_type)}" for x in numbers)
    content = f"private unnamed_addr constant [{numbers.size} x {stored_type}] [{body}], align 64"
    name = f"@table{hashlib.blake2b(content.encode(), digest_size=8).hexdigest()}"
    t.declared[name] = f"{name} = {content}"
    return Strided(array.shape, kind, Table(name), contiguous(array.shape))
