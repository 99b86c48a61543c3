"""Elementary functions that no instruction computes, as code on whole vectors.

They are written for double precision; single precision is converted to it. Errors are at most 2
units in the last place, 4 for `cbrt` (`tests/lanes/test_library.py`). Subnormal results may be
zero, since the threads that run lanes treat such numbers as zero.
"""

from collections.abc import Callable, Sequence
from fractions import Fraction
from math import factorial, frexp, inf, nan, pi
from math import log as ln
from typing import Any

from ._text import Text, Value

# The least number of terms to split a polynomial. In one chain atan takes a seventh longer.
_LONG = 9


class Real:
    """A number of every lane with Python's operators. Products may be fused with sums.

    `plus` and `minus` are not fused, for sums whose rounding errors are computed afterwards.
    """

    def __init__(self, t: Text, value: Value):
        self.t, self.value = t, value

    def of(self, other: "Real | float") -> "Real":
        if isinstance(other, Real):
            return other
        return Real(self.t, self.t.constant(other, "double"))

    def _two(self, what: str, other: "Real | float", kind: str = "double") -> "Real":
        return Real(self.t, self.t.binary(what, self.value, self.of(other).value, kind))

    def __add__(self, other):
        return self._two("fadd contract", other)

    def __sub__(self, other):
        return self._two("fsub contract", other)

    def __rsub__(self, other):
        return self.of(other) - self

    def __mul__(self, other):
        return self._two("fmul contract", other)

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other):
        return self._two("fdiv", other)

    def __rtruediv__(self, other):
        return self.of(other) / self

    def __neg__(self):
        return Real(self.t, self.t.negative(self.value))

    def plus(self, other):
        return self._two("fadd", other)

    def minus(self, other):
        return self._two("fsub", other)

    # Comparisons are false if either number is NaN. They return flags for `choose`.

    def __lt__(self, other):
        return self._two("fcmp olt", other, "i1").value

    def __gt__(self, other):
        return self._two("fcmp ogt", other, "i1").value

    def equals(self, other) -> Value:
        return self._two("fcmp oeq", other, "i1").value

    def is_no_number(self) -> Value:
        return self._two("fcmp uno", self, "i1").value

    def choose(self, flag: Value, other) -> "Real":
        return Real(self.t, self.t.select(flag, self.value, self.of(other).value))

    def at_most(self, most: float) -> "Real":
        """Return the smaller of this number and `most`; NaN remains NaN."""
        return self.of(most).choose(self > most, self)

    def at_least(self, least: float) -> "Real":
        return self.of(least).choose(self < least, self)

    def call(self, name: str, *others) -> "Real":
        return Real(self.t, self.t.intrinsic(name, self.value, *(self.of(o).value for o in others)))

    def size(self) -> "Real":
        return self.call("fabs")

    def with_sign_of(self, other: "Real") -> "Real":
        return self.call("copysign", other)

    def is_negative(self) -> Value:
        """Return whether the sign bit is set, also for -0."""
        bits = self.t.cast("bitcast", self.value, "i64")
        return self.t.binary("icmp slt", bits, self.t.zero("i64"), "i1")

    def is_zero(self) -> Value:
        """Return whether this is +0, by its bits: false for subnormal numbers on any processor."""
        bits = self.t.cast("bitcast", self.value, "i64")
        return self.t.binary("icmp eq", bits, self.t.zero("i64"), "i1")

    def split(self) -> "tuple[Real, Real]":
        """Return m from √½ to √2 and an integer n: a normal positive number is m 2^n."""
        t = self.t
        bits = t.cast("bitcast", self.value, "i64")
        shifted = t.binary("sub", bits, t.constant(0x3FE6A09E667F3BCD, "i64"))
        power = t.binary("ashr", shifted, t.constant(52, "i64"))
        shifted = t.binary("sub", bits, t.binary("shl", power, t.constant(52, "i64")))
        m = t.cast("bitcast", shifted, "double")
        return Real(t, m), Real(t, t.cast("sitofp", power, "double"))

    def horner(self, coefficients: Sequence[float]) -> "Real":
        """Return the polynomial with these coefficients, constant term first."""
        total = self.of(coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            total = total * self + coefficient
        return total

    def polynomial(self, coefficients: Sequence[float], first: int = 2) -> "Real":
        """Return the same. In a long polynomial the terms after the `first` are two independent
        chains, of even and of odd powers."""
        if len(coefficients) < _LONG:
            return self.horner(coefficients)
        square, rest = self * self, coefficients[first:]
        even, odd = (square.polynomial(rest[i::2]) for i in range(2))
        total = self * odd + even
        for coefficient in coefficients[first - 1 :: -1]:
            total = total * self + coefficient
        return total

    def minus_multiple(self, turns: "Real", parts: Sequence[float]) -> "Real":
        """Return this number minus `turns` times the sum of `parts`."""
        found = self
        for part in parts:
            found = found - turns * part
        return found

    def power_of_two(self) -> "Real":
        """Return 2 to this integer, from -1022 to 1023; infinity at 1024."""
        t = self.t
        # The last bits of the sum are the biased exponent.
        biased = t.cast("bitcast", self.plus(1.5 * 2.0**52 + 1023).value, "i64")
        bits = t.binary("shl", biased, t.constant(52, "i64"))
        return Real(t, t.cast("bitcast", bits, "double"))


def two_sum(a: Real, b: Real) -> tuple[Real, Real]:
    """Return a + b rounded, and the rounding error."""
    total = a.plus(b)
    part = total.minus(a)
    return total, a.minus(total.minus(part)).plus(b.minus(part))


def fast_sum(a: Real, b: Real) -> tuple[Real, Real]:
    """Return the same if |a| >= |b| or a is zero."""
    total = a.plus(b)
    return total, b.minus(total.minus(a))


def significand(a: Real) -> tuple[Real, Real]:
    """Return `Real.split` for any finite a > 0; arbitrary numbers for zero."""
    small = a < 2.0**-1022
    # The bits of a subnormal number are an integer multiple of 2^-1074.
    whole = Real(a.t, a.t.cast("uitofp", a.t.cast("bitcast", a.value, "i64"), "double"))
    m, n = whole.choose(small, a).split()
    return m, (n - 1074.0).choose(small, n)


def _parts_of(number: float, count: int) -> list[float]:
    """Return `number` (to some hundred bits) as a sum of doubles. Products of all but the last with
    small integers are exact."""
    exact = {
        pi: Fraction(884279719003555, 281474976710656) + Fraction(1.2246467991473532e-16)
        + Fraction(-2.9947698097183397e-33),
        ln(2): Fraction(ln(2)) + Fraction(2.3190468138462996e-17),
    }[number]  # fmt: skip
    parts = []
    for _ in range(count - 1):
        scale = 2.0 ** (29 - frexp(abs(float(exact)))[1])
        head = round(exact * Fraction(scale)) / scale
        parts.append(head)
        exact -= Fraction(head)
    return [*parts, float(exact)]


_PI, _PI_LOW = pi, 1.2246467991473532e-16
_PI_PARTS, _LN2 = _parts_of(pi, 3), _parts_of(ln(2), 2)

# Taylor coefficients of the functions that a motion needs in each step.
_SIN = tuple((-1) ** n / factorial(2 * n + 1) for n in range(11))
_COS = tuple((-1) ** n / factorial(2 * n) for n in range(12))
_EXP = tuple(1 / factorial(n) for n in range(14))
_ATANH = tuple(2 / (2 * n + 1) for n in range(12))

# The spacing of larger doubles is at least one radian.
_LARGEST_PHASE = 2.0**52


def sincos(x: Real) -> tuple[Real, Real]:
    """Return sine and cosine: exact to rounding up to a million turns, arbitrary beyond 2^52."""
    t, turns = x.t, (x * (1 / pi)).call("roundeven")
    # Too large numbers and NaN become arbitrary integers.
    whole = t.cast("fptosi", turns.value, "i64")
    whole = t.value(f"freeze {t.vector('i64')} {whole.text}", "i64")
    odd = t.binary("shl", whole, t.constant(63, "i64"))  # the sign bit of (-1)^turns

    def flipped(y: Real) -> Real:
        bits = t.binary("xor", t.cast("bitcast", y.value, "i64"), odd)
        return Real(t, t.cast("bitcast", bits, "double"))

    rest = x.minus_multiple(turns, _PI_PARTS)
    square = rest * rest
    sine = flipped(rest * square.horner(_SIN))
    return sine, flipped(square.horner(_COS))


def sin(x: Real) -> Real:
    return _of_any_phase(x, sincos(x)[0])


def cos(x: Real) -> Real:
    return _of_any_phase(x, sincos(x)[1])


def _of_any_phase(x: Real, value: Real) -> Real:
    """Return the sine or cosine `value`, but NaN beyond 2^52, where x has no digits of a phase."""
    return value.choose(x.size() < _LARGEST_PHASE, nan)


def exp(x: Real) -> Real:
    t = x.t
    y = x.at_least(-760.0).at_most(720.0)
    n = (y * (1 / ln(2))).call("roundeven")
    value = y.minus_multiple(n, _LN2).horner(_EXP)
    # 2^n as two factors, so that neither overflows nor underflows.
    finite = x.of(0.0).choose(x.is_no_number(), n)
    whole = t.cast("fptosi", finite.value, "i64")
    half = t.binary("ashr", whole, t.constant(1, "i64"))
    for power in (half, t.binary("sub", whole, half)):
        biased = t.binary("add", power, t.constant(1023, "i64"))
        bits = t.binary("shl", biased, t.constant(52, "i64"))
        value = value * Real(t, t.cast("bitcast", bits, "double"))
    return value


def log(x: Real) -> Real:
    tiny = x < 2.0**-1000
    m, n = (x * 2.0**54).choose(tiny, x).split()
    n = n.minus(54.0).choose(tiny, n)
    ratio = m.minus(1.0) / m.plus(1.0)
    series = ratio * (ratio * ratio).horner(_ATANH)
    low = series + n * _LN2[1]
    value = n * _LN2[0] + low
    value = value.choose(x < inf, x)
    value = x.of(-inf).choose(x.equals(0.0), value)
    return x.of(nan).choose(x < 0.0, value)


# Polynomials of elementary functions, constant term first.
#
# They are near-minimax: interpolated at Chebyshev points with 60 digits, then rounded to doubles.
# The stated error is the largest error of the rounded polynomial in exact arithmetic, relative to
# the function.

# (f(z) / z - 1) / z² as polynomials p(z²): z + z³ p(z²) has the zero of the odd function f exactly.
# tanh on |z| <= 0.55, error 5.1e-18.
TANH = (
    -0.3333333333333333, 0.13333333333332714, -0.053968253967434016, 0.021869488493666944,
    -0.008863234397814355, 0.003592110378689024, -0.001455661830100716, 0.0005889360520074057,
    -0.0002346347410887237, 8.511313685577672e-05, -2.060276537636634e-05,
)  # fmt: skip
# atan on |z| <= 1, error 6.7e-18.
ATAN = (
    -0.3333333333333333, 0.19999999999999984, -0.14285714285711718, 0.11111111110929807,
    -0.09090909084093506, 0.07692307534369985, -0.06666664203478607, 0.0588232553920069,
    -0.05262931380521779, 0.04760471049395462, -0.043407182638729704, 0.03971908106924452,
    -0.036139320776507194, 0.03213544133307827, -0.02718155333081564, 0.021121594179966983,
    -0.014503079564732733, 0.00844989240397037, -0.004000209679906822, 0.0014617449054205385,
    -0.00038394037972999467, 6.417524965866564e-05, -5.1088410388226665e-06,
)  # fmt: skip
# asin on |z| <= 1/2, error 5.1e-18.
ASIN = (
    0.16666666666666669, 0.07499999999998433, 0.04464285714635543, 0.030381944138531247,
    0.02237217294214989, 0.017352392720869973, 0.013971212973552933, 0.011479177415184906,
    0.01032281435018578, 0.005457506718640358, 0.01740087944269402, -0.014851887071247204,
    0.028757851367421566,
)  # fmt: skip
# tan on |z| <= π/4, error 7.5e-18.
TAN = (
    0.3333333333333333, 0.1333333333333336, 0.05396825396821662, 0.021869488538180618,
    0.008863235472360148, 0.003592129022471812, 0.0014558233340176158, 0.0005901127322555614,
    0.00023866159900899438, 9.876874636871174e-05, 3.392890384212224e-05, 2.7108596383546008e-05,
    -1.0197280163552528e-05, 1.953688210814275e-05, -9.74523086709087e-06, 3.949593305285971e-06,
)  # fmt: skip
# sinh on |z| <= 1, error 9.2e-18.
SINH = (
    0.16666666666666666, 0.008333333333333299, 0.00019841269841324198, 2.7557319191381816e-06,
    2.5052117695907823e-08, 1.6057679623801638e-10, 7.746178593018827e-13,
)  # fmt: skip

# (e^r - 1 - r) / r², by Taylor's series: |r| <= ln(2) / 2, error below 1e-17.
_EXP_REST = tuple(1 / factorial(n) for n in range(2, 14))
# ln((1 + s) / (1 - s)) / s - 2 over s², the same; s² <= 0.0295.
_LOG = tuple(2 / (2 * n + 3) for n in range(10))

_HALF_PI = [part / 2 for part in _parts_of(pi, 4)]
# For |x| up to this bound the products of n and the first three parts are exact.
_TURNED = 2.0**20


def _odd(x: Real, value: Real) -> Real:
    """Return an odd function near x at zero from its value at |x|. Small x are returned even if the
    processor treats subnormal numbers as zero, as on XLA's threads."""
    return x.choose(x.size() < 2.0**-30, value.with_sign_of(x))


def _split_exponent(x: Real) -> tuple[Real, Real, Real]:
    """Return n, r rounded and e^r - 1 - r, with x = n ln(2) + r and |r| <= 0.35."""
    n = (x * (1 / ln(2))).call("roundeven")
    head = x - n * _LN2[0]  # exact
    r = head.minus(n * _LN2[1])
    rest = head.minus(r) - n * _LN2[1]
    return n, r, r * r * r.polynomial(_EXP_REST) + (rest + rest * r)


def exp_parts(x: Real) -> tuple[Real, Real]:
    """Return n and e^x 2^-n - 1, which lies between √½ - 1 and √2 - 1."""
    n, r, rest = _split_exponent(x)
    return n, r + rest


def expm1(x: Real) -> Real:
    n, r, rest = _split_exponent(x.at_least(-60.0).at_most(709.9))
    # 2^n (r + rest) + (2^n - 1), halved to stay finite until the end.
    half = (n - 1).power_of_two()
    high, low = fast_sum(half.minus(0.5), half * r)
    value = 2.0 * (high + (low + half * rest))
    return x.choose(x.size() < 2.0**-54, value)


def tanh(x: Real) -> Real:
    a = x.size()
    n, e = exp_parts((2.0 * a).at_most(40.0))
    square = a * a
    near = a < 0.55
    rest = (a * square * square.polynomial(TANH)).choose(
        near, -2.0 / ((e + 1.0) * n.power_of_two() + 1.0)
    )
    return _odd(x, a.choose(near, 1.0) + rest)


def _half_exp(a: Real) -> Real:
    """Return e^a / 2 for a >= 0, infinite only if it overflows."""
    n, e = exp_parts(a.at_most(711.0))
    return (2.0 * e + 2.0) * (n - 2.0).power_of_two()


def sinh(x: Real) -> Real:
    a = x.size()
    square, half = a * a, _half_exp(a)
    near = a + a * square * square.polynomial(SINH)
    return _odd(x, near.choose(a < 1.0, half - 0.25 / half))


def cosh(x: Real) -> Real:
    half = _half_exp(x.size())
    return half + 0.25 / half


def log1p(x: Real) -> Real:
    u, low = two_sum(x.of(1.0), x)
    m, n = u.split()
    f = m.minus(1.0)
    s = f / (f + 2.0)
    square = s * s
    # ln(1 + f) = 2 artanh(s), and 2s = f - s f.
    rest = low / u - s * (f - square * square.polynomial(_LOG))
    high, off = fast_sum(n * _LN2[0], f)
    value = (high + (off + (n * _LN2[1] + rest))).choose(u < inf, u)
    value = x.of(-inf).choose(u.equals(0.0), value)
    value = x.of(nan).choose(u < 0.0, value)
    return x.choose(x.size() < 2.0**-54, value)


def _arctangent(z: Real) -> Real:
    square = z * z
    # The terms alternate. Shorter chains have rounding errors up to 2.2 units near one.
    return z + z * square * square.polynomial(ATAN, 8)


def atan(x: Real) -> Real:
    a = x.size()
    far = a > 1.0
    angle = _arctangent((-1.0 / a).choose(far, a))
    high = x.of(_PI / 2).choose(far, 0.0)
    return _odd(x, high + (angle + x.of(_PI_LOW / 2).choose(far, 0.0)))


def atan2(y: Real, x: Real) -> Real:
    a, b = x.size(), y.size()
    steep = b > a
    less, more = a.choose(steep, b), b.choose(steep, a)
    ratio = less / more
    same = a.of(0.0).choose(a.equals(0.0), 1.0)
    angle = _arctangent(same.choose(a.equals(b), ratio))
    # x < 0: π minus the angle to the x axis; steep: π/2 minus the angle to the y axis.
    left = x.is_negative()
    angle = (-angle).choose(x.t.binary("xor", steep, left, "i1"), angle)
    quarters = x.of(1.0).choose(steep, x.of(2.0).choose(left, 0.0))
    value = quarters * (_PI / 2) + (angle + quarters * (_PI_LOW / 2))
    return value.with_sign_of(y)


def _arcsine(a: Real) -> tuple[Value, Real, Real]:
    """For a >= 0, return whether a > 1/2, z = √((1 - a) / 2) if so and else a, and asin(z) - z."""
    far = a > 0.5
    square = (0.5 - 0.5 * a).choose(far, a * a)
    z = square.call("sqrt").choose(far, a)
    return far, z, z * square * square.polynomial(ASIN)


def asin(x: Real) -> Real:
    far, z, rest = _arcsine(x.size())
    high, off = fast_sum(x.of(_PI / 2), -2.0 * z)
    steep = high + (off + (_PI_LOW / 2 - 2.0 * rest))
    return _odd(x, steep.choose(far, z + rest))


def acos(x: Real) -> Real:
    far, z, rest = _arcsine(x.size())
    left = x.is_negative()
    # 2 asin(z) for large x, π minus that for large -x, π/2 minus asin(x) between.
    factor = x.of(2.0).choose(far, 1.0)
    factor = factor.choose(x.t.binary("xor", far, left, "i1"), -factor)
    base = x.of(2.0).choose(left, 0.0).choose(far, 1.0)
    high, off = fast_sum(base * (_PI / 2), factor * z)
    return high + (off + (base * (_PI_LOW / 2) + factor * rest))


def tan(x: Real) -> Real:
    n = (x * (2 / pi)).call("roundeven")
    first = x - n * _HALF_PI[0]  # exact up to 2^20 quarter turns, like the next two products
    second, off = two_sum(first, -(n * _HALF_PI[1]))
    third, more = two_sum(second, -(n * _HALF_PI[2]))
    r, low = fast_sum(third, (off + more) - n * _HALF_PI[3])
    square = r * r
    rest = r * square * square.polynomial(TAN)
    rest = rest + low * (1.0 + (r + rest) * (r + rest))
    value, off = fast_sum(r, rest)
    inverse = -1.0 / value
    inverse = inverse + inverse * (inverse.call("fma", value, 1.0) + inverse * off)
    even = (2.0 * (0.5 * n).call("roundeven")).equals(n)
    a = x.size()
    near, far = value.choose(even, inverse).value, a > _TURNED
    with x.t.skipped_unless(far, rare=True) as fork:  # by the C library
        chosen = x.t.select(far, x.t.per_lane("tan", x.value), near)
    value = Real(x.t, fork.joined(chosen, near))
    return x.choose(a < 2.0**-30, value)


def rule(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of `Real`s, with one or several results, as a rule for either precision."""

    def written(t: Text, *args: Value) -> Any:
        single = args[0].kind == "float"
        wide = [t.cast("fpext", a, "double") if single else a for a in args]
        found = function(*(Real(t, a) for a in wide))
        several = found if isinstance(found, tuple) else (found,)
        narrow = [t.cast("fptrunc", x.value, "float") if single else x.value for x in several]
        return tuple(narrow) if isinstance(found, tuple) else narrow[0]

    return written


# Rarely used functions, called lane by lane in the C library, two to four times slower.
_BY_LANE = ("asinh", "acosh", "atanh", "exp2", "cbrt", "erf", "erfc")

LIBRARY = {
    function.__name__: rule(function)
    for function in (
        sin, cos, sincos, exp, log, tanh, tan, sinh, cosh, asin, acos, atan, atan2, expm1, log1p,
    )
} | {name: lambda t, x, name=name: t.per_lane(name, x) for name in _BY_LANE}  # fmt: skip


_LN2_PARTS = _parts_of(ln(2), 3)
# ln((1 + s) / (1 - s)) / s = 2 + s² (2/3 + s² p(s²)), by Taylor's series; s² <= 0.0295.
_THIRD, _THIRD_LOW = 2 / 3, float(Fraction(2, 3) - Fraction(2 / 3))
_LOG_TAIL = tuple(2 / (2 * n + 5) for n in range(11))


def _product(a: Real, b: Real) -> tuple[Real, Real]:
    """Return a b rounded, and the rounding error."""
    product = a * b
    return product, a.call("fma", b, -product)


def _logarithm(a: Real) -> tuple[Real, Real]:
    """Return ln(a) for a finite a > 0, as a sum of two numbers."""
    m, n = significand(a)
    f = m.minus(1.0)
    below, off = fast_sum(a.of(2.0), f)
    s = f / below
    s_low = ((-s).call("fma", below, f) - s * off) / below
    square, square_low = _product(s, s)
    square_low = square_low + 2.0 * s * s_low
    third, third_low = fast_sum(a.of(_THIRD), square * square.polynomial(_LOG_TAIL))
    third_low = third_low + _THIRD_LOW
    cube, cube_low = _product(square, third)
    cube_low = cube_low + square * third_low + square_low * third
    rest, rest_low = _product(s, cube)
    rest_low = rest_low + s * cube_low + s_low * cube
    # n ln(2) + 2s + rest: the products of n and the first two parts of ln(2) are exact.
    high, off = fast_sum(n * _LN2_PARTS[0], 2.0 * s)
    high, more = two_sum(high, n * _LN2_PARTS[1])
    high, least = two_sum(high, rest)
    low = off + more + least + (n * _LN2_PARTS[2] + 2.0 * s_low + rest_low)
    return fast_sum(high, low)


@rule
def power(x: Real, y: Real) -> Real:
    """Return x to the power y as the C library defines it, including special cases."""
    t, a = x.t, x.size()
    high, low = _logarithm(a)
    high = x.of(-inf).choose(a.is_zero(), high.choose(a < inf, a))
    exponent = y * high
    # For results out of range, infinities included, only the sign of the exponent matters.
    off = (y.call("fma", high, -exponent) + y * low).choose(exponent.size() < 800.0, 0.0)
    n, s = exp_parts(exponent.at_least(-800.0).at_most(800.0))
    value = 1.0 + (s + (off + s * off))
    half = (0.5 * n).call("roundeven")
    value = value * half.power_of_two() * (n - half).power_of_two()
    whole = y.call("trunc").equals(y)
    halves = 0.5 * y
    even = halves.call("trunc").equals(halves)
    odd = t.both(whole, t.inverse(even))
    value = (-value).choose(t.both(odd, x.is_negative()), value)
    undefined = t.both(t.both(x < 0.0, x > -inf), t.inverse(whole))
    value = x.of(nan).choose(undefined, value)
    one = t.both(a.equals(1.0), y.size().equals(inf))
    value = x.of(1.0).choose(one, value)
    return x.of(1.0).choose(t.binary("or", x.equals(1.0), y.equals(0.0)), value)
