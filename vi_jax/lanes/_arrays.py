"""What each JAX primitive becomes that works on arrays of known shape, which are taken apart.

An array within a lane is a numpy array of `Value`s, so that whatever moves numbers about (slices,
transposes, concatenations) is done while the code is written and costs nothing.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from ._operations import Rule, add, compare, extreme, kind_of, mul, register
from ._text import Text, Value

Values = np.ndarray
"""An object array of `Value`s, of the shape of the JAX array."""

# Rules with the arguments `t`, the `Text`; `p`, the parameters of the equation; `avals`, the shapes
# and types of its results; and `Values` for each argument. They return `Values`, or a tuple.
STRUCTURAL: dict[str, Rule] = {}
structural = partial(register, STRUCTURAL)


def each(function: Callable, *arrays: Values) -> Values:
    """A function of `Value`s, number by number; arrays of other shapes are broadcast."""
    arrays = np.broadcast_arrays(*arrays)
    out = np.empty(arrays[0].shape, object)
    for i in np.ndindex(out.shape):
        out[i] = function(*(a[i] for a in arrays))
    return out


for _name, _rule in {
    "reshape": lambda x, p: x.reshape(p["new_sizes"]),
    "transpose": lambda x, p: x.transpose(p["permutation"]),
    "squeeze": lambda x, p: x.squeeze(tuple(p["dimensions"])),
    "expand_dims": lambda x, p: np.expand_dims(x, p["dimensions"]),
    "rev": lambda x, p: np.flip(x, p["dimensions"]),
    "slice": lambda x, p: x[
        tuple(
            slice(a, b, c)
            for a, b, c in zip(
                p["start_indices"], p["limit_indices"],
                p["strides"] or [1] * x.ndim, strict=True,
            )
        )
    ],
}.items():  # fmt: skip
    STRUCTURAL[_name] = lambda t, p, avals, x, rule=_rule: rule(x, p)


@structural("broadcast_in_dim")
def _(t, p, avals, x, *sizes):
    shape = [1] * len(p["shape"])
    for place, size in zip(p["broadcast_dimensions"], x.shape, strict=True):
        shape[place] = size
    return np.broadcast_to(x.reshape(shape), p["shape"])


@structural("concatenate")
def _(t, p, avals, *xs):
    return np.concatenate(xs, axis=p["dimension"])


@structural("stack")
def _(t, p, avals, *xs):
    return np.stack(xs, axis=p["axis"])


@structural("split")
def _(t, p, avals, x):
    return tuple(np.split(x, np.cumsum(p["sizes"])[:-1], axis=p["axis"]))


@structural("iota")
def _(t, p, avals, *sizes):
    kind, shape = kind_of(p["dtype"]), tuple(p["shape"])
    places = np.indices(shape)[p["dimension"]] if shape else np.zeros((), int)
    return each(lambda n: t.constant(int(n), kind), places)


@structural("pad")
def _(t, p, avals, x, fill):
    out = x
    for axis, (low, high, inside) in enumerate(p["padding_config"]):
        if min(low, high) < 0:
            raise KeyError("pad")
        shape = list(out.shape)
        shape[axis] = low + high + shape[axis] + inside * max(shape[axis] - 1, 0)
        padded = np.empty(shape, object)
        padded.fill(fill[()])
        where = [slice(None)] * out.ndim
        where[axis] = slice(low, shape[axis] - high, inside + 1)
        padded[tuple(where)] = out
        out = padded
    return out


def _reduce(function: Callable, x: Values, axes: tuple[int, ...], empty: Value) -> Values:
    kept = [n for i, n in enumerate(x.shape) if i not in axes]
    flat = np.moveaxis(x, axes, range(-len(axes), 0)).reshape(*kept, -1) if axes else x[..., None]
    out = np.empty(kept, object)
    for i in np.ndindex(*kept):
        total = None
        for value in flat[i]:
            total = value if total is None else function(total, value)
        out[i] = empty if total is None else total
    return out


for _name, _with in {
    "reduce_sum": add,
    "reduce_prod": mul,
    "reduce_max": lambda t, a, b: extreme(t, "gt", a, b, False),
    "reduce_min": lambda t, a, b: extreme(t, "lt", a, b, False),
    "reduce_and": lambda t, a, b: t.binary("and", a, b),
    "reduce_or": lambda t, a, b: t.binary("or", a, b),
}.items():
    STRUCTURAL[_name] = lambda t, p, avals, x, how=_with, name=_name: _reduce(
        lambda a, b: how(t, a, b), x, tuple(p["axes"]),
        t.constant(int(name in ("reduce_prod", "reduce_and")), kind_of(avals[0].dtype)),
    )  # fmt: skip


@structural("cumsum")
def _(t, p, avals, x):
    out = np.moveaxis(x, p["axis"], 0).copy()
    out = out[::-1] if p["reverse"] else out
    for i in range(1, len(out)):
        out[i : i + 1] = each(lambda a, b: add(t, a, b), out[i - 1 : i], out[i : i + 1])
    return np.moveaxis(out[::-1] if p["reverse"] else out, 0, p["axis"])


@structural("dot_general")
def _(t, p, avals, a, b):
    (over_a, over_b), (batch_a, batch_b) = p["dimension_numbers"]
    free_a = [i for i in range(a.ndim) if i not in (*over_a, *batch_a)]
    free_b = [i for i in range(b.ndim) if i not in (*over_b, *batch_b)]
    shape = (
        *(a.shape[i] for i in batch_a), *(a.shape[i] for i in free_a),
        *(b.shape[i] for i in free_b),
    )  # fmt: skip
    left = a.transpose(*batch_a, *free_a, *over_a)
    right = b.transpose(*batch_b, *free_b, *over_b)
    out = np.empty(shape, object)
    n, m = len(batch_a), len(free_a)
    zero = t.zero(kind_of(avals[0].dtype))
    for i in np.ndindex(*shape):
        x, y = left[i[: n + m]].ravel(), right[i[:n] + i[n + m :]].ravel()
        total = zero
        for u, v in zip(x, y, strict=True):
            total = add(t, total, mul(t, u, v))
        out[i] = total
    return out


def _starts(t: Text, starts: list[Value], sizes: list[int], shape: tuple[int, ...]):
    """Every place at which a block of `sizes` may begin, and whether it does (clamped)."""
    for corner in np.ndindex(*(n - m + 1 for n, m in zip(shape, sizes, strict=True))):
        flag = t.constant(True, "i1")
        for i, start, n, m in zip(corner, starts, shape, sizes, strict=True):
            if n == m:
                continue
            at = t.constant(i, start.kind)
            how = "le" if i == 0 else "ge" if i == n - m else "eq"
            flag = t.both(flag, compare(t, how, start, at, False))
        yield corner, flag


@structural("dynamic_slice")
def _(t, p, avals, x, *starts):
    sizes = list(p["slice_sizes"])
    out = None
    for corner, flag in _starts(t, [s[()] for s in starts], sizes, x.shape):
        block = x[tuple(slice(i, i + m) for i, m in zip(corner, sizes, strict=True))]
        out = block if out is None else each(lambda a, b, f=flag: t.select(f, a, b), block, out)
    return out


@structural("dynamic_update_slice")
def _(t, p, avals, x, update, *starts):
    out = x
    for corner, flag in _starts(t, [s[()] for s in starts], list(update.shape), x.shape):
        moved = x.copy()
        where = tuple(slice(i, i + m) for i, m in zip(corner, update.shape, strict=True))
        moved[where] = update
        out = each(lambda a, b, f=flag: a if a == b else t.select(f, a, b), moved, out)
    return out
