"""Whole numbers: what is known of them while the code is written, quotients, comparisons."""

import operator

from ._text import Text, Value, is_float


def known(t: Text, a: Value, b: Value, operation: str) -> Value | None:
    """The result for two known integers small enough not to run over; places in arrays are such."""
    if a.number is None or b.number is None or a.kind == "i1":
        return None
    x, y = int(a.number), int(b.number)
    if max(abs(x), abs(y)) >= 2**15 or a.kind not in ("i32", "i64"):
        return None
    found = {"add": x + y, "sub": x - y, "mul": x * y}.get(operation)
    return None if found is None else t.constant(found, a.kind)


def compare(t: Text, how: str, a: Value, b: Value, unsigned: bool) -> Value:
    """Whether a is `"lt"`, `"le"`, `"eq"`, … b; false where either is NaN, but for `"ne"`."""
    if is_float(a.kind):
        order = {"eq": "oeq", "ne": "une"}.get(how, "o" + how)
        return t.binary(f"fcmp {order}", a, b, "i1")
    if a.number is not None and b.number is not None and a.kind != "i1":
        return t.constant(getattr(operator, how)(a.number, b.number), "i1")
    order = how if how in ("eq", "ne") else ("u" if unsigned else "s") + how
    return t.binary(f"icmp {order}", a, b, "i1")


def of_integers(t: Text, what: str, a: Value, b: Value, unsigned: bool) -> Value:
    """Quotient (`"div"`) or remainder (`"rem"`) of integers as XLA has them where a processor would
    trap: by zero -1 and the dividend; by -1, which may overflow, -a and 0. A slot of a group in
    which there is no lane holds zeros."""
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
    """An integer for each floating-point number, in IEEE's total order of them."""
    if not is_float(a.kind):
        return a
    kind, bits = ("i64", 63) if a.kind == "double" else ("i32", 31)
    whole = t.cast("bitcast", a, kind)
    sign = t.binary("ashr", whole, t.constant(bits, kind))
    return t.binary("xor", whole, t.binary("and", sign, t.constant(2**bits - 1, kind)))
