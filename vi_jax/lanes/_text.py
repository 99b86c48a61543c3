"""Vector code as LLVM's text: values, operations on them, and blocks."""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np


class Arena:
    """Which places of a kernel's memory are in use while its text is written.

    Places are counted in vectors of eight-byte numbers, one for each lane of a group. What is let
    go of is given out again, lowest first, so that a step's arrays stay near each other.
    """

    def __init__(self) -> None:
        self.size = 0
        """The places that the kernel needs in all."""
        self._free: list[tuple[int, int]] = []  # from, to; in order, apart from each other

    def take(self, numbers: int) -> "Block":
        """Room for so many numbers of every lane, until nothing refers to the block any more."""
        for i, (begin, end) in enumerate(self._free):
            if end - begin >= numbers:
                rest = [(begin + numbers, end)] if end - begin > numbers else []
                self._free[i : i + 1] = rest
                return Block(self, begin, numbers)
        begin = self.size
        if self._free and self._free[-1][1] == self.size:
            begin = self._free.pop()[0]
        self.size = begin + numbers
        return Block(self, begin, numbers)

    def give_back(self, begin: int, end: int) -> None:
        """What `Block` calls as it goes."""
        kept = []
        for a, b in self._free:
            if b == begin:
                begin = a
            elif a == end:
                end = b
            else:
                kept.append((a, b))
        self._free = sorted([*kept, (begin, end)])


@dataclass(eq=False)
class Block:
    """Places of an arena, in use as long as this object is."""

    arena: Arena = field(repr=False)
    start: int
    numbers: int

    def __del__(self) -> None:
        self.arena.give_back(self.start, self.start + self.numbers)


@dataclass(frozen=True, slots=True)
class Value:
    """One number of every lane of a group: an SSA name or a constant, and its type."""

    text: str
    kind: str
    """LLVM's type: `double`, `float`, `i1`, `i8` … `i64`."""
    number: float | int | bool | None = None
    """The number of a constant; else `None`."""


KINDS = {
    "float64": "double", "float32": "float", "bool": "i1",
    "int8": "i8", "int16": "i16", "int32": "i32", "int64": "i64",
    "uint8": "i8", "uint16": "i16", "uint32": "i32", "uint64": "i64",
}  # fmt: skip


# The weights of a branch that `Text.fork` marks as rare. Without them LLVM takes both ways for
# equally likely, and spills what every step needs for what few steps do (a tenth of the time).
RARE = '!0 = !{!"branch_weights", i32 1, i32 200}'


def attributes(bits: int) -> str:
    """The attributes of a kernel's functions, for registers of so many bits."""
    widths = f'"min-legal-vector-width"="{bits}" "prefer-vector-width"="{bits}"'
    return f"attributes #0 = {{ nounwind {widths} }}"


def is_float(kind: str) -> bool:
    return kind in ("double", "float")


def literal(number: Any, kind: str) -> str:
    """A number as LLVM's text."""
    if is_float(kind):
        return "0x" + struct.pack(">d", float(number)).hex().upper()
    return str(bool(number)).lower() if kind == "i1" else str(int(number))


class Text:
    """The body of a function while it is written, with equal operations merged.

    A value may be used only in blocks that its own dominates. Scopes keep account of that: see
    `open`, `close` and `follow`, and `docs/internals/lanes.md`. `width` is the lanes of a group.
    """

    def __init__(self, width: int):
        self.width = width
        self.lines: list[str] = []
        self.declared: dict[str, str] = {}
        self.block = "entry"
        self.arena = Arena()
        # Of a loop's counter, and of places counted from it, the least and the greatest number.
        self.ranges: dict[str, tuple[int, int]] = {}
        self._stores = 0
        self._names = 0
        # Operations written in blocks that dominate the current one, a table for each open scope.
        self._seen: list[dict[tuple, Value]] = [{}]

    def vector(self, kind: str) -> str:
        """LLVM's type of one number of every lane."""
        return f"<{self.width} x {kind}>"

    def fresh(self) -> str:
        """A new name of a value."""
        self._names += 1
        return f"%v{self._names}"

    def constant(self, number: Any, kind: str) -> Value:
        """The same number in every lane."""
        if is_float(kind):
            number = float(np.float32(number)) if kind == "float" else float(number)
        else:
            number = bool(number) if kind == "i1" else int(number)
        return Value(f"splat ({kind} {literal(number, kind)})", kind, number)

    def zero(self, kind: str) -> Value:
        return self.constant(0, kind)

    def line(self, text: str) -> None:
        """Append an instruction without a result."""
        self.lines.append("  " + text)

    def raw(self, operation: str) -> str:
        """Append an instruction; the name of its result. For results that are no vectors of the
        group, and what must not be merged."""
        name = self.fresh()
        self.line(f"{name} = {operation}")
        return name

    def once(self, operation: str) -> str:
        """The name of a scalar's operation, merged as `value` is."""
        return self.value(operation, "scalar").text

    def load(self, operation: str, kind: str) -> Value:
        """Append a load from memory, merged with an equal one in this block since the last store.

        **Arguments:** as for `value`.
        """
        key = (f"{operation}, {self._stores}", kind)
        found = self._seen[-1].get(key)
        if found is None:
            found = self._seen[-1][key] = Value(self.raw(operation), kind)
        return found

    def store(self, operation: str) -> None:
        """Append a store to memory."""
        self._stores += 1
        self.line(operation)

    def value(self, operation: str, kind: str, *, merge: bool = True) -> Value:
        """Append an operation on vectors, unless an equal one was written in a block that dominates
        this one.

        **Arguments:** the operation in LLVM's words; the type of its result's numbers.
        """
        key = (operation, kind)
        if merge:
            for seen in self._seen:
                if key in seen:
                    return seen[key]
        result = Value(self.raw(operation), kind)
        if merge:
            self._seen[-1][key] = result
        return result

    def ordered(self, a: Value, b: Value) -> tuple[Value, Value]:
        """In one order, so that a·b and b·a are merged; a constant last."""
        first = a.number is not None, a.text
        return (a, b) if first <= (b.number is not None, b.text) else (b, a)

    def opaque(self, a: Value) -> Value:
        """A value that comes out of a condition or a turn of a loop (see `FixedText`)."""
        return a

    def binary(self, operation: str, a: Value, b: Value, kind: str | None = None) -> Value:
        """An operation on two values of one type; `kind` is its result's type if another."""
        return self.value(f"{operation} {self.vector(a.kind)} {a.text}, {b.text}", kind or a.kind)

    def negative(self, a: Value) -> Value:
        """A floating-point number with the other sign."""
        return self.value(f"fneg {self.vector(a.kind)} {a.text}", a.kind)

    def cast(self, operation: str, a: Value, kind: str) -> Value:
        """A conversion (`fpext`, `zext`, `bitcast` …) to another type."""
        old, new = self.vector(a.kind), self.vector(kind)
        return self.value(f"{operation} {old} {a.text} to {new}", kind)

    def select(self, condition: Value, a: Value, b: Value) -> Value:
        """a where the condition holds, else b."""
        if a == b:
            return a
        if condition.number is not None:
            return a if condition.number else b
        v = self.vector(a.kind)
        flags = f"{self.vector('i1')} {condition.text}"
        return self.value(f"select {flags}, {v} {a.text}, {v} {b.text}", a.kind)

    def suffix(self, kind: str) -> str:
        """The vector type as in the names of intrinsics: `v8f64`."""
        return f"v{self.width}" + {"double": "f64", "float": "f32"}.get(kind, kind)

    def intrinsic(self, name: str, *args: Value, kind: str | None = None) -> Value:
        """An intrinsic of LLVM on values of one type, such as `sqrt`; `kind` as in `binary`."""
        own = args[0].kind
        function = f"@llvm.{name}.{self.suffix(own)}"
        result = kind or own
        types = ", ".join(self.vector(a.kind) for a in args)
        self.declared[function] = f"declare {self.vector(result)} {function}({types})"
        call = ", ".join(f"{self.vector(a.kind)} {a.text}" for a in args)
        return self.value(f"call {self.vector(result)} {function}({call})", result)

    def each(self, name: str, *args: Value) -> Value:
        """A function of the C library, lane by lane, in double precision."""
        wide = [self.cast("fpext", a, "double") if a.kind == "float" else a for a in args]
        types = ", ".join("double" for _ in args)
        attributes = "nounwind willreturn memory(none)"
        self.declared["@" + name] = f"declare double @{name}({types}) {attributes}"
        v = self.vector("double")
        total = "poison"
        for lane in range(self.width):
            parts = [self.raw(f"extractelement {v} {a.text}, i32 {lane}") for a in wide]
            call = ", ".join(f"double {p}" for p in parts)
            one = self.raw(f"call double @{name}({call})")
            total = self.raw(f"insertelement {v} {total}, double {one}, i32 {lane}")
        result = Value(total, "double")
        return self.cast("fptrunc", result, "float") if args[0].kind == "float" else result

    # Flags

    def both(self, a: Value, b: Value) -> Value:
        """Whether both flags hold, lane by lane."""
        if a.number is not None:
            return b if a.number else a
        if b.number is not None:
            return a if b.number else b
        return self.binary("and", a, b)

    def inverse(self, a: Value) -> Value:
        """Whether a flag does not hold, lane by lane."""
        return self.binary("xor", a, self.constant(True, "i1"))

    def any(self, a: Value) -> str:
        """Whether a flag holds in any lane: the name of an `i1`."""
        bits = self.raw(f"bitcast {self.vector('i1')} {a.text} to i{self.width}")
        return self.raw(f"icmp ne i{self.width} {bits}, 0")

    # Blocks

    def open(self, label: str) -> None:
        """Begin a block that the current one dominates, in a scope that lasts until `close`."""
        self.follow(label)
        self._seen.append({})

    def close(self) -> None:
        """End the last scope: the blocks that follow do not see what was computed in it."""
        self._seen.pop()

    def fork(self, condition: str, yes: str, no: str, *, rare: bool = False) -> None:
        """End the block: go on at one of two labels. If `yes` is `rare`, `no` is kept fast."""
        self.line(f"br i1 {condition}, label %{yes}, label %{no}{', !prof !0' if rare else ''}")

    @contextmanager
    def skipped_unless(self, mask: Value, *, rare: bool = False) -> "Iterator[Skipped]":
        """Blocks that are skipped where the mask holds in no lane; `rare` as in `fork`."""
        inside, after = self.label(), self.label()
        way = Skipped(self, self.block)
        self.fork(self.any(mask), inside, after, rare=rare)
        self.open(inside)
        yield way
        way.end = self.block
        self.line(f"br label %{after}")
        self.close()
        self.follow(after)

    def follow(self, label: str) -> None:
        """Begin a block that the blocks of all open scopes dominate, without a scope of its own."""
        self.lines.append(f"{label}:")
        self.block = label
        self._stores += 1  # what is in memory may have changed on the way to this block

    def label(self) -> str:
        """A new name of a block."""
        self._names += 1
        return f"b{self._names}"

    def phi(self, kind: str, *ways: tuple[str, str]) -> Value:
        """The value that came with the block it was reached from."""
        return self.value(self._phi(kind, ways), kind, merge=False)

    def join(
        self, names: list[Value], *ways: tuple[list[Value], str], at: int | None = None
    ) -> None:
        """Define names by phi instructions.

        **Arguments:** the names; for each block from which this one is reached, the values that
        come from there, and its label; the line where the phis are to stand, if not here. A loop's
        head is written before its body, so that its phis are put there afterwards.
        """
        lines = []
        for name, *values in zip(names, *(values for values, _ in ways), strict=True):
            pairs = [(v.text, block) for v, (_, block) in zip(values, ways, strict=True)]
            lines.append(f"  {name.text} = {self._phi(name.kind, pairs)}")
        at = len(self.lines) if at is None else at
        self.lines[at:at] = lines

    def _phi(self, kind: str, ways: Sequence[tuple[str, str]]) -> str:
        pairs = ", ".join(f"[ {text}, %{block} ]" for text, block in ways)
        return f"phi {self.vector(kind)} {pairs}"


@dataclass
class Skipped:
    """Blocks that are skipped, or not."""

    text: Text
    before: str
    """The block from which they are skipped."""
    end: str = ""
    """The last of the blocks that may be skipped."""

    def joined(self, a: Value, b: Value) -> Value:
        """a, which was computed in these blocks; b where they were skipped."""
        return self.text.phi(a.kind, (a.text, self.end), (b.text, self.before))


# Text whose arithmetic has one meaning: equal operations give equal bits in any function.
#
# With the flag `contract` LLVM fuses a product with a sum where it sees fit, which depends on what
# else is done with the product. A value that is computed again on the way back must decide about an
# event as it did on the way there, so that there the fusing is done as the text is written.

_CONTRACT = " contract"


class FixedText(Text):
    """A `Text` that fuses by a rule: the first operand of a sum or difference if that is a product,
    else the second. (LLVM's `fmuladd` is one operation where the processor has it, else two.)"""

    def __init__(self, width: int):
        super().__init__(width)
        self._products: dict[str, tuple[Value, Value]] = {}

    def ordered(self, a: Value, b: Value) -> tuple[Value, Value]:
        """As they stand: names, by which they would be ordered, are others in each function."""
        return a, b

    def opaque(self, a: Value) -> Value:
        """The same number, of which it is not known that it is a product: a branch may be skipped
        in one function and be computed for all lanes in another."""
        return self.cast("bitcast", a, a.kind) if is_float(a.kind) else a

    def binary(self, operation: str, a: Value, b: Value, kind: str | None = None) -> Value:
        plain = operation.removesuffix(_CONTRACT)
        if plain == operation:
            return super().binary(operation, a, b, kind)
        if plain == "fmul":
            product = super().binary(plain, a, b)
            self._products[product.text] = a, b
            return product
        if plain in ("fadd", "fsub") and a.text in self._products:
            x, y = self._products[a.text]
            return self.intrinsic("fmuladd", x, y, b if plain == "fadd" else self.negative(b))
        if plain in ("fadd", "fsub") and b.text in self._products:
            x, y = self._products[b.text]
            return self.intrinsic("fmuladd", x if plain == "fadd" else self.negative(x), y, a)
        return super().binary(plain, a, b)
