"""Writing vector code as LLVM's text: values, operations on them, and blocks."""

import functools
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import copysign
from typing import Any

import numpy as np


class Arena:
    """The allocation of a kernel's memory while its text is written.

    Memory is counted in vectors of eight-byte numbers, one for each lane of a group. A free place
    is reused, lowest first, so that the arrays of a step stay close together.
    """

    def __init__(self) -> None:
        self.size = 0
        """The number of vectors that the kernel needs in all."""
        self._free: list[tuple[int, int]] = []  # begin, end; sorted and disjoint

    def take(self, numbers: int) -> "Block":
        """Reserve so many numbers of each lane, until no reference to the block is left."""
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

    def free(self, begin: int, end: int) -> None:
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
    """A range of places in an arena, reserved during the lifetime of this object."""

    arena: Arena = field(repr=False)
    start: int
    numbers: int

    def __del__(self) -> None:
        self.arena.free(self.start, self.start + self.numbers)


@dataclass(frozen=True, slots=True)
class Value:
    """One number of each lane of a group: an SSA name or a constant, and its type."""

    text: str
    kind: str
    """LLVM's type: `double`, `float`, `i1`, `i8` … `i64`."""
    number: float | int | bool | None = None
    """The number of a constant, else `None`."""


KINDS = {
    "float64": "double", "float32": "float", "bool": "i1",
    "int8": "i8", "int16": "i16", "int32": "i32", "int64": "i64",
    "uint8": "i8", "uint16": "i16", "uint32": "i32", "uint64": "i64",
}  # fmt: skip


# The weights of a branch that `Text.fork` marks as rare. Without them LLVM takes both sides for
# equally likely. It then spills registers that each step needs, which cost a tenth of the time.
RARE = '!0 = !{!"branch_weights", i32 1, i32 200}'


def attributes(bits: int) -> str:
    """Return the attributes of a kernel's functions, for registers of so many bits. LLVM (22) does
    not align the stack of a function that calls no other, so that each register kept there would
    cross a cache line: a sixth of the time."""
    widths = f'"min-legal-vector-width"="{bits}" "prefer-vector-width"="{bits}"'
    return f"attributes #0 = {{ nounwind alignstack={bits // 8} {widths} }}"


def is_float(kind: str) -> bool:
    return kind in ("double", "float")


def literal(number: Any, kind: str) -> str:
    if is_float(kind):
        return "0x" + struct.pack(">d", float(number)).hex().upper()
    return str(bool(number)).lower() if kind == "i1" else str(int(number))


@functools.lru_cache(maxsize=4096)
def _constant(number: Any, kind: str, sign: float) -> Value:
    return Value(f"splat ({kind} {literal(number, kind)})", kind, number)


class Text:
    """The body of a function while it is written, with equal operations merged.

    A value may be used only in blocks that its own block dominates. Scopes ensure this: see `open`,
    `close`, `follow` and `docs/internals/lanes.md`. `width` is the number of lanes of a group.
    """

    def __init__(self, width: int):
        self.width = width
        self._vectors: dict[str, str] = {}
        self.lines: list[str] = []
        self.declared: dict[str, str] = {}
        self.block = "entry"
        self.arena = Arena()
        # The least and the greatest number of loop counters and of indices computed from them.
        self.ranges: dict[str, tuple[int, int]] = {}
        # Functions for parts that are called several times; `None` if all calls are written inline.
        self.functions: Any = None
        self._stores = 0
        self._names = 0
        # The operations in blocks that dominate the current one, a table for each open scope.
        self._operations: list[dict[tuple, Value]] = [{}]

    def vector(self, kind: str) -> str:
        found = self._vectors.get(kind)
        if found is None:
            found = self._vectors[kind] = f"<{self.width} x {kind}>"
        return found

    def fresh(self) -> str:
        self._names += 1
        return f"%v{self._names}"

    def constant(self, number: Any, kind: str) -> Value:
        if is_float(kind):
            number = float(np.float32(number)) if kind == "float" else float(number)
            return _constant(number, kind, copysign(1.0, number))  # 0 and -0 are equal
        return _constant(bool(number) if kind == "i1" else int(number), kind, 1.0)

    def zero(self, kind: str) -> Value:
        return self.constant(0, kind)

    def line(self, text: str) -> None:
        self.lines.append("  " + text)

    def raw(self, operation: str) -> str:
        """Append an instruction, and return its result's name. It is not merged, and its result
        need not be a vector of the group."""
        name = self.fresh()
        self.line(f"{name} = {operation}")
        return name

    def once(self, operation: str) -> str:
        """Append a scalar operation, merged as in `value`, and return its result's name."""
        return self.value(operation, "scalar").text

    def call(self, operation: Callable[[], str], of: str) -> str:
        """Append a call of a function without effects, merged with an equal one as in `value`, and
        return its result's name. `of` is the function with its arguments; `operation` returns the
        instruction, in which its scratch memory stands too."""
        key = (of, "call")
        for operations in self._operations:
            if key in operations:
                return operations[key].text
        name = self.raw(operation())
        self._operations[-1][key] = Value(name, "call")
        return name

    def load(self, operation: str, kind: str) -> Value:
        """Append a load, merged with an equal one in this block since the last store."""
        key = (f"{operation}, {self._stores}", kind)
        found = self._operations[-1].get(key)
        if found is None:
            found = self._operations[-1][key] = Value(self.raw(operation), kind)
        return found

    def store(self, operation: str) -> None:
        self._stores += 1
        self.line(operation)

    def value(self, operation: str, kind: str, *, merge: bool = True) -> Value:
        """Append an operation on vectors, or reuse an equal one from a dominating block."""
        key = (operation, kind)
        if merge:
            for operations in self._operations:
                if key in operations:
                    return operations[key]
        result = Value(self.raw(operation), kind)
        if merge:
            self._operations[-1][key] = result
        return result

    def ordered(self, a: Value, b: Value) -> tuple[Value, Value]:
        """Return operands in a fixed order, constants last, so that a·b and b·a are merged."""
        first = a.number is not None, a.text
        return (a, b) if first <= (b.number is not None, b.text) else (b, a)

    def opaque(self, a: Value) -> Value:
        """Return the value of a result of a condition or a loop iteration (see `FixedText`)."""
        return a

    def binary(self, operation: str, a: Value, b: Value, kind: str | None = None) -> Value:
        """Append an operation on two values of one type; `kind` is the result's, if another."""
        return self.value(f"{operation} {self.vector(a.kind)} {a.text}, {b.text}", kind or a.kind)

    def negative(self, a: Value) -> Value:
        return self.value(f"fneg {self.vector(a.kind)} {a.text}", a.kind)

    def cast(self, operation: str, a: Value, kind: str) -> Value:
        """Append a conversion (`fpext`, `zext`, `bitcast` …) to another type."""
        old, new = self.vector(a.kind), self.vector(kind)
        return self.value(f"{operation} {old} {a.text} to {new}", kind)

    def select(self, condition: Value, a: Value, b: Value) -> Value:
        if a == b:
            return a
        if condition.number is not None:
            return a if condition.number else b
        v = self.vector(a.kind)
        flags = f"{self.vector('i1')} {condition.text}"
        return self.value(f"select {flags}, {v} {a.text}, {v} {b.text}", a.kind)

    def suffix(self, kind: str) -> str:
        """Return the vector type as the suffix of an intrinsic's name, such as `v8f64`."""
        return f"v{self.width}" + {"double": "f64", "float": "f32"}.get(kind, kind)

    def intrinsic(self, name: str, *args: Value, kind: str | None = None) -> Value:
        """Call an LLVM intrinsic, such as `sqrt`, on values of one type; `kind` as in `binary`."""
        argument_kind = args[0].kind
        function = f"@llvm.{name}.{self.suffix(argument_kind)}"
        result = kind or argument_kind
        types = ", ".join(self.vector(a.kind) for a in args)
        self.declared[function] = f"declare {self.vector(result)} {function}({types})"
        call = ", ".join(f"{self.vector(a.kind)} {a.text}" for a in args)
        return self.value(f"call {self.vector(result)} {function}({call})", result)

    def per_lane(self, name: str, *args: Value) -> Value:
        """Call a function of the C library for each lane, in double precision."""
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
        """Return the conjunction of two flags, per lane."""
        if a.number is not None:
            return b if a.number else a
        if b.number is not None:
            return a if b.number else b
        return self.binary("and", a, b)

    def inverse(self, a: Value) -> Value:
        """Return the negation of a flag, per lane."""
        return self.binary("xor", a, self.constant(True, "i1"))

    def any(self, a: Value) -> str:
        """Return the name of an `i1` that is true if a flag holds in any lane."""
        bits = self.raw(f"bitcast {self.vector('i1')} {a.text} to i{self.width}")
        return self.raw(f"icmp ne i{self.width} {bits}, 0")

    # Blocks

    def open(self, label: str) -> None:
        """Begin a block that the current block dominates, in a scope that lasts until `close`."""
        self.follow(label)
        self._operations.append({})

    def close(self) -> None:
        """End the innermost scope. Following blocks do not use values from it."""
        self._operations.pop()

    def fork(self, condition: str, yes: str, no: str, *, rare: bool = False) -> None:
        """End the block with a branch to a label; `rare` if `yes` seldom happens."""
        self.line(f"br i1 {condition}, label %{yes}, label %{no}{', !prof !0' if rare else ''}")

    @contextmanager
    def skipped_unless(self, mask: Value, *, rare: bool = False) -> "Iterator[Skipped]":
        """Write blocks that are skipped if the mask holds in no lane; `rare` as in `fork`."""
        inside, after = self.label(), self.label()
        skipped = Skipped(self, self.block)
        self.fork(self.any(mask), inside, after, rare=rare)
        self.open(inside)
        yield skipped
        skipped.end = self.block
        self.line(f"br label %{after}")
        self.close()
        self.follow(after)

    def follow(self, label: str) -> None:
        """Begin a block that the blocks of all open scopes dominate, without opening a scope."""
        self.lines.append(f"{label}:")
        self.block = label
        self._stores += 1  # other blocks that lead here may have stored

    def label(self) -> str:
        self._names += 1
        return f"b{self._names}"

    def phi(self, kind: str, *sources: tuple[str, str]) -> Value:
        """Return the value that belongs to the block from which this block was entered."""
        return self.value(self._phi(kind, sources), kind, merge=False)

    def join(
        self, names: list[Value], *sources: tuple[list[Value], str], at: int | None = None
    ) -> None:
        """Define names by phi instructions, from the values and the label of each predecessor of
        this block. They are inserted at line `at`, by default the current one. The phis of a loop's
        head are inserted later, since the head is written before the loop's body."""
        lines = []
        for name, *values in zip(names, *(values for values, _ in sources), strict=True):
            pairs = [(v.text, block) for v, (_, block) in zip(values, sources, strict=True)]
            lines.append(f"  {name.text} = {self._phi(name.kind, pairs)}")
        at = len(self.lines) if at is None else at
        self.lines[at:at] = lines

    def _phi(self, kind: str, sources: Sequence[tuple[str, str]]) -> str:
        pairs = ", ".join(f"[ {text}, %{block} ]" for text, block in sources)
        return f"phi {self.vector(kind)} {pairs}"


@dataclass
class Skipped:
    """Blocks that run only if a condition holds."""

    text: Text
    before: str
    """The block from which they are skipped."""
    end: str = ""
    """The last of the blocks."""

    def joined(self, a: Value, b: Value) -> Value:
        """Return a, computed in these blocks, or b if they were skipped."""
        return self.text.phi(a.kind, (a.text, self.end), (b.text, self.before))


# Text whose arithmetic is reproducible: equal operations give equal bits in any function.
#
# With the flag `contract`, LLVM may fuse a product and a sum, depending on other uses of the
# product. A value computed again in the reverse pass must decide about an event as in the forward
# pass. The text itself fixes the fusing there.

_CONTRACT = " contract"


class FixedText(Text):
    """A `Text` with a fixed rule of fusing. A sum or difference is fused with its first operand if
    that is a product, else with its second. LLVM's `fmuladd` is one operation if the processor has
    it, else two."""

    def __init__(self, width: int):
        super().__init__(width)
        self._products: dict[str, tuple[Value, Value]] = {}

    def ordered(self, a: Value, b: Value) -> tuple[Value, Value]:
        """Return the operands unsorted, since their names differ between functions."""
        return a, b

    def opaque(self, a: Value) -> Value:
        """Return the same number without the information that it is a product. A branch may be
        skipped in one function and be computed for all lanes in another."""
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
