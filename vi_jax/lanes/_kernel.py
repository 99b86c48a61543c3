"""The text of a kernel: a machine function that runs one lane after another in each slot.

    void kernel(ptr inputs, ptr sizes, ptr outputs, i64 lanes, ptr next, ptr stop)

`inputs` and `outputs` are tables of pointers to arrays, one per leaf. `sizes` are the greatest
number of rows and the inputs' strides; one of 0 shares an input between all lanes. `next` counts
the lanes that all threads have taken; `stop` ends the call early.

The method of the same name writes each block (`docs/internals/lanes.md` has the picture):

    entry -> refill -> [begin ->] ready -> head -> look -> step -> head ...
                                                     look -> flush -> refill ...
    ready and head -> exit
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from jax.extend.core import ClosedJaxpr

from ._arrays import (
    MOST_IN_REGISTERS,
    Array,
    Formula,
    Registers,
    Strided,
    Table,
    contiguous,
    fill,
    gathered,
    in_lanes,
    mapped,
    place_of,
    replace,
    reserve,
    scattered,
    selected,
    splat,
    to_registers,
    uniform,
    write_for_each,
)
from ._operations import kind_of
from ._program import LaneProgram
from ._text import RARE, Text, Value, attributes, is_float
from ._vector import Functions, Unsupported, write

# The greatest memory for arrays per thread, a choice. Programs that need more run on XLA's backend,
# with a warning.
_MOST_BYTES = 4 << 30

# Bytes of a cache line, and of the widest register.
_LINE = 64

_PREAMBLE = """\
define void @kernel(ptr noalias readonly %inputs, ptr noalias readonly %sizes,
                    ptr noalias readonly %outputs, i64 %lanes, ptr %next, ptr %stop) #0 {
entry:"""


def kernel_text(
    program: LaneProgram, width: int, bits: int, one_for_all: tuple[bool, ...] = ()
) -> str:
    """Return LLVM's text of a program. Large inputs that lanes share are not copied."""
    return _Writer(program, width, one_for_all).text(bits)


class _Group(NamedTuple):
    """The values of a group's slots at one place of the kernel."""

    arrays: list[Any]
    """The lanes' inputs, then their carry. Large arrays have a fixed place in memory."""
    lane: Value
    """The number of each slot's lane; -1 for a slot without a lane."""
    rows: Value
    """The number of rows that the lane has completed."""
    active: Value
    """True while the lane continues."""

    def values(self) -> list[Value]:
        """Return all numbers in registers, in a fixed order."""
        numbers = (v for x in self.arrays if isinstance(x, Registers) for v in x.values.flat)
        return [*numbers, self.lane, self.rows, self.active]


class _Writer:
    """A kernel while it is written. The methods append blocks to `t` in the order of `text`."""

    def __init__(self, program: LaneProgram, width: int, one_for_all: tuple[bool, ...]):
        self.program = program
        self.t = Text(width)
        self.t.functions = Functions([program.begin, program.step, program.end])
        self.one_for_all = one_for_all or (False,) * len(program.in_avals)

    def text(self, bits: int) -> str:
        """Return the whole module. `bits` is the width of the registers that LLVM may use."""
        t = self.t
        self._entry()
        head, place = self._head()
        stepped, step_end = self._step(head)
        flush_end = self._flush(head)
        t.close()  # look
        t.close()  # head
        old, new = self._refill(head, flush_end)
        begun, begin_end = self._begin(old, new)
        ready = self._ready(old, begun, begin_end)
        # The head was written before the two blocks that lead to it.
        t.join(head.values(), (ready.values(), "ready"), (stepped.values(), step_end), at=place)
        if t.arena.size * t.width * 8 > _MOST_BYTES:
            raise Unsupported(f"{t.arena.size * t.width * 8 >> 30} GB for its arrays")
        claimed, released = allocation_lines(t)
        t.lines += ["exit:", *released, "  ret void", "}"]
        declared = t.declared.values()
        functions = t.functions.texts
        lines = [*declared, *functions, _PREAMBLE, *claimed, *t.lines, attributes(bits), RARE, ""]
        return "\n".join(lines)

    def _entry(self) -> None:
        """Write the code that runs once per thread: addresses of all arrays, and strides."""
        t, program = self.t, self.program
        results = len(program.out_avals)
        self.inputs = [load_pointer(t, "inputs", i) for i in range(len(program.in_avals))]
        self.strides = [load_stride(t, i) for i in range(len(program.in_avals))]
        outs = [load_pointer(t, "outputs", i) for i in range(results + len(program.row_avals))]
        self.results, self.rows = outs[:results], outs[results:]
        self.most_rows = load_row_count(t)
        self.large: list[Strided | None] = []
        for i, aval in enumerate((*program.in_avals, *program.carry_avals)):
            found = None
            if i < len(self.inputs) and self.one_for_all[i] and aval.size > MOST_IN_REGISTERS:
                found = shared_input(self.inputs[i], aval)
            elif aval.size > MOST_IN_REGISTERS:
                found = reserve(t, aval.shape, kind_of(aval.dtype))
            self.large.append(found)
        t.line("br label %refill")

    def _names(self) -> _Group:
        t, arrays = self.t, []
        avals = (*self.program.in_avals, *self.program.carry_avals)
        for aval, in_memory in zip(avals, self.large, strict=True):
            kind = kind_of(aval.dtype)
            new = lambda _, kind=kind: Value(t.fresh(), kind)
            arrays.append(in_memory or Registers.of(aval.shape, kind, new))
        index, filled = Value(t.fresh(), "i64"), Value(t.fresh(), "i64")
        return _Group(arrays, index, filled, Value(t.fresh(), "i1"))

    def _ended(self, group: _Group) -> tuple[Value, Value]:
        """Return the masks of slots with a lane, and of slots with a lane that has ended."""
        t = self.t
        present = t.binary("icmp sge", group.lane, t.zero("i64"), "i1")
        return present, t.both(present, t.inverse(group.active))

    def _head(self) -> tuple[_Group, int]:
        """Write `head` and `look`, which run in every iteration. They exit on `stop`, flush if a
        lane has ended, or step. Both blocks stay open, since `step` and `flush` use their values.
        Return the group, and the line at which to insert its phis."""
        t = self.t
        t.open("head")
        group, place = self._names(), len(t.lines)
        ended = t.any(self._ended(group)[1])
        halt = t.raw("load volatile i8, ptr %stop")
        halted = t.raw(f"icmp ne i8 {halt}, 0")
        t.fork(halted, "exit", "look", rare=True)
        t.open("look")
        t.fork(ended, "flush", "step", rare=True)
        return group, place

    def _step(self, group: _Group) -> tuple[_Group, str]:
        """Advance all lanes and store their rows. Return the new group and the last block."""
        t = self.t
        t.open("step")
        active, n = group.active, len(self.inputs)
        own = group.arrays[n:]
        carry, going, complete, row = self._run(self.program.step, group.arrays, active, own)
        going = t.both(active, going)
        complete = t.both(active, complete)
        self._store_row(group.lane, complete, group.rows, row)
        rows = t.binary("add", group.rows, t.cast("zext", complete, "i64"))
        replace(t, group.arrays[n:], carry)
        end = t.block
        t.line("br label %head")
        t.close()
        return _Group([*group.arrays[:n], *carry], group.lane, rows, going), end

    def _flush(self, group: _Group) -> str:
        """Store the results of lanes that have ended. Return the last block."""
        t, end = self.t, self.program.end
        t.open("flush")
        present, ended = self._ended(group)
        out = write(t, end, group.arrays, present)
        for pointer, x in zip(self.results, out, strict=True):
            base = t.binary("mul", group.lane, t.constant(x.size, "i64"))
            scatter(t, pointer, base, x, ended)
        self._fill(group.lane, ended, group.rows)
        block = t.block
        t.line("br label %refill")
        t.close()
        return block

    def _refill(self, head: _Group, flush_end: str) -> tuple[_Group, Value]:
        """Assign lanes to free slots. Return the group, and the mask of slots with new lanes."""
        t = self.t
        t.open("refill")
        old = self._names()
        nothing = [t.zero(v.kind) for v in old.values()]
        nothing[-3] = t.constant(-1, "i64")  # no lane
        t.join(old.values(), (nothing, "entry"), (head.values(), flush_end))
        free = t.inverse(old.active)
        flags = t.raw(f"bitcast {t.vector('i1')} {free.text} to i{t.width}")
        t.declared["@llvm.ctpop"] = f"declare i{t.width} @llvm.ctpop.i{t.width}(i{t.width})"
        number = t.raw(f"call i{t.width} @llvm.ctpop.i{t.width}(i{t.width} {flags})")
        number = t.raw(f"zext i{t.width} {number} to i64")
        first = t.raw(f"atomicrmw add ptr %next, i64 {number} monotonic")
        rank = self._flags_before(free)
        following = t.binary("add", splat(t, first, "i64"), rank)
        total = splat(t, "%lanes", "i64")
        new = t.both(free, t.binary("icmp slt", following, total, "i1"))
        lane = t.select(free, t.select(new, following, t.constant(-1, "i64")), old.lane)
        t.fork(t.any(new), "begin", "ready")
        return old._replace(lane=lane), new

    def _flags_before(self, flag: Value) -> Value:
        t = self.t
        ones = t.cast("zext", flag, "i64")
        # Prefix sums, by shifts of 1, 2, 4, … slots.
        v, shift, sums = t.vector("i64"), 1, ones
        while shift < t.width:
            mask = ", ".join(f"i32 {i - shift if i >= shift else t.width}" for i in range(t.width))
            mask = f"<{t.width} x i32> <{mask}>"
            moved = t.raw(f"shufflevector {v} {sums.text}, {v} zeroinitializer, {mask}")
            sums = t.binary("add", sums, Value(moved, "i64"))
            shift *= 2
        return t.binary("sub", sums, ones)

    def _begin(self, old: _Group, new: Value) -> tuple[_Group, str]:
        """Initialize the lanes in the slots `new`. Return the group and the last block."""
        t = self.t
        t.open("begin")
        n = len(self.inputs)
        read = [self._read_input(i, x, old.lane, new) for i, x in enumerate(old.arrays[:n])]
        carry, going, complete, row = self._run(self.program.begin, read, new)
        complete = t.both(new, complete)
        self._store_row(old.lane, complete, t.zero("i64"), row)
        rows = t.select(new, t.cast("zext", complete, "i64"), old.rows)
        replace(t, old.arrays[n:], carry, new)
        arrays = [
            selected(t, new, x, y) if isinstance(y, Registers) else y
            for x, y in zip([*read, *carry], old.arrays, strict=True)
        ]
        active = t.select(new, going, old.active)
        end = t.block
        t.line("br label %ready")
        t.close()
        return _Group(arrays, old.lane, rows, active), end

    def _read_input(self, i: int, old: Array, lane: Value, new: Value) -> Array:
        t, base = self.t, self.t.binary("mul", lane, self.strides[i])
        read = gathered_array(t, self.inputs[i], base, self.program.in_avals[i], new)
        if isinstance(old, Registers):
            return to_registers(t, read)
        if not self.one_for_all[i]:
            assert isinstance(old, Strided)
            fill(t, old, selected(t, new, read, old))
        return old

    def _ready(self, old: _Group, begun: _Group, begin_end: str) -> _Group:
        """Merge the group with and without new lanes; exit if no slot has a lane."""
        t = self.t
        t.follow("ready")

        def either(a: Value, b: Value) -> Value:
            return t.phi(a.kind, (a.text, begin_end), (b.text, "refill"))

        arrays = [
            mapped(t, either, a, b) if isinstance(b, Registers) else b
            for a, b in zip(begun.arrays, old.arrays, strict=True)
        ]
        rows, active = either(begun.rows, old.rows), either(begun.active, old.active)
        any_lane = t.any(t.binary("icmp sge", old.lane, t.zero("i64"), "i1"))
        t.fork(any_lane, "head", "exit")
        return _Group(arrays, old.lane, rows, active)

    def _run(
        self, jaxpr: ClosedJaxpr, args: list[Any], mask: Value, owned: list[Any] | None = None
    ) -> tuple[list[Any], Value, Value, list[Any]]:
        """Return results of `begin` or `step`: carry, flags (lane continues, has a row), row. Large
        arrays that are `owned` may be changed in place."""
        out: list[Any] = write(self.t, jaxpr, args, mask, owned or ())
        n = len(self.program.carry_avals)
        return out[:n], out[n].item(), out[n + 1].item(), out[n + 2 :]

    # Rows

    def _store_row(self, lane: Value, mask: Value, place: Value, row: list[Any]) -> None:
        """Store row number `place` where `mask` holds and the lane has room for it."""
        t = self.t
        if not row:
            return
        fits = t.both(mask, t.binary("icmp slt", place, self.most_rows, "i1"))
        with t.skipped_unless(fits, rare=True):
            self._put_row(lane, fits, place, row)

    def _put_row(self, lane: Value, mask: Value, place: Value, row: list[Any]) -> None:
        t = self.t
        line = t.binary("add", t.binary("mul", lane, self.most_rows), place)
        for pointer, x in zip(self.rows, row, strict=True):
            scatter(t, pointer, t.binary("mul", line, t.constant(x.size, "i64")), x, mask)

    def _fill(self, lane: Value, ended: Value, filled: Value) -> None:
        """Fill the rows that a lane did not reach, from `filled` on, with NaN (0 for integers)."""
        t, program = self.t, self.program
        if not self.rows:
            return
        empty = []
        for aval in program.row_avals:
            kind = kind_of(aval.dtype)
            nothing = t.constant(float("nan") if is_float(kind) else 0, kind)
            empty.append(to_registers(t, uniform(aval.shape, nothing)))
        over_rows(
            t, filled, self.most_rows, ended, lambda n, mask: self._put_row(lane, mask, n, empty)
        )


# --- loads and stores of lanes' numbers in XLA's arrays


def load_pointer(t: Text, table: str, i: int) -> str:
    place = t.raw(f"getelementptr ptr, ptr %{table}, i64 {i}")
    return t.raw(f"load ptr, ptr {place}")


def load_stride(t: Text, i: int) -> Value:
    """Return the numbers per lane of input `i` (0 for a shared one), as a vector over the lanes."""
    place = t.raw(f"getelementptr i64, ptr %sizes, i64 {i + 1}")
    return splat(t, t.raw(f"load i64, ptr {place}"), "i64")


def load_row_count(t: Text) -> Value:
    """Return the greatest number of rows, as a vector over the lanes."""
    return splat(t, t.raw("load i64, ptr %sizes"), "i64")


def gathered_array(t: Text, pointer: str, base: Value, aval: Any, mask: Value) -> Formula:
    """Return an array of each slot, read at each use where `mask` holds, else zero. `base` is the
    index of its first number in the arrays of all lanes."""
    steps, kind = contiguous(aval.shape), kind_of(aval.dtype)

    def number(index) -> Value:
        place = t.binary("add", base, in_lanes(t, place_of(t, index, steps)))
        return gathered(t, pointer, place, kind, mask)

    return Formula(tuple(aval.shape), kind, number)


def shared_input(pointer: str, aval: Any) -> Strided:
    return Strided(aval.shape, kind_of(aval.dtype), Table(pointer), contiguous(aval.shape))


def scatter(t: Text, pointer: str, base: Value, x: Array, mask: Value) -> None:
    """Store `x` of the lanes in `mask`; `base` is the index of each lane's first number."""

    steps = contiguous(x.shape)

    def put(i) -> None:
        value = x.at(t, i)
        place = t.binary("add", base, in_lanes(t, place_of(t, i, steps)))
        scattered(t, pointer, place, value, mask)

    write_for_each(t, x, put)


def over_rows(
    t: Text, first: Value, number: Value, mask: Value, body: Callable[[Value, Value], None]
) -> None:
    """Write a loop over the rows of each lane, beginning at that lane's first row. `body` gets each
    slot's row and the mask of slots that have it."""
    head, inside, after, before = t.label(), t.label(), t.label(), t.block
    t.line(f"br label %{head}")
    t.open(head)
    at, place, following = len(t.lines), Value(t.fresh(), "i64"), Value(t.fresh(), "i64")
    has_row = t.both(mask, t.binary("icmp slt", place, number, "i1"))
    t.fork(t.any(has_row), inside, after)
    t.open(inside)
    body(place, has_row)
    one = t.constant(1, "i64").text
    t.line(f"{following.text} = add {t.vector('i64')} {place.text}, {one}")
    t.join([place], ([first], before), ([following], t.block), at=at)
    t.line(f"br label %{head}")
    t.close()
    t.close()
    t.follow(after)


def allocation_lines(t: Text) -> tuple[list[str], list[str]]:
    """Return the lines that allocate and free memory for large arrays, aligned to a cache line."""
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
