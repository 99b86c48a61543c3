"""What each JAX primitive becomes that works on arrays of known shape, which are taken apart.

An array within a lane is a numpy array of `Value`s, so that whatever moves numbers about (slices,
transposes, concatenations) is done while the code is written and costs nothing.
"""

from collections.abc import Callable
from functools import partial

import jax
import numpy as np

from ._large import LARGE, Held, Large, Values, at, held
from ._operations import Rule, add, kind_of, register
from ._reductions import register_products, register_reductions
from ._text import Text, Value

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


@structural("unstack")
def _(t, p, avals, x):
    return tuple(np.asarray(part, object) for part in np.moveaxis(x, p["axis"], 0))


@structural("split")
def _(t, p, avals, x):
    return tuple(np.split(x, np.cumsum(p["sizes"])[:-1], axis=p["axis"]))


@structural("empty2")
def _(t, p, avals):
    """What JAX leaves where a branch has nothing that its derivative needs: any number."""
    return each(lambda _: t.zero(kind_of(avals[0].dtype)), np.zeros(avals[0].shape))


@structural("iota")
def _(t, p, avals, *sizes):
    kind, shape = kind_of(p["dtype"]), tuple(p["shape"])
    places = np.indices(shape)[p["dimension"]] if shape else np.zeros((), int)
    return each(lambda n: t.constant(int(n), kind), places)


@structural("pad")
def _(t, p, avals, x, fill):
    out = x
    for axis, (low, high, inside) in enumerate(p["padding_config"]):
        shape = list(out.shape)
        shape[axis] = max(0, low) + max(0, high) + shape[axis] + inside * max(shape[axis] - 1, 0)
        padded = np.empty(shape, object)
        padded.fill(fill[()])
        where = [slice(None)] * out.ndim
        where[axis] = slice(max(0, low), shape[axis] - max(0, high), inside + 1)
        padded[tuple(where)] = out
        where[axis] = slice(max(0, -low), shape[axis] - max(0, -high))
        out = padded[tuple(where)]
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


def _cumulated(t, p, avals, x, how):
    out = np.moveaxis(x, p["axis"], 0).copy()
    out = out[::-1] if p["reverse"] else out
    for i in range(1, len(out)):
        out[i : i + 1] = each(how, out[i - 1 : i], out[i : i + 1])
    return np.moveaxis(out[::-1] if p["reverse"] else out, 0, p["axis"])


register_reductions(
    STRUCTURAL,
    lambda t, axes, avals, x, how, empty: _reduce(how, x, axes, empty),
    _cumulated,
)


def _dot(t, p, avals, a, b, product: Callable):
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
        # Without a sum an element is a `Value` itself.
        x, y = np.ravel(left[i[: n + m]]), np.ravel(right[i[:n] + i[n + m :]])
        total = zero
        for u, v in zip(x, y, strict=True):
            total = add(t, total, product(t, u, v))
        out[i] = total
    return out


register_products(STRUCTURAL, _dot)


def any_in(t: Text, x: Held) -> Value:
    """Whether any flag of an array holds."""
    if not x.ndim:
        return at(t, x, ())
    rules = LARGE if isinstance(x, Large) else STRUCTURAL
    axes, flag = {"axes": tuple(range(x.ndim))}, jax.ShapeDtypeStruct((), bool)
    return at(t, held(t, rules["reduce_or"](t, axes, [flag], x)), ())
