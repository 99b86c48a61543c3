"""A program's forward and reverse pass as one machine function, with the arguments of `_kernel.py`.

A thread takes one group of lanes at a time. The forward pass runs until the last lane has ended,
and stores the carry of each iteration on the *tape*. The reverse pass goes through `end`, the
iterations from last to first, and `begin`. A lane takes part only in its own iterations. The driver
is scalar code (`DRIVER`). It calls these functions, which share the group's *frame* in memory; each
is written by the method of its name:

    begin       loads new lanes: their inputs, their first carry
    step        advances the lanes that have not ended by one iteration
    end_back    maps cotangents of the results to those of the carry and the inputs
    step_back   does the same for one iteration and the rows completed in it
    begin_back  does the same for `begin`, and stores the cotangents of the inputs

A full tape is copied into twice the memory, up to `MOST_BYTES` per thread. Beyond that the call
ends with an error.
"""

from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from ._array_rules import any_in
from ._arrays import (
    MOST_IN_REGISTERS,
    Array,
    Masked,
    Memory,
    Registers,
    Strided,
    contiguous,
    fill,
    mapped,
    selected,
    splat,
    stored,
    to_registers,
    uniform,
)
from ._kernel import (
    gathered_array,
    load_pointer,
    load_row_count,
    load_stride,
    over_rows,
    scatter,
    shared_input,
)
from ._operations import add, compare, kind_of
from ._reverse import ReverseProgram
from ._text import RARE, FixedText, Text, Value, attributes
from ._vector import write

# The scalar code that drives a group of lanes forward and back, as LLVM's text.
#
# The blocks (`docs/internals/lanes.md` has the picture):
#
#     take     take a group's lanes, as long as there are any; begin
#     forward  while a lane continues: store the carry (a full tape grows), step
#     turn     all lanes have ended: back through `end` and the iterations
#     finish   back through `begin`

# The value of `stop` after a failed allocation, or if a tape would exceed its limit.
OUT_OF_MEMORY = 2

# Memory is aligned to 64 bytes, so that no vector crosses a cache line.
DRIVER = """\
declare ptr @malloc(i64)
declare void @free(ptr)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)

define internal ptr @aligned(ptr %memory) {{
  %address = ptrtoint ptr %memory to i64
  %over = and i64 %address, 63
  %rest = sub i64 64, %over
  %place = getelementptr i8, ptr %memory, i64 %rest
  ret ptr %place
}}

define void @kernel(ptr %inputs, ptr %sizes, ptr %outputs, i64 %lanes, ptr %next, ptr %stop) #0 {{
entry:
  %memory = call ptr @malloc(i64 {frame})
  %first.size = mul i64 {entry}, {entries}
  %first.whole = add i64 %first.size, 64
  %first.tape = call ptr @malloc(i64 %first.whole)
  %none = icmp eq ptr %memory, null
  %none.tape = icmp eq ptr %first.tape, null
  %lacks = or i1 %none, %none.tape
  %frame = call ptr @aligned(ptr %memory)
  br i1 %lacks, label %lack, label %take

take:
  %tape.t = phi ptr [ %first.tape, %entry ], [ %tape, %finish ]
  %room.t = phi i64 [ {entries}, %entry ], [ %room, %finish ]
  %first = atomicrmw add ptr %next, i64 {width} monotonic
  %left = icmp slt i64 %first, %lanes
  br i1 %left, label %begin, label %leave
begin:
  %begun = call i1 @begin({call}, i64 %first, i64 %lanes)
  br i1 %begun, label %forward, label %turn

forward:
  %n = phi i64 [ 0, %begin ], [ %n.next, %put ]
  %tape.f = phi ptr [ %tape.t, %begin ], [ %tape.p, %put ]
  %room.f = phi i64 [ %room.t, %begin ], [ %room.p, %put ]
  %halt.1 = load volatile i8, ptr %stop
  %halted.1 = icmp ne i8 %halt.1, 0
  br i1 %halted.1, label %leave, label %keep
keep:
  %full = icmp eq i64 %n, %room.f
  br i1 %full, label %grow, label %put
grow:
  %old.size = mul i64 %room.f, {entry}
  %room.more = mul i64 %room.f, 2
  %new.size = mul i64 %old.size, 2
  %new.whole = add i64 %new.size, 64
  %beyond = icmp ugt i64 %new.size, {most}
  br i1 %beyond, label %lack, label %ask
ask:
  %new = call ptr @malloc(i64 %new.whole)
  %new.none = icmp eq ptr %new, null
  br i1 %new.none, label %lack, label %move
move:
  %move.to = call ptr @aligned(ptr %new)
  %move.from = call ptr @aligned(ptr %tape.f)
  call void @llvm.memcpy.p0.p0.i64(ptr %move.to, ptr %move.from, i64 %old.size, i1 false)
  call void @free(ptr %tape.f)
  br label %put
put:
  %tape.p = phi ptr [ %tape.f, %keep ], [ %new, %move ]
  %room.p = phi i64 [ %room.f, %keep ], [ %room.more, %move ]
  %entries.p = call ptr @aligned(ptr %tape.p)
  %at.byte = mul i64 %n, {entry}
  %put.to = getelementptr i8, ptr %entries.p, i64 %at.byte
  call void @llvm.memcpy.p0.p0.i64(ptr %put.to, ptr %frame, i64 {entry}, i1 false)
  %more = call i1 @step({call}, i64 %n)
  %n.next = add i64 %n, 1
  br i1 %more, label %forward, label %turn

turn:
  %total = phi i64 [ 0, %begin ], [ %n.next, %put ]
  %tape = phi ptr [ %tape.t, %begin ], [ %tape.p, %put ]
  %room = phi i64 [ %room.t, %begin ], [ %room.p, %put ]
  %entries = call ptr @aligned(ptr %tape)
  call void @end_back({call})
  br label %back
back:
  %b.next = phi i64 [ %total, %turn ], [ %b, %through ]
  %some = icmp sgt i64 %b.next, 0
  br i1 %some, label %look, label %finish
look:
  %halt.2 = load volatile i8, ptr %stop
  %halted.2 = icmp ne i8 %halt.2, 0
  br i1 %halted.2, label %leave, label %through
through:
  %b = sub i64 %b.next, 1
  %b.byte = mul i64 %b, {entry}
  %b.entry = getelementptr i8, ptr %entries, i64 %b.byte
  call void @step_back({call}, ptr %b.entry, i64 %b)
  br label %back

finish:
  call void @begin_back({call})
  br label %take

lack:
  %tape.l = phi ptr [ %first.tape, %entry ], [ %tape.f, %grow ], [ %tape.f, %ask ]
  store volatile i8 {out_of_memory}, ptr %stop
  br label %leave
leave:
  %tape.e = phi ptr [ %tape.t, %take ], [ %tape.f, %forward ], [ %tape, %look ], [ %tape.l, %lack ]
  call void @free(ptr %tape.e)
  call void @free(ptr %memory)
  ret void
}}"""


# The greatest size of a thread's tape in bytes, and its initial number of entries. The paper's
# motor takes 1.1 kB per iteration in groups of eight, so 250,000 cycles of 15 steps fit.
MOST_BYTES = 4 << 30
_FIRST_ENTRIES = 64

# The iteration count of a lane that has not ended yet.
_NO_END = (1 << 63) - 1


def reverse_text(
    program: ReverseProgram,
    width: int,
    bits: int,
    one_for_all: tuple[bool, ...] = (),
    *,
    entries: int = _FIRST_ENTRIES,
    most: int = MOST_BYTES,
) -> str:
    """Return LLVM's text of a program forward and backward; a tape begins with `entries`."""
    return _Writer(program, width, one_for_all).text(bits, entries, most)


# Types: of a lane's number and of its counters; of a boolean.
_LANE, _FLAG = np.zeros((), np.int64), np.zeros((), bool)

_ARGUMENTS = "ptr %inputs, ptr %sizes, ptr %outputs, ptr %frame"


class _Writer:
    """A reverse kernel while it is written."""

    def __init__(self, program: ReverseProgram, width: int, one_for_all: tuple[bool, ...]):
        self.program, self.base, self.width = program, program.program, width
        self.declared: dict[str, str] = {}
        self.arena = 0
        n = len(self.base.in_avals)
        self.inputs = program.in_avals[:n]
        self.shared = [
            flag and a.size > MOST_IN_REGISTERS
            for flag, a in zip(one_for_all or (False,) * n, self.inputs, strict=False)
        ]
        self.results = sum(program.given[: len(self.base.out_avals)])
        self.varied = program.results()
        self.carried = [
            a for a, flag in zip(program.carry_avals, program.carried, strict=True) if flag
        ]
        parts = {
            # An entry of the tape: the carry, and the number of rows complete before the iteration.
            "carry": program.carry_avals,
            "rows": [_LANE],
            "lane": [_LANE],  # its number; -1 for a slot without one
            "count": [_LANE],  # its iterations
            # Inputs that differ between lanes, or that are small.
            "inputs": [x for x, flag in zip(self.inputs, self.shared, strict=True) if not flag],
            "undefined": [_FLAG],  # True if a given cotangent makes all results NaN
            "to_inputs": self.varied,  # cotangents so far
            "to_carry": self.carried,
        }
        self.frame = Frame(parts, width)

    def text(self, bits: int, entries: int, most: int) -> str:
        functions = [
            self._begin(), self._step(), self._end_back(), self._step_back(), self._begin_back(),
        ]  # fmt: skip
        driver = DRIVER.format(
            width=self.width, frame=64 + self.frame.size + self.arena, entries=entries, most=most,
            entry=self.frame.places["lane"], call=_ARGUMENTS, out_of_memory=OUT_OF_MEMORY,
        )  # fmt: skip
        return "\n".join([*self.declared.values(), *functions, driver, attributes(bits), RARE, ""])

    def _function(self, kind: str, name: str, more: str, t: Text, result: str) -> str:
        """Return a function with the written body. `more` are arguments after the common ones."""
        self.declared.update(t.declared)
        self.arena = max(self.arena, t.arena.size * self.width * 8)
        head = f"define internal {kind} @{name}({_ARGUMENTS}{more}) noinline #0 {{\nentry:"
        arena = f"  %arena = getelementptr i8, ptr %frame, i64 {self.frame.size}"
        return "\n".join([head, arena, *t.lines, f"  ret {result}", "}"])

    # Code common to the functions

    def _load_inputs(self, t: Text) -> list[Array]:
        """Return the inputs. Large ones that all lanes share are read from XLA's array."""
        frame_inputs = iter(self.frame.load(t, "inputs"))
        return [
            shared_input(load_pointer(t, "inputs", i), aval) if flag else next(frame_inputs)
            for i, (aval, flag) in enumerate(zip(self.inputs, self.shared, strict=True))
        ]

    def _lanes(self, t: Text) -> tuple[Value, Value]:
        """Return the number of each slot's lane, and the mask of the slots that have one."""
        lane = self.frame.number(t, "lane")
        return lane, t.binary("icmp sge", lane, t.zero("i64"), "i1")

    def _weights(
        self, t: Text, first: int, avals: list[Any], lane: Value, place: Value | None, mask: Value
    ) -> list[Array]:
        """Return given cotangents from number `first` on, zero where `mask` does not hold; `place`
        is the number of the row, for cotangents of rows."""
        arrays = []
        for i, aval in enumerate(avals, len(self.inputs) + first):
            start = t.binary("mul", lane, load_stride(t, i))
            if place is not None:
                row = t.binary("mul", place, t.constant(aval.size, "i64"))
                start = t.binary("add", start, row)
            pointer = load_pointer(t, "inputs", i)
            arrays.append(to_registers(t, gathered_array(t, pointer, start, aval, mask)))
        return arrays

    def _row_weights(self, t: Text, lane: Value, place: Value, complete: Value) -> list[Array]:
        """Return the cotangents of row `place`, for the lanes that have `complete`d it."""
        avals = self.program.weight_avals[self.results :]
        no_weights = zeros(t, avals)
        if not avals:
            return no_weights
        has_row = t.binary("icmp slt", place, load_row_count(t), "i1")
        mask = t.both(complete, has_row)

        def read() -> list[Array]:
            found = self._weights(t, self.results, avals, lane, place, mask)
            self._undefine_by_weights(t, found)
            return found

        if not all(isinstance(x, Registers) for x in no_weights):
            return read()
        with t.skipped_unless(mask) as fork:
            found = read()
        return [mapped(t, fork.joined, a, b) for a, b in zip(found, no_weights, strict=True)]

    def _undefine_by_weights(self, t: Text, arrays: list[Array]) -> None:
        """Mark lanes with NaN or infinity as a cotangent, since 0 times it is NaN."""

        def is_no_number(x: Value) -> Value:
            return compare(t, "ne", t.binary("fsub", x, x), t.zero(x.kind), False)

        self._undefine(t, [mapped(t, is_no_number, x, kind="i1") for x in arrays])

    def _undefine(self, t: Text, flags: list[Array]) -> None:
        """Mark lanes in which any of these flags holds: their derivatives become NaN."""
        undefined = self.frame.number(t, "undefined")
        for x in flags:
            undefined = t.binary("or", undefined, any_in(t, x))
        self.frame.store_number(t, "undefined", undefined)

    def _undefine_by_missing_rows(self, t: Text, lane: Value, rows: Value, present: Value) -> None:
        """Mark lanes with a nonzero cotangent of a row that they did not reach, a NaN."""
        avals = self.program.weight_avals[self.results :]
        if not avals:
            return

        def mark_lanes(place: Value, mask: Value) -> None:
            read = self._weights(t, self.results, avals, lane, place, mask)
            is_nonzero = lambda x: compare(t, "ne", x, t.zero(x.kind), False)
            self._undefine(t, [mapped(t, is_nonzero, x, kind="i1") for x in read])

        over_rows(t, rows, load_row_count(t), present, mark_lanes)

    def _back(
        self, t: Text, jaxpr: ClosedJaxpr, args: list[Array], mask: Value
    ) -> tuple[list[Array], list[Array]]:
        """Return cotangents of inputs and carry after a reverse step, zero outside `mask`."""
        out = masked_to(t, mask, write(t, jaxpr, args, mask), jaxpr.out_avals)
        return out[: len(self.varied)], out[len(self.varied) :]

    # The functions

    def _begin(self) -> str:
        t = FixedText(self.width)
        places = ", ".join(f"i64 {i}" for i in range(self.width))
        lane = t.binary("add", splat(t, "%first", "i64"), Value(f"<{places}>", "i64"))
        present = t.binary("icmp slt", lane, splat(t, "%lanes", "i64"), "i1")
        lane = t.select(present, lane, t.constant(-1, "i64"))
        inputs = []
        for i in (i for i, flag in enumerate(self.shared) if not flag):
            pointer = load_pointer(t, "inputs", i)
            at = t.binary("mul", lane, load_stride(t, i))
            inputs.append(to_registers(t, gathered_array(t, pointer, at, self.inputs[i], present)))
        self.frame.store_number(t, "lane", lane)
        self.frame.store(t, "inputs", inputs)
        inputs = self._load_inputs(t)
        given = zeros(t, [*self.carried, *self.program.weight_avals[self.results :]])
        out: list[Any] = write(t, self.program.begin.forward, [*inputs, *given], present)
        *carry, active, complete = out
        going = t.both(present, active.item())
        rows = t.cast("zext", t.both(present, complete.item()), "i64")
        count = t.select(going, t.constant(_NO_END, "i64"), t.zero("i64"))
        self.frame.store_number(t, "count", count)
        self.frame.store(t, "carry", carry)
        self.frame.store_number(t, "rows", rows)
        return self._function("i1", "begin", ", i64 %first, i64 %lanes", t, f"i1 {t.any(going)}")

    def _step(self) -> str:
        """Advance the lanes with more than `number` iterations. Return whether any continues."""
        t = FixedText(self.width)
        number, count = splat(t, "%number", "i64"), self.frame.number(t, "count")
        mask = t.binary("icmp slt", number, count, "i1")
        inputs, carry = self._load_inputs(t), self.frame.load(t, "carry")
        rows = self.frame.number(t, "rows")
        given = zeros(t, [*self.carried, *self.program.weight_avals[self.results :]])
        out: list[Any] = write(t, self.program.step.forward, [*inputs, *carry, *given], mask)
        *new, active, complete = out
        more = t.binary("add", rows, t.cast("zext", complete.item(), "i64"))
        self.frame.store(t, "carry", select_all(t, mask, new, carry))
        self.frame.store_number(t, "rows", t.select(mask, more, rows))
        ended = t.both(mask, t.inverse(active.item()))
        following = t.binary("add", number, t.constant(1, "i64"))
        count = t.select(ended, following, count)
        self.frame.store_number(t, "count", count)
        any_left = t.any(t.binary("icmp slt", following, count, "i1"))
        return self._function("i1", "step", ", i64 %number", t, f"i1 {any_left}")

    def _end_back(self) -> str:
        t = FixedText(self.width)
        lane, present = self._lanes(t)
        inputs, carry = self._load_inputs(t), self.frame.load(t, "carry")
        avals = self.program.weight_avals[: self.results]
        weights = self._weights(t, 0, avals, lane, None, present)
        self.frame.store_number(t, "undefined", t.constant(False, "i1"))
        self._undefine_by_weights(t, weights)
        self._undefine_by_missing_rows(t, lane, self.frame.number(t, "rows"), present)
        args = [*inputs, *carry, *weights]
        to_inputs, to_carry = self._back(t, self.program.end.backward, args, present)
        self.frame.store(t, "to_inputs", to_inputs)
        self.frame.store(t, "to_carry", to_carry)
        return self._function("void", "end_back", "", t, "void")

    def _step_back(self) -> str:
        """Reverse iteration `number`, whose initial carry is in an `entry` of the tape. The frame's
        row count changes from that after the iteration to that before it."""
        t = FixedText(self.width)
        lane, count = self.frame.number(t, "lane"), self.frame.number(t, "count")
        mask = t.binary("icmp slt", splat(t, "%number", "i64"), count, "i1")
        inputs, carry = self._load_inputs(t), self.frame.load(t, "carry", "%before")
        rows, after = (self.frame.number(t, "rows", place) for place in ("%before", "%frame"))
        complete = t.both(mask, t.binary("icmp slt", rows, after, "i1"))
        weights = self._row_weights(t, lane, rows, complete)
        to_carry = self.frame.load(t, "to_carry")
        args = [*inputs, *carry, *to_carry, *weights]
        more, new = self._back(t, self.program.step.backward, args, mask)
        self.frame.add(t, "to_inputs", more)
        self.frame.store(t, "to_carry", select_all(t, mask, new, to_carry))
        self.frame.store_number(t, "rows", t.select(mask, rows, after))
        return self._function("void", "step_back", ", ptr %before, i64 %number", t, "void")

    def _begin_back(self) -> str:
        t = FixedText(self.width)
        lane, present = self._lanes(t)
        inputs = self._load_inputs(t)
        rows, zero = self.frame.number(t, "rows"), t.zero("i64")
        complete = t.both(present, t.binary("icmp sgt", rows, zero, "i1"))
        weights = self._row_weights(t, lane, zero, complete)
        args = [*inputs, *self.frame.load(t, "to_carry"), *weights]
        more, _ = self._back(t, self.program.begin.backward, args, present)
        total = add_all(t, self.frame.load(t, "to_inputs"), more)
        undefined = self.frame.number(t, "undefined")
        nan = lambda v: t.constant(float("nan"), v.kind)
        nothing = [mapped(t, nan, x) for x in total]
        total = select_all(t, undefined, nothing, total)
        for i, x in enumerate(total):
            start = t.binary("mul", lane, t.constant(x.size, "i64"))
            scatter(t, load_pointer(t, "outputs", i), start, x, present)
        return self._function("void", "begin_back", "", t, "void")


# --- whole arrays of a group of lanes: kept in memory, selected, added


def masked_to(t: Text, flag: Value, arrays: list[Array], avals: list[Any]) -> list[Array]:
    """Return the arrays in lanes where the flag holds, else zeros. `Masked` arrays are returned as
    they are; their masks must imply the flag."""
    chosen = select_all(t, flag, arrays, zeros(t, avals))
    return [x if isinstance(x, Masked) else y for x, y in zip(arrays, chosen, strict=True)]


def select_all(t: Text, flag: Value, a: list[Array], b: list[Array]) -> list[Array]:
    return [selected(t, flag, x, y) for x, y in zip(a, b, strict=True)]


def add_all(t: Text, a: list[Array], b: list[Array]) -> list[Array]:
    return [mapped(t, lambda x, y: add(t, x, y), x, y) for x, y in zip(a, b, strict=True)]


def zeros(t: Text, avals: list[Any]) -> list[Array]:
    return [to_registers(t, uniform(aval.shape, t.zero(kind_of(aval.dtype)))) for aval in avals]


class Frame:
    """Memory of a group of lanes at `%frame`, kept between the functions of a kernel: parts by
    name, each with shapes and types of its arrays."""

    def __init__(self, parts: dict[str, list[Any]], width: int):
        self._parts, self.places, size = parts, {}, 0
        """The offset of each part, in bytes."""
        for name, avals in parts.items():
            self.places[name] = size
            size += sum(a.size for a in avals) * 8 * width
        # The memory after the frame begins on a cache line, as the frame does.
        self.size = -(-size // 64) * 64
        """The size of the frame in bytes."""

    def _arrays(self, t: Text, part: str, pointer: str = "%frame") -> list[Strided]:
        """Return the arrays of a part. Each number has `8 * width` bytes of room."""
        found, place = [], self.places[part]
        for aval in self._parts[part]:
            memory, shape = Memory((pointer, place)), tuple(aval.shape)
            found.append(Strided(shape, kind_of(aval.dtype), memory, contiguous(shape)))
            place += aval.size * 8 * t.width
        return found

    def load(self, t: Text, part: str, pointer: str = "%frame") -> list[Any]:
        """Return the arrays of a part, from the frame or from a copy of it. Large ones are not
        copied."""
        return [to_registers(t, x) for x in self._arrays(t, part, pointer)]

    def store(self, t: Text, part: str, arrays: list[Array]) -> None:
        # Large arrays may depend on those that are overwritten, so they are computed first.
        arrays = [x if isinstance(x, Registers) else stored(t, x) for x in arrays]
        for place, x in zip(self._arrays(t, part), arrays, strict=True):
            fill(t, place, x)

    def add(self, t: Text, part: str, arrays: list[Array]) -> None:
        """Add arrays to those of a part. They must not depend on these."""
        places = self._arrays(t, part)
        rare: dict[Value, list[tuple[Strided, Array]]] = {}
        sums = add_all(t, [to_registers(t, x) for x in places], arrays)
        for place, more, new in zip(places, arrays, sums, strict=True):
            if isinstance(more, Masked):
                rare.setdefault(more.mask, []).append((place, new))
            else:
                fill(t, place, new)
        # The cotangents of a law's weights are nonzero only in iterations with an impact.
        for mask, pairs in rare.items():
            with t.skipped_unless(mask, rare=True):
                for place, new in pairs:
                    fill(t, place, new)

    def number(self, t: Text, part: str, pointer: str = "%frame") -> Value:
        return self.load(t, part, pointer)[0].item()

    def store_number(self, t: Text, part: str, value: Value) -> None:
        self.store(t, part, [Registers.one(value)])
