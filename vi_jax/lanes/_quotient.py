"""Division whose derivative divides once, however many directions it is taken in.

JAX divides each tangent of the dividend by the divisor, and each of the divisor by its square. Here
each is multiplied by one reciprocal: in the derivatives of a machine's motion the divisions would
take most of the time.
"""

from typing import Any

import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr
from jax.interpreters import ad

from ._program import rewritten
from .elementary import elementwise_primitive


def _divided(eqn: Any) -> Any:
    """An equation, with this derivative if it divides floating-point numbers."""
    if eqn.primitive.name == "div" and jnp.issubdtype(eqn.outvars[0].aval.dtype, jnp.floating):
        return eqn.replace(primitive=quotient_p, params={})
    return eqn


def with_quotients(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The same jaxpr, its divisions of floating-point numbers with this derivative."""
    return rewritten(closed, _divided)


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


quotient_p = elementwise_primitive("quotient", lambda x, y: x / y, _jvp)
