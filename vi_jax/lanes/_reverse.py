"""Forward and reverse jaxprs of a program's parts.

Each of the three functions of a `LaneProgram` is traced once together with its transposed
derivative, and that jaxpr is split into a forward and a backward jaxpr. So both contain the same
equations for the values, in the same order. Values computed again in the reverse pass are then the
same bits (`FixedText` in `_text.py`).
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
    evaluate_inlined,
    inner,
    loop_depends,
    propagate_marks,
    shape_of,
)
from ._vector import Unsupported, check
from .elementary import elementwise_primitive

# Products of a cotangent and a slope that are zero if the cotangent is zero, for any slope.
#
# When a program selects one of two numbers, the other one has the cotangent 0. Its slope may be
# infinite or NaN (√0, division by 0). Then 0·∞ would make the sum of both cotangents NaN. Forward
# mode has no such products, since the unselected tangent is dropped.

weighted_p = elementwise_primitive(
    "weighted", lambda weight, slope: jnp.where(weight == 0, weight, weight * slope)
)
weighted_quotient_p = elementwise_primitive(
    "weighted_quotient", lambda weight, x: jnp.where(weight == 0, weight, weight / x)
)
weighted_dot_p = Primitive("weighted_dot")


def _dot(weight, slope, *, weight_first: bool, **params):
    """Return a plain product, used for its shape: on XLA's backend no program runs backward."""
    pair = (weight, slope) if weight_first else (slope, weight)
    return jax.lax.dot_general(*pair, **params)


@weighted_dot_p.def_abstract_eval
def _(weight, slope, *, weight_first: bool, **params):
    out = jax.eval_shape(
        lambda a, b: _dot(a, b, weight_first=weight_first, **params), weight, slope
    )
    return ShapedArray(out.shape, out.dtype)


def with_zero_safe_products(closed: ClosedJaxpr, weights: Sequence[bool]) -> ClosedJaxpr:
    """Return the jaxpr with these products where a factor, or the dividend, depends on one of the
    arguments flagged in `weights`. Its results must be linear in these, or not depend on them."""
    return closed.replace(jaxpr=_rewritten(closed.jaxpr, weights))


def _rewritten(jaxpr: Jaxpr, weights: Sequence[bool]) -> Jaxpr:
    eqns = []

    def visit(eqn: Any, args: list[bool], _: list[bool]) -> None:
        eqns.append(_equation(eqn, args) if any(args) else eqn)

    propagate_marks(jaxpr, weights, functools.partial(dependent_of_equation, smooth=False), visit)
    return jaxpr.replace(eqns=eqns)


def _equation(eqn: Any, args: list[bool]) -> Any:
    """Replace an equation that has weights among its arguments."""
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
        return eqn.replace(params=_with_rewritten(params, CALLS[name], args))
    if name == "cond":
        branches = tuple(with_zero_safe_products(b, args[1:]) for b in params["branches"])
        return eqn.replace(params={**params, "branches": branches})
    if name == "scan":
        return eqn.replace(params=_with_rewritten(params, "jaxpr", dependent_in_scan(eqn, args)))
    return eqn


def _with_rewritten(params: dict[str, Any], key: str, weights: Sequence[bool]) -> dict[str, Any]:
    jaxpr = params[key]
    new = _rewritten(inner(jaxpr), weights)
    return {**params, key: jaxpr.replace(jaxpr=new) if isinstance(jaxpr, ClosedJaxpr) else new}


class ForwardBackward(NamedTuple):
    """The two jaxprs of one of a lane's functions. Their arguments are the function's own, followed
    by the given cotangents: first those of the carry, then those of rows or results."""

    forward: ClosedJaxpr
    """For `begin` and `step`: the carry, whether the lane continues, whether a row is complete."""
    backward: ClosedJaxpr
    """The wanted cotangents of the inputs; for `step` and `end`, then those of the carry."""


class ReverseProgram(eqx.Module):
    """The program of a reverse kernel; hashable, as a primitive's parameter must be. Its inputs are
    those of `program`, then the given cotangents. Its results are the wanted cotangents."""

    program: LaneProgram = eqx.field(static=True)
    varied: tuple[bool, ...] = eqx.field(static=True)
    """Flags of the inputs whose cotangents are wanted."""
    given: tuple[bool, ...] = eqx.field(static=True)
    """Flags of the results, then of the parts of a row, that have a cotangent."""
    carried: tuple[bool, ...] = eqx.field(static=True)
    """Flags of the parts of the carry that have one: they depend on a wanted input, and a result or
    row with a cotangent depends on them."""
    begin: ForwardBackward = eqx.field(static=True)
    step: ForwardBackward = eqx.field(static=True)
    end: ForwardBackward = eqx.field(static=True)

    __hash__ = object.__hash__
    __eq__ = object.__eq__

    @property
    def jaxprs(self) -> tuple[ClosedJaxpr, ...]:
        begin, step, end = self.begin, self.step, self.end
        return begin.forward, step.forward, end.backward, step.backward, begin.backward

    @property
    def carry_avals(self) -> list[Any]:
        return self.program.carry_avals

    @property
    def weight_avals(self) -> list[Any]:
        avals = (*self.program.out_avals, *self.program.row_avals)
        return [a for a, flag in zip(avals, self.given, strict=True) if flag]

    @property
    def in_avals(self) -> list[Any]:
        """Shapes and types of one lane's inputs, including the cotangents of its rows: here none,
        since their number belongs to a call."""
        weights = zip(self.program.results(0), self.given, strict=True)
        return [*self.program.in_avals, *(a for a, flag in weights if flag)]

    def results(self, rows: int = 0) -> list[Any]:
        """Return shapes and types of the wanted cotangents of one lane."""
        return [a for a, v in zip(self.program.in_avals, self.varied, strict=True) if v]


@functools.lru_cache(maxsize=64)
def reverse(
    program: LaneProgram, varied: tuple[bool, ...], given: tuple[bool, ...]
) -> ReverseProgram | None:
    """Return the program backward; `None` if a part of it has no transpose or no vector form.
    `given` flags the results, then the parts of a row, with a cotangent; each depends on a `varied`
    input."""
    carried = _carried(program, varied, given)
    parts = (program.begin, varied), (program.step, (*varied, *carried))
    if any(loop_depends(jaxpr.jaxpr, flags_of_part) for jaxpr, flags_of_part in parts):
        return None  # JAX has no transpose of a `while`; tracing would fail later
    outs, flags = given[: len(program.out_avals)], (False, False)
    emitted = (*carried, *flags, *given[len(program.out_avals) :])
    try:
        found = ReverseProgram(
            program, varied, given, carried,
            begin=_split_passes(program, "begin", varied, emitted, len(carried) + 2),
            step=_split_passes(program, "step", (*varied, *carried), emitted, len(carried) + 2),
            end=_split_passes(program, "end", (*varied, *carried), outs, 0),
        )  # fmt: skip
        for jaxpr in found.jaxprs:
            check(jaxpr.jaxpr)
    except (NotImplementedError, ValueError, Unsupported):  # JAX's errors for a missing transpose
        return None
    return found


def _carried(program: LaneProgram, varied, given) -> tuple[bool, ...]:
    """Return for each part of the carry whether it has a cotangent (see `ReverseProgram`)."""
    n, inputs = len(program.carry_avals), [False] * len(program.in_avals)
    depend = dependent_parts(program, varied, smooth=True)
    outs = given[: len(program.out_avals)]
    rows = given[len(program.out_avals) :]
    needed, successors = set(), {}
    for i in (i for i in range(n) if depend.carry[i]):
        one = [*inputs, *(j == i for j in range(n))]
        stepped = dependent_results(program.step.jaxpr, one, smooth=True)
        ended = dependent_results(program.end.jaxpr, one, smooth=True)
        successors[i] = {j for j in range(n) if stepped[j]}
        if any(g and r for g, r in zip((*outs, *rows), (*ended, *stepped[n + 2 :]), strict=True)):
            needed.add(i)
    is_growing = True
    while is_growing:
        more = {i for i, to in successors.items() if to & needed} - needed
        needed, is_growing = needed | more, bool(more)
    return tuple(i in needed for i in range(n))


def _split_passes(
    program: LaneProgram, name: str, varied: Sequence[bool], weighted: Sequence[bool], kept: int
) -> ForwardBackward:
    """Return the forward and the backward jaxpr of the function `name`, for flags of its `varied`
    arguments and `weighted` results. The forward pass needs `kept` results. An operation without a
    transpose raises `NotImplementedError` or `ValueError`."""
    closed, number = getattr(program, name), len(varied)
    along = _along(program, name, varied, weighted)

    def both(*args):
        primals, weights = args[:number], args[number:]
        changing = [x for x, v in zip(primals, varied, strict=True) if v]
        values: list[Any] = []

        def slopes(*tangents):
            # `jax.vjp` would take three times as long to trace, because of its rule for each
            # primitive.
            out = along(*primals, *tangents)
            values[:] = out[: len(closed.out_avals)]
            return out[len(closed.out_avals) :]

        pullback = jax.linear_transpose(slopes, *changing)
        return [*values[:kept], *pullback(list(weights))]

    shapes = [shape_of(a) for a in closed.in_avals]
    shapes += [shape_of(a) for a, w in zip(closed.out_avals, weighted, strict=True) if w]
    whole = jax.make_jaxpr(both)(*shapes)
    cotangents = len(whole.out_avals) - kept
    forward = _pruned(whole, [True] * kept + [False] * cotangents)
    backward = _pruned(whole, [False] * kept + [True] * cotangents)
    return ForwardBackward(
        forward, with_zero_safe_products(backward, [i >= number for i in range(len(shapes))])
    )


def _along(
    program: LaneProgram, name: str, varied: Sequence[bool], weighted: Sequence[bool]
) -> Callable[..., list[Any]]:
    """Return a function of a program's arguments and their tangents. It returns the results, then
    the derivatives of the `weighted` ones. Widening comes after it (see `forward`)."""
    widening, number = program.widening, len(varied)
    source = program if widening is None else widening.program
    function = functools.partial(evaluate_inlined, with_quotients(getattr(source, name)))

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
    """Return a jaxpr with the wanted results, the equations that they need, and all arguments."""
    jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, wanted, instantiate=True)
    return closed.replace(jaxpr=jaxpr)
