"""Taylor coefficients along a flow, by recursion over the field's own jaxpr.

With the first n coefficients of every quantity known, each equation of the jaxpr gives the next one
of its result: a sum, a convolution, or a recurrence of the kind e' = a' e. A coefficient that is
zero by structure is `None` and costs nothing.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

Coefficient = Any
"""An array, or `None` for zero."""
Series = list[Coefficient]

_CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "remat": "jaxpr",
    "checkpoint": "jaxpr", "remat2": "jaxpr",
}  # fmt: skip

# What acts on each coefficient by itself.
_LINEAR = (
    "neg", "convert_element_type", "stop_gradient", "copy", "copy_p", "pin", "reshape",
    "broadcast_in_dim", "squeeze", "expand_dims", "transpose", "slice", "rev", "reduce_sum",
    "cumsum", "split",
)  # fmt: skip

# What moves arrays about: of all operands at once.
_JOINED = ("concatenate", "stack", "dynamic_slice")

# What is decided by the value where the step begins.
_DECIDED = ("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "xor", "is_finite", "iota")


class NoSeries(Exception):
    """A field without a recursion; the argument is the primitive's name."""


def expand(
    field: Callable[[Any, Any], Any], s: Any, state: Any, order: int
) -> tuple[Any, list[Any]]:
    """Coefficients of the solution of d(state)/ds = field(s, state) in powers of s - s0.

    **Arguments:** `order`, the last power.

    **Returns:** their tree, and the coefficients of each leaf, each a list of `order + 1` (`None`
    for zero).

    **Raises:** `NoSeries` if the field has a primitive without a recursion.
    """
    leaves, treedef = jtu.tree_flatten(state)

    def flat(s, *leaves):
        return jtu.tree_leaves(field(s, jtu.tree_unflatten(treedef, leaves)))

    closed = jax.make_jaxpr(flat)(s, *leaves)
    clock: Series = [s, jnp.ones_like(s)]
    series: list[Series] = [[x] for x in leaves]
    flow = _Flow(closed, [clock, *series])
    for n in range(order):
        for own, rate in zip(series, flow.next(n), strict=True):
            own.append(None if rate is None else rate * (1 / (n + 1)) if n else rate)
    return treedef, series


def along(function: Callable[[Any], Any], treedef: Any, series: list[Series]) -> Series:
    """The series of a scalar function of the state."""

    def flat(*leaves):
        return jtu.tree_leaves(function(jtu.tree_unflatten(treedef, leaves)))

    closed = jax.make_jaxpr(flat)(*(x[0] for x in series))
    flow = _Flow(closed, series)
    return [flow.next(n)[0] for n in range(len(series[0]))]


def at(series: Series, h: Any) -> Any:
    """The sum of a series, by Horner's rule."""
    total = None
    for c in reversed(series):
        if total is not None:
            total = total * h
        total = _plus(total, c)
    return total


class _Flow:
    """A jaxpr evaluated coefficient by coefficient."""

    def __init__(self, closed: ClosedJaxpr, inputs: list[Series]):
        self.env: dict[Any, Series] = {}
        self.equations: list[tuple[Any, list[Any], list[Any]]] = []
        self.extra: list[dict[str, Series]] = []
        self.outs = self._inline(closed.jaxpr, list(closed.consts), inputs)

    def _inline(self, jaxpr: Jaxpr, consts: list, args: list[Series]) -> list[Series]:
        """The equations of a jaxpr and all that it calls, with a series for each variable."""
        names: dict[Any, Series] = {}
        for var, const in zip(jaxpr.constvars, consts, strict=True):
            names[var] = [const]
        names.update(zip(jaxpr.invars, args, strict=True))

        def read(atom: Any) -> Series:
            if isinstance(atom, Literal):
                return [np.asarray(atom.val, getattr(atom.aval, "dtype", None))]
            return names[atom]

        for eqn in jaxpr.eqns:
            operands = [read(a) for a in eqn.invars]
            name = eqn.primitive.name
            if name in _CALLS:
                inner = eqn.params[_CALLS[name]]
                own = inner if isinstance(inner, Jaxpr) else inner.jaxpr
                held = [] if isinstance(inner, Jaxpr) else list(inner.consts)
                names.update(zip(eqn.outvars, self._inline(own, held, operands), strict=True))
                continue
            if name not in _RULES:
                raise NoSeries(name)
            results: list[Series] = [[] for _ in eqn.outvars]
            names.update(zip(eqn.outvars, results, strict=True))
            self.equations.append((eqn, operands, results))
            self.extra.append({})
        return [read(a) for a in jaxpr.outvars]

    def next(self, n: int) -> list[Coefficient]:
        """The n-th coefficients of the results, from all operands' up to the n-th."""
        for (eqn, operands, results), extra in zip(self.equations, self.extra, strict=True):
            if results[0] is not None and len(results[0]) > n:
                continue
            out = _RULES[eqn.primitive.name](eqn, n, operands, results, extra)
            for series, c in zip(results, out if isinstance(out, list) else [out], strict=True):
                series.append(c)
        return [_get(x, n) for x in self.outs]


def _get(series: Series, n: int) -> Coefficient:
    return series[n] if n < len(series) else None


def _plus(a: Coefficient, b: Coefficient) -> Coefficient:
    if a is None or b is None:
        return b if a is None else a
    return a + b


def _minus(a: Coefficient, b: Coefficient) -> Coefficient:
    if b is None:
        return a
    return -b if a is None else a - b


def _times(a: Coefficient, b: Coefficient) -> Coefficient:
    return None if a is None or b is None else a * b


def _scaled(c: float, a: Coefficient) -> Coefficient:
    return None if a is None else a if c == 1 else a * c


def _convolution(
    a: Series, b: Series, n: int, begin: int = 0, weight: Callable[[int], float] | None = None
) -> Coefficient:
    """Σ weight(j) a_j b_{n-j} over j from `begin` to n."""
    terms = []
    # What is known longest comes first: only the last products wait for the newest coefficients.
    for j in sorted(range(begin, n + 1), key=lambda j: max(j, n - j)):
        term = _times(_get(a, j), _get(b, n - j))
        terms.append(term if weight is None else _scaled(weight(j), term))
    return _total(terms)


def _total(terms: list[Coefficient]) -> Coefficient:
    """Their sum, by two chains of additions that do not wait for each other."""
    chains: list[Coefficient] = [None, None]
    for i, term in enumerate(t for t in terms if t is not None):
        chains[i % 2] = _plus(chains[i % 2], term)
    return _plus(*chains)


def _square(a: Series, n: int) -> Coefficient:
    """Of a series with itself: each mixed product once."""
    pairs = [_times(_get(a, j), _get(a, n - j)) for j in reversed(range((n + 1) // 2))]
    total = _scaled(2.0, _total(pairs))
    return _plus(total, _times(_get(a, n // 2), _get(a, n // 2))) if n % 2 == 0 else total


def _bound(eqn: Any, *values: Any) -> Any:
    if any(isinstance(v, Tracer) for v in values):
        return eqn.primitive.bind(*values, **eqn.params)
    with jax.ensure_compile_time_eval():  # what is known, such as an exponent, stays known
        return eqn.primitive.bind(*values, **eqn.params)


def _linear(eqn, n, operands, results, extra):
    c = _get(operands[0], n)
    if c is None:
        return [None] * len(eqn.outvars)
    out = _bound(eqn, c, *(x[0] for x in operands[1:]))
    return list(out) if eqn.primitive.multiple_results else [out]


def _joined(eqn, n, operands, results, extra):
    parts = [_get(x, n) for x in operands]
    if eqn.primitive.name == "dynamic_slice":
        return None if parts[0] is None else _bound(eqn, parts[0], *(x[0] for x in operands[1:]))
    if all(p is None for p in parts):
        return None
    full = [jnp.zeros_like(x[0]) if p is None else p for p, x in zip(parts, operands, strict=True)]
    return _bound(eqn, *full)


def _decided(eqn, n, operands, results, extra):
    return None if n else _bound(eqn, *(x[0] for x in operands))


def _selected(eqn, n, operands, results, extra):
    which, *cases = operands
    parts = [_get(x, n) for x in cases]
    if all(p is None for p in parts):
        return None
    zero = jnp.zeros_like(cases[0][0])
    return _bound(eqn, which[0], *(zero if p is None else p for p in parts))


def _product(eqn, n, operands, results, extra):
    a, b = operands
    return _square(a, n) if a is b else _convolution(a, b, n)


def _dot(eqn, n, operands, results, extra):
    total = None
    for j in range(n + 1):
        a, b = _get(operands[0], j), _get(operands[1], n - j)
        total = _plus(total, None if a is None or b is None else _bound(eqn, a, b))
    return total


def _inverse(extra: dict, base: Any) -> Any:
    if "inverse" not in extra:
        extra["inverse"] = 1 / base
    return extra["inverse"]


def _quotient(eqn, n, operands, results, extra):
    a, b = operands
    if all(c is None for c in b[1:]):  # a constant
        return _times(_get(a, n), _inverse(extra, b[0])) if n else a[0] / b[0]
    rest = _minus(_get(a, n), _convolution(b, results[0], n, 1) if n else None)
    return _times(rest, _inverse(extra, b[0]))


def _power(series: Series, own: Series, p: float, n: int, first: Any, extra: dict) -> Coefficient:
    """Of a^p: n a0 c_n = Σ (p j - (n - j)) a_j c_{n-j}."""
    if n == 0:
        return first(series[0])
    total = _convolution(series, own, n, 1, lambda j: (p * j - (n - j)) / n)
    return _times(total, _inverse(extra, series[0]))


def _integer_power(eqn, n, operands, results, extra):
    a, y = operands[0], eqn.params["y"]
    if y == 0:
        return None if n else jnp.ones_like(a[0])
    if y < 0:
        extra.setdefault("power", [])
        below = _multiplied(a, -y, n, extra)
        extra["power"].append(below)
        rest = _minus(
            None if n else jnp.ones_like(a[0]),
            _convolution(extra["power"], results[0], n, 1) if n else None,
        )
        return _times(rest, _inverse(extra, extra["power"][0]))
    return _multiplied(a, y, n, extra)


def _multiplied(a: Series, y: int, n: int, extra: dict) -> Coefficient:
    """The n-th coefficient of a^y by squares and products, whose series are kept."""
    if y == 1:
        return _get(a, n)
    own: Series = extra.setdefault(y, [])
    if y % 2 == 0:
        half_of: Series = a if y == 2 else extra.setdefault(("half", y), [])
        if y > 2:
            half_of.append(_multiplied(a, y // 2, n, extra))
        c = _square(half_of, n)
    else:
        less: Series = extra.setdefault(("less", y), [])
        less.append(_multiplied(a, y - 1, n, extra))
        c = _convolution(a, less, n)
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
    return _convolution(operands[0], results[0], n, 1, _derivative_weight(n))


def _log(eqn, n, operands, results, extra):
    a = operands[0]
    if n == 0:
        return _bound(eqn, a[0])
    total = None
    for j in range(1, n):
        total = _plus(total, _scaled(j / n, _times(_get(results[0], j), _get(a, n - j))))
    return _times(_minus(_get(a, n), total), _inverse(extra, a[0]))


def _pair(n: int, a: Series, sine: Series, cosine: Series) -> tuple[Coefficient, Coefficient]:
    """Next coefficients of sine and cosine, each other's derivatives."""
    s = _convolution(a, cosine, n, 1, _derivative_weight(n))
    return s, _minus(None, _convolution(a, sine, n, 1, _derivative_weight(n)))


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
        y = _convolution(operands[0], rates, n, 1, _derivative_weight(n))
        rates.append(next_slope([*results[0], y], n))
        return y

    return rule


def _chosen(eqn, n, operands, results, extra):
    """max and min: one operand or the other, by their values where the step begins."""
    a, b = operands
    if n == 0:
        extra["first"] = a[0] >= b[0] if eqn.primitive.name == "max" else a[0] <= b[0]
        return _bound(eqn, a[0], b[0])
    x, y = _get(a, n), _get(b, n)
    if x is None and y is None:
        return None
    zero = jnp.zeros_like(a[0])
    return jnp.where(extra["first"], zero if x is None else x, zero if y is None else y)


def _absolute(eqn, n, operands, results, extra):
    a = operands[0]
    return jnp.abs(a[0]) if n == 0 else _times(jnp.sign(a[0]), _get(a, n))


def _flat(eqn, n, operands, results, extra):
    return None if n else _bound(eqn, operands[0][0])


_RULES: dict[str, Callable] = {
    **dict.fromkeys(_LINEAR, _linear),
    **dict.fromkeys(_JOINED, _joined),
    **dict.fromkeys(_DECIDED, _decided),
    **dict.fromkeys(("sign", "round", "floor", "ceil"), _flat),
    **dict.fromkeys(("max", "min"), _chosen),
    "add": lambda e, n, o, r, x: _plus(_get(o[0], n), _get(o[1], n)),
    "add_any": lambda e, n, o, r, x: _plus(_get(o[0], n), _get(o[1], n)),
    "sub": lambda e, n, o, r, x: _minus(_get(o[0], n), _get(o[1], n)),
    "mul": _product,
    "div": _quotient,
    "square": lambda e, n, o, r, x: _square(o[0], n),
    "integer_pow": _integer_power,
    "pow": _pow,
    "sqrt": _root(0.5),
    "rsqrt": _root(-0.5),
    "exp": _exp,
    "log": _log,
    "sincos": _sincos,
    "sin": _one_of_pair(0),
    "cos": _one_of_pair(1),
    "tanh": _saturating(lambda y: 1 - y * y, lambda y, n: _minus(None, _square(y, n))),
    "logistic": _saturating(lambda y: y * (1 - y), lambda y, n: _minus(_get(y, n), _square(y, n))),
    "abs": _absolute,
    "select_n": _selected,
    "dot_general": _dot,
}
