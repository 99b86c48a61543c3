"""A program of lanes as one machine function: a loop over places, each taking up lane after lane.

    void kernel(ptr inputs, ptr strides, ptr outputs, i64 lanes, ptr next, ptr stop)

`inputs` and `outputs` point to one array each per leaf; a stride of 0 shares an input between all
lanes. `next` counts the lanes given out so far, by whichever thread; `stop` ends the call early.
"""

from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from ._arrays import Values
from ._operations import kind_of
from ._program import LaneProgram
from ._text import RARE, Text, Value, is_float
from ._vector import write

_BYTES = {"double": 8, "float": 4, "i1": 1, "i8": 1, "i16": 2, "i32": 4, "i64": 8}

_PREAMBLE = """\
define void @kernel(ptr noalias readonly %inputs, ptr noalias readonly %strides,
                    ptr noalias readonly %outputs, i64 %lanes, ptr %next, ptr %stop) #0 {
entry:
"""


def kernel_text(program: LaneProgram, width: int, bits: int) -> str:
    """LLVM's text of a program, for groups of `width` lanes in registers of `bits` bits."""
    return _Writer(program, width).text(bits)


class _Writer:
    """A kernel under way."""

    def __init__(self, program: LaneProgram, width: int):
        self.program = program
        self.t = Text(width)
        self.n_out = len(program.out_avals)

    def text(self, bits: int) -> str:
        t, program = self.t, self.program
        ins = [self._pointer("inputs", i) for i in range(len(program.in_avals))]
        strides = [self._stride(i) for i in range(len(program.in_avals))]
        outs = [self._pointer("outputs", i) for i in range(self.n_out + len(program.row_avals))]
        kept = [*program.in_avals, *program.carry_avals]
        t.line("br label %refill")

        # Every turn of the loop: new lanes where some have ended, then a step of all.
        t.open("head")
        flat, names = [], []
        for aval in kept:
            array = np.empty(aval.shape, object)
            for i in np.ndindex(aval.shape):
                array[i] = Value(t.fresh(), kind_of(aval.dtype))
            flat.append(array)
            names += list(array.ravel())
        index, filled = Value(t.fresh(), "i64"), Value(t.fresh(), "i64")
        active = Value(t.fresh(), "i1")
        phis = len(t.lines)
        inputs, carry = flat[: len(ins)], flat[len(ins) :]
        present = t.binary("icmp sge", index, t.zero("i64"), "i1")
        ended = t.any(t.both(present, t.inverse(active)))
        halt = t.raw("load volatile i8, ptr %stop")
        halted = t.raw(f"icmp ne i8 {halt}, 0")
        t.fork(halted, "exit", "look", rare=True)
        t.open("look")
        t.fork(ended, "flush", "step", rare=True)

        t.open("step")
        new, going, complete, row = self._run(program.step, [*inputs, *carry], active)
        going = t.both(active, going)
        complete = t.both(active, complete)
        self._store_row(outs[self.n_out :], index, complete, filled, row)
        grown = t.binary("add", filled, t.cast("zext", complete, "i64"))
        step_end = t.block
        after_step = [*(v for x in [*inputs, *new] for v in x.ravel()), index, grown, going]
        t.line("br label %head")
        t.close()

        t.open("flush")
        out = write(t, program.end.jaxpr, program.end.consts, [*inputs, *carry], present)
        over = t.both(present, t.inverse(active))
        for pointer, x in zip(outs, out, strict=False):
            self._scatter(pointer, index, x, over)
        self._fill(outs[self.n_out :], index, over, filled)
        flush_end = t.block
        t.line("br label %refill")
        t.close()
        t.close()
        t.close()

        # Places without a lane take up the next ones.
        t.open("refill")
        zeros = [t.zero(v.kind) for v in names]
        old = [Value(t.fresh(), v.kind) for v in names]
        place_of, had = Value(t.fresh(), "i64"), Value(t.fresh(), "i64")
        busy = Value(t.fresh(), "i1")
        for v, a, b in zip(
            [*old, place_of, had, busy],
            [*zeros, t.constant(-1, "i64"), t.zero("i64"), t.zero("i1")],
            [*names, index, filled, active],
            strict=True,
        ):
            ways = f"[ {a.text}, %entry ], [ {b.text}, %{flush_end} ]"
            t.line(f"{v.text} = phi {t.vector(v.kind)} {ways}")
        free = t.inverse(busy)
        bits_free = t.raw(f"bitcast {t.vector('i1')} {free.text} to i{t.width}")
        t.declared["@llvm.ctpop"] = f"declare i{t.width} @llvm.ctpop.i{t.width}(i{t.width})"
        number = t.raw(f"call i{t.width} @llvm.ctpop.i{t.width}(i{t.width} {bits_free})")
        number = t.raw(f"zext i{t.width} {number} to i64")
        first = t.raw(f"atomicrmw add ptr %next, i64 {number} monotonic")
        rank = self._rank(free)
        base = self._splat(first, "i64")
        following = t.binary("add", base, rank)
        total = self._splat("%lanes", "i64")
        fresh = t.both(free, t.binary("icmp slt", following, total, "i1"))
        index2 = t.select(free, t.select(fresh, following, t.constant(-1, "i64")), place_of)
        some = t.any(fresh)
        before = t.block
        t.fork(some, "begin", "ready")
        t.open("begin")
        shaped, at = [], 0
        for aval in kept:
            size = int(np.prod(aval.shape, dtype=int))
            array = np.empty(size, object)
            array[:] = old[at : at + size]
            shaped.append(array.reshape(aval.shape))
            at += size
        read = [
            self._gather(p, s, index2, x, fresh)
            for p, s, x in zip(ins, strides, shaped, strict=False)
        ]
        carry2, going2, complete, row2 = self._run(program.begin, read, fresh)
        complete = t.both(fresh, complete)
        self._store_row(outs[self.n_out :], index2, complete, t.zero("i64"), row2)
        has = t.select(fresh, t.cast("zext", complete, "i64"), had)
        begun = [
            t.select(fresh, a, b)
            for x, y in zip([*read, *carry2], shaped, strict=True)
            for a, b in zip(x.ravel(), y.ravel(), strict=True)
        ]
        active2 = t.select(fresh, going2, busy)
        begin_end = t.block
        t.line("br label %ready")
        t.close()
        t.follow("ready")
        ready = [
            t.phi(a.kind, (a.text, begin_end), (b.text, before))
            for a, b in zip([*begun, has, active2], [*old, had, busy], strict=True)
        ]
        left = t.any(t.binary("icmp sge", index2, t.zero("i64"), "i1"))
        t.fork(left, "head", "exit")
        lines = []
        ready = [*ready[:-2], index2, *ready[-2:]]
        for v, a, b in zip([*names, index, filled, active], ready, after_step, strict=True):
            ways = f"[ {a.text}, %ready ], [ {b.text}, %{step_end} ]"
            lines.append(f"  {v.text} = phi {t.vector(v.kind)} {ways}")
        t.lines[phis:phis] = lines
        t.lines += ["exit:", "  ret void", "}"]
        return self._whole(bits)

    def _whole(self, bits: int) -> str:
        t = self.t
        attributes = (
            f'attributes #0 = {{ nounwind "min-legal-vector-width"="{bits}" '
            f'"prefer-vector-width"="{bits}" }}'
        )
        return "\n".join([*t.declared.values(), _PREAMBLE.rstrip(), *t.lines, attributes, RARE, ""])

    # Memory

    def _pointer(self, array: str, i: int) -> str:
        place = self.t.raw(f"getelementptr ptr, ptr %{array}, i64 {i}")
        return self.t.raw(f"load ptr, ptr {place}")

    def _stride(self, i: int) -> Value:
        place = self.t.raw(f"getelementptr i64, ptr %strides, i64 {i}")
        return self._splat(self.t.raw(f"load i64, ptr {place}"), "i64")

    def _splat(self, scalar: str, kind: str) -> Value:
        t = self.t
        v = t.vector(kind)
        one = t.raw(f"insertelement {v} poison, {kind} {scalar}, i32 0")
        mask = f"<{t.width} x i32> zeroinitializer"
        return Value(t.raw(f"shufflevector {v} {one}, {v} poison, {mask}"), kind)

    def _rank(self, flag: Value) -> Value:
        """How many flags hold before each place."""
        t = self.t
        ones = t.cast("zext", flag, "i64")
        # Shifted sums: 1, 2, 4, … places.
        v, shift, run = t.vector("i64"), 1, ones
        while shift < t.width:
            mask = ", ".join(f"i32 {i - shift if i >= shift else t.width}" for i in range(t.width))
            moved = Value(
                t.raw(
                    f"shufflevector {v} {run.text}, {v} zeroinitializer, <{t.width} x i32> <{mask}>"
                ),
                "i64",
            )
            run = t.binary("add", run, moved)
            shift *= 2
        return t.binary("sub", run, ones)

    def _addresses(self, pointer: str, offset: Value, kind: str) -> str:
        t = self.t
        stored = "i8" if kind == "i1" else kind
        return t.raw(f"getelementptr {stored}, ptr {pointer}, {t.vector('i64')} {offset.text}")

    def _gather(
        self, pointer: str, stride: Value, index: Value, old: Values, mask: Value
    ) -> Values:
        """An input of the lanes `index`; what was there in the other places."""
        t = self.t
        base = t.binary("mul", index, stride)
        out = np.empty(old.shape, object)
        for n, i in enumerate(np.ndindex(old.shape)):
            kind: str = old[i].kind  # pyright: ignore[reportAttributeAccessIssue]
            stored = "i8" if kind == "i1" else kind
            where = self._addresses(pointer, t.binary("add", base, t.constant(n, "i64")), kind)
            v, p = t.vector(stored), f"<{t.width} x ptr>"
            name = f"@llvm.masked.gather.{t.suffix(stored)}.v{t.width}p0"
            flags = f"{t.vector('i1')}"
            t.declared[name] = f"declare {v} {name}({p}, i32, {flags}, {v})"
            call = f"{p} {where}, i32 {_BYTES[stored]}, {flags} {mask.text}, {v} zeroinitializer"
            value = Value(t.raw(f"call {v} {name}({call})"), stored)
            if kind == "i1":
                value = t.binary("icmp ne", value, t.zero("i8"), "i1")
            out[i] = value
        return out

    def _scatter(
        self, pointer: str, index: Value, x: Values, mask: Value, base: Value | None = None
    ) -> None:
        """`x` of the lanes in `mask` to their places in an output."""
        t = self.t
        if base is None:
            base = t.binary("mul", index, t.constant(x.size, "i64"))
        for n, value in enumerate(x.ravel()):
            if value.kind == "i1":
                value = t.cast("zext", value, "i8")
            kind = value.kind
            where = self._addresses(pointer, t.binary("add", base, t.constant(n, "i64")), kind)
            v, p = t.vector(kind), f"<{t.width} x ptr>"
            name = f"@llvm.masked.scatter.{t.suffix(kind)}.v{t.width}p0"
            t.declared[name] = f"declare void {name}({v}, {p}, i32, {t.vector('i1')})"
            call = (
                f"{v} {value.text}, {p} {where}, i32 {_BYTES[kind]}, {t.vector('i1')} {mask.text}"
            )
            t.line(f"call void {name}({call})")

    def _store_row(
        self, outs: list[str], index: Value, mask: Value, place: Value, row: list[Values]
    ) -> None:
        """The row that a lane completed, where there is room for it."""
        t, rows = self.t, self.program.rows
        if not row:
            return
        fits = t.both(mask, t.binary("icmp slt", place, t.constant(rows, "i64"), "i1"))
        inside, after = t.label(), t.label()
        t.fork(t.any(fits), inside, after, rare=True)
        t.open(inside)
        self._put_row(outs, index, fits, place, row)
        t.line(f"br label %{after}")
        t.close()
        t.follow(after)

    def _put_row(
        self, outs: list[str], index: Value, mask: Value, place: Value, row: list[Values]
    ) -> None:
        t = self.t
        line = t.binary("add", t.binary("mul", index, t.constant(self.program.rows, "i64")), place)
        for pointer, x in zip(outs, row, strict=True):
            base = t.binary("mul", line, t.constant(x.size, "i64"))
            self._scatter(pointer, index, x, mask, base)

    def _fill(self, outs: list[str], index: Value, over: Value, filled: Value) -> None:
        """Rows that a lane did not come to: not a number."""
        t, program = self.t, self.program
        if not outs:
            return
        empty = []
        for aval in program.row_avals:
            kind = kind_of(aval.dtype)
            x = np.empty(aval.shape, object)
            x.fill(t.constant(float("nan") if is_float(kind) else 0, kind))
            empty.append(x)
        head, inside, after = t.label(), t.label(), t.label()
        before = t.block
        t.line(f"br label %{head}")
        t.open(head)
        place, following = Value(t.fresh(), "i64"), Value(t.fresh(), "i64")
        ways = f"[ {filled.text}, %{before} ], [ {following.text}, %{inside} ]"
        t.line(f"{place.text} = phi {t.vector('i64')} {ways}")
        room = t.binary("icmp slt", place, t.constant(program.rows, "i64"), "i1")
        room = t.both(over, room)
        t.fork(t.any(room), inside, after)
        t.open(inside)
        self._put_row(outs, index, room, place, empty)
        one = t.constant(1, "i64").text
        t.line(f"{following.text} = add {t.vector('i64')} {place.text}, {one}")
        t.line(f"br label %{head}")
        t.close()
        t.close()
        t.follow(after)

    def _run(
        self, jaxpr: ClosedJaxpr, args: list[Values], mask: Value
    ) -> tuple[list[Values], Value, Value, list[Values]]:
        """What `begin` or `step` gives: carry, whether the lane goes on, has a row, the row."""
        out: list[Any] = write(self.t, jaxpr.jaxpr, jaxpr.consts, args, mask)
        n = len(self.program.carry_avals)
        return out[:n], out[n][()], out[n + 1][()], out[n + 2 :]
