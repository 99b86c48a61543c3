"""Derivatives of simulated motions beside what they must agree with."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


def quick(cases, *names, slow=None):
    """Of these cases only the named ones run by default; the rest with the longer studies, or only
    those of `slow` with these and all others before a release. A case of several arguments is a
    tuple."""

    def marks(x):
        return pytest.mark.slow if slow is None or x in slow else pytest.mark.exhaustive

    def case(x):
        return pytest.param(*(x if isinstance(x, tuple) else (x,)), marks=marks(x))

    return [x if x in names else case(x) for x in cases]


def some(cases, *names):
    """Of these cases the named ones run with the longer studies; the rest before a release."""
    return quick(cases, slow=names)


def check_derivatives(
    last: Callable[..., Any],
    at: Any,
    *,
    step: Any = 1e-5,
    tolerance: float = 1e-6,
    impacts: int,
) -> None:
    """Forward derivatives beside central differences, and reverse ones beside forward ones.

    `last(x)` simulates by a vector of numbers, and gives the state at the end and the
    impacts, which no step may change, and of which there are to be at least so many.
    """
    at = jnp.asarray(at)
    steps = jnp.diag(jnp.broadcast_to(jnp.asarray(step), at.shape))

    def numbers(x: Any) -> tuple[Any, Any]:
        state, counts = last(x)
        found = jnp.stack(jax.tree.leaves(state))
        return found, (found, counts)

    # One program gives the derivatives here and the motions on both sides.
    places = jnp.concatenate([at[None], at + steps, at - steps])
    slopes, (moved, counts) = vi.jit(jax.vmap(jax.jacfwd(numbers, has_aux=True)))(places)
    assert (counts == counts[0]).all() and int(counts[0].sum()) >= impacts
    forward, (ahead, behind) = np.asarray(slopes[0]), np.split(np.asarray(moved[1:]), 2)
    slope = (ahead - behind).T / (2 * np.diag(steps))
    np.testing.assert_allclose(forward, slope, rtol=tolerance, atol=tolerance)
    # Another weight for each component, so that none can be left out.
    weights = jnp.arange(1.0, forward.shape[0] + 1)
    backward = vi.jit(jax.grad(lambda x: weights @ numbers(x)[0]))(at)
    np.testing.assert_allclose(backward, weights @ forward, rtol=1e-12, atol=1e-12)
