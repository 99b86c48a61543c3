"""Arrays computed, stored, chosen, replaced."""

import hashlib
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .._text import Text, Value, is_float
from .index import Index, contiguous, over, place_of
from .kinds import (
    MOST_IN_REGISTERS,
    Array,
    Formula,
    Memory,
    Pieces,
    Registers,
    Strided,
    Table,
    joined,
    stored_kind,
    uniform,
)


def addressable(t: Text, x: Array) -> Array:
    """An array that can be asked for numbers at places known only at run time."""
    if not isinstance(x, Registers):
        return x
    return uniform(x.shape, x.item()) if x.size == 1 else stored(t, x)


def held(t: Text, x: Array) -> Any:
    """An array as a kernel holds one of its size."""
    if isinstance(x, Registers) or x.size > MOST_IN_REGISTERS:
        return x
    return Registers.of(x.shape, x.kind, lambda i: x.at(t, i))


def mapped(t: Text, function: Callable[..., Value], *arrays: Array, kind: str | None = None) -> Any:
    """A function of numbers, number by number, of arrays of one shape.

    **Arguments:** `kind`, the type of its result, if another than that of the first array.
    """
    first, kind = arrays[0], kind or arrays[0].kind
    if not first.shape:
        return Registers.one(function(*(x.at(t, ()) for x in arrays)))
    if all(isinstance(x, Registers) for x in arrays):
        numbers = zip(*(x.values.flat for x in arrays), strict=True)  # pyright: ignore
        out: Any = np.empty(first.shape, object)
        out.flat = [function(*each) for each in numbers]
        return Registers(out, kind)
    number = lambda i: function(*(x.at(t, i) for x in arrays))
    return Formula(first.shape, kind, number, cuts=joined(*(x.cuts for x in arrays)))


def over_all(t: Text, x: Array, body: Callable[[tuple[Index, ...]], None]) -> None:
    """All elements of an array: one after the other if it is in registers, else in loops."""
    if isinstance(x, Registers):
        for i in np.ndindex(x.shape):
            body(i)
    else:
        over(t, x.shape, body, x.cuts)


def room(t: Text, shape: Sequence[int], kind: str) -> Strided:
    """An array in memory whose numbers are still to be stored."""
    numbers = int(np.prod(shape, dtype=int))
    source = Memory(t.arena.take(max(1, numbers)))
    return Strided(tuple(shape), kind, source, contiguous(shape))


def fill(
    t: Text, out: Strided, x: Array, *, offset: Index = 0, strides: Sequence[int] | None = None
) -> None:
    """Store the numbers of an array in room for them, by default in order.

    **Arguments:** the text; the room; the array; the place of its first number, and the places from
    one number to the next along each axis.
    """
    steps = contiguous(x.shape) if strides is None else strides
    memory = out.source
    assert isinstance(memory, Memory)
    over_all(t, x, lambda i: memory.store(t, place_of(t, i, steps, offset), x.at(t, i)))


def stored(t: Text, x: Array) -> Strided:
    """A copy of an array in memory."""
    out = room(t, x.shape, x.kind)
    fill(t, out, x)
    return out


def settled(t: Text, x: Array) -> Array:
    """An array whose numbers are computed: what is a formula is stored."""
    return x if is_cheap(x) else stored(t, x)


def is_cheap(x: Array) -> bool:
    """Whether the numbers of an array need not be stored to be asked for again."""
    if isinstance(x, Pieces):
        return all(map(is_cheap, x.parts))
    return not isinstance(x, Formula) or x.cheap


def store_at(t: Text, x: Strided, index: Sequence[Index], value: Value) -> None:
    """Store one number of an array in memory."""
    memory = x.source
    assert isinstance(memory, Memory)
    memory.store(t, place_of(t, index, x.strides, x.offset), value)


def selected(t: Text, mask: Value, a: Array, b: Array) -> Any:
    """The first array where `mask` holds, else the second."""
    return mapped(t, lambda x, y: t.select(mask, x, y), a, b)


def replace(t: Text, old: Sequence[Array], new: Sequence[Array], mask: Value | None = None) -> None:
    """Store large arrays over those that they replace, where `mask` holds. The new ones may depend
    on any of the old ones; arrays in registers are left out."""
    pairs = [
        (a, b) for a, b in zip(old, new, strict=True) if isinstance(a, Strided) and not same(a, b)
    ]
    blocks = [a.source.block for a, _ in pairs if isinstance(a.source, Memory)]

    def apart(x: Array) -> Array:
        free = isinstance(x, Strided) and not (
            isinstance(x.source, Memory) and any(x.source.block is b for b in blocks)
        )
        return x if free else stored(t, x)

    for a, b in [(a, apart(b)) for a, b in pairs]:
        fill(t, a, b if mask is None else selected(t, mask, b, a))


def same(a: Array, b: Array) -> bool:
    """Whether two large arrays are the same numbers of the same memory."""
    if a is b:
        return True
    if not (isinstance(a, Strided) and isinstance(b, Strided)):
        return False
    mine = isinstance(a.source, Memory) and isinstance(b.source, Memory)
    alike = a.source.block is b.source.block if mine else a.source == b.source  # pyright: ignore[reportAttributeAccessIssue]
    return alike and (a.shape, a.strides, a.offset) == (b.shape, b.strides, b.offset)


def table(t: Text, array: object, kind: str) -> Array:
    """A large array known while the code is written, as constants in the module's text."""
    array = np.asarray(array)
    numbers = array.reshape(-1)
    word = stored_kind(kind)
    if all(x.tobytes() == numbers[0].tobytes() for x in numbers):
        return uniform(array.shape, t.constant(numbers[0], kind))
    body = ", ".join(f"{word} {_llvm_number(x, kind)}" for x in numbers)
    content = f"private unnamed_addr constant [{numbers.size} x {word}] [{body}], align 64"
    name = f"@table{hashlib.blake2b(content.encode(), digest_size=8).hexdigest()}"
    t.declared[name] = f"{name} = {content}"
    return Strided(array.shape, kind, Table(name), contiguous(array.shape))


def _llvm_number(number: Any, kind: str) -> str:
    if is_float(kind):
        return "0x" + struct.pack(">d", float(number)).hex().upper()
    return str(int(number))
