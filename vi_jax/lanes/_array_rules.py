"""Rules of primitives that rearrange, index, reduce or multiply whole arrays.

They return arrays of any kind. The caller puts small ones into registers (`to_registers`).
Rearranging registers costs nothing at run time, since it is done while the text is written.
"""

import functools
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np

from ._arrays import (
    MOST_IN_REGISTERS,
    Array,
    Formula,
    Index,
    Pieces,
    Registers,
    Strided,
    addressable,
    computed,
    contiguous,
    fill,
    in_lanes,
    is_cheap,
    joined_cuts,
    mapped,
    plus,
    reserve,
    same,
    selected,
    stored,
    times,
    to_registers,
    uniform,
    without_cuts,
    write_for_each,
    write_loop,
    write_loops,
)
from ._operations import (
    ELEMENTWISE,
    Rule,
    add,
    compare,
    convert,
    is_unsigned,
    kind_of,
    mul,
    register,
    weighted,
)
from ._text import Text, Value

STRUCTURAL: dict[str, Rule] = {}
"""Rules with the arguments `t`, the `Text`; `p`, the parameters of the equation; `avals`, the
shapes and types of its results; an `Array` for each argument. Results: one or more `Array`s."""

PLACED: dict[str, Rule] = {}
"""Rules that also take the types of the arguments, which tell signed indices from unsigned ones.
The arguments are `t`, `p`, `avals`, `d` and the arrays."""

structural = partial(register, STRUCTURAL)
placed = partial(register, PLACED)


# --- views


class _AxisMap(NamedTuple):
    """The indices along one axis of an array, as a linear function of indices of another shape."""

    axis: int | None
    """The corresponding axis of the new shape; `None` if the index is constant."""
    step: int = 1
    begin: int = 0

    def place(self, t: Text, index: Sequence[Index]) -> Index:
        if self.axis is None:
            return self.begin
        return plus(t, times(t, index[self.axis], self.step), self.begin)


def _viewed(t: Text, x: Array, shape: Sequence[int], maps: Sequence[_AxisMap]) -> Array:
    """Return a view of an array's numbers in another shape."""
    cuts: dict[int, set[int]] = {}
    if any(maps[a].step != 1 for a in x.cuts):
        x = stored(t, x)
    for a, places in x.cuts.items():
        if (axis := maps[a].axis) is not None:
            cuts.setdefault(axis, set()).update(n - maps[a].begin for n in places)
    if isinstance(x, Formula) and x.value is not None:
        return uniform(shape, x.value)
    if isinstance(x, Strided):
        steps, offset = [0] * len(shape), 0
        for stride, axis_map in zip(x.strides, maps, strict=True):
            offset += stride * axis_map.begin
            if axis_map.axis is not None:
                steps[axis_map.axis] += stride * axis_map.step
        return x.viewed(t, shape, steps, offset)
    new_cuts = {a: frozenset(n for n in ns if 0 < n < shape[a]) for a, ns in cuts.items()}
    number = lambda i: x.at(t, tuple(axis_map.place(t, i) for axis_map in maps))
    return Formula(tuple(shape), x.kind, number, is_cheap(x), cuts=new_cuts)


@structural("reshape", "squeeze", "expand_dims")
def _(t, p, avals, x):
    return reshaped(t, x, avals[0].shape)


def reshaped(t: Text, x: Array, shape: tuple[int, ...]) -> Array:
    if isinstance(x, Registers):
        return Registers(x.values.reshape(shape), x.kind)
    old, new = ([i for i, n in enumerate(s) if n != 1] for s in (x.shape, shape))
    if [x.shape[i] for i in old] == [shape[i] for i in new]:
        axes = dict(zip(old, new, strict=True))
        return _viewed(t, x, shape, [_AxisMap(axes.get(a)) for a in range(x.ndim)])
    if not isinstance(x, Strided) or [x.strides[i] for i in old] != [
        contiguous(x.shape)[i] for i in old
    ]:
        x = stored(t, x)
    return x.viewed(t, shape, contiguous(shape))


@structural("transpose")
def _(t, p, avals, x):
    return transposed(t, x, p["permutation"])


def transposed(t: Text, x: Array, order: Sequence[int]) -> Array:
    order = list(order)
    maps = [_AxisMap(order.index(a)) for a in range(x.ndim)]
    return _viewed(t, x, [x.shape[a] for a in order], maps)


@structural("rev")
def _(t, p, avals, x):
    axes = p["dimensions"]
    maps = [_AxisMap(a, -1, n - 1) if a in axes else _AxisMap(a) for a, n in enumerate(x.shape)]
    return _viewed(t, x, x.shape, maps)


@structural("slice")
def _(t, p, avals, x):
    # The transposes of JAX have NumPy integers here.
    pairs = zip(p["strides"] or [1] * x.ndim, p["start_indices"], strict=True)
    maps = [_AxisMap(a, int(step), int(begin)) for a, (step, begin) in enumerate(pairs)]
    return _viewed(t, x, avals[0].shape, maps)


def part_along(t: Text, x: Array, axis: int, begin: int, end: int) -> Array:
    shape = [end - begin if a == axis else n for a, n in enumerate(x.shape)]
    return _viewed(t, x, shape, [_AxisMap(a, 1, begin if a == axis else 0) for a in range(x.ndim)])


@structural("split")
def _(t, p, avals, x):
    x, axis = computed(t, x), p["axis"]
    ends = np.cumsum([0, *(aval.shape[axis] for aval in avals)]).tolist()
    return tuple(part_along(t, x, axis, begin, end) for begin, end in pairwise(ends))


@structural("unstack")
def _(t, p, avals, x):
    x, axis, shape = computed(t, x), p["axis"], avals[0].shape
    return tuple(reshaped(t, part_along(t, x, axis, i, i + 1), shape) for i in range(len(avals)))


@structural("empty2")
def _(t, p, avals):
    return uniform(avals[0].shape, t.zero(kind_of(avals[0].dtype)))


@structural("broadcast_in_dim")
def _(t, p, avals, x, *sizes):
    shape, where = tuple(p["shape"]), p["broadcast_dimensions"]
    size = int(np.prod(shape, dtype=int))
    if size > MOST_IN_REGISTERS:
        x = addressable(t, x)
    if x.size < size:  # else each number is used once
        x = computed(t, x)
    pairs = zip(where, x.shape, strict=True)
    return _viewed(t, x, shape, [_AxisMap(a if n != 1 else None) for a, n in pairs])


def select_parts(t: Text, flag: Value, a: Array, b: Array) -> Array | None:
    """Return the first array if a flag holds, else the second, by selecting the parts that differ,
    such as one changed number of a state. Return `None` unless one axis, and only one, has cuts."""
    cuts = joined_cuts(a.cuts, b.cuts)
    if len(cuts) != 1:
        return None
    ((axis, places),) = cuts.items()
    parts = []
    for begin, end in pairwise(sorted({0, a.shape[axis], *places})):
        x, y = (_piece(t, z, axis, begin, end) for z in (a, b))
        part = x if same(x, y) else to_registers(t, selected(t, flag, x, y))
        parts.append(part)
    return Pieces(a.shape, a.kind, axis, tuple(parts))


def _piece(t: Text, x: Array, axis: int, begin: int, end: int) -> Array:
    """Return a part of an axis, from the array that it was concatenated from if there is one."""
    first = 0
    for part in x.parts if isinstance(x, Pieces) and x.axis == axis else ():
        size = part.shape[axis]
        if first <= begin and end <= first + size:
            return _piece(t, part, axis, begin - first, end - first)
        first += size
    return part_along(t, addressable(t, x), axis, begin, end)


# --- concatenated arrays


@structural("concatenate")
def _(t, p, avals, *xs):
    parts = tuple(x for x in xs if x.size)
    return Pieces(avals[0].shape, kind_of(avals[0].dtype), p["dimension"], parts)


@structural("stack")
def _(t, p, avals, *xs):
    axis, aval = p["axis"], avals[0]
    shape = (*aval.shape[:axis], 1, *aval.shape[axis + 1 :])
    parts = [reshaped(t, x, shape) for x in xs]
    return Pieces(aval.shape, kind_of(aval.dtype), axis, tuple(parts))


@structural("pad")
def _(t, p, avals, x, value):
    number = value.at(t, ())
    if any(inside for _, _, inside in p["padding_config"]):
        x = _spread(t, p["padding_config"], x, number)
    for axis, (low, high, _) in enumerate(p["padding_config"]):
        low, high = int(low), int(high)
        before, after = (
            uniform([max(0, n) if a == axis else m for a, m in enumerate(x.shape)], number)
            for n in (low, high)
        )
        size = max(0, low) + x.shape[axis] + max(0, high)
        shape = tuple(size if a == axis else m for a, m in enumerate(x.shape))
        x = Pieces(shape, value.kind, axis, tuple(y for y in (before, x, after) if y.size))
        if min(low, high) < 0:  # negative padding cuts off
            x = part_along(t, x, axis, max(0, -low), size + min(0, high))
    return x


def _spread(t: Text, config: Sequence[tuple[int, int, int]], x: Array, number: Value) -> Array:
    between = [int(inside) for _, _, inside in config]
    shape = [max(0, (n - 1) * (i + 1) + 1) for n, i in zip(x.shape, between, strict=True)]
    whole = uniform(shape, number)
    if isinstance(x, Registers) and whole.size <= MOST_IN_REGISTERS:
        out = to_registers(t, whole)
        out.values[tuple(slice(None, None, i + 1) for i in between)] = x.values
        return out
    out = stored(t, whole)
    steps = [(i + 1) * s for i, s in zip(between, out.strides, strict=True)]
    fill(t, out.viewed(t, x.shape, steps), x)
    return out


@structural("iota")
def _(t, p, avals, *sizes):
    kind, axis = kind_of(p["dtype"]), p["dimension"]
    number = lambda index: convert(t, in_lanes(t, index[axis]), kind, False)
    return Formula(tuple(p["shape"]), kind, number, cheap=True)


# --- indices that depend on data


def _clipped(t: Text, given: Value, dtype: Any, greatest: int) -> tuple[Index, Value]:
    """Return an index clipped to the range from 0 to `greatest`, and whether it was in it."""
    place = convert(t, given, "i64", is_unsigned(dtype))
    if place.number is not None:
        inside = 0 <= int(place.number) <= greatest
        return min(max(int(place.number), 0), greatest), t.constant(inside, "i1")
    last = t.constant(greatest, "i64")
    low = compare(t, "ge", place, t.zero("i64"), False)
    high = compare(t, "le", place, last, False)
    inside = t.both(low, high)
    return t.select(low, t.select(high, place, last), t.zero("i64")), inside


def _starts(t: Text, starts, dtypes, sizes, shape) -> list[Index]:
    """Return the first indices of a block of `sizes`, clipped so that it lies in the array."""
    return [
        _clipped(t, s.at(t, ()), d, n - m)[0]
        for s, d, m, n in zip(starts, dtypes, sizes, shape, strict=True)
    ]


@placed("dynamic_slice")
def _(t, p, avals, d, x, *starts):
    begin, x = _starts(t, starts, d[1:], p["slice_sizes"], x.shape), without_cuts(t, x)
    number = lambda index: x.at(t, [plus(t, i, j) for i, j in zip(index, begin, strict=True)])
    return Formula(tuple(avals[0].shape), x.kind, number)


@placed("dynamic_update_slice")
def _(t, p, avals, d, x, update, *starts, mask=None):
    begin, axes = _starts(t, starts, d[2:], update.shape, x.shape), range(x.ndim)
    if all(isinstance(i, int) for i in begin):
        update = computed(t, update)
    inside = t.constant(True, "i1")
    return _with_blocks(t, x, update, axes, axes, lambda _: ([*begin], inside), None, mask)


IN_PLACE = ("dynamic_update_slice", "scatter")
"""The primitives whose rules have a keyword argument `mask`: with it they change an array in memory
in place, in these lanes, and its old numbers must not be used any more."""


def _patched(t: Text, x: Array, window: Sequence[tuple[int, int]], new: Callable) -> Pieces | None:
    """Return a large array with other numbers in a window, without a copy. The window is the first
    index and the size along each axis; `new` maps an index in it to a number. `None` unless it
    covers all axes but one completely."""
    axes = [a for a, (_, n) in enumerate(window) if n != x.shape[a]]
    if len(axes) != 1 or isinstance(x, Registers):
        return None
    axis, shape = axes[0], tuple(n for _, n in window)
    begin, size = window[axis]
    parts: list[Array] = [part_along(t, x, axis, 0, begin)] if begin else []
    parts.append(to_registers(t, Formula(shape, x.kind, new)))
    if begin + size < x.shape[axis]:
        parts.append(part_along(t, x, axis, begin + size, x.shape[axis]))
    return Pieces(x.shape, x.kind, axis, tuple(parts))


def _copy(t: Text, x: Array, in_memory: bool) -> Registers | Strided:
    if in_memory or not isinstance(x, Registers):
        return stored(t, x)
    return Registers(x.values.copy(), x.kind)


class _IndexedBlocks(NamedTuple):
    """Blocks of an array at indices that depend on data."""

    indices: Array
    dtype: Any
    axes: Sequence[int]
    """The axes for which the last axis of `indices` holds the index."""
    batched: Sequence[tuple[int, int]]
    """Pairs of an axis of the array and an axis of `indices` that have the same index."""
    greatest: Sequence[int]
    """The greatest first index of a block, along each axis."""
    clipped: bool
    """True if a block outside the array is moved into it."""

    def corner(self, t: Text, batch: Sequence[Index]) -> tuple[list[Index], Value]:
        """Return the first indices of the block at `batch` in `indices`, clipped to the array, and
        whether the block is valid: it was inside, or such blocks are clipped."""
        place: list[Index] = [0] * len(self.greatest)
        for a, b in self.batched:
            place[a] = batch[b]
        inside = t.constant(True, "i1")
        for k, a in enumerate(self.axes):
            given = self.indices.at(t, (*batch, k))
            place[a], is_inside = _clipped(t, given, self.dtype, self.greatest[a])
            inside = inside if self.clipped else t.both(inside, is_inside)
        return place, inside


@placed("gather")
def _(t, p, avals, d, x, indices):
    n, aval, x, indices = (
        p["dimension_numbers"],
        avals[0],
        without_cuts(t, x),
        without_cuts(t, indices),
    )
    removed = (*n.collapsed_slice_dims, *n.operand_batching_dims)
    inner = [a for a in range(x.ndim) if a not in removed]

    blocks = _IndexedBlocks(
        indices, d[1], n.start_index_map,
        tuple(zip(n.operand_batching_dims, n.start_indices_batching_dims, strict=True)),
        [size - length for size, length in zip(x.shape, p["slice_sizes"], strict=True)],
        "FILL" not in str(p["mode"]),
    )  # fmt: skip

    def number(index: tuple[Index, ...]) -> Value:
        place, inside = blocks.corner(t, [i for a, i in enumerate(index) if a not in n.offset_dims])
        for a, i in zip(inner, [index[o] for o in n.offset_dims], strict=True):
            place[a] = plus(t, place[a], i)
        outside = t.constant(_fill_value(p["fill_value"], aval.dtype), x.kind)
        return t.select(inside, x.at(t, place), outside)

    return Formula(tuple(aval.shape), x.kind, number)


def _fill_value(given, dtype):
    """Return JAX's value for a number from outside an array."""
    if given is not None:
        return given
    dtype = np.dtype(dtype)
    if dtype.kind == "f":
        return float("nan")
    if dtype.kind == "b":
        return True
    return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max


def _scatter(
    how: str | None, t: Text, p: dict, avals, dtypes, x: Array, indices, update,
    mask: Value | None = None,
) -> Array:  # fmt: skip
    """Return an array with numbers written at indices that depend on data, or combined by the rule
    `how`. Numbers outside the array are dropped, unless the mode is to clip."""
    d = p["dimension_numbers"]
    removed = (*d.inserted_window_dims, *d.operand_batching_dims)
    inner, axes = [a for a in range(x.ndim) if a not in removed], d.update_window_dims
    sizes = dict(zip(inner, [update.shape[o] for o in axes], strict=True))
    blocks = _IndexedBlocks(
        without_cuts(t, indices), dtypes[1], d.scatter_dims_to_operand_dims,
        tuple(zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True)),
        [n - sizes.get(a, 1) for a, n in enumerate(x.shape)], "CLIP" in str(p["mode"]),
    )  # fmt: skip
    combined = partial(ELEMENTWISE[how], t, {}, dtypes) if how else None
    corner = partial(blocks.corner, t)
    return _with_blocks(t, x, computed(t, update), inner, axes, corner, combined, mask)


def _with_blocks(
    t: Text, x: Array, update: Array, inner: Sequence[int], axes: Sequence[int],
    corner: Callable, combined: Callable[[Value, Value], Value] | None = None,
    mask: Value | None = None,
) -> Array:  # fmt: skip
    """Return an array with blocks of other numbers. They extend along its axes `inner`, which
    correspond to `axes` of `update`. `corner` maps indices along the other axes of `update` to the
    first indices of a block and whether it is valid. `combined` gets the old number and that of
    `update`, which by default replaces it. With a `mask` see `IN_PLACE`."""
    sizes = dict(zip(inner, [update.shape[o] for o in axes], strict=True))
    others = [n for o, n in enumerate(update.shape) if o not in axes]
    if mask is None and int(np.prod(others, dtype=int)) == 1:
        first, inside = corner([0] * len(others))
        if all(isinstance(i, int) for i in first) and inside.number:
            window = [(i, sizes.get(a, 1)) for a, i in enumerate(first)]

            def changed(index: tuple[Index, ...]) -> Value:
                place_in_update: list[Index] = [0] * update.ndim
                for a, o in zip(inner, axes, strict=True):
                    place_in_update[o] = index[a]
                if combined is None:
                    return update.at(t, place_in_update)
                old = x.at(t, [plus(t, i, b) for i, (b, _) in zip(index, window, strict=True)])
                return combined(old, update.at(t, place_in_update))

            found = _patched(t, x, window, changed)
            if found is not None:
                return found
    out: Any = x
    if mask is None:
        out = _copy(t, x, not isinstance(update, Registers))
    else:
        update = update if isinstance(update, Registers) else stored(t, update)

    def put(index: tuple[Index, ...]) -> None:
        place, inside = corner([i for o, i in enumerate(index) if o not in axes])
        for a, i in zip(inner, [index[o] for o in axes], strict=True):
            place[a] = plus(t, place[a], i)
        value = update.at(t, index)
        if mask is not None:
            return out.put(t, place, value, t.both(mask, inside))
        new = lambda old: value if combined is None else combined(old, value)
        put_at(t, out, place, lambda old: t.select(inside, new(old), old))

    write_for_each(t, update, put)
    return out


def put_at(t: Text, x: Registers | Strided, place: Sequence[Index], new: Callable) -> None:
    """Change the number of an array at an index; in registers, by `select` at all possible ones."""
    if isinstance(x, Strided):
        return x.put(t, place, new(x.at(t, place)))
    for candidate in np.ndindex(x.shape):
        match = t.constant(True, "i1")
        for i, n in zip(place, candidate, strict=True):
            if isinstance(i, int):
                match = t.both(match, t.constant(i == n, "i1"))
            else:
                equal = t.binary("icmp eq", in_lanes(t, i), t.constant(n, "i64"), "i1")
                match = t.both(match, equal)
        if match.number is None or match.number:
            x.values[candidate] = t.select(match, new(x.values[candidate]), x.values[candidate])


PLACED["scatter"] = partial(_scatter, None)
for _name in ("add", "mul", "sub", "min", "max"):
    # JAX 0.10.2 writes some of them with an underscore.
    for _dash in "-_":
        PLACED[f"scatter{_dash}{_name}"] = partial(_scatter, _name)


# --- reductions

# The number of partial sums of a long sum. The additions of one partial sum wait for each other: a
# fused multiply-add takes four cycles, and two begin in each cycle.
_SUMS = 8


# The greatest number of loops written in place. It bounds the text's length and its compile time.
_MOST_LOOPS = 4


def reduced(
    t: Text, number: int, term: Callable[[Index], Value], combine: Callable, empty: Value,
    *, in_order: bool = False,
) -> Value:  # fmt: skip
    """Return a reduction of all terms, in several partial results unless `in_order`; `empty` is the
    result for no terms."""
    if number == 0:
        return empty
    if in_order:
        return functools.reduce(combine, map(term, range(number)))
    chains = _SUMS if number >= 2 * _SUMS else 1
    iterations, rest = divmod(number, chains)
    first = [term(j) for j in range(chains)]

    def iteration(i: Index, carry: list[Value]) -> list[Value]:
        begin = times(t, plus(t, i, 1), chains)
        return [combine(c, term(plus(t, begin, j))) for j, c in enumerate(carry)]

    found = write_loop(t, iterations - 1, iteration, first)
    found = [*found, *(term(iterations * chains + j) for j in range(rest))]
    while len(found) > 1:
        pairs = [combine(a, b) for a, b in zip(found[::2], found[1::2], strict=False)]
        found = pairs + found[len(pairs) * 2 :]
    return found[0]


def _reduce(rule: str, empty: int, t: Text, p: dict, avals, x: Array) -> Array:
    """Reduce an array along some axes by `rule`; `empty` is the result for no numbers."""
    ((aval,), axes), in_order = (avals, tuple(map(int, p["axes"]))), isinstance(x, Registers)
    kind, both = kind_of(aval.dtype), partial(ELEMENTWISE[rule], t, {}, [aval.dtype])
    x = _grouped(t, x, (*([a] for a in range(x.ndim) if a not in axes), axes))

    def number(index):
        term, none = lambda i: x.at(t, (*index, i)), t.constant(empty, kind)
        return reduced(t, x.shape[-1], term, both, none, in_order=in_order)

    if in_order:
        return Registers.of(aval.shape, kind, number)
    # Each number is a loop. A few loops are written at the places of use.
    formula = Formula(tuple(aval.shape), kind, number)
    return formula if formula.size <= _MOST_LOOPS else stored(t, formula)


def _grouped(t: Text, x: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Return an array with its axes reordered and each group of them merged."""
    x = stored(t, x) if x.cuts else x
    order = [a for group in groups for a in group]
    if order != list(range(x.ndim)):
        x = to_registers(t, transposed(t, x, order))
    sizes = iter(x.shape)
    shape = tuple(int(np.prod([next(sizes) for _ in group], dtype=int)) for group in groups)
    return reshaped(t, x, shape)


def _cumulate(name: str, t: Text, p: dict, avals, x: Array) -> Array:
    combine = partial(ELEMENTWISE[name], t, {}, [avals[0].dtype])
    if isinstance(x, Registers):
        out = np.moveaxis(x.values, p["axis"], 0).copy()
        out = out[::-1] if p["reverse"] else out
        for i in range(1, len(out)):
            before, here = (Registers(out[n : n + 1], x.kind) for n in (i - 1, i))
            out[i : i + 1] = mapped(t, combine, before, here).values
        out = out[::-1] if p["reverse"] else out
        return Registers(np.moveaxis(out, 0, p["axis"]), x.kind)
    x = without_cuts(t, x)
    axis, out = p["axis"], reserve(t, x.shape, x.kind)
    length = x.shape[axis]
    others = [1 if a == axis else n for a, n in enumerate(x.shape)]

    def cumulate(index: tuple[Index, ...]) -> None:
        def put(i: Index, before: Value | None) -> Value:
            place = plus(t, length - 1, times(t, i, -1)) if p["reverse"] else i
            whole = (*index[:axis], place, *index[axis + 1 :])
            value = x.at(t, whole)
            value = value if before is None else combine(before, value)
            out.put(t, whole, value)
            return value

        first = put(0, None)
        write_loop(t, length - 1, lambda i, carry: [put(plus(t, i, 1), carry[0])], [first])

    write_loops(t, others, cumulate)
    return out


for _name, _how in {"sum": "add", "prod": "mul", "max": "max", "min": "min"}.items():
    STRUCTURAL["reduce_" + _name] = partial(_reduce, _how, int(_how == "mul"))
    STRUCTURAL["cum" + _name] = partial(_cumulate, _how)
STRUCTURAL["reduce_and"] = partial(_reduce, "and", 1)
STRUCTURAL["reduce_or"] = partial(_reduce, "or", 0)


def any_in(t: Text, x: Array) -> Value:
    if not x.ndim:
        return x.at(t, ())
    axes, flag = {"axes": tuple(range(x.ndim))}, jax.ShapeDtypeStruct((), bool)
    return to_registers(t, STRUCTURAL["reduce_or"](t, axes, [flag], x)).at(t, ())


# --- products


def _dot(t: Text, p: dict, avals, a: Array, b: Array, product: Callable) -> Array:
    """Return a product of arrays with `product` as the product of two numbers."""
    (over_a, over_b), (batch_a, batch_b) = p["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*over_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*over_b, *batch_b)]
    kind, groups = kind_of(avals[0].dtype), ((batch_a, free_a, over_a), (batch_b, free_b, over_b))
    in_order = avals[0].size <= MOST_IN_REGISTERS and all(isinstance(x, Registers) for x in (a, b))
    # In a product with a vector each number of the matrix is used once.
    once_a, once_b = (
        int(np.prod([x.shape[i] for i in free], dtype=int)) == 1
        for x, free in ((b, free_b), (a, free_a))
    )
    left, right = (
        _grouped(t, x if in_order else addressable(t, x if once else computed(t, x)), group)
        for x, once, group in zip((a, b), (once_a, once_b), groups, strict=True)
    )
    shape, length = (left.shape[0], left.shape[1], right.shape[1]), left.shape[2]

    def term(i: tuple[Index, ...], k: Index) -> Value:
        return product(t, left.at(t, (i[0], i[1], k)), right.at(t, (i[0], i[2], k)))

    if in_order:
        number = lambda i: reduced(
            t, length, partial(term, i), partial(add, t), t.zero(kind), in_order=True
        )
        found = Registers.of(shape, kind, number)
    elif length == 1:  # no sum
        found = Formula(shape, kind, lambda i: t.opaque(term(i, 0)))
    else:
        found = _product(t, left, right, shape, kind, product)
    return reshaped(t, found, avals[0].shape)


def _product(t: Text, left: Array, right: Array, shape, kind: str, product: Callable) -> Array:
    """Multiply arrays of shapes (batch, n, k) and (batch, m, k), several rows at once."""
    batch, rows, columns = shape
    swapped = columns > rows
    if swapped:
        left, right, rows, columns = right, left, columns, rows
    multiplied = (lambda x, y: product(t, y, x)) if swapped else partial(product, t)
    out, length, zero = reserve(t, shape, kind), left.shape[2], t.zero(kind)

    def block(first: Index, number: int, z: Index, column: Index) -> None:
        if number < _SUMS // 2 and length >= 2 * _SUMS:
            sums = []
            for j in range(number):
                row = plus(t, first, j)
                term = lambda i, row=row: multiplied(
                    left.at(t, (z, row, i)), right.at(t, (z, column, i))
                )
                sums.append(reduced(t, length, term, partial(add, t), zero))
        else:

            def iteration(i: Index, carry: list[Value]) -> list[Value]:
                other = right.at(t, (z, column, i))
                return [
                    add(t, c, multiplied(left.at(t, (z, plus(t, first, j), i)), other))
                    for j, c in enumerate(carry)
                ]

            sums = write_loop(t, length, iteration, [zero] * number)
        for j, value in enumerate(sums):
            row = plus(t, first, j)
            index = (z, column, row) if swapped else (z, row, column)
            out.put(t, index, value)

    whole, rest = divmod(rows, _SUMS)
    for number, first, blocks in ((_SUMS, 0, whole), (rest, whole * _SUMS, 1)):

        def part(i: tuple[Index, ...], number: int = number, first: int = first) -> None:
            block(plus(t, times(t, i[2], _SUMS), first), number, i[0], i[1])

        if number:
            write_loops(t, (batch, columns, blocks), part)
    return out


STRUCTURAL["dot_general"] = lambda t, p, avals, a, b: _dot(t, p, avals, a, b, mul)


@structural("weighted_dot")
def _(t, p, avals, weight, slope):
    product = lambda t, a, b: weighted(t, a, mul(t, a, b))
    if p["weight_first"]:
        return _dot(t, p, avals, weight, slope, product)
    return _dot(t, p, avals, slope, weight, lambda t, a, b: product(t, b, a))
