"""The next coefficient of each primitive's result, from those known: a sum, a convolution, or a
recurrence of the kind e' = a' e.

Each rule returns the n-th coefficient of an equation's result, or a list of them where
it has several results.

**Arguments** of every rule: `eqn`, the equation of a jaxpr; `n`; `operands`, the series of what it
takes, known up to n; `results`, those of its results, known before n; `extra`, a dictionary of its
own that it keeps from one n to the next.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer

Coefficient = Any
"""An array, or `None` for zero."""
Series = list[Coefficient]


class NoSeries(Exception):
    """A field without a recursion; the argument is the primitive's name."""


class NotSmooth(Exception):
    """A field with a kink or a jump where the state says; the argument is what makes it."""


def nth(series: Series, n: int) -> Coefficient:
    """The n-th coefficient, zero beyond those known."""
    return series[n] if n < len(series) else None


def plus(a: Coefficient, b: Coefficient) -> Coefficient:
    """The sum a + b of two power series."""
    if a is None or b is None:
        return b if a is None else a
    return a + b


def minus(a: Coefficient, b: Coefficient) -> Coefficient:
    """The difference a - b of two power series."""
    if b is None:
        return a
    return -b if a is None else a - b


def times(a: Coefficient, b: Coefficient) -> Coefficient:
    """The product a b of two power series, as far as both are known."""
    return None if a is None or b is None else a * b


def scaled(c: float, a: Coefficient) -> Coefficient:
    """The power series a times a number c."""
    return None if a is None else a if c == 1 else a * c


def convolution(
    a: Series, b: Series, n: int, begin: int = 0, weight: Callable[[int], float] | None = None
) -> Coefficient:
    """The n-th coefficient of a product of two series, or a part of that sum: Σ weight(j) a_j
    b_{n-j} over j from `begin` to n.

    **Arguments:** `weight`, 1 if left out.
    """
    terms = []
    # What is known longest comes first: only the last products wait for the newest coefficients.
    for j in sorted(range(begin, n + 1), key=lambda j: max(j, n - j)):
        term = times(nth(a, j), nth(b, n - j))
        terms.append(term if weight is None else scaled(weight(j), term))
    return sum_of(terms)


def sum_of(terms: list[Coefficient]) -> Coefficient:
    """Their sum, by two chains of additions that do not wait for each other."""
    chains: list[Coefficient] = [None, None]
    for i, term in enumerate(t for t in terms if t is not None):
        chains[i % 2] = plus(chains[i % 2], term)
    return plus(*chains)


def square(a: Series, n: int) -> Coefficient:
    """Of a series with itself: each mixed product once."""
    pairs = [times(nth(a, j), nth(a, n - j)) for j in reversed(range((n + 1) // 2))]
    total = scaled(2.0, sum_of(pairs))
    return plus(total, times(nth(a, n // 2), nth(a, n // 2))) if n % 2 == 0 else total


# What acts on each coefficient by itself.
_LINEAR = (
    "neg", "convert_element_type", "stop_gradient", "copy", "copy_p", "pin", "reshape",
    "broadcast_in_dim", "squeeze", "expand_dims", "transpose", "slice", "rev", "reduce_sum",
    "cumsum", "split", "tile", "unstack",
)  # fmt: skip

# What is linear in several operands at once: those in these places, or all; the others are places
# in arrays, known where the step begins.
_JOINED = {
    "concatenate": None, "stack": None, "pad": None, "dynamic_slice": (0,), "gather": (0,),
    "dynamic_update_slice": (0, 1), "scatter": (0, 2), "scatter-add": (0, 2),
}  # fmt: skip


class _Kink(NamedTuple):
    """What is not smooth in some of its operands."""

    word: str
    """How a field writes it."""
    places: tuple[int | None, int | None]
    """The first of those operands, and the one behind the last; `None` for an end."""


# A series goes on as the step begins. Comparisons count where something is chosen by them.
KINKS = {
    "abs": _Kink("abs", (0, None)),
    "max": _Kink("maximum", (0, None)),
    "min": _Kink("minimum", (0, None)),
    "sign": _Kink("sign", (0, None)),
    "round": _Kink("round", (0, None)),
    "floor": _Kink("floor", (0, None)),
    "ceil": _Kink("ceil", (0, None)),
    "select_n": _Kink("where", (0, 1)),
    "gather": _Kink("an index", (1, None)),
    "dynamic_slice": _Kink("an index", (1, None)),
    "dynamic_update_slice": _Kink("an index", (2, None)),
    "scatter": _Kink("an index", (1, 2)),
    "scatter-add": _Kink("an index", (1, 2)),
}

# What is decided by the value where the step begins.
_DECIDED = (
    "eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "xor", "is_finite", "iota", "abs",
    "max", "min", "sign", "round", "floor", "ceil",
)  # fmt: skip


def _bound(eqn: Any, *values: Any) -> Any:
    if any(isinstance(v, Tracer) for v in values):
        return eqn.primitive.bind(*values, **eqn.params)
    with jax.ensure_compile_time_eval():  # what is known, such as an exponent, stays known
        return eqn.primitive.bind(*values, **eqn.params)


def _linear(eqn, n, operands, results, extra):
    c = nth(operands[0], n)
    if c is None:
        return [None] * len(eqn.outvars)
    out = _bound(eqn, c, *(x[0] for x in operands[1:]))
    return list(out) if eqn.primitive.multiple_results else [out]


def _joined(eqn, n, operands, results, extra):
    places = _JOINED[eqn.primitive.name]
    parts = [nth(x, n) if places is None or i in places else x[0] for i, x in enumerate(operands)]
    moving = parts if places is None else [parts[i] for i in places]
    if all(p is None for p in moving):
        return None
    full = [jnp.zeros_like(x[0]) if p is None else p for p, x in zip(parts, operands, strict=True)]
    return _bound(eqn, *full)


def _decided(eqn, n, operands, results, extra):
    return None if n else _bound(eqn, *(x[0] for x in operands))


def _selected(eqn, n, operands, results, extra):
    which, *cases = operands
    parts = [nth(x, n) for x in cases]
    if all(p is None for p in parts):
        return None
    zero = jnp.zeros_like(cases[0][0])
    return _bound(eqn, which[0], *(zero if p is None else p for p in parts))


def _product(eqn, n, operands, results, extra):
    a, b = operands
    return square(a, n) if a is b else convolution(a, b, n)


def _dot(eqn, n, operands, results, extra):
    total = None
    for j in range(n + 1):
        a, b = nth(operands[0], j), nth(operands[1], n - j)
        total = plus(total, None if a is None or b is None else _bound(eqn, a, b))
    return total


def _inverse(extra: dict, base: Any) -> Any:
    if "inverse" not in extra:
        extra["inverse"] = 1 / base
    return extra["inverse"]


def _quotient(eqn, n, operands, results, extra):
    a, b = operands
    if all(c is None for c in b[1:]):  # a constant
        return times(nth(a, n), _inverse(extra, b[0])) if n else a[0] / b[0]
    rest = minus(nth(a, n), convolution(b, results[0], n, 1) if n else None)
    return times(rest, _inverse(extra, b[0]))


def _power(series: Series, own: Series, p: float, n: int, first: Any, extra: dict) -> Coefficient:
    """The n-th coefficient c_n of a^p: n a0 c_n = Σ (p j - (n - j)) a_j c_{n-j}.

    **Arguments:** `series`, a; `own`, the coefficients c before it; `first`, a^p of a number;
    `extra`, what is kept from one n to the next.
    """
    if n == 0:
        return first(series[0])
    total = convolution(series, own, n, 1, lambda j: (p * j - (n - j)) / n)
    return times(total, _inverse(extra, series[0]))


def _integer_power(eqn, n, operands, results, extra):
    a, y = operands[0], eqn.params["y"]
    if y == 0:
        return None if n else jnp.ones_like(a[0])
    if y < 0:
        extra.setdefault("power", [])
        below = _multiplied(a, -y, n, extra)
        extra["power"].append(below)
        rest = minus(
            None if n else jnp.ones_like(a[0]),
            convolution(extra["power"], results[0], n, 1) if n else None,
        )
        return times(rest, _inverse(extra, extra["power"][0]))
    return _multiplied(a, y, n, extra)


def _multiplied(a: Series, y: int, n: int, extra: dict) -> Coefficient:
    """The n-th coefficient of a^y by squares and products, whose series are kept."""
    if y == 1:
        return nth(a, n)
    own: Series = extra.setdefault(y, [])
    if y % 2 == 0:
        half_of: Series = a if y == 2 else extra.setdefault(("half", y), [])
        if y > 2:
            half_of.append(_multiplied(a, y // 2, n, extra))
        c = square(half_of, n)
    else:
        less: Series = extra.setdefault(("less", y), [])
        less.append(_multiplied(a, y - 1, n, extra))
        c = convolution(a, less, n)
    own.append(c)
    return c


def _constant_exponent(exponent: Series) -> float:
    try:
        return float(exponent[0])
    except (TypeError, jax.errors.ConcretizationTypeError):
        raise NoSeries("pow with an exponent that is no constant") from None


def _pow(eqn, n, operands, results, extra):
    a, b = operands
    p = _constant_exponent(b)
    return _power(a, results[0], p, n, lambda x: _bound(eqn, x, b[0]), extra)


def _root(p: float):
    def rule(eqn, n, operands, results, extra):
        return _power(operands[0], results[0], p, n, lambda x: _bound(eqn, x), extra)

    return rule


def _derivative_weight(n: int) -> Callable[[int], float]:
    return lambda j: j / n


def _exp(eqn, n, operands, results, extra):
    if n == 0:
        return _bound(eqn, operands[0][0])
    return convolution(operands[0], results[0], n, 1, _derivative_weight(n))


def _log(eqn, n, operands, results, extra):
    a = operands[0]
    if n == 0:
        return _bound(eqn, a[0])
    total = None
    for j in range(1, n):
        total = plus(total, scaled(j / n, times(nth(results[0], j), nth(a, n - j))))
    return times(minus(nth(a, n), total), _inverse(extra, a[0]))


def _pair(n: int, a: Series, sine: Series, cosine: Series) -> tuple[Coefficient, Coefficient]:
    """Next coefficients of sine and cosine, each other's derivatives."""
    s = convolution(a, cosine, n, 1, _derivative_weight(n))
    return s, minus(None, convolution(a, sine, n, 1, _derivative_weight(n)))


def _sincos(eqn, n, operands, results, extra):
    if n == 0:
        return list(_bound(eqn, operands[0][0]))
    return list(_pair(n, operands[0], *results))


def _one_of_pair(which: int):
    def rule(eqn, n, operands, results, extra):
        a = operands[0]
        sine, cosine = extra.setdefault("sine", []), extra.setdefault("cosine", [])
        new = (jnp.sin(a[0]), jnp.cos(a[0])) if n == 0 else _pair(n, a, sine, cosine)
        sine.append(new[0])
        cosine.append(new[1])
        return new[which]

    return rule


def _saturating(slope: Callable[[Any], Any], next_slope: Callable[[Series, int], Coefficient]):
    """Of functions whose derivative is a polynomial of themselves: y' = slope(y) a'."""

    def rule(eqn, n, operands, results, extra):
        rates: Series = extra.setdefault("slope", [])
        if n == 0:
            y = _bound(eqn, operands[0][0])
            rates.append(slope(y))
            return y
        y = convolution(operands[0], rates, n, 1, _derivative_weight(n))
        rates.append(next_slope([*results[0], y], n))
        return y

    return rule


RULES: dict[str, Callable] = {
    **dict.fromkeys(_LINEAR, _linear),
    **dict.fromkeys(_JOINED, _joined),
    **dict.fromkeys(_DECIDED, _decided),
    "add": lambda e, n, o, r, x: plus(nth(o[0], n), nth(o[1], n)),
    "add_any": lambda e, n, o, r, x: plus(nth(o[0], n), nth(o[1], n)),
    "sub": lambda e, n, o, r, x: minus(nth(o[0], n), nth(o[1], n)),
    "mul": _product,
    "div": _quotient,
    "square": lambda e, n, o, r, x: square(o[0], n),
    "integer_pow": _integer_power,
    "pow": _pow,
    "sqrt": _root(0.5),
    "rsqrt": _root(-0.5),
    "exp": _exp,
    "log": _log,
    "sincos": _sincos,
    "sin": _one_of_pair(0),
    "cos": _one_of_pair(1),
    "tanh": _saturating(lambda y: 1 - y * y, lambda y, n: minus(None, square(y, n))),
    "logistic": _saturating(lambda y: y * (1 - y), lambda y, n: minus(nth(y, n), square(y, n))),
    "select_n": _selected,
    "dot_general": _dot,
}
"""By the primitive's name, functions of its equation, n, the operands' series, the results' series
so far, and what was kept from one n to the next."""
