"""Loads and stores of a kernel: where the numbers of a group's lanes lie in XLA's arrays."""

import numpy as np

from ._arrays import Values
from ._text import Text, Value

_BYTES = {"double": 8, "float": 4, "i1": 1, "i8": 1, "i16": 2, "i32": 4, "i64": 8}


def load_pointer(t: Text, table: str, i: int) -> str:
    """Entry `i` of one of the kernel's tables of pointers, as a scalar."""
    place = t.raw(f"getelementptr ptr, ptr %{table}, i64 {i}")
    return t.raw(f"load ptr, ptr {place}")


def load_stride(t: Text, i: int) -> Value:
    """How many numbers input `i` has per lane (0 for one that all lanes share), for every lane."""
    place = t.raw(f"getelementptr i64, ptr %strides, i64 {i}")
    return splat(t, t.raw(f"load i64, ptr {place}"), "i64")


def splat(t: Text, scalar: str, kind: str) -> Value:
    """A scalar of the kernel in every lane of the group."""
    v = t.vector(kind)
    one = t.raw(f"insertelement {v} poison, {kind} {scalar}, i32 0")
    mask = f"<{t.width} x i32> zeroinitializer"
    return Value(t.raw(f"shufflevector {v} {one}, {v} poison, {mask}"), kind)


def _addresses(t: Text, pointer: str, offset: Value, kind: str) -> str:
    return t.raw(f"getelementptr {kind}, ptr {pointer}, {t.vector('i64')} {offset.text}")


def gather(t: Text, pointer: str, stride: Value, lane: Value, old: Values, mask: Value) -> Values:
    """One input of the lanes `lane`, read where `mask` holds; the other slots get zeros.

    **Arguments:** where the input's array begins; its numbers per lane; each slot's lane; an array
    of the input's shape and types; which slots read.
    """
    base = t.binary("mul", lane, stride)
    out = np.empty(old.shape, object)
    for n, i in enumerate(np.ndindex(old.shape)):
        kind: str = old[i].kind  # pyright: ignore[reportAttributeAccessIssue]
        stored = "i8" if kind == "i1" else kind  # XLA keeps truth values in bytes
        where = _addresses(t, pointer, t.binary("add", base, t.constant(n, "i64")), stored)
        v, p, flags = t.vector(stored), f"<{t.width} x ptr>", t.vector("i1")
        name = f"@llvm.masked.gather.{t.suffix(stored)}.v{t.width}p0"
        t.declared[name] = f"declare {v} {name}({p}, i32, {flags}, {v})"
        call = f"{p} {where}, i32 {_BYTES[stored]}, {flags} {mask.text}, {v} zeroinitializer"
        value = Value(t.raw(f"call {v} {name}({call})"), stored)
        if kind == "i1":
            value = t.binary("icmp ne", value, t.zero("i8"), "i1")
        out[i] = value
    return out


def scatter(t: Text, pointer: str, base: Value, x: Values, mask: Value) -> None:
    """Write `x` of the lanes in `mask`, the numbers of each from `base` on.

    **Arguments:** where the output's array begins; of each lane, the number of its first number in
    the array; the values; which slots write.
    """
    for n, value in enumerate(x.ravel()):
        if value.kind == "i1":
            value = t.cast("zext", value, "i8")
        kind = value.kind
        where = _addresses(t, pointer, t.binary("add", base, t.constant(n, "i64")), kind)
        v, p, flags = t.vector(kind), f"<{t.width} x ptr>", t.vector("i1")
        name = f"@llvm.masked.scatter.{t.suffix(kind)}.v{t.width}p0"
        t.declared[name] = f"declare void {name}({v}, {p}, i32, {flags})"
        call = f"{v} {value.text}, {p} {where}, i32 {_BYTES[kind]}, {flags} {mask.text}"
        t.line(f"call void {name}({call})")
