"""Rules of JAX primitives that act on single numbers: arithmetic, flags, conversions."""

import functools
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from ._library import LIBRARY, power
from ._text import KINDS, Text, Value, is_float


def constant_result(t: Text, a: Value, b: Value, operation: str) -> Value | None:
    """Return the result for two constant integers below 2¹⁵, such as indices of arrays."""
    if a.number is None or b.number is None or a.kind == "i1":
        return None
    x, y = int(a.number), int(b.number)
    if max(abs(x), abs(y)) >= 2**15 or a.kind not in ("i32", "i64"):
        return None
    found = {"add": x + y, "sub": x - y, "mul": x * y}.get(operation)
    return None if found is None else t.constant(found, a.kind)


def compare(t: Text, how: str, a: Value, b: Value, unsigned: bool) -> Value:
    """Return whether a is `"lt"`, `"le"`, `"eq"`, … b. If either is NaN, only `"ne"` is true."""
    if is_float(a.kind):
        order = {"eq": "oeq", "ne": "une"}.get(how, "o" + how)
        return t.binary(f"fcmp {order}", a, b, "i1")
    if a.number is not None and b.number is not None and a.kind != "i1":
        return t.constant(getattr(operator, how)(a.number, b.number), "i1")
    order = how if how in ("eq", "ne") else ("u" if unsigned else "s") + how
    return t.binary(f"icmp {order}", a, b, "i1")


def int_divide(t: Text, what: str, a: Value, b: Value, unsigned: bool) -> Value:
    """Return a quotient (`"div"`) or remainder (`"rem"`) of integers where a processor would trap.
    As in XLA, division by 0 gives -1 and remainder a. Division by -1, which may overflow, gives -a
    and remainder 0. A slot without a lane holds zeros."""
    operation = ("u" if unsigned else "s") + what
    if b.number is not None and b.number not in (0, -1):
        return t.binary(operation, a, b)
    zero, one = t.zero(a.kind), t.constant(1, a.kind)
    minus = t.binary("sub", zero, one)
    by_zero = compare(t, "eq", b, zero, True)
    divisor = t.select(by_zero, one, b)
    if unsigned:
        found = t.binary(operation, a, divisor)
    else:
        by_minus = compare(t, "eq", b, minus, True)
        found = t.binary(operation, a, t.select(by_minus, one, divisor))
        found = t.select(by_minus, t.binary("sub", zero, a) if what == "div" else zero, found)
    return t.select(by_zero, minus if what == "div" else a, found)


def in_total_order(t: Text, a: Value) -> Value:
    """Return an integer for each floating-point number, ordered as in IEEE's total order."""
    if not is_float(a.kind):
        return a
    kind, bits = ("i64", 63) if a.kind == "double" else ("i32", 31)
    whole = t.cast("bitcast", a, kind)
    sign = t.binary("ashr", whole, t.constant(bits, kind))
    return t.binary("xor", whole, t.binary("and", sign, t.constant(2**bits - 1, kind)))


Rule = Callable[..., Any]
ELEMENTWISE: dict[str, Rule] = {}


@functools.cache
def kind_of(dtype: Any) -> str:
    """Return LLVM's type. **Raises:** `KeyError` for complex numbers, half precision and keys."""
    return KINDS[np.dtype(dtype).name]


def is_unsigned(dtype: Any) -> bool:
    return np.dtype(dtype).kind in "ub"


def register(table: dict[str, Rule], *names: str) -> Callable[[Rule], Rule]:
    """Decorator: put a rule into a table under these names of primitives.

    A rule of `ELEMENTWISE` has the arguments `t`, the `Text`; `p`, the parameters of the equation;
    `d`, the types of its arguments; and a `Value` for each argument. It returns a `Value` or a
    tuple of them. Its bits must not depend on the slot. It must not trap on any number, since it
    also runs in slots whose lane does not need it.
    """

    def put(rule: Rule) -> Rule:
        table.update(dict.fromkeys(names, rule))
        return rule

    return put


elementwise = functools.partial(register, ELEMENTWISE)


# --- arithmetic


def add(t: Text, a: Value, b: Value) -> Value:
    return _commuting(t, a, b, 0, "fadd contract", "or" if a.kind == "i1" else "add")


def mul(t: Text, a: Value, b: Value) -> Value:
    return _commuting(t, a, b, 1, "fmul contract", "and" if a.kind == "i1" else "mul")


def _commuting(t: Text, a: Value, b: Value, neutral: int, real: str, whole: str) -> Value:
    """Return a sum or product by `real` (floating-point) or `whole` (integers). A floating-point
    operand that is `neutral` is left out."""
    if not is_float(a.kind):
        return constant_result(t, a, b, whole) or t.binary(whole, a, b)
    if a.number == neutral:
        return b
    return a if b.number == neutral else t.binary(real, *t.ordered(a, b))


def sub(t: Text, a: Value, b: Value) -> Value:
    if not is_float(a.kind):
        return constant_result(t, a, b, "sub") or t.binary("sub", a, b)
    return a if b.number == 0 else t.binary("fsub contract", a, b)


def div(t: Text, a: Value, b: Value, *, unsigned: bool = False) -> Value:
    if not is_float(a.kind):
        return int_divide(t, "div", a, b, unsigned)
    return a if b.number == 1 else t.binary("fdiv contract", a, b)


def neg(t: Text, a: Value) -> Value:
    if not is_float(a.kind):
        return t.binary("sub", t.zero(a.kind), a)
    if a.number is not None:
        return t.constant(-a.number, a.kind)
    return t.negative(a)


def weighted(t: Text, weight: Value, product: Value) -> Value:
    """Return `product` (or quotient) with the cotangent `weight`; zero if that is zero."""
    return t.select(compare(t, "eq", weight, t.zero(weight.kind), False), weight, product)


for _name in ("add", "add_any"):
    ELEMENTWISE[_name] = lambda t, p, d, a, b: add(t, a, b)
ELEMENTWISE["sub"] = lambda t, p, d, a, b: sub(t, a, b)
ELEMENTWISE["mul"] = lambda t, p, d, a, b: mul(t, a, b)
ELEMENTWISE["div"] = lambda t, p, d, a, b: div(t, a, b, unsigned=is_unsigned(d[0]))
ELEMENTWISE["quotient"] = lambda t, p, d, a, b: div(t, a, b)
ELEMENTWISE["weighted"] = lambda t, p, d, a, b: weighted(t, a, mul(t, a, b))
ELEMENTWISE["weighted_quotient"] = lambda t, p, d, a, b: weighted(t, a, div(t, a, b))
ELEMENTWISE["neg"] = lambda t, p, d, a: neg(t, a)
for _name in ("eq", "ne", "lt", "le", "gt", "ge"):
    ELEMENTWISE[_name] = lambda t, p, d, a, b, how=_name: compare(t, how, a, b, is_unsigned(d[0]))


@elementwise("weighted_sum")
def _weighted_sum(t: Text, params: dict, dtypes: list, *terms: Value) -> Value:
    both = zip(terms, params["weights"], strict=True)
    return functools.reduce(
        functools.partial(add, t), (mul(t, x, t.constant(w, x.kind)) for x, w in both)
    )


IDENTITY_PRIMITIVES = "stop_gradient copy copy_p name pvary reshard pin".split()
"""Primitives that return their argument."""
for _name in IDENTITY_PRIMITIVES:
    ELEMENTWISE[_name] = lambda t, p, d, a: a
ELEMENTWISE["square"] = lambda t, p, d, a: mul(t, a, a)
ELEMENTWISE["rsqrt"] = lambda t, p, d, a: div(t, t.constant(1, a.kind), t.intrinsic("sqrt", a))
for _name in ("sqrt", "floor", "ceil"):
    ELEMENTWISE[_name] = lambda t, p, d, a, name=_name: t.intrinsic(name, a)


@elementwise("abs")
def _(t, p, d, a):
    if is_float(a.kind):
        return t.intrinsic("fabs", a)
    return t.select(t.binary("icmp slt", a, t.zero(a.kind), "i1"), neg(t, a), a)


for _name, _how in {"lt_to": "slt", "le_to": "sle"}.items():
    ELEMENTWISE[_name] = lambda t, p, d, a, b, how=_how: t.binary(
        f"icmp {how}", in_total_order(t, a), in_total_order(t, b), "i1"
    )


@elementwise("sign")
def _(t, p, d, a):
    zero = t.zero(a.kind)
    unsigned = is_unsigned(d[0])
    up = t.select(compare(t, "gt", a, zero, unsigned), t.constant(1, a.kind), a)
    if unsigned:
        return up
    return t.select(compare(t, "lt", a, zero, False), t.constant(-1, a.kind), up)


for _name, _how in {"max": "gt", "min": "lt"}.items():
    ELEMENTWISE[_name] = lambda t, p, d, a, b, how=_how: extreme(t, how, a, b, is_unsigned(d[0]))


def extreme(t: Text, how: str, a: Value, b: Value, unsigned: bool) -> Value:
    """Return the larger (`"gt"`) or smaller (`"lt"`) of two values; NaN if either is NaN."""
    if a.kind == "i1":
        return t.binary("or" if how == "gt" else "and", a, b)
    if b.number is None and a.number is not None:
        a, b = b, a
    if not is_float(a.kind):
        return t.select(compare(t, how, a, b, unsigned), a, b)
    # NaN wins. The unordered comparison chooses a if it is NaN; b is tested, unless it is a known
    # number.
    best = t.select(t.binary(f"fcmp u{how}", a, b, "i1"), a, b)
    is_number = b.number is not None and b.number == b.number
    return best if is_number else t.select(t.binary("fcmp uno", b, b, "i1"), b, best)


@elementwise("clamp")
def _(t, p, d, low, a, high):
    above = extreme(t, "gt", a, low, is_unsigned(d[1]))
    return extreme(t, "lt", above, high, is_unsigned(d[1]))


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
        # A root, except that powers of -∞ are infinite, and powers of -0 are those of 0.
        infinity = t.constant(float("inf"), a.kind)
        root = t.intrinsic("sqrt", t.binary("fadd", a, t.zero(a.kind)))
        lowest = t.binary("fcmp oeq", a, t.constant(-float("inf"), a.kind), "i1")
        root = t.select(lowest, infinity, root)
        if b.number < 0:
            return div(t, t.constant(1, a.kind), root)
        return root if b.number == 0.5 else mul(t, t.intrinsic("fabs", a), root)
    if a.kind == "float" and b.number is not None and b.number != round(b.number):
        # Negative bases have no such power. In double precision its error is far below the
        # rounding to single precision.
        wide = t.cast("fpext", a, "double")
        exponent = mul(t, LIBRARY["log"](t, wide), t.constant(b.number, "double"))
        return t.cast("fptrunc", LIBRARY["exp"](t, exponent), "float")
    return power(t, a, b)


@elementwise("logistic")
def _(t, p, d, a):
    one = t.constant(1, a.kind)
    return div(t, one, add(t, one, LIBRARY["exp"](t, neg(t, a))))


for _name, _function in LIBRARY.items():
    ELEMENTWISE[_name] = lambda t, p, d, *args, function=_function: function(t, *args)
ELEMENTWISE["rem"] = lambda t, p, d, a, b: (
    t.per_lane("fmod", a, b) if is_float(a.kind) else int_divide(t, "rem", a, b, is_unsigned(d[0]))
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


ELEMENTWISE["xor"] = lambda t, p, d, a, b: t.binary("xor", a, b)


# LLVM leaves shifts by more than the last bit undefined.
for _name, _how in {"shift_left": "shl", "shift_right_logical": "lshr"}.items():
    ELEMENTWISE[_name] = lambda t, p, d, a, b, how=_how: _shifted(t, how, a, b)


def _shifted(t: Text, how: str, a: Value, shift: Value) -> Value:
    bits = int(a.kind[1:])
    within = compare(t, "lt", shift, t.constant(bits, a.kind), True)
    safe = t.binary("and", shift, t.constant(bits - 1, a.kind))
    return t.select(within, t.binary(how, a, safe), t.zero(a.kind))


@elementwise("not")
def _(t, p, d, a):
    if a.kind == "i1" and a.number is not None:
        return t.constant(not a.number, "i1")
    return t.binary("xor", a, t.constant(True if a.kind == "i1" else -1, a.kind))


@elementwise("convert_element_type")
def _(t, p, d, a):
    new = p["new_dtype"]
    return convert(t, a, kind_of(new), is_unsigned(d[0]), to_unsigned=is_unsigned(new))


def convert(t: Text, a: Value, kind: str, unsigned: bool, *, to_unsigned: bool = False) -> Value:
    """Return a value in another type, converted as JAX does. `unsigned` describes integers of the
    old type, `to_unsigned` those of the new one."""
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
        name = f"@llvm.fpto{'u' if to_unsigned else 's'}i.sat.{v}.{w}"
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
