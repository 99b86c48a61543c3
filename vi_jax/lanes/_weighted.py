"""Products of a cotangent and a slope: zero where the cotangent is zero, whatever the slope is.

Where a program chooses between two numbers, that which is not chosen has the cotangent 0. Its slope
may be infinite or no number there (√0, a quotient by 0), and 0·∞ would spoil the sum in which the
chosen one's share is too. Forward mode has no such products: what is not chosen is dropped.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive

from ._program import CALLS, dependent_in_scan, dependent_of_equation, inner
from .elementary import elementwise_primitive

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
    found = {v for v, w in zip(jaxpr.invars, weights, strict=True) if w}
    eqns = []
    for eqn in jaxpr.eqns:
        args = [not isinstance(a, Literal) and a in found for a in eqn.invars]
        if any(args):
            outs = dependent_of_equation(eqn, args, smooth=False)
            found.update(v for v, out in zip(eqn.outvars, outs, strict=True) if out)
            eqn = _equation(eqn, args)
        eqns.append(eqn)
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
