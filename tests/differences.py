"""Compare derivatives of simulated motions with finite differences."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


def quick(cases, *names, slow=None):
    """Mark all cases but `names` as slow, so that only these run by default. If `slow` is given,
    other cases are exhaustive (run before a release). A case of several arguments is a tuple."""

    def marks(x):
        return pytest.mark.slow if slow is None or x in slow else pytest.mark.exhaustive

    def case(x):
        return pytest.param(*(x if isinstance(x, tuple) else (x,)), marks=marks(x))

    return [x if x in names else case(x) for x in cases]


def some(cases, *names):
    """Mark the named cases as slow and all others as exhaustive."""
    return quick(cases, slow=names)


def check_derivatives(
    last: Callable[..., Any], at: Any, *, step: Any = 1e-5, tolerance: float = 1e-6, impacts: int
) -> None:
    """Compare forward derivatives with central differences, and reverse with forward derivatives.

    `last(x)` returns the final state and the impact counts. No difference step may change the
    counts, and their sum must be at least `impacts`.
    """
    at = jnp.asarray(at)
    steps = jnp.diag(jnp.broadcast_to(jnp.asarray(step), at.shape))

    def numbers(x: Any) -> tuple[Any, Any]:
        state, counts = last(x)
        found = jnp.stack(jax.tree.leaves(state))
        return found, (found, counts)

    # One program computes the derivatives and the motions on both sides.
    places = jnp.concatenate([at[None], at + steps, at - steps])
    slopes, (moved, counts) = vi.jit(jax.vmap(jax.jacfwd(numbers, has_aux=True)))(places)
    assert (counts == counts[0]).all() and int(counts[0].sum()) >= impacts
    forward, (ahead, behind) = np.asarray(slopes[0]), np.split(np.asarray(moved[1:]), 2)
    slope = (ahead - behind).T / (2 * np.diag(steps))
    np.testing.assert_allclose(forward, slope, rtol=tolerance, atol=tolerance)
    # Weights differ, so that a missing component is noticed.
    weights = jnp.arange(1.0, forward.shape[0] + 1)
    backward = vi.jit(jax.grad(lambda x: weights @ numbers(x)[0]))(at)
    np.testing.assert_allclose(backward, weights @ forward, rtol=1e-12, atol=1e-12)
