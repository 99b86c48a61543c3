"""A lane that failed has no derivatives: they are NaN, where the loop would give zeros.

What follows a failure is not computed, and so depends on nothing: an optimiser would take that for
a stationary point. The numbers of the run themselves stay what they are.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

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
    return numbers, jtu.tree_map(lambda rate: _fail.bind(good, rate, back=False), rates)


# Linear as JAX understands it, with a transpose that arithmetic could not have: what asks for
# nothing of a lane, as a loss that leaves failed ones out, gets nothing.
_fail = Primitive("fail_derivatives")


def _value(good, x, *, back: bool):
    good = jnp.reshape(good, good.shape + (1,) * (x.ndim - good.ndim))
    return jnp.where(good | (x == 0) if back else good, x, jnp.nan)


def _batched(args, dims, *, back: bool):
    size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    good, x = (
        jnp.broadcast_to(x, (size, *x.shape)) if d is None else jnp.moveaxis(x, d, 0)
        for x, d in zip(args, dims, strict=True)
    )
    return _fail.bind(good, x, back=back), 0


def _jvp(primals, tangents, *, back: bool):
    (good, x), (_, rate) = primals, tangents
    out = _fail.bind(good, x, back=back)
    return out, rate if type(rate) is ad.Zero else _fail.bind(good, rate, back=back)


def _transposed(weight, good, _, *, back: bool):
    return None, weight if type(weight) is ad.Zero else _fail.bind(good, weight, back=not back)


_fail.def_abstract_eval(lambda good, x, *, back: x)
_fail.def_impl(_value)
batching.primitive_batchers[_fail] = _batched
ad.primitive_jvps[_fail] = _jvp
ad.primitive_transposes[_fail] = _transposed
mlir.register_lowering(_fail, mlir.lower_fun(_value, multiple_results=False))
