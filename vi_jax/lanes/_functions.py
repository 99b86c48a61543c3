"""Elementary functions without a hardware instruction, as polynomials on whole vectors."""

from collections.abc import Sequence
from fractions import Fraction
from math import factorial, frexp, log, nan, pi

from ._text import Text, Value

_SIN = tuple((-1) ** n / factorial(2 * n + 1) for n in range(11))
_COS = tuple((-1) ** n / factorial(2 * n) for n in range(12))
_EXP = tuple(1 / factorial(n) for n in range(14))
_ATANH = tuple(2 / (2 * n + 1) for n in range(12))


def parts_of(number: float, count: int) -> list[float]:
    """`number` (to some hundred bits) as a sum of doubles whose products with small integers are
    exact."""
    exact = {
        pi: Fraction(884279719003555, 281474976710656) + Fraction(1.2246467991473532e-16)
        + Fraction(-2.9947698097183397e-33),
        log(2): Fraction(log(2)) + Fraction(2.3190468138462996e-17),
    }[number]  # fmt: skip
    parts = []
    for _ in range(count - 1):
        scale = 2.0 ** (29 - frexp(abs(float(exact)))[1])
        head = round(exact * Fraction(scale)) / scale
        parts.append(head)
        exact -= Fraction(head)
    return [*parts, float(exact)]


# Beyond, a double does not tell where in a turn it is.
_LARGEST_PHASE = 2.0**52
_PI, LN2 = parts_of(pi, 3), parts_of(log(2), 2)


def _add(t: Text, a: Value, b: Value) -> Value:
    return t.binary("fadd contract", a, b)


def _mul(t: Text, a: Value, b: Value) -> Value:
    return t.binary("fmul contract", a, b)


def horner(t: Text, coefficients: Sequence[float], x: Value) -> Value:
    """The polynomial with these coefficients, constant term first."""
    total = t.constant(coefficients[-1], x.kind)
    for c in coefficients[-2::-1]:
        total = _add(t, _mul(t, total, x), t.constant(c, x.kind))
    return total


def _less_multiples(t: Text, x: Value, turns: Value, parts: Sequence[float]) -> Value:
    for part in parts:
        x = t.binary("fsub contract", x, _mul(t, turns, t.constant(part, x.kind)))
    return x


def _reduced(t: Text, x: Value) -> tuple[Value, Value]:
    """x less a multiple of π, within ±π/2, and the sign bit of (-1)^multiple."""
    turns = t.intrinsic("roundeven", _mul(t, x, t.constant(1 / pi, "double")))
    # What is too large, or no number, becomes any whole one.
    whole = t.value(f"freeze {t.vector('i64')} {t.cast('fptosi', turns, 'i64').text}", "i64")
    odd = t.binary("shl", whole, t.constant(63, "i64"))
    return _less_multiples(t, x, turns, _PI), odd


def _flipped(t: Text, x: Value, bit: Value) -> Value:
    return t.cast("bitcast", t.binary("xor", t.cast("bitcast", x, "i64"), bit), "double")


def sincos(t: Text, x: Value) -> tuple[Value, Value]:
    """Sine and cosine of a phase, to rounding up to a million turns; any number beyond 2^52."""
    wide = t.cast("fpext", x, "double") if x.kind == "float" else x
    rest, bit = _reduced(t, wide)
    square = _mul(t, rest, rest)
    sine = _flipped(t, _mul(t, rest, horner(t, _SIN, square)), bit)
    cosine = _flipped(t, horner(t, _COS, square), bit)
    if x.kind == "float":
        return t.cast("fptrunc", sine, "float"), t.cast("fptrunc", cosine, "float")
    return sine, cosine


def of_any_phase(t: Text, x: Value, value: Value) -> Value:
    """The sine or cosine of any x; not a number beyond 2^52, where x has no digits of a phase."""
    known = _compare(t, "olt", t.intrinsic("fabs", x), t.constant(_LARGEST_PHASE, x.kind))
    return t.select(known, value, t.constant(nan, x.kind))


def exp(t: Text, x: Value) -> Value:
    """e to the x, overflow and underflow included."""
    if x.kind == "float":
        return t.cast("fptrunc", exp(t, t.cast("fpext", x, "double")), "float")
    low, high = t.constant(-760.0, "double"), t.constant(720.0, "double")
    # Not a number stays one: the comparisons are false for it.
    y = t.select(_compare(t, "olt", x, low), low, x)
    y = t.select(_compare(t, "ogt", y, high), high, y)
    n = t.intrinsic("roundeven", _mul(t, y, t.constant(1 / log(2), "double")))
    value = horner(t, _EXP, _less_multiples(t, y, n, LN2))
    # 2^n in two factors, so that neither leaves the range of exponents.
    finite = t.select(_compare(t, "uno", x, x), t.zero("double"), n)
    whole = t.cast("fptosi", finite, "i64")
    half = t.binary("ashr", whole, t.constant(1, "i64"))
    for power in (half, t.binary("sub", whole, half)):
        biased = t.binary("add", power, t.constant(1023, "i64"))
        factor = t.cast("bitcast", t.binary("shl", biased, t.constant(52, "i64")), "double")
        value = _mul(t, value, factor)
    return value


def mantissa(t: Text, x: Value) -> tuple[Value, Value]:
    """m between √½ and √2 and a whole number n, so that x = m 2^n, for a normal x > 0."""
    bits = t.cast("bitcast", x, "i64")
    shifted = t.binary("sub", bits, t.constant(0x3FE6A09E667F3BCD, "i64"))
    power = t.binary("ashr", shifted, t.constant(52, "i64"))
    shifted = t.binary("sub", bits, t.binary("shl", power, t.constant(52, "i64")))
    return t.cast("bitcast", shifted, "double"), power


def log_(t: Text, x: Value) -> Value:
    """Natural logarithm."""
    if x.kind == "float":
        return t.cast("fptrunc", log_(t, t.cast("fpext", x, "double")), "float")
    tiny = _compare(t, "olt", x, t.constant(2.0**-1000, "double"))
    scaled = t.select(tiny, _mul(t, x, t.constant(2.0**54, "double")), x)
    significand, power = mantissa(t, scaled)
    n = t.cast("sitofp", power, "double")
    n = t.select(tiny, t.binary("fsub", n, t.constant(54.0, "double")), n)
    one = t.constant(1.0, "double")
    ratio = t.binary("fdiv", t.binary("fsub", significand, one), t.binary("fadd", significand, one))
    series = _mul(t, ratio, horner(t, _ATANH, _mul(t, ratio, ratio)))
    low = _add(t, series, _mul(t, n, t.constant(LN2[1], "double")))
    value = _add(t, _mul(t, n, t.constant(LN2[0], "double")), low)
    infinity, none = t.constant(float("inf"), "double"), t.constant(nan, "double")
    value = t.select(_compare(t, "olt", x, infinity), value, x)
    value = t.select(
        _compare(t, "oeq", x, t.zero("double")), t.constant(-float("inf"), "double"), value
    )
    return t.select(_compare(t, "olt", x, t.zero("double")), none, value)


def _compare(t: Text, how: str, a: Value, b: Value) -> Value:
    return t.binary(f"fcmp {how}", a, b, "i1")
