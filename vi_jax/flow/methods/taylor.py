"""A Taylor method: each step is a power series, in which events are located directly.

The coefficients are computed by recursion over the field's own jaxpr. From the first n coefficients
of every variable, each equation gives the next one of its result: by a sum, a convolution, or a
recurrence such as e' = a' e.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import factorial, pi
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal
from jax.lax import stop_gradient

from ..._checks import count, require
from ..._types import Scalar, Scalars, State
from ...lanes import called
from ...machine import SoftStop, switches_of
from .._step.roots import Rates
from ..smooth import Integrals, SmoothMachine, rate_of_integrals
from .base import AbstractMethod, has_relaxation

Coefficient = Any
"""An array, or `None` for zero."""
Series = list[Coefficient]


class NoSeries(Exception):
    """A field without a recursion; the argument is the name of the primitive."""


class NotSmooth(Exception):
    """A field with a kink or jump that depends on the state; the argument names its function."""


def nth(series: Series, n: int) -> Coefficient:
    """Return the n-th coefficient, zero beyond those known."""
    return series[n] if n < len(series) else None


def plus(a: Coefficient, b: Coefficient) -> Coefficient:
    if a is None or b is None:
        return b if a is None else a
    return a + b


def minus(a: Coefficient, b: Coefficient) -> Coefficient:
    if b is None:
        return a
    return -b if a is None else a - b


def times(a: Coefficient, b: Coefficient) -> Coefficient:
    return None if a is None or b is None else a * b


def scaled(c: float, a: Coefficient) -> Coefficient:
    return None if a is None else a if c == 1 else a * c


def convolution(
    a: Series, b: Series, n: int, begin: int = 0, weight: Callable[[int], float] | None = None
) -> Coefficient:
    """Return the n-th coefficient of a product of two series, or a part of that sum: Σ weight(j)
    a_j b_{n-j} over j from `begin` to n."""
    terms = []
    # The oldest coefficients come first: only the last products wait for the newest ones.
    for j in sorted(range(begin, n + 1), key=lambda j: max(j, n - j)):
        term = times(nth(a, j), nth(b, n - j))
        terms.append(term if weight is None else scaled(weight(j), term))
    return sum_of(terms)


def sum_of(terms: list[Coefficient]) -> Coefficient:
    """Return the sum of terms, by two independent chains of additions."""
    chains: list[Coefficient] = [None, None]
    for i, term in enumerate(t for t in terms if t is not None):
        chains[i % 2] = plus(chains[i % 2], term)
    return plus(*chains)


def square(a: Series, n: int) -> Coefficient:
    """Return the n-th coefficient of a series squared; each mixed product is computed once."""
    pairs = [times(nth(a, j), nth(a, n - j)) for j in reversed(range((n + 1) // 2))]
    total = scaled(2.0, sum_of(pairs))
    return plus(total, times(nth(a, n // 2), nth(a, n // 2))) if n % 2 == 0 else total


# Primitives that act on each coefficient separately.
_LINEAR = (
    "neg", "convert_element_type", "stop_gradient", "copy", "copy_p", "pin", "reshape",
    "broadcast_in_dim", "squeeze", "expand_dims", "transpose", "slice", "rev", "reduce_sum",
    "cumsum", "split", "tile", "unstack",
)  # fmt: skip

# Primitives that are linear in several operands together: those at these positions, or all. The
# others are indices, known at the start of the step.
_JOINED = {
    "concatenate": None, "stack": None, "pad": None, "dynamic_slice": (0,), "gather": (0,),
    "dynamic_update_slice": (0, 1), "scatter": (0, 2), "scatter-add": (0, 2),
}  # fmt: skip


# Primitives that are not smooth in some of their operands: the function's name for users, and the
# operands' positions. A series continues the branch at the start of the step. A comparison counts
# only if `select_n` uses it.
KINKS = {
    "abs": ("abs", slice(None)),
    "max": ("maximum", slice(None)),
    "min": ("minimum", slice(None)),
    "sign": ("sign", slice(None)),
    "round": ("round", slice(None)),
    "floor": ("floor", slice(None)),
    "ceil": ("ceil", slice(None)),
    "select_n": ("where", slice(1)),
    "gather": ("an index", slice(1, None)),
    "dynamic_slice": ("an index", slice(1, None)),
    "dynamic_update_slice": ("an index", slice(2, None)),
    "scatter": ("an index", slice(1, 2)),
    "scatter-add": ("an index", slice(1, 2)),
}

# Primitives whose result is constant within a step: it depends on the value at the start.
_DECIDED = (
    "eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "xor", "is_finite", "iota", "abs",
    "max", "min", "sign", "round", "floor", "ceil",
)  # fmt: skip


def _bind(eqn: Any, *values: Any) -> Any:
    if any(isinstance(v, Tracer) for v in values):
        return eqn.primitive.bind(*values, **eqn.params)
    with jax.ensure_compile_time_eval():  # known values, such as an exponent, stay known
        return eqn.primitive.bind(*values, **eqn.params)


# Each rule returns the n-th coefficient of an equation's result, or a list of them for several
# results. Its arguments are the equation of a jaxpr; n; the series of its operands, known up to n;
# those of its results, known before n; and a dictionary that it keeps from one n to the next.


def _linear(eqn, n, operands, results, extra):
    c = nth(operands[0], n)
    if c is None:
        return [None] * len(eqn.outvars)
    out = _bind(eqn, c, *(x[0] for x in operands[1:]))
    return list(out) if eqn.primitive.multiple_results else [out]


def _joined(eqn, n, operands, results, extra):
    places = _JOINED[eqn.primitive.name]
    parts = [nth(x, n) if places is None or i in places else x[0] for i, x in enumerate(operands)]
    moving = parts if places is None else [parts[i] for i in places]
    if all(p is None for p in moving):
        return None
    full = [jnp.zeros_like(x[0]) if p is None else p for p, x in zip(parts, operands, strict=True)]
    return _bind(eqn, *full)


def _decided(eqn, n, operands, results, extra):
    return None if n else _bind(eqn, *(x[0] for x in operands))


def _selected(eqn, n, operands, results, extra):
    which, *cases = operands
    parts = [nth(x, n) for x in cases]
    if all(p is None for p in parts):
        return None
    zero = jnp.zeros_like(cases[0][0])
    return _bind(eqn, which[0], *(zero if p is None else p for p in parts))


def _product(eqn, n, operands, results, extra):
    a, b = operands
    return square(a, n) if a is b else convolution(a, b, n)


def _dot(eqn, n, operands, results, extra):
    total = None
    for j in range(n + 1):
        a, b = nth(operands[0], j), nth(operands[1], n - j)
        total = plus(total, None if a is None or b is None else _bind(eqn, a, b))
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


def _power(series: Series, known: Series, p: float, n: int, first: Any, extra: dict) -> Coefficient:
    """Return the n-th coefficient c_n of a^p: n a0 c_n = Σ (p j - (n - j)) a_j c_{n-j}. `known` are
    the previous ones, `first` returns a^p of a number."""
    if n == 0:
        return first(series[0])
    total = convolution(series, known, n, 1, lambda j: (p * j - (n - j)) / n)
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
    """Return the n-th coefficient of a^y by squares and products, whose series are kept."""
    if y == 1:
        return nth(a, n)
    power: Series = extra.setdefault(y, [])
    if y % 2 == 0:
        half_power: Series = a if y == 2 else extra.setdefault(("half", y), [])
        if y > 2:
            half_power.append(_multiplied(a, y // 2, n, extra))
        c = square(half_power, n)
    else:
        lower_power: Series = extra.setdefault(("less", y), [])
        lower_power.append(_multiplied(a, y - 1, n, extra))
        c = convolution(a, lower_power, n)
    power.append(c)
    return c


def _constant_exponent(exponent: Series) -> float:
    try:
        return float(exponent[0])
    except (TypeError, jax.errors.ConcretizationTypeError):
        raise NoSeries("pow with an exponent that is no constant") from None


def _pow(eqn, n, operands, results, extra):
    a, b = operands
    p = _constant_exponent(b)
    return _power(a, results[0], p, n, lambda x: _bind(eqn, x, b[0]), extra)


def _root(p: float):
    def rule(eqn, n, operands, results, extra):
        return _power(operands[0], results[0], p, n, lambda x: _bind(eqn, x), extra)

    return rule


def _derivative_weight(n: int) -> Callable[[int], float]:
    return lambda j: j / n


def _exp(eqn, n, operands, results, extra):
    if n == 0:
        return _bind(eqn, operands[0][0])
    return convolution(operands[0], results[0], n, 1, _derivative_weight(n))


def _log(eqn, n, operands, results, extra):
    a = operands[0]
    if n == 0:
        return _bind(eqn, a[0])
    total = None
    for j in range(1, n):
        total = plus(total, scaled(j / n, times(nth(results[0], j), nth(a, n - j))))
    return times(minus(nth(a, n), total), _inverse(extra, a[0]))


def _pair(n: int, a: Series, sine: Series, cosine: Series) -> tuple[Coefficient, Coefficient]:
    """Return the next coefficients of sine and cosine, each other's derivatives."""
    s = convolution(a, cosine, n, 1, _derivative_weight(n))
    return s, minus(None, convolution(a, sine, n, 1, _derivative_weight(n)))


def _sincos(eqn, n, operands, results, extra):
    if n == 0:
        return list(_bind(eqn, operands[0][0]))
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
    """Return a rule for a function whose derivative is a polynomial of itself: y' = slope(y) a'."""

    def rule(eqn, n, operands, results, extra):
        rates: Series = extra.setdefault("slope", [])
        if n == 0:
            y = _bind(eqn, operands[0][0])
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


def expand(
    field: Callable[[Scalar, State], State], s: Scalar, state: State, order: int
) -> tuple[Any, list[Series]]:
    """Return the solution of d(state)/ds = field(s, state) in powers of s - s0: its tree, and for
    each leaf a list of `order + 1` coefficients (`None` for zero). **Raises:** `NoSeries` for a
    primitive without a recursion, `NotSmooth` for one that is not smooth and acts on a variable."""
    leaves, treedef = jtu.tree_flatten(state)

    def flat(s, *leaves):
        return jtu.tree_leaves(field(s, jtu.tree_unflatten(treedef, leaves)))

    closed = jax.make_jaxpr(flat)(s, *leaves)
    clock: Series = [s, jnp.ones_like(s)]
    series: list[Series] = [[x] for x in leaves]
    flow = _Flow(closed, [clock, *series])
    for n in range(order):
        for coefficients, rate in zip(series, flow.next(n), strict=True):
            coefficients.append(None if rate is None else rate * (1 / (n + 1)) if n else rate)
    return treedef, series


def along(function: Callable[[State], Scalar], treedef: object, series: list[Series]) -> "Along":
    """Return a scalar function of the state along a motion, as a power series; as from `expand`."""

    def flat(*leaves):
        return jtu.tree_leaves(function(jtu.tree_unflatten(treedef, leaves)))

    closed = jax.make_jaxpr(flat)(*(x[0] for x in series))
    flow = _Flow(closed, series)
    return Along([flow.next(n)[0] for n in range(len(series[0]))])


def _sum_series(series: Series, h: Scalar) -> Coefficient:
    total = None
    for c in reversed(series):
        if total is not None:
            total = total * h
        total = plus(total, c)
    return total


def _derivative(series: Series) -> Series:
    return [None if c is None else c * float(n) for n, c in enumerate(series)][1:]


class Along(NamedTuple):
    """A number along a motion, as a power series in s; a constant for differentiation."""

    series: Series

    def without_rounding_after_release(self, shortest: Scalar) -> "Along":
        """Return the series without speed and acceleration of a body that has just been released,
        if its jerk outweighs both within the time `shortest`: they are rounding errors."""
        if len(self.series) < 4 or any(x is None for x in self.series[1:4]):
            return self
        x, v, a, j, *rest = self.series
        jerk = 3 * jnp.abs(jnp.asarray(j)) * shortest
        still = (2 * jnp.abs(jnp.asarray(a)) <= jerk) & (jnp.abs(jnp.asarray(v)) <= jerk * shortest)
        v, a = (jnp.where(still, 0.0, c) for c in (v, a))
        return Along([x, v, a, j, *rest])

    def ends(self, h: Scalar) -> tuple[Rates, Rates]:
        slope, zero = _derivative(self.series), jnp.zeros_like(h)
        derivatives = self.series, slope, _derivative(slope)

        def rates(place: Callable[[Series], Coefficient]) -> Rates:
            return Rates(*(zero if (x := place(c)) is None else x for c in derivatives))

        return rates(lambda c: c[0]), rates(lambda c: _sum_series(c, h))

    def over(self, h: Scalar, factor: int = 1, offset: Scalar | None = None) -> Scalars:
        """Return the coefficients of factor·x - offset in θ, from 0 to 1 along such a step."""
        terms, power = [], None
        for c in self.series:
            terms.append(jnp.zeros_like(h) if c is None else c if power is None else c * power)
            power = h if power is None else power * h
        if factor != 1:
            terms = [factor * c for c in terms]
        return tuple(terms) if offset is None else (terms[0] - offset, *terms[1:])


class _Flow:
    """A jaxpr evaluated coefficient by coefficient; equations keep series of operands and
    results."""

    def __init__(self, closed: ClosedJaxpr, inputs: list[Series]):
        self.env: dict[Any, Series] = {}
        self.equations: list[tuple[Any, list[Any], list[Any]]] = []
        self.extra: list[dict[str, Series]] = []
        # The series that vary, by their identity; all others are constant.
        self.moving = {id(x) for x in inputs}
        self.outs = self._inline(closed.jaxpr, list(closed.consts), inputs)

    def _inline(self, jaxpr: Jaxpr, consts: list, args: list[Series]) -> list[Series]:
        """Add the equations of a jaxpr and all that it calls, with a series for each variable."""
        series: dict[Any, Series] = {}
        for var, const in zip(jaxpr.constvars, consts, strict=True):
            series[var] = [const]
        series.update(zip(jaxpr.invars, args, strict=True))

        def read(atom: object) -> Series:
            if isinstance(atom, Literal):
                return [np.asarray(atom.val, getattr(atom.aval, "dtype", None))]
            return series[atom]

        for eqn in jaxpr.eqns:
            operands = [read(a) for a in eqn.invars]
            name = eqn.primitive.name
            if (inner := called(eqn)) is not None:
                body = inner if isinstance(inner, Jaxpr) else inner.jaxpr
                captured = [] if isinstance(inner, Jaxpr) else list(inner.consts)
                series.update(zip(eqn.outvars, self._inline(body, captured, operands), strict=True))
                continue
            if name not in RULES:
                raise NoSeries(name)
            moves = [id(x) in self.moving for x in operands]
            word, places = KINKS.get(name, ("", slice(0)))
            if any(moves[places]):
                raise NotSmooth(word)
            results: list[Series] = [[] for _ in eqn.outvars]
            if any(moves):
                self.moving.update(map(id, results))
            series.update(zip(eqn.outvars, results, strict=True))
            self.equations.append((eqn, operands, results))
            self.extra.append({})
        return [read(a) for a in jaxpr.outvars]

    def next(self, n: int) -> list[Coefficient]:
        """Return the n-th coefficients of the results, from all operands' up to the n-th."""
        for (eqn, operands, results), extra in zip(self.equations, self.extra, strict=True):
            if results[0] is not None and len(results[0]) > n:
                continue
            out = RULES[eqn.primitive.name](eqn, n, operands, results, extra)
            for series, c in zip(results, out if isinstance(out, list) else [out], strict=True):
                series.append(c)
        return [nth(x, n) for x in self.outs]


@contextmanager
def _explain_errors() -> Iterator[None]:
    """**Raises:** `NotImplementedError` with a remedy for primitives without a series."""
    where = "in the machine's field, averages or coordinates"
    try:
        yield
    except NoSeries as error:
        raise NotImplementedError(
            f"Method `Taylor` has no recursion for the primitive `{error}` {where}. Use `Adaptive` "
            "or `FixedStep`."
        ) from None
    except NotSmooth as error:
        raise NotImplementedError(
            f"Method `Taylor` needs smooth functions, but the state decides by `{error}` {where}. "
            "Use `Adaptive`, or a `Switch` whose guard is zero at the kink and whose mode chooses "
            "in the field."
        ) from None


class Expansion(NamedTuple):
    """A motion about a point, in powers of s - s0."""

    treedef: Any
    """The structure of the state and the integrals."""
    series: list[Series]
    tolerance: np.ndarray | float | None
    """The tolerance that determines its reach; `None` without a limit."""
    rarely: bool = False
    """True if it shortens few steps; static."""
    sizes: State | None = None
    """The sizes of the state's numbers, relative to which its error is judged; `None`: all 1."""

    def at(self, h: Scalar) -> tuple[State, Integrals]:
        """Return the state and the integrals after a length h."""
        return jtu.tree_unflatten(self.treedef, [_sum_series(x, h) for x in self.series])

    def of(self, function: Callable[[State], Any]) -> Along:
        """Return a function of the state along the motion, a constant for differentiation."""
        constants = [[None if c is None else stop_gradient(c) for c in x] for x in self.series]
        with _explain_errors():
            return along(lambda y: function(y[0]), self.treedef, constants)

    def reach(self, limit: Scalar) -> Scalar:
        """Return the length at which the last two terms are as small as the tolerance, relative to
        the state (Jorba and Zou, Experimental Mathematics 14, 2005), at most `limit`."""
        if self.tolerance is None:
            return limit
        floor = 8 * jnp.finfo(limit.dtype).eps
        values = [jnp.abs(stop_gradient(x[0])) for x in self.series]
        allowed = jnp.maximum(jnp.asarray(self.tolerance, limit.dtype), floor)
        if self.sizes is None:
            allowed, weights = allowed * (1 + sum(jnp.sum(x) for x in values)), None
        else:  # each number by its own size, since they have different units
            sizes = [*jtu.tree_leaves(self.sizes), *(1.0 for _ in values)]
            weights = [1 / (size + x) for size, x in zip(sizes, values, strict=False)]
            allowed = allowed * sum(x.size for x in values)
        for n in (len(self.series[0]) - 2, len(self.series[0]) - 1):
            terms = [
                jnp.sum(jnp.abs(stop_gradient(x[n])) * (1.0 if weights is None else weights[i]))
                for i, x in enumerate(self.series)
                if x[n] is not None
            ]
            if not terms:
                continue
            term = jnp.maximum(sum(terms), jnp.finfo(limit.dtype).tiny)

            def shorten(limit: Scalar, ratio: Scalar, n: int = n) -> Scalar:
                return jnp.minimum(limit, jnp.exp(jnp.log(ratio) * (1.0 / n)))

            ratio = allowed / term
            if self.rarely:
                is_long = limit**n > ratio
                limit = jax.lax.cond(is_long, shorten, lambda x, _: x, limit, ratio)
            else:
                limit = shorten(limit, ratio)
        return limit


def _as_array(x: Any) -> Any:
    return x if x is None or isinstance(x, Tracer) else np.asarray(x)


class Taylor(AbstractMethod):
    """Power series of the motion, with coefficients by recursion over the machine's own field.

    The series gives the motion within a step, so that an event is located directly. It is
    recommended for smooth fields at small errors. `NotImplementedError` names the operation of a
    field that has no recursion, or that is not smooth in the state (`jnp.where`, `jnp.abs`).

    **Arguments:** `order` of the series (at least 4, default 16); `steps_per_cycle` (at least 5,
    default 8), as for `FixedStep`, and the fewest, since a step is shortened if its series would
    diverge; `rtol`, a tolerance by which each step is sized from its last terms instead.

    **Raises:** `ValueError` for numbers out of range, and for a `SoftStop` with an exponent other
    than 1, whose force has no series at first touch.
    """

    order: int = eqx.field(static=True, default=16)
    steps_per_cycle: int = eqx.field(static=True, default=8)  # pyright: ignore
    rtol: np.ndarray | float | None = eqx.field(kw_only=True, default=None, converter=_as_array)
    sizes: Any = eqx.field(kw_only=True, default=None, repr=False)
    """The sizes of the state's numbers, set by `with_sizes`."""

    def __check_init__(self):
        count("order", self.order, least=4)
        count("steps_per_cycle", self.steps_per_cycle, least=5)
        if self.rtol is not None:
            require("rtol", self.rtol, low=0.0, high=1.0, open_low=True)

    @property
    def wander(self):
        return 0.0 if self.rtol is None else self.rtol

    def tighter(self):
        steps = 2 * self.steps_per_cycle
        if self.rtol is None:
            return Taylor(self.order, steps)
        return Taylor(self.order + 4, steps, rtol=self.rtol / 100)

    def check(self, machine):
        """**Raises:** `ValueError` for a soft stop whose force has no series at first touch."""
        for i, switch in enumerate(switches_of(machine)):
            if isinstance(switch, SoftStop) and switch.law.exponent != 1:
                raise ValueError(
                    f"Method `Taylor` cannot carry switch {i}, {type(switch).__name__}: at first "
                    "touch its force has no power series (a soft stop's has one with exponent 1). "
                    "Use `Adaptive`."
                )

    @property
    def is_limited_by_decay(self):
        """True for fixed steps; others are sized by their errors."""
        return self.rtol is None

    def foresee(
        self, smooth: SmoothMachine, s: Scalar, state: State, beside: Integrals
    ) -> Expansion:
        """Return the motion as a power series about (s, state), with the integrals."""

        def field(s, y):
            state, beside = y
            return smooth.field(s, state), rate_of_integrals(smooth, s, state, beside)

        with _explain_errors():
            treedef, series = expand(field, s, (state, beside), self.order)
        if self.rtol is not None:
            return Expansion(treedef, series, self.rtol, sizes=self.sizes)
        known = has_relaxation(smooth.machine, s, state)
        tolerance = None if known else self._coarsest
        return Expansion(treedef, series, tolerance, rarely=True, sizes=self.sizes)

    @property
    def _coarsest(self) -> float:
        """The last term, relative to the state, of a motion with four periods in a natural period
        or a cycle. Fixed steps with a larger term are shortened, since their series would diverge,
        as under strong damping that the machine does not define (`relaxation`)."""
        return min((8 * pi / self.steps_per_cycle) ** self.order / factorial(self.order), 0.1)

    def step(self, smooth, s0, s1, state, beside):
        new, beside = self.foresee(smooth, s0, state, beside).at(s1 - s0)
        return new, beside, jnp.zeros_like(s0)
