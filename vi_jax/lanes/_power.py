"""Powers, by a logarithm to some 66 bits."""

from fractions import Fraction
from math import inf, log, nan

from ._functions import parts_of
from ._library import exp_parts, rule
from ._real import Real, fast_sum, significand, two_sum

_LN2 = parts_of(log(2), 3)
# ln((1 + s) / (1 - s)) / s = 2 + s² (2/3 + s² p(s²)), by Taylor's series; s² <= 0.0295.
_THIRD, _THIRD_LOW = 2 / 3, float(Fraction(2, 3) - Fraction(2 / 3))
_LOG = tuple(2 / (2 * n + 5) for n in range(11))


def _product(a: Real, b: Real) -> tuple[Real, Real]:
    """a b rounded, and what was rounded off."""
    product = a * b
    return product, a.call("fma", b, -product)


def _logarithm(a: Real) -> tuple[Real, Real]:
    """ln(a) for a finite a > 0, as a sum of two numbers."""
    m, n = significand(a)
    f = m.minus(1.0)
    below, off = fast_sum(a.of(2.0), f)
    s = f / below
    s_low = ((-s).call("fma", below, f) - s * off) / below
    square, square_low = _product(s, s)
    square_low = square_low + 2.0 * s * s_low
    third, third_low = fast_sum(a.of(_THIRD), square * square.polynomial(_LOG))
    third_low = third_low + _THIRD_LOW
    cube, cube_low = _product(square, third)
    cube_low = cube_low + square * third_low + square_low * third
    rest, rest_low = _product(s, cube)
    rest_low = rest_low + s * cube_low + s_low * cube
    # n ln(2) + 2s + rest: the first two parts of ln(2) times n are exact.
    high, off = fast_sum(n * _LN2[0], 2.0 * s)
    high, more = two_sum(high, n * _LN2[1])
    high, least = two_sum(high, rest)
    low = off + more + least + (n * _LN2[2] + 2.0 * s_low + rest_low)
    return fast_sum(high, low)


@rule
def power(x: Real, y: Real) -> Real:
    """x to the y as the C library has it, with its corners."""
    t, a = x.t, x.size()
    high, low = _logarithm(a)
    high = x.of(-inf).choose(a.is_zero(), high.choose(a < inf, a))
    exponent = y * high
    # Beyond the range of results, where also infinities are, only the sign of it matters.
    off = (y.call("fma", high, -exponent) + y * low).choose(exponent.size() < 800.0, 0.0)
    n, s = exp_parts(exponent.at_least(-800.0).at_most(800.0))
    value = 1.0 + (s + (off + s * off))
    half = (0.5 * n).call("roundeven")
    value = value * half.power_of_two() * (n - half).power_of_two()
    whole = y.call("trunc").equals(y)
    halves = 0.5 * y
    even = halves.call("trunc").equals(halves)
    odd = t.both(whole, t.inverse(even))
    value = (-value).choose(t.both(odd, x.negative()), value)
    undefined = t.both(t.both(x < 0.0, x > -inf), t.inverse(whole))
    value = x.of(nan).choose(undefined, value)
    one = t.both(a.equals(1.0), y.size().equals(inf))
    value = x.of(1.0).choose(one, value)
    return x.of(1.0).choose(t.binary("or", x.equals(1.0), y.equals(0.0)), value)
