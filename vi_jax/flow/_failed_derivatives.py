"""A lane that failed has no derivatives: they are NaN, where the loop would give zeros.

What follows a failure is not computed, and so depends on nothing: an optimiser would take that for
a stationary point. The numbers of the run themselves stay what they are.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.interpreters import ad

from ..lanes import elementwise_primitive
from .results import Run


def failed_derivatives(run: Run) -> Run:
    """The same run, whose derivatives are NaN if it failed."""
    numbers, rest = eqx.partition(run, eqx.is_inexact_array)
    return eqx.combine(_marked(run.successful, numbers), rest)


@jax.custom_jvp
def _marked(good: object, numbers: object) -> Any:
    return numbers


@_marked.defjvp
def _(primals, tangents):
    (good, numbers), (_, rates) = primals, tangents

    def marked(rate):
        wide = jnp.reshape(good, good.shape + (1,) * (rate.ndim - good.ndim))
        return _fail.bind(jnp.broadcast_to(wide, rate.shape), rate, back=False)

    return numbers, jtu.tree_map(marked, rates)


def _value(good, x, *, back: bool):
    return jnp.where(good | (x == 0) if back else good, x, jnp.nan)


def _jvp(primals, tangents, *, back: bool):
    (good, x), (_, rate) = primals, tangents
    out = _fail.bind(good, x, back=back)
    return out, rate if type(rate) is ad.Zero else _fail.bind(good, rate, back=back)


def _transposed(weight, good, _, *, back: bool):
    return None, weight if type(weight) is ad.Zero else _fail.bind(good, weight, back=not back)


# Linear as JAX understands it, with a transpose that arithmetic could not have: what asks for
# nothing of a lane, as a loss that leaves failed ones out, gets nothing.
_fail = elementwise_primitive("fail_derivatives", _value, _jvp)
ad.primitive_transposes[_fail] = _transposed
