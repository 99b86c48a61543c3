"""A Taylor method: each step is a power series, which also says where in it an event lies."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import factorial, pi
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient

from ..._checks import count, require
from ..._types import Scalar, State
from ...machine import switches_of
from ..integrals import Integrals, rate_of_integrals
from ..smooth import SmoothMachine
from . import _series as power_series
from ._recurrences import NoSeries, NotSmooth, Series
from ._series import Along
from .base import AbstractMethod, fading_is_known


@contextmanager
def _in_words() -> Iterator[None]:
    """**Raises:** `NotImplementedError` for what has no series, by name and with a remedy."""
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
    """Of the state and what is integrated beside it."""
    series: list[Series]
    tolerance: np.ndarray | float | None
    """By which its reach is measured; `None` of one that reaches as far as it is asked to."""
    rarely: bool = False
    """Few steps are shortened by it; static."""

    def at(self, h: Scalar) -> tuple[State, Integrals]:
        """State, and what is integrated beside it, a length h away."""
        return jtu.tree_unflatten(self.treedef, [power_series.at(x, h) for x in self.series])

    def of(self, function: Callable[[State], Any]) -> Along:
        """A scalar function of the state along it, a constant for differentiation."""
        still = [[None if c is None else stop_gradient(c) for c in x] for x in self.series]
        with _in_words():
            return power_series.along(lambda y: function(y[0]), self.treedef, still)

    def reach(self, limit: Scalar) -> Scalar:
        """The length at which the last two terms are as small as the tolerance, relative to the
        state (Jorba and Zou, Experimental Mathematics 14, 2005), up to this limit."""
        if self.tolerance is None:
            return limit
        floor = 8 * jnp.finfo(limit.dtype).eps
        size = jnp.asarray(sum(jnp.sum(jnp.abs(stop_gradient(x[0]))) for x in self.series))
        allowed = jnp.maximum(jnp.asarray(self.tolerance, limit.dtype), floor) * (1 + size)
        for n in (len(self.series[0]) - 2, len(self.series[0]) - 1):
            there = [stop_gradient(x[n]) for x in self.series if x[n] is not None]
            terms = [jnp.sum(jnp.abs(x)) for x in there]
            if not terms:
                continue
            term = jnp.maximum(sum(terms), jnp.finfo(size.dtype).tiny)

            def shortened(limit: Scalar, ratio: Scalar, n: int = n) -> Scalar:
                return jnp.minimum(limit, jnp.exp(jnp.log(ratio) * (1.0 / n)))

            ratio = allowed / term
            if self.rarely:
                long = limit**n > ratio
                limit = jax.lax.cond(long, shortened, lambda x, _: x, limit, ratio)
            else:
                limit = shortened(limit, ratio)
        return limit


class Taylor(AbstractMethod):
    """Power series of the motion, their coefficients by recursion over the machine's own field.

    The series gives the motion within a step, so that an event is located directly. The method of
    choice for smooth fields at small errors; `NotImplementedError` names the operation of a field
    that has no recursion, or that is not smooth in the state (`jnp.where`, `jnp.abs`).

    **Arguments:** `order` of the series (at least 4, default 16); `steps_per_cycle` (at least 5,
    default 8), as for `FixedStep`, and the fewest: a step is shortened where its series would
    diverge; `rtol`, if given, sizes each step by its last terms instead.

    **Raises:** `ValueError` for numbers out of range, and for a `SoftStop` with an exponent other
    than 1, whose force has no series at first touch.
    """

    order: int = eqx.field(static=True, default=16)
    steps_per_cycle: int = eqx.field(static=True, default=8)  # pyright: ignore
    rtol: np.ndarray | float | None = eqx.field(
        kw_only=True, default=None, converter=lambda x: x if x is None else np.asarray(x)
    )

    def __check_init__(self):
        count("order", self.order, least=4)
        count("steps_per_cycle", self.steps_per_cycle, least=5)
        if self.rtol is not None:
            require("rtol", self.rtol, low=0.0, high=1.0, open_low=True)

    @property
    def wander(self):
        """By how much a motion that repeats may differ: the tolerance; 0 of fixed steps."""
        return 0.0 if self.rtol is None else self.rtol

    def tighter(self):
        """Twice the steps, and a hundredth of the tolerance if there is one."""
        steps = 2 * self.steps_per_cycle
        if self.rtol is None:
            return Taylor(self.order, steps)
        return Taylor(self.order + 4, steps, rtol=self.rtol / 100)

    def check(self, machine):
        """**Raises:** `ValueError` for a soft stop whose force has no series at first touch."""
        for i, switch in enumerate(switches_of(machine)):
            if not switch.analytic:
                raise ValueError(
                    f"Method `Taylor` cannot carry switch {i}, {type(switch).__name__}: at first "
                    "touch its force has no power series (a soft stop's has one with exponent 1). "
                    "Use `Adaptive`."
                )

    @property
    def follows_fading(self):
        """True for fixed steps; others are sized by their errors."""
        return self.rtol is None

    def foresee(
        self, smooth: SmoothMachine, s: Scalar, state: State, beside: Integrals
    ) -> Expansion:
        """The motion as a power series about (s, state), with the integrals."""

        def field(s, y):
            state, beside = y
            return smooth.field(s, state), rate_of_integrals(smooth, s, state, beside)

        with _in_words():
            treedef, series = power_series.expand(field, s, (state, beside), self.order)
        if self.rtol is not None:
            return Expansion(treedef, series, self.rtol)
        known = fading_is_known(smooth.machine, s, state)
        return Expansion(treedef, series, None if known else self._coarsest, rarely=True)

    @property
    def _coarsest(self) -> float:
        """The last term, relative to the state, of a motion with four periods in a natural one or
        a cycle: fixed steps are shortened where theirs is larger, as under strong damping that the
        machine does not define (`relaxation`), since the series would diverge."""
        return min((8 * pi / self.steps_per_cycle) ** self.order / factorial(self.order), 0.1)

    def step(self, smooth, s0, s1, state, beside):
        """The sum of the series at `s1`."""
        new, beside = self.foresee(smooth, s0, state, beside).at(s1 - s0)
        return new, beside, jnp.zeros_like(s0)
