"""A program's parts forward and backward: what the cotangents of its results make of its inputs'.

Each of the three functions of a `LaneProgram` is traced once together with its transposed
derivative (`jax.vjp`), and that jaxpr is taken apart into the way there and the way back. So both
hold the same equations for the values, in the same order, and where these are computed again for
the way back they are the same bits (`FixedText` in `_text.py`).
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive
from jax.interpreters import partial_eval

from ._derivative import values_and_slopes, with_quotients
from ._program import (
    CALLS,
    LaneProgram,
    dependent_in_scan,
    dependent_of_equation,
    dependent_parts,
    dependent_results,
    evaluated,
    inner,
    loop_depends,
    shape_of,
    walked,
)
from ._vector import Unsupported, check
from .elementary import elementwise_primitive

# Products of a cotangent and a slope: zero where the cotangent is zero, whatever the slope is.
#
# Where a program chooses between two numbers, that which is not chosen has the cotangent 0. Its
# slope may be infinite or no number there (√0, a quotient by 0), and 0·∞ would spoil the sum in
# which the chosen one's share is too. Forward mode has no such products: what is not chosen is
# dropped.

weighted_p = elementwise_primitive(
    "weighted", lambda weight, slope: jnp.where(weight == 0, weight, weight * slope)
)
weighted_quotient_p = elementwise_primitive(
    "weighted_quotient", lambda weight, x: jnp.where(weight == 0, weight, weight / x)
)
weighted_dot_p = Primitive("weighted_dot")


def _dot(weight, slope, *, weight_first: bool, **params):
    """XLA's product as it is: on its backend no program goes backward."""
    pair = (weight, slope) if weight_first else (slope, weight)
    return jax.lax.dot_general(*pair, **params)


@weighted_dot_p.def_abstract_eval
def _(weight, slope, *, weight_first: bool, **params):
    out = jax.eval_shape(
        lambda a, b: _dot(a, b, weight_first=weight_first, **params), weight, slope
    )
    return ShapedArray(out.shape, out.dtype)


def with_weights(closed: ClosedJaxpr, weights: Sequence[bool]) -> ClosedJaxpr:
    """The same jaxpr with these products where one factor, or the dividend, depends on one of the
    arguments `weights`. Its results must be linear in these, or not depend on them."""
    return closed.replace(jaxpr=_rewritten(closed.jaxpr, weights))


def _rewritten(jaxpr: Jaxpr, weights: Sequence[bool]) -> Jaxpr:
    eqns = []

    def visit(eqn: Any, args: list[bool], _: list[bool]) -> None:
        eqns.append(_equation(eqn, args) if any(args) else eqn)

    walked(jaxpr, weights, functools.partial(dependent_of_equation, smooth=False), visit)
    return jaxpr.replace(eqns=eqns)


def _equation(eqn: Any, args: list[bool]) -> Any:
    """An equation some of whose arguments are weights."""
    name, params = eqn.primitive.name, eqn.params
    if name == "mul":
        weight, slope = eqn.invars if args[0] else eqn.invars[::-1]
        if isinstance(slope, Literal) and np.all(np.isfinite(slope.val)):  # pyright: ignore
            return eqn
        return eqn.replace(primitive=weighted_p, invars=[weight, slope], params={})
    if name in ("div", "quotient"):
        return eqn.replace(primitive=weighted_quotient_p, params={})
    if name == "dot_general":
        pair = eqn.invars if args[0] else eqn.invars[::-1]
        params = {**params, "weight_first": args[0]}
        return eqn.replace(primitive=weighted_dot_p, invars=list(pair), params=params)
    if name in CALLS:
        return eqn.replace(params=_with(params, CALLS[name], args))
    if name == "cond":
        branches = tuple(with_weights(b, args[1:]) for b in params["branches"])
        return eqn.replace(params={**params, "branches": branches})
    if name == "scan":
        return eqn.replace(params=_with(params, "jaxpr", dependent_in_scan(eqn, args)))
    return eqn


def _with(params: dict[str, Any], key: str, weights: Sequence[bool]) -> dict[str, Any]:
    held = params[key]
    new = _rewritten(inner(held), weights)
    return {**params, key: held.replace(jaxpr=new) if isinstance(held, ClosedJaxpr) else new}


class BothWays(NamedTuple):
    """One of a lane's functions. The arguments of either jaxpr are its own, then the cotangents of
    what has one, of the carry before rows or results."""

    forward: ClosedJaxpr
    """Of `begin` and `step`: the carry, whether the lane goes on, whether a row is complete."""
    backward: ClosedJaxpr
    """The cotangents of the inputs that are asked for; of `step` and `end`, then of the carry."""


class ReverseProgram(eqx.Module):
    """What a reverse kernel runs; hashable, as a primitive's parameter must be. Its inputs are
    those of the program, then the cotangents that are given; its results the cotangents of the
    inputs that are asked for."""

    program: LaneProgram = eqx.field(static=True)
    varied: tuple[bool, ...] = eqx.field(static=True)
    """Which inputs' cotangents are asked for."""
    given: tuple[bool, ...] = eqx.field(static=True)
    """Which results, and then which parts of a row, have a cotangent."""
    carried: tuple[bool, ...] = eqx.field(static=True)
    """Which parts of the carry have one: those that depend on such inputs, and that something
    given depends on."""
    begin: BothWays = eqx.field(static=True)
    step: BothWays = eqx.field(static=True)
    end: BothWays = eqx.field(static=True)

    __hash__ = object.__hash__
    __eq__ = object.__eq__

    @property
    def jaxprs(self) -> tuple[ClosedJaxpr, ...]:
        """All jaxprs of a kernel."""
        begin, step, end = self.begin, self.step, self.end
        return begin.forward, step.forward, end.backward, step.backward, begin.backward

    @property
    def carry_avals(self) -> list[Any]:
        """Shapes and types of one lane's carry."""
        return self.program.carry_avals

    @property
    def weight_avals(self) -> list[Any]:
        """Shapes and types of the cotangents of one lane's results and of a row."""
        avals = (*self.program.out_avals, *self.program.row_avals)
        return [a for a, here in zip(avals, self.given, strict=True) if here]

    @property
    def in_avals(self) -> list[Any]:
        """Shapes and types of one lane's inputs, the cotangents of all of its rows included."""
        weights = zip(self.program.result_avals, self.given, strict=True)
        return [*self.program.in_avals, *(a for a, here in weights if here)]

    @property
    def result_avals(self) -> list[Any]:
        """Shapes and types of the cotangents asked for, of one lane."""
        return [a for a, v in zip(self.program.in_avals, self.varied, strict=True) if v]


@functools.lru_cache(maxsize=64)
def reverse(
    program: LaneProgram, varied: tuple[bool, ...], given: tuple[bool, ...]
) -> ReverseProgram | None:
    """The program backward; `None` if something in it has no transpose, or no vector form.

    **Arguments:** the program; which inputs' cotangents are asked for; which results, and then
    which parts of a row, have a cotangent (all of them must depend on such inputs).
    """
    carried = _carried(program, varied, given)
    parts = (program.begin, varied), (program.step, (*varied, *carried))
    if any(loop_depends(jaxpr.jaxpr, which) for jaxpr, which in parts):
        return None  # JAX has no transpose of a `while`; tracing would tell as much, later
    outs, flags = given[: len(program.out_avals)], (False, False)
    emitted = (*carried, *flags, *given[len(program.out_avals) :])
    try:
        found = ReverseProgram(
            program, varied, given, carried,
            begin=_both_ways(program, "begin", varied, emitted, len(carried) + 2),
            step=_both_ways(program, "step", (*varied, *carried), emitted, len(carried) + 2),
            end=_both_ways(program, "end", (*varied, *carried), outs, 0),
        )  # fmt: skip
        for jaxpr in found.jaxprs:
            check(jaxpr.jaxpr)
    except (NotImplementedError, ValueError, Unsupported):  # as JAX says that there is no transpose
        return None
    return found


def _carried(program: LaneProgram, varied, given) -> tuple[bool, ...]:
    """The parts of the carry that have a cotangent (see `ReverseProgram.carried`)."""
    n, inputs = len(program.carry_avals), [False] * len(program.in_avals)
    depend = dependent_parts(program, varied, smooth=True)
    outs = given[: len(program.out_avals)]
    rows = given[len(program.out_avals) :]
    needed, leads = set(), {}
    for i in (i for i in range(n) if depend.carry[i]):
        one = [*inputs, *(j == i for j in range(n))]
        stepped = dependent_results(program.step.jaxpr, one, smooth=True)
        ended = dependent_results(program.end.jaxpr, one, smooth=True)
        leads[i] = {j for j in range(n) if stepped[j]}
        if any(g and r for g, r in zip((*outs, *rows), (*ended, *stepped[n + 2 :]), strict=True)):
            needed.add(i)
    grown = True
    while grown:
        more = {i for i, to in leads.items() if to & needed} - needed
        needed, grown = needed | more, bool(more)
    return tuple(i in needed for i in range(n))


def _both_ways(
    program: LaneProgram,
    name: str,
    varied: Sequence[bool],
    weighted: Sequence[bool],
    kept: int,
) -> BothWays:
    """A jaxpr and its transposed derivative.

    **Arguments:** the program, and which of its functions; which arguments are differentiated;
    which results have a cotangent; how many results are needed on the way there.

    **Raises:** `NotImplementedError` or `ValueError` if something has no transpose.
    """
    closed, number = getattr(program, name), len(varied)
    along = _along(program, name, varied, weighted)

    def both(*args):
        primals, weights = args[:number], args[number:]
        changing = [x for x, v in zip(primals, varied, strict=True) if v]
        values: list[Any] = []

        def slopes(*tangents):
            # Not by `jax.vjp`, whose rule for each primitive takes three times as long to trace.
            out = along(*primals, *tangents)
            values[:] = out[: len(closed.out_avals)]
            return out[len(closed.out_avals) :]

        pullback = jax.linear_transpose(slopes, *changing)
        return [*values[:kept], *pullback(list(weights))]

    shapes = [shape_of(a) for a in closed.in_avals]
    shapes += [shape_of(a) for a, w in zip(closed.out_avals, weighted, strict=True) if w]
    whole = jax.make_jaxpr(both)(*shapes)
    cotangents = len(whole.out_avals) - kept
    there = _pruned(whole, [True] * kept + [False] * cotangents)
    back = _pruned(whole, [False] * kept + [True] * cotangents)
    return BothWays(there, with_weights(back, [i >= number for i in range(len(shapes))]))


def _along(
    program: LaneProgram, name: str, varied: Sequence[bool], weighted: Sequence[bool]
) -> Callable[..., list[Any]]:
    """A function of a program's arguments and their tangents: its results, and the derivatives of
    those that are `weighted`. What is widened is differentiated first (see `forward`)."""
    widening, number = program.widening, len(varied)
    source = program if widening is None else widening.program
    function = functools.partial(evaluated, with_quotients(getattr(source, name)))

    def along(*args):
        primals, tangents = args[:number], args[number:]
        out, slopes = values_and_slopes(function, varied, weighted, primals, tangents)
        return [*out, *slopes]

    if widening is None:
        return along
    inputs, results = widening.axes(name)
    inputs = (*inputs, *(w for w, v in zip(inputs, varied, strict=True) if v))
    results = (*results, *(w for w, v in zip(results, weighted, strict=True) if v))
    return lambda *args: widening.over(along, args, inputs, results)


def _pruned(closed: ClosedJaxpr, wanted: list[bool]) -> ClosedJaxpr:
    """A jaxpr with some of its results, without what only the others need; of equal arguments."""
    jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, wanted, instantiate=True)
    return closed.replace(jaxpr=jaxpr)
