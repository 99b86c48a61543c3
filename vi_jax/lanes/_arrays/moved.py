"""What moves the numbers of arrays about: other places of the same numbers, arrays joined.

The rules return arrays of any kind. The caller puts few numbers into registers (`held`), which
costs nothing: what moves them is done while the code is written.
"""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .._operations import Rule, convert, kind_of, register
from .._text import Text, Value
from .held import addressable, fill, held, is_cheap, same, selected, settled, stored
from .index import Index, contiguous, in_lanes, plus, times
from .kinds import MOST_IN_REGISTERS, Array, Formula, Pieces, Registers, Strided, joined, uniform

STRUCTURAL: dict[str, Rule] = {}
"""Rules with the arguments `t`, the `Text`; `p`, the parameters of the equation; `avals`, the
shapes and types of its results; an `Array` for each argument. They return an `Array`, or some."""

structural = partial(register, STRUCTURAL)


# --- the same numbers at other places


class _Along(NamedTuple):
    """Where the numbers of an array lie along one of its axes, by their places in another shape."""

    axis: int | None
    """The axis of the new shape that goes along it; `None` if none does."""
    by: int = 1
    begin: int = 0

    def place(self, t: Text, index: Sequence[Index]) -> Index:
        if self.axis is None:
            return self.begin
        return plus(t, times(t, index[self.axis], self.by), self.begin)


def _moved(t: Text, x: Array, shape: Sequence[int], along: Sequence[_Along]) -> Array:
    """An array that shows the numbers of another one.

    **Arguments:** the text; the array; the new shape; how it goes along each axis of the array.
    """
    cuts: dict[int, set[int]] = {}
    if any(along[a].by != 1 for a in x.cuts):
        x = stored(t, x)
    for a, places in x.cuts.items():
        if (axis := along[a].axis) is not None:
            cuts.setdefault(axis, set()).update(n - along[a].begin for n in places)
    if isinstance(x, Formula) and x.value is not None:
        return uniform(shape, x.value)
    if isinstance(x, Strided):
        steps, offset = [0] * len(shape), 0
        for stride, way in zip(x.strides, along, strict=True):
            offset += stride * way.begin
            if way.axis is not None:
                steps[way.axis] += stride * way.by
        return x.viewed(shape, steps, offset)
    known = {a: frozenset(n for n in ns if 0 < n < shape[a]) for a, ns in cuts.items()}
    number = lambda i: x.at(t, tuple(way.place(t, i) for way in along))
    return Formula(tuple(shape), x.kind, number, is_cheap(x), cuts=known)


@structural("reshape")
def _(t, p, avals, x):
    return reshaped(t, x, tuple(p["new_sizes"]))


def reshaped(t: Text, x: Array, shape: tuple[int, ...]) -> Array:
    """The numbers of an array in another shape, in the same order."""
    if isinstance(x, Registers):
        return Registers(x.values.reshape(shape), x.kind)
    mine, other = ([i for i, n in enumerate(s) if n != 1] for s in (x.shape, shape))
    if [x.shape[i] for i in mine] == [shape[i] for i in other]:
        axes = dict(zip(mine, other, strict=True))
        return _moved(t, x, shape, [_Along(axes.get(a)) for a in range(x.ndim)])
    if not isinstance(x, Strided) or [x.strides[i] for i in mine] != [
        contiguous(x.shape)[i] for i in mine
    ]:
        x = stored(t, x)
    return x.viewed(shape, contiguous(shape))


@structural("squeeze", "expand_dims")
def _(t, p, avals, x):
    return reshaped(t, x, avals[0].shape)


@structural("transpose")
def _(t, p, avals, x):
    return transposed(t, x, p["permutation"])


def transposed(t: Text, x: Array, order: Sequence[int]) -> Array:
    """An array with its axes in another order."""
    order = list(order)
    along = [_Along(order.index(a)) for a in range(x.ndim)]
    return _moved(t, x, [x.shape[a] for a in order], along)


@structural("rev")
def _(t, p, avals, x):
    turned = p["dimensions"]
    along = [_Along(a, -1, n - 1) if a in turned else _Along(a) for a, n in enumerate(x.shape)]
    return _moved(t, x, x.shape, along)


@structural("slice")
def _(t, p, avals, x):
    begin = p["start_indices"]
    return sliced(t, x, begin, avals[0].shape, p["strides"] or [1] * len(begin))


def sliced(t: Text, x: Array, begin: Sequence[int], shape: Sequence[int], by=()) -> Array:
    """A part of an array: from a place on, of a shape, every so many numbers along each axis."""
    # JAX's transposes have NumPy's integers.
    ways = zip(by or [1] * len(begin), begin, strict=True)
    return _moved(t, x, shape, [_Along(a, int(n), int(b)) for a, (n, b) in enumerate(ways)])


@structural("split")
def _(t, p, avals, x):
    x, axis, parts, first = settled(t, x), p["axis"], [], 0
    for aval in avals:
        begin = [first if a == axis else 0 for a in range(x.ndim)]
        parts.append(sliced(t, x, begin, aval.shape))
        first += aval.shape[axis]
    return tuple(parts)


@structural("unstack")
def _(t, p, avals, x):
    x, axis = settled(t, x), p["axis"]
    shape = [1 if a == axis else n for a, n in enumerate(x.shape)]
    corners = ([i if a == axis else 0 for a in range(x.ndim)] for i in range(x.shape[axis]))
    return tuple(reshaped(t, sliced(t, x, c, shape), avals[0].shape) for c in corners)


@structural("empty2")
def _(t, p, avals):
    return uniform(avals[0].shape, t.zero(kind_of(avals[0].dtype)))


@structural("broadcast_in_dim")
def _(t, p, avals, x, *sizes):
    shape, where = tuple(p["shape"]), p["broadcast_dimensions"]
    size = int(np.prod(shape, dtype=int))
    if size > MOST_IN_REGISTERS:
        x = addressable(t, x)
    if x.size < size:  # else nothing would be computed twice
        x = settled(t, x)
    pairs = zip(where, x.shape, strict=True)
    return _moved(t, x, shape, [_Along(a if n != 1 else None) for a, n in pairs])


def chosen(t: Text, flag: Value, a: Array, b: Array) -> Array | None:
    """The first array where a flag holds, else the second, where they differ in a few places only,
    as in a state of which one number was changed; else `None`."""
    cuts = joined(a.cuts, b.cuts)
    if len(cuts) != 1:
        return None
    ((axis, places),) = cuts.items()
    parts = []
    for begin, end in pairwise(sorted({0, a.shape[axis], *places})):
        x, y = (_piece(t, z, axis, begin, end) for z in (a, b))
        part = x if same(x, y) else held(t, selected(t, flag, x, y))
        parts.append(part)
    return Pieces(a.shape, a.kind, axis, tuple(parts))


def _piece(t: Text, x: Array, axis: int, begin: int, end: int) -> Array:
    """What lies between two places of an axis; the numbers that it was put together from, if it
    was."""
    first = 0
    for part in x.parts if isinstance(x, Pieces) and x.axis == axis else ():
        size = part.shape[axis]
        if first <= begin and end <= first + size:
            return _piece(t, part, axis, begin - first, end - first)
        first += size
    x = addressable(t, x)
    corner = [begin if a == axis else 0 for a in range(x.ndim)]
    return sliced(t, x, corner, [end - begin if a == axis else n for a, n in enumerate(x.shape)])


# --- arrays put together


@structural("concatenate")
def _(t, p, avals, *xs):
    return Pieces(avals[0].shape, kind_of(avals[0].dtype), p["dimension"], _filled(xs))


@structural("stack")
def _(t, p, avals, *xs):
    axis, aval = p["axis"], avals[0]
    shape = (*aval.shape[:axis], 1, *aval.shape[axis + 1 :])
    parts = [reshaped(t, x, shape) for x in xs]
    return Pieces(aval.shape, kind_of(aval.dtype), axis, tuple(parts))


def _filled(xs: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(x for x in xs if x.size)


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
        x = Pieces(shape, value.kind, axis, _filled([before, x, after]))
        if min(low, high) < 0:  # that much is cut off
            begin = [max(0, -low) if a == axis else 0 for a in range(x.ndim)]
            size += min(0, low) + min(0, high)
            x = sliced(t, x, begin, [size if a == axis else m for a, m in enumerate(x.shape)])
    return x


def _spread(t: Text, config: Sequence[tuple[int, int, int]], x: Array, number: Value) -> Array:
    """An array with so many other numbers between its own along each axis."""
    between = [int(inside) for _, _, inside in config]
    shape = [max(0, (n - 1) * (i + 1) + 1) for n, i in zip(x.shape, between, strict=True)]
    whole = uniform(shape, number)
    if isinstance(x, Registers) and whole.size <= MOST_IN_REGISTERS:
        out = held(t, whole)
        out.values[tuple(slice(None, None, i + 1) for i in between)] = x.values
        return out
    out = stored(t, whole)
    steps = [(i + 1) * s for i, s in zip(between, out.strides, strict=True)]
    fill(t, out, x, strides=steps)
    return out


@structural("iota")
def _(t, p, avals, *sizes):
    kind, axis = kind_of(p["dtype"]), p["dimension"]
    return Formula(
        tuple(p["shape"]),
        kind,
        lambda index: convert(t, in_lanes(t, index[axis]), kind, False),
        cheap=True,
    )
