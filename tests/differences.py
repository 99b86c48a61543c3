"""Derivatives of simulated motions beside what they must agree with."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


def quick(cases, *names):
    """Of these cases only the named ones run by default; the rest with the longer studies."""
    return [x if x in names else pytest.param(x, marks=pytest.mark.slow) for x in cases]


each_mode = pytest.mark.parametrize("mode", ["forward", "reverse"])


def check_derivatives(
    mode: str,
    last: Callable[..., Any],
    at: Any,
    *,
    step: Any = 1e-5,
    tolerance: float = 1e-6,
    impacts: int,
) -> None:
    """Forward derivatives beside central differences, or reverse ones beside forward ones.

    `last(x)` simulates by a vector of numbers, and gives the state at the end and the
    impacts, which no step may change, and of which there are to be at least so many.
    """
    at = jnp.asarray(at)
    steps = jnp.diag(jnp.broadcast_to(jnp.asarray(step), at.shape))

    def numbers(x: Any) -> tuple[Any, Any]:
        state, counts = last(x)
        return jnp.stack(jax.tree.leaves(state)), counts

    forward = np.asarray(vi.jit(jax.jacfwd(lambda x: numbers(x)[0]))(at))
    if mode == "forward":
        moved, counts = vi.jit(jax.vmap(numbers))(jnp.concatenate([at + steps, at - steps]))
        assert (counts == counts[0]).all() and int(counts[0].sum()) >= impacts
        ahead, behind = np.split(np.asarray(moved), 2)
        slope = (ahead - behind).T / (2 * np.diag(steps))
        np.testing.assert_allclose(forward, slope, rtol=tolerance, atol=tolerance)
        return
    # Another weight for each component, so that none can be left out.
    weights = jnp.arange(1.0, forward.shape[0] + 1)

    def weighted(x: Any) -> Any:
        return weights @ numbers(x)[0]

    backward = vi.jit(jax.grad(weighted))(at)
    np.testing.assert_allclose(backward, weights @ forward, rtol=1e-12, atol=1e-12)
