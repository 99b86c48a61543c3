"""Division whose derivative divides once, however many directions it is taken in.

JAX divides each tangent of the dividend by the divisor, and each of the divisor by its square. Here
each is multiplied by one reciprocal: in the derivatives of a machine's motion the divisions would
take most of the time.
"""

import functools
from typing import Any

import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, Primitive
from jax.interpreters import ad, batching

from ._program import OWN_DERIVATIVE
from .elementary import jitted

quotient_p = Primitive("quotient")


@functools.lru_cache(maxsize=256)
def with_quotients(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same jaxpr, its divisions of floating-point numbers with this derivative."""
    return closed.replace(jaxpr=_rewritten(closed.jaxpr))


def _rewritten(jaxpr: Jaxpr) -> Jaxpr:
    return jaxpr.replace(eqns=[_equation(eqn) for eqn in jaxpr.eqns])


def _equation(eqn: Any) -> Any:
    """An equation with divisions replaced, in inner jaxprs too."""
    name = eqn.primitive.name
    if name == "div" and jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
        return eqn.replace(primitive=quotient_p, params={})
    if name in OWN_DERIVATIVE:
        return eqn
    return eqn.replace(params={key: _parameter(x) for key, x in eqn.params.items()})


def _parameter(value: Any) -> Any:
    if isinstance(value, ClosedJaxpr):
        return with_quotients(value)
    if isinstance(value, Jaxpr):
        return _rewritten(value)
    if isinstance(value, tuple) and any(isinstance(x, ClosedJaxpr) for x in value):
        return tuple(map(_parameter, value))
    return value


@quotient_p.def_abstract_eval
def _(x, y):
    return ShapedArray(x.shape, x.dtype, weak_type=x.weak_type and y.weak_type)


def _jvp(primals, tangents):
    (x, y), (dx, dy) = primals, tangents
    ratio = quotient_p.bind(x, y)
    reciprocal = quotient_p.bind(jnp.ones_like(y), y)
    parts = []
    if type(dx) is not ad.Zero:
        parts.append(dx * reciprocal)
    if type(dy) is not ad.Zero:
        parts.append(dy * -(ratio * reciprocal))
    return ratio, sum(parts[1:], parts[0])


def _batched(args, dims):
    front = [
        x[None] if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims, strict=True)
    ]
    return quotient_p.bind(*jnp.broadcast_arrays(*front)), 0


jitted(quotient_p, lambda x, y: x / y)
ad.primitive_jvps[quotient_p] = _jvp
batching.primitive_batchers[quotient_p] = _batched
