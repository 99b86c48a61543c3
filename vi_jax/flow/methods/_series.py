"""Taylor coefficients along a flow, by recursion over the field's own jaxpr.

With the first n coefficients of every quantity known, each equation of the jaxpr gives the next one
of its result.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from ..._types import Scalar, Scalars, State
from ...lanes import called
from ..events import Rates
from ._recurrences import KINKS, RULES, Coefficient, NoSeries, NotSmooth, Series, nth, plus


def expand(
    field: Callable[[Scalar, State], State], s: Scalar, state: State, order: int
) -> tuple[Any, list[Series]]:
    """Coefficients of the solution of d(state)/ds = field(s, state) in powers of s - s0.

    **Arguments:** `order`, the last power.

    **Returns:** their tree, and the coefficients of each leaf, each a list of `order + 1` (`None`
    for zero).

    **Raises:** `NoSeries` if the field has a primitive without a recursion, `NotSmooth` if one that
    is not smooth acts on what moves.
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


def along(function: Callable[[State], Scalar], treedef: object, series: list[Series]) -> "Along":
    """A scalar function of the state along a motion, as a power series; `treedef` and `series` as
    from `expand`."""

    def flat(*leaves):
        return jtu.tree_leaves(function(jtu.tree_unflatten(treedef, leaves)))

    closed = jax.make_jaxpr(flat)(*(x[0] for x in series))
    flow = _Flow(closed, series)
    return Along([flow.next(n)[0] for n in range(len(series[0]))])


def at(series: Series, h: Scalar) -> Coefficient:
    """The sum of a series, by Horner's rule."""
    total = None
    for c in reversed(series):
        if total is not None:
            total = total * h
        total = plus(total, c)
    return total


def _slope(series: Series) -> Series:
    return [None if c is None else c * float(n) for n, c in enumerate(series)][1:]


class Along(NamedTuple):
    """A number along a motion, as a power series in s; a constant for differentiation."""

    series: Series

    def without_flutter(self, shortest: Scalar) -> "Along":
        """The same, but for a body that has just been let go without the speed and acceleration
        that rounding has left, if its jerk outweighs both within the time `shortest`."""
        if len(self.series) < 4 or any(x is None for x in self.series[1:4]):
            return self
        x, v, a, j, *rest = self.series
        jerk = 3 * jnp.abs(jnp.asarray(j)) * shortest
        still = (2 * jnp.abs(jnp.asarray(a)) <= jerk) & (jnp.abs(jnp.asarray(v)) <= jerk * shortest)
        v, a = (jnp.where(still, 0.0, c) for c in (v, a))
        return Along([x, v, a, j, *rest])

    def ends(self, h: Scalar) -> tuple[Rates, Rates]:
        """Its rates at both ends of a step of this length."""
        slope, zero = _slope(self.series), jnp.zeros_like(h)
        each = self.series, slope, _slope(slope)

        def rates(place: Callable[[Series], Coefficient]) -> Rates:
            return Rates(*(zero if (x := place(c)) is None else x for c in each))

        return rates(lambda c: c[0]), rates(lambda c: at(c, h))

    def over(self, h: Scalar, factor: int = 1, offset: Scalar | None = None) -> Scalars:
        """Coefficients of factor·x - offset in θ, which goes from 0 to 1 along such a step."""
        found, power = [], None
        for c in self.series:
            found.append(jnp.zeros_like(h) if c is None else c if power is None else c * power)
            power = h if power is None else power * h
        if factor != 1:
            found = [factor * c for c in found]
        return tuple(found) if offset is None else (found[0] - offset, *found[1:])


class _Flow:
    """A jaxpr evaluated coefficient by coefficient: each of its equations keeps the series of its
    operands and results."""

    def __init__(self, closed: ClosedJaxpr, inputs: list[Series]):
        self.env: dict[Any, Series] = {}
        self.equations: list[tuple[Any, list[Any], list[Any]]] = []
        self.extra: list[dict[str, Series]] = []
        # By their identity the series that move; all others are numbers that stay what they are.
        self.moving = {id(x) for x in inputs}
        self.outs = self._inline(closed.jaxpr, list(closed.consts), inputs)

    def _inline(self, jaxpr: Jaxpr, consts: list, args: list[Series]) -> list[Series]:
        """The equations of a jaxpr and all that it calls, with a series for each variable."""
        names: dict[Any, Series] = {}
        for var, const in zip(jaxpr.constvars, consts, strict=True):
            names[var] = [const]
        names.update(zip(jaxpr.invars, args, strict=True))

        def read(atom: object) -> Series:
            if isinstance(atom, Literal):
                return [np.asarray(atom.val, getattr(atom.aval, "dtype", None))]
            return names[atom]

        for eqn in jaxpr.eqns:
            operands = [read(a) for a in eqn.invars]
            name = eqn.primitive.name
            if (inner := called(eqn)) is not None:
                own = inner if isinstance(inner, Jaxpr) else inner.jaxpr
                held = [] if isinstance(inner, Jaxpr) else list(inner.consts)
                names.update(zip(eqn.outvars, self._inline(own, held, operands), strict=True))
                continue
            if name not in RULES:
                raise NoSeries(name)
            moves = [id(x) in self.moving for x in operands]
            if name in KINKS and any(moves[slice(*KINKS[name].places)]):
                raise NotSmooth(KINKS[name].word)
            results: list[Series] = [[] for _ in eqn.outvars]
            if any(moves):
                self.moving.update(map(id, results))
            names.update(zip(eqn.outvars, results, strict=True))
            self.equations.append((eqn, operands, results))
            self.extra.append({})
        return [read(a) for a in jaxpr.outvars]

    def next(self, n: int) -> list[Coefficient]:
        """The n-th coefficients of the results, from all operands' up to the n-th."""
        for (eqn, operands, results), extra in zip(self.equations, self.extra, strict=True):
            if results[0] is not None and len(results[0]) > n:
                continue
            out = RULES[eqn.primitive.name](eqn, n, operands, results, extra)
            for series, c in zip(results, out if isinstance(out, list) else [out], strict=True):
                series.append(c)
        return [nth(x, n) for x in self.outs]
