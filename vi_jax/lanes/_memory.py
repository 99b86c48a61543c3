"""Loads and stores of a kernel: where the numbers of a group's lanes lie in XLA's arrays."""

from collections.abc import Callable
from typing import Any

from ._arrays import (
    Array,
    Formula,
    Strided,
    Table,
    contiguous,
    gathered,
    in_lanes,
    over_all,
    place_of,
    scattered,
    splat,
)
from ._operations import kind_of
from ._text import Text, Value

# Bytes of a cache line, and of the widest register.
_LINE = 64


def load_pointer(t: Text, table: str, i: int) -> str:
    """Entry `i` of one of the kernel's tables of pointers, as a scalar."""
    place = t.raw(f"getelementptr ptr, ptr %{table}, i64 {i}")
    return t.raw(f"load ptr, ptr {place}")


def load_stride(t: Text, i: int) -> Value:
    """How many numbers input `i` has per lane (0 for one that all lanes share), for every lane."""
    place = t.raw(f"getelementptr i64, ptr %strides, i64 {i}")
    return splat(t, t.raw(f"load i64, ptr {place}"), "i64")


def gathering(t: Text, pointer: str, base: Value, aval: Any, mask: Value) -> Formula:
    """An array of each slot, read where it is asked for and `mask` holds, else zeros.

    **Arguments:** where the arrays of all lanes begin; of each slot the number of its first number
    in them; the array's shape and type; which slots read.
    """
    steps, kind = contiguous(aval.shape), kind_of(aval.dtype)

    def number(index) -> Value:
        place = t.binary("add", base, in_lanes(t, place_of(t, index, steps)))
        return gathered(t, pointer, place, kind, mask)

    return Formula(tuple(aval.shape), kind, number)


def shared(pointer: str, shape: tuple[int, ...], kind: str) -> Strided:
    """An input that all lanes share, where XLA keeps it."""
    return Strided(shape, kind, Table(pointer), contiguous(shape))


def scatter(t: Text, pointer: str, base: Value, x: Array, mask: Value) -> None:
    """Write `x` of the lanes in `mask`, the numbers of each from `base` on.

    **Arguments:** where the output's array begins; of each lane, the number of its first number in
    the array; the values; which slots write.
    """

    steps = contiguous(x.shape)

    def put(i) -> None:
        value = x.at(t, i)
        place = t.binary("add", base, in_lanes(t, place_of(t, i, steps)))
        scattered(t, pointer, place, value, mask)

    over_all(t, x, put)


def over_rows(
    t: Text, first: Value, number: int, mask: Value, body: Callable[[Value, Value], None]
) -> None:
    """The rows of each lane from one of its own on.

    **Arguments:** each slot's first row; how many a lane has room for; which slots take part; what
    is done with the row of each slot, and which slots have it.
    """
    head, inside, after, before = t.label(), t.label(), t.label(), t.block
    t.line(f"br label %{head}")
    t.open(head)
    at, place, following = len(t.lines), Value(t.fresh(), "i64"), Value(t.fresh(), "i64")
    room = t.both(mask, t.binary("icmp slt", place, t.constant(number, "i64"), "i1"))
    t.fork(t.any(room), inside, after)
    t.open(inside)
    body(place, room)
    one = t.constant(1, "i64").text
    t.line(f"{following.text} = add {t.vector('i64')} {place.text}, {one}")
    t.join([place], ([first], before), ([following], t.block), at=at)
    t.line(f"br label %{head}")
    t.close()
    t.close()
    t.follow(after)


def claim(t: Text) -> tuple[list[str], list[str]]:
    """What a kernel does to have memory for large arrays, aligned to a cache line, and to let go of
    it."""
    if not t.arena.size:
        return [], []
    t.declared["@malloc"] = "declare noalias ptr @malloc(i64)"
    t.declared["@free"] = "declare void @free(ptr)"
    claimed = [
        f"  %heap = call ptr @malloc(i64 {t.arena.size * t.width * 8 + _LINE})",
        f"  %ahead = getelementptr i8, ptr %heap, i64 {_LINE - 1}",
        f"  %arena = call ptr @llvm.ptrmask.p0.i64(ptr %ahead, i64 {-_LINE})",
    ]
    t.declared["@llvm.ptrmask"] = "declare ptr @llvm.ptrmask.p0.i64(ptr, i64)"
    return claimed, ["  call void @free(ptr %heap)"]
