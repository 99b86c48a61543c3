"""A lane that failed has no derivatives: they are NaN, where the loop would give zeros.

What follows a failure is not computed, and so depends on nothing: an optimiser would take that for
a stationary point. The numbers of the run themselves stay what they are.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from ._lane import Plan
from .results import Run


def spoiled(plan: Plan, start: Any, run: Run) -> Run:
    """The same run, whose derivatives are NaN if it failed."""
    numbers, rest = eqx.partition(run, eqx.is_inexact_array)
    if plan.bound:
        inputs = eqx.filter((plan.scene, start), eqx.is_inexact_array)
        numbers = _backward(run.successful, inputs, numbers)
    else:
        numbers = _forward(run.successful, numbers)
    return eqx.combine(numbers, rest)


@jax.custom_jvp
def _forward(good: Any, numbers: Any) -> Any:
    return numbers


@_forward.defjvp
def _(primals, tangents):
    (good, numbers), (_, rates) = primals, tangents
    return numbers, jtu.tree_map(lambda rate: jnp.where(good, rate, jnp.nan), rates)


@jax.custom_vjp
def _backward(good: Any, inputs: Any, numbers: Any) -> Any:
    return numbers


def _begin(good, inputs, numbers):
    return numbers, (good, inputs)


def _end(kept, weights):
    # What asks for nothing of this lane, as a loss that leaves failed ones out, gets nothing.
    good, inputs = kept
    asked = jnp.asarray(False)
    for weight in jtu.tree_leaves(weights):
        asked = asked | jnp.any(weight != 0)
    blame = jtu.tree_map(lambda x: jnp.where(asked & ~good, jnp.nan, jnp.zeros_like(x)), inputs)
    return None, blame, weights


_backward.defvjp(_begin, _end)
