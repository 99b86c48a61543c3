"""Parts of arrays, small ones too, at places that the data name."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .._operations import Rule, add, compare, convert, extreme, is_unsigned, mul, sub
from .._text import Text, Value
from .held import held, over_all, settled, stored
from .index import Index, in_lanes, place_of, plus
from .kinds import Array, Formula, Pieces, Registers, Strided
from .moved import sliced
from .sums import in_one

# --- places that the data name


def _within(t: Text, place: Value, greatest: int) -> tuple[Index, Value]:
    """A place moved to between 0 and the greatest, and whether it was there."""
    if place.number is not None:
        inside = 0 <= int(place.number) <= greatest
        return min(max(int(place.number), 0), greatest), t.constant(inside, "i1")
    last = t.constant(greatest, "i64")
    low = compare(t, "ge", place, t.zero("i64"), False)
    high = compare(t, "le", place, last, False)
    inside = t.both(low, high)
    return t.select(low, t.select(high, place, last), t.zero("i64")), inside


def _as_place(t: Text, value: Value, dtype) -> Value:
    return convert(t, value, "i64", is_unsigned(dtype))


def _starts(t: Text, starts, dtypes, sizes, shape) -> list[Index]:
    """Where a block of `sizes` begins, moved so that it lies within the array."""
    return [
        _within(t, _as_place(t, s.at(t, ()), d), n - m)[0]
        for s, d, m, n in zip(starts, dtypes, sizes, shape, strict=True)
    ]


def dynamic_slice(t: Text, p: dict, avals, dtypes, x: Array, *starts: Array) -> Array:
    """A block of an array that begins at a place given by the data."""
    begin, x = _starts(t, starts, dtypes, p["slice_sizes"], x.shape), in_one(t, x)
    return Formula(
        tuple(avals[0].shape),
        x.kind,
        lambda index: x.at(t, [plus(t, i, j) for i, j in zip(index, begin, strict=True)]),
    )


def dynamic_update_slice(
    t: Text, p: dict, avals, dtypes, x: Array, update: Array, *starts
) -> Array:
    """An array with a block of other numbers from a place given by the data."""
    begin = _starts(t, starts, dtypes, update.shape, x.shape)
    if all(isinstance(i, int) for i in begin):
        window = [(int(i), n) for i, n in zip(begin, update.shape, strict=True)]  # pyright: ignore[reportArgumentType]
        update = settled(t, update)
        found = _patched(t, x, window, lambda index: update.at(t, index))
        if found is not None:
            return found
    out = _copy(t, x, not isinstance(update, Registers))

    def put(index: tuple[Index, ...]) -> None:
        place = [plus(t, i, j) for i, j in zip(index, begin, strict=True)]
        value = update.at(t, index)
        put_at(t, out, place, lambda old: value)

    over_all(t, update, put)
    return out


def _patched(t: Text, x: Array, window: Sequence[tuple[int, int]], new: Callable) -> Pieces | None:
    """A large array with other numbers in a window, without a copy; `None` unless the window
    leaves out something along one axis only.

    **Arguments:** the text; the array; of each axis where the window begins and its size; its
    numbers by their index in it.
    """
    axes = [a for a, (_, n) in enumerate(window) if n != x.shape[a]]
    if len(axes) != 1 or isinstance(x, Registers):
        return None
    axis, shape = axes[0], tuple(n for _, n in window)
    begin, size = window[axis]

    def part(first: int, end: int) -> Array:
        corner = [first if a == axis else 0 for a in range(x.ndim)]
        return sliced(t, x, corner, [end - first if a == axis else n for a, n in enumerate(shape)])

    parts: list[Array] = [part(0, begin)] if begin else []
    parts.append(held(t, Formula(shape, x.kind, new)))
    if begin + size < x.shape[axis]:
        parts.append(part(begin + size, x.shape[axis]))
    return Pieces(x.shape, x.kind, axis, tuple(parts))


def _copy(t: Text, x: Array, in_memory: bool) -> Registers | Strided:
    """A copy of an array that may be changed, in memory if it is large or that is asked for."""
    if in_memory or not isinstance(x, Registers):
        return stored(t, x)
    return Registers(x.values.copy(), x.kind)


class _Asked(NamedTuple):
    """Where the data name blocks of an array."""

    indices: Array
    dtype: Any
    axes: Sequence[int]
    """The axes whose places the last axis of the indices names."""
    batched: Sequence[tuple[int, int]]
    """Axes whose place is that of an axis of the indices."""
    greatest: Sequence[int]
    """The last place at which a block may begin, of each axis."""

    def corner(self, t: Text, batch: Sequence[Index]) -> tuple[list[Index], Value]:
        """Where the block begins that is named at a place of the indices, moved into the array; and
        whether it was in it."""
        place: list[Index] = [0] * len(self.greatest)
        for a, b in self.batched:
            place[a] = batch[b]
        inside = t.constant(True, "i1")
        for k, a in enumerate(self.axes):
            given = _as_place(t, self.indices.at(t, (*batch, k)), self.dtype)
            place[a], here = _within(t, given, self.greatest[a])
            inside = t.both(inside, here)
        return place, inside


def gather(t: Text, p: dict, avals, dtypes, x: Array, indices: Array) -> Array:
    """Blocks of an array from places given by the data."""
    d, aval, x, indices = p["dimension_numbers"], avals[0], in_one(t, x), in_one(t, indices)
    kind, sizes = x.kind, p["slice_sizes"]
    gone = (*d.collapsed_slice_dims, *d.operand_batching_dims)
    inner = [a for a in range(x.ndim) if a not in gone]

    asked = _Asked(
        indices, dtypes[0], d.start_index_map,
        tuple(zip(d.operand_batching_dims, d.start_indices_batching_dims, strict=True)),
        [n - m for n, m in zip(x.shape, sizes, strict=True)],
    )  # fmt: skip

    def number(index: tuple[Index, ...]) -> Value:
        place, inside = asked.corner(t, [i for a, i in enumerate(index) if a not in d.offset_dims])
        for a, i in zip(inner, [index[o] for o in d.offset_dims], strict=True):
            place[a] = plus(t, place[a], i)
        value = x.at(t, place)
        if "FILL" not in str(p["mode"]):
            return value
        return t.select(inside, value, t.constant(_filling(p["fill_value"], aval.dtype), kind))

    return Formula(tuple(aval.shape), kind, number)


def _filling(given, dtype):
    """What JAX takes for a number from outside an array."""
    if given is not None:
        return given
    dtype = np.dtype(dtype)
    if dtype.kind == "f":
        return float("nan")
    if dtype.kind == "b":
        return True
    return np.iinfo(dtype).min if dtype.kind == "i" else np.iinfo(dtype).max


def _extreme_of(how: str) -> Callable:
    return lambda t, old, new, unsigned: extreme(t, how, old, new, unsigned)


# By the primitive's name, what becomes of an old number and a new one; whether they are unsigned.
_COMBINED: dict[str, Callable] = {
    "scatter": lambda t, old, new, unsigned: new,
    "scatter-add": lambda t, old, new, unsigned: add(t, old, new),
    "scatter-mul": lambda t, old, new, unsigned: mul(t, old, new),
    "scatter-sub": lambda t, old, new, unsigned: sub(t, old, new),
    "scatter-min": _extreme_of("lt"),
    "scatter-max": _extreme_of("gt"),
}
# JAX 0.10.2 spells some of them with an underscore.
_COMBINED |= {name.replace("-", "_"): how for name, how in _COMBINED.items()}


def scatter(t: Text, name: str, p: dict, avals, dtypes, x: Array, indices: Array, update: Array):
    """An array with numbers put, added, … at places given by the data; what lies outside is left
    out, unless the mode says that places are moved inside."""
    d, unsigned = p["dimension_numbers"], is_unsigned(avals[0].dtype)
    combined = lambda t, old, new: _COMBINED[name](t, old, new, unsigned)
    gone = (*d.inserted_window_dims, *d.operand_batching_dims)
    inner = [a for a in range(x.ndim) if a not in gone]
    window = dict(zip(inner, [update.shape[a] for a in d.update_window_dims], strict=True))
    indices, update = in_one(t, indices), settled(t, update)

    asked = _Asked(
        indices, dtypes[0], d.scatter_dims_to_operand_dims,
        tuple(zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True)),
        [n - window.get(a, 1) for a, n in enumerate(x.shape)],
    )  # fmt: skip

    def begin(batch: list[Index]) -> tuple[list[Index], Value]:
        """Where the window for this place among the indices begins, and whether to put it there."""
        place, inside = asked.corner(t, batch)
        return place, t.constant(True, "i1") if "CLIP" in str(p["mode"]) else inside

    others = [n for a, n in enumerate(update.shape) if a not in d.update_window_dims]
    if int(np.prod(others, dtype=int)) == 1 and not d.operand_batching_dims:
        first, inside = begin([0] * len(others))
        if all(isinstance(i, int) for i in first) and inside.number:
            sizes = [(int(i), window.get(a, 1)) for a, i in enumerate(first)]  # pyright: ignore[reportArgumentType]

            def changed(index: tuple[Index, ...]) -> Value:
                given: list[Index] = [0] * update.ndim
                for a, o in zip(inner, d.update_window_dims, strict=True):
                    given[o] = index[a]
                old = x.at(t, [plus(t, i, b) for i, (b, _) in zip(index, sizes, strict=True)])
                return combined(t, old, update.at(t, given))

            found = _patched(t, x, sizes, changed)
            if found is not None:
                return found
    out = _copy(t, x, not isinstance(update, Registers))

    def put(index: tuple[Index, ...]) -> None:
        place, inside = begin([i for a, i in enumerate(index) if a not in d.update_window_dims])
        for a, i in zip(inner, [index[o] for o in d.update_window_dims], strict=True):
            place[a] = plus(t, place[a], i)
        value = update.at(t, index)
        put_at(t, out, place, lambda old: t.select(inside, combined(t, old, value), old))

    over_all(t, update, put)
    return out


def put_at(t: Text, x: Registers | Strided, place: Sequence[Index], new: Callable) -> None:
    """Change the number of an array at a place: in memory, or in registers at all places that
    it may be.

    **Arguments:** the text; the array; the place; the new number as a function of the old one.
    """
    if isinstance(x, Strided):
        where, memory = place_of(t, place, x.strides, x.offset), x.source
        memory.store(t, where, new(memory.load(t, where, x.kind)))  # pyright: ignore[reportAttributeAccessIssue]
        return
    for way in np.ndindex(x.shape):
        here = t.constant(True, "i1")
        for i, n in zip(place, way, strict=True):
            if isinstance(i, int):
                here = t.both(here, t.constant(i == n, "i1"))
            else:
                asked = t.binary("icmp eq", in_lanes(t, i), t.constant(n, "i64"), "i1")
                here = t.both(here, asked)
        if here.number is None or here.number:
            x.values[way] = t.select(here, new(x.values[way]), x.values[way])


# Rules that ask for the types of their places too, which say whether those are signed.
PLACED: dict[str, Rule] = {
    "dynamic_slice": dynamic_slice,
    "dynamic_update_slice": dynamic_update_slice,
    "gather": gather,
    **{name: partial(lambda n, t, *rest: scatter(t, n, *rest), name) for name in _COMBINED},
}
