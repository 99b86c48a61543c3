"""Double precision numbers of every lane with Python's operators, to write long formulas."""

from collections.abc import Sequence

from ._functions import horner, mantissa
from ._text import Text, Value

# Terms from which on a polynomial is split; with all in one chain erf and erfc take a fifth longer.
_LONG = 9


class Real:
    """A number of every lane with Python's operators; products may be fused with sums.

    `plus` and `minus` round as they stand, where a later operation recovers what was rounded off.
    """

    def __init__(self, t: Text, value: Value):
        self.t, self.value = t, value

    def of(self, other: "Real | float") -> "Real":
        """A Python number as one of these."""
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
        return Real(
            self.t, self.t.value(f"fneg {self.t.vector('double')} {self.value.text}", "double")
        )

    def plus(self, other):
        return self._two("fadd", other)

    def minus(self, other):
        return self._two("fsub", other)

    # Comparisons are false where either is NaN. They return flags for `choose`.

    def __lt__(self, other):
        return self._two("fcmp olt", other, "i1").value

    def __gt__(self, other):
        return self._two("fcmp ogt", other, "i1").value

    def equals(self, other) -> Value:
        return self._two("fcmp oeq", other, "i1").value

    def choose(self, flag: Value, other) -> "Real":
        """This where the flag holds, else the other."""
        return Real(self.t, self.t.select(flag, self.value, self.of(other).value))

    def at_most(self, most: float) -> "Real":
        """The smaller of this and `most`; NaN stays NaN."""
        return self.of(most).choose(self > most, self)

    def at_least(self, least: float) -> "Real":
        return self.of(least).choose(self < least, self)

    def call(self, name: str, *others) -> "Real":
        """The intrinsic of LLVM of this name, of this and the others."""
        return Real(self.t, self.t.intrinsic(name, self.value, *(self.of(o).value for o in others)))

    def size(self) -> "Real":
        return self.call("fabs")

    def with_sign_of(self, other: "Real") -> "Real":
        return self.call("copysign", other)

    def negative(self) -> Value:
        """Whether the sign bit is set, as that of -0 is."""
        bits = self.t.cast("bitcast", self.value, "i64")
        return self.t.binary("icmp slt", bits, self.t.zero("i64"), "i1")

    def is_zero(self) -> Value:
        """Whether this is zero without a sign; no subnormal number is, whatever the processor."""
        bits = self.t.cast("bitcast", self.value, "i64")
        return self.t.binary("icmp eq", bits, self.t.zero("i64"), "i1")

    def split(self) -> "tuple[Real, Real]":
        """For a normal positive number, m between √½ and √2 and a whole n: m 2^n."""
        m, power = mantissa(self.t, self.value)
        return Real(self.t, m), Real(self.t, self.t.cast("sitofp", power, "double"))

    def polynomial(self, coefficients: Sequence[float], first: int = 2) -> "Real":
        """With these coefficients, constant term first; of a long one all but the `first` terms as
        two that do not wait for each other, of the even powers and of the odd."""
        if len(coefficients) < _LONG:
            return Real(self.t, horner(self.t, coefficients, self.value))
        square, rest = self * self, coefficients[first:]
        even, odd = (square.polynomial(rest[i::2]) for i in range(2))
        total = self * odd + even
        for coefficient in coefficients[first - 1 :: -1]:
            total = total * self + coefficient
        return total

    def power_of_two(self) -> "Real":
        """2 to this whole number, from -1022 to 1023; infinity at 1024."""
        t = self.t
        # The sum's last bits are the exponent with its bias.
        biased = t.cast("bitcast", self.plus(1.5 * 2.0**52 + 1023).value, "i64")
        bits = t.binary("shl", biased, t.constant(52, "i64"))
        return Real(t, t.cast("bitcast", bits, "double"))


def two_sum(a: Real, b: Real) -> tuple[Real, Real]:
    """a + b rounded, and what was rounded off."""
    total = a.plus(b)
    part = total.minus(a)
    return total, a.minus(total.minus(part)).plus(b.minus(part))


def fast_sum(a: Real, b: Real) -> tuple[Real, Real]:
    """The same where |a| >= |b| or a is zero."""
    total = a.plus(b)
    return total, b.minus(total.minus(a))


def significand(a: Real) -> tuple[Real, Real]:
    """`Real.split` for any finite a >= 0; anything at zero."""
    small = a < 2.0**-1022
    # The bits of a subnormal number are its multiple of 2^-1074.
    whole = Real(a.t, a.t.cast("uitofp", a.t.cast("bitcast", a.value, "i64"), "double"))
    m, n = whole.choose(small, a).split()
    return m, (n - 1074.0).choose(small, n)
