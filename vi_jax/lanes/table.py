"""What each JAX primitive becomes: elementwise operations, and arrays of known shape taken apart.

An array within a lane is a numpy array of `Value`s, so that whatever moves numbers about (slices,
transposes, concatenations) is done while the code is written and costs nothing.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from . import functions
from .text import KINDS, Text, Value, is_float

Values = np.ndarray
"""An object array of `Value`s, of the shape of the JAX array."""

Rule = Callable[..., Any]
ELEMENTWISE: dict[str, Rule] = {}
STRUCTURAL: dict[str, Rule] = {}


def kind_of(dtype: Any) -> str:
    """**Raises:** `KeyError` for types that lanes do not have (complex, half precision, keys)."""
    return KINDS[np.dtype(dtype).name]


def _is_unsigned(dtype: Any) -> bool:
    return np.dtype(dtype).kind in "ub"


def _into(table: dict[str, Rule], *names: str) -> Callable[[Rule], Rule]:
    def put(rule: Rule) -> Rule:
        table.update(dict.fromkeys(names, rule))
        return rule

    return put


elementwise, structural = partial(_into, ELEMENTWISE), partial(_into, STRUCTURAL)


# --- arithmetic


def add(t: Text, a: Value, b: Value) -> Value:
    if not is_float(a.kind):
        return t.binary("or" if a.kind == "i1" else "add", a, b)
    if a.number == 0:
        return b
    return a if b.number == 0 else t.binary("fadd contract", *_ordered(a, b))


def mul(t: Text, a: Value, b: Value) -> Value:
    if not is_float(a.kind):
        return t.binary("and" if a.kind == "i1" else "mul", a, b)
    if a.number == 1:
        return b
    return a if b.number == 1 else t.binary("fmul contract", *_ordered(a, b))


def _ordered(a: Value, b: Value) -> tuple[Value, Value]:
    """In one order, so that a·b and b·a are merged; a constant last."""
    first = a.number is not None, a.text
    return (a, b) if first <= (b.number is not None, b.text) else (b, a)


def sub(t: Text, a: Value, b: Value) -> Value:
    if not is_float(a.kind):
        return t.binary("sub", a, b)
    return a if b.number == 0 else t.binary("fsub contract", a, b)


def div(t: Text, a: Value, b: Value, *, unsigned: bool = False) -> Value:
    if not is_float(a.kind):
        return t.binary("udiv" if unsigned else "sdiv", a, b)
    return a if b.number == 1 else t.binary("fdiv contract", a, b)


def neg(t: Text, a: Value) -> Value:
    if not is_float(a.kind):
        return t.binary("sub", t.zero(a.kind), a)
    if a.number is not None:
        return t.constant(-a.number, a.kind)
    return t.value(f"fneg {t.vector(a.kind)} {a.text}", a.kind)


def compare(t: Text, how: str, a: Value, b: Value, unsigned: bool) -> Value:
    if is_float(a.kind):
        order = {"eq": "oeq", "ne": "une"}.get(how, "o" + how)
        return t.binary(f"fcmp {order}", a, b, "i1")
    order = how if how in ("eq", "ne") else ("u" if unsigned else "s") + how
    return t.binary(f"icmp {order}", a, b, "i1")


for _name in ("add", "add_any"):
    ELEMENTWISE[_name] = lambda t, p, d, a, b: add(t, a, b)
ELEMENTWISE["sub"] = lambda t, p, d, a, b: sub(t, a, b)
ELEMENTWISE["mul"] = lambda t, p, d, a, b: mul(t, a, b)
ELEMENTWISE["div"] = lambda t, p, d, a, b: div(t, a, b, unsigned=_is_unsigned(d[0]))
ELEMENTWISE["neg"] = lambda t, p, d, a: neg(t, a)
for _name in ("eq", "ne", "lt", "le", "gt", "ge"):
    ELEMENTWISE[_name] = lambda t, p, d, a, b, how=_name: compare(t, how, a, b, _is_unsigned(d[0]))
_SAME = "stop_gradient copy copy_p name pvary reshard reduce_precision pin"
for _name in _SAME.split():
    ELEMENTWISE[_name] = lambda t, p, d, a: a
ELEMENTWISE["square"] = lambda t, p, d, a: mul(t, a, a)
ELEMENTWISE["sqrt"] = lambda t, p, d, a: t.intrinsic("sqrt", a)
ELEMENTWISE["rsqrt"] = lambda t, p, d, a: div(t, t.constant(1, a.kind), t.intrinsic("sqrt", a))
ELEMENTWISE["floor"] = lambda t, p, d, a: t.intrinsic("floor", a)
ELEMENTWISE["ceil"] = lambda t, p, d, a: t.intrinsic("ceil", a)


@elementwise("abs")
def _(t, p, d, a):
    if is_float(a.kind):
        return t.intrinsic("fabs", a)
    return t.select(t.binary("icmp slt", a, t.zero(a.kind), "i1"), neg(t, a), a)


@elementwise("sign")
def _(t, p, d, a):
    zero = t.zero(a.kind)
    up = t.select(compare(t, "gt", a, zero, False), t.constant(1, a.kind), a)
    return t.select(compare(t, "lt", a, zero, False), t.constant(-1, a.kind), up)


@elementwise("max")
def _(t, p, d, a, b):
    return _extreme(t, "gt", a, b, _is_unsigned(d[0]))


@elementwise("min")
def _(t, p, d, a, b):
    return _extreme(t, "lt", a, b, _is_unsigned(d[0]))


def _extreme(t: Text, how: str, a: Value, b: Value, unsigned: bool) -> Value:
    if a.kind == "i1":
        return t.binary("or" if how == "gt" else "and", a, b)
    if b.number is None and a.number is not None:
        a, b = b, a
    if not is_float(a.kind):
        return t.select(compare(t, how, a, b, unsigned), a, b)
    # What is not a number wins: true for such an a, and asked for in b unless that is known.
    best = t.select(t.binary(f"fcmp u{how}", a, b, "i1"), a, b)
    return best if b.number is not None else t.select(t.binary("fcmp uno", b, b, "i1"), b, best)


@elementwise("clamp")
def _(t, p, d, low, a, high):
    above = _extreme(t, "gt", a, low, _is_unsigned(d[1]))
    return _extreme(t, "lt", above, high, _is_unsigned(d[1]))


@elementwise("is_finite")
def _(t, p, d, a):
    infinity = t.constant(float("inf"), a.kind)
    return t.binary("fcmp olt", t.intrinsic("fabs", a), infinity, "i1")


@elementwise("round")
def _(t, p, d, a):
    return t.intrinsic("roundeven" if int(p["rounding_method"]) else "round", a)


@elementwise("integer_pow")
def _(t, p, d, a):
    exponent, base, result = abs(p["y"]), a, None
    while exponent:
        if exponent & 1:
            result = base if result is None else mul(t, result, base)
        exponent >>= 1
        if exponent:
            base = mul(t, base, base)
    one = t.constant(1, a.kind)
    result = one if result is None else result
    return div(t, one, result) if p["y"] < 0 else result


@elementwise("pow")
def _(t, p, d, a, b):
    if b.kind != a.kind:
        b = convert(t, b, a.kind, False)
    if b.number in (0.5, 1.5, -0.5):
        # A root but for two corners: powers of -∞ are infinite, those of -0 those of 0.
        infinity = t.constant(float("inf"), a.kind)
        root = t.intrinsic("sqrt", t.binary("fadd", a, t.zero(a.kind)))
        lowest = t.binary("fcmp oeq", a, t.constant(-float("inf"), a.kind), "i1")
        root = t.select(lowest, infinity, root)
        if b.number < 0:
            return div(t, t.constant(1, a.kind), root)
        return root if b.number == 0.5 else mul(t, t.intrinsic("fabs", a), root)
    if a.kind == "float" and b.number is not None and b.number != round(b.number):
        # No negative base has such a power, and double precision leaves single to rounding.
        wide = t.cast("fpext", a, "double")
        power = mul(t, functions.log_(t, wide), t.constant(b.number, "double"))
        return t.cast("fptrunc", functions.exp(t, power), "float")
    return t.each("pow", a, b)


@elementwise("exp")
def _(t, p, d, a):
    return functions.exp(t, a)


@elementwise("log")
def _(t, p, d, a):
    return functions.log_(t, a)


@elementwise("logistic")
def _(t, p, d, a):
    one = t.constant(1, a.kind)
    return div(t, one, add(t, one, functions.exp(t, neg(t, a))))


@elementwise("sin")
def _(t, p, d, a):
    return functions.sincos(t, a)[0]


@elementwise("cos")
def _(t, p, d, a):
    return functions.sincos(t, a)[1]


@elementwise("sincos")
def _(t, p, d, a):
    return functions.sincos(t, a)


_LIBRARY = (
    "tanh", "tan", "sinh", "cosh", "asin", "acos", "atan", "asinh", "acosh", "atanh", "atan2",
    "exp2", "expm1", "log1p", "cbrt", "erf", "erfc",
)  # fmt: skip
for _name in _LIBRARY:
    ELEMENTWISE[_name] = lambda t, p, d, *args, name=_name: t.each(name, *args)
ELEMENTWISE["rem"] = lambda t, p, d, a, b: (
    t.each("fmod", a, b)
    if is_float(a.kind)
    else t.binary("urem" if _is_unsigned(d[0]) else "srem", a, b)
)


# --- flags and types


@elementwise("and")
def _(t, p, d, a, b):
    return t.both(a, b) if a.kind == "i1" else t.binary("and", a, b)


@elementwise("or")
def _(t, p, d, a, b):
    if a.kind == "i1" and a.number is not None:
        return a if a.number else b
    if a.kind == "i1" and b.number is not None:
        return b if b.number else a
    return t.binary("or", a, b)


@elementwise("xor")
def _(t, p, d, a, b):
    return t.binary("xor", a, b)


@elementwise("not")
def _(t, p, d, a):
    if a.kind == "i1" and a.number is not None:
        return t.constant(not a.number, "i1")
    return t.binary("xor", a, t.constant(True if a.kind == "i1" else -1, a.kind))


@elementwise("convert_element_type")
def _(t, p, d, a):
    return convert(t, a, kind_of(p["new_dtype"]), _is_unsigned(d[0]))


def convert(t: Text, a: Value, kind: str, unsigned: bool) -> Value:
    if a.kind == kind:
        return a
    if a.number is not None:
        return t.constant(a.number, kind)
    if kind == "i1":
        return compare(t, "ne", a, t.zero(a.kind), unsigned)
    if is_float(kind):
        if is_float(a.kind):
            return t.cast("fpext" if kind == "double" else "fptrunc", a, kind)
        return t.cast("uitofp" if unsigned else "sitofp", a, kind)
    if is_float(a.kind):
        v, w = t.suffix(kind), t.suffix(a.kind)
        name = f"@llvm.fptosi.sat.{v}.{w}"
        t.declared[name] = f"declare {t.vector(kind)} {name}({t.vector(a.kind)})"
        return t.value(f"call {t.vector(kind)} {name}({t.vector(a.kind)} {a.text})", kind)
    if int(a.kind[1:]) > int(kind[1:]):
        return t.cast("trunc", a, kind)
    return t.cast("zext" if unsigned else "sext", a, kind)


@elementwise("select_n")
def _(t, p, d, which, *cases):
    if which.kind == "i1":
        return t.select(which, cases[1], cases[0])
    result = cases[-1]
    for i in range(len(cases) - 2, -1, -1):
        here = compare(t, "le", which, t.constant(i, which.kind), False)
        result = t.select(here, cases[i], result)
    return result


# --- arrays of known shape


def _each(function: Callable, *arrays: Values) -> Values:
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
    return _each(lambda n: t.constant(int(n), kind), places)


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
    "reduce_max": lambda t, a, b: _extreme(t, "gt", a, b, False),
    "reduce_min": lambda t, a, b: _extreme(t, "lt", a, b, False),
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
        out[i : i + 1] = _each(lambda a, b: add(t, a, b), out[i - 1 : i], out[i : i + 1])
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


def _here(t: Text, starts: list[Value], sizes: list[int], shape: tuple[int, ...]):
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
    for corner, flag in _here(t, [s[()] for s in starts], sizes, x.shape):
        block = x[tuple(slice(i, i + m) for i, m in zip(corner, sizes, strict=True))]
        out = block if out is None else _each(lambda a, b, f=flag: t.select(f, a, b), block, out)
    return out


@structural("dynamic_update_slice")
def _(t, p, avals, x, update, *starts):
    out = x
    for corner, flag in _here(t, [s[()] for s in starts], list(update.shape), x.shape):
        moved = x.copy()
        where = tuple(slice(i, i + m) for i, m in zip(corner, update.shape, strict=True))
        moved[where] = update
        out = _each(lambda a, b, f=flag: a if a == b else t.select(f, a, b), moved, out)
    return out
