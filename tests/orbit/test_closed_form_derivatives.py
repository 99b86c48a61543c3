"""Derivatives of the motions in closed form."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax.orbit.closed_form import one_impact_orbits

from closed_forms import FIELDS, solve
from differences import some


@partial(jax.jit, static_argnums=1)
def answer(at, n):
    """All numbers of the first motion, derivatives of which the absent second must not spoil."""
    orbits = one_impact_orbits(*at, n)
    values = jnp.stack([getattr(orbits, name)[0] for name in FIELDS])
    values = jnp.where(jnp.isinf(values), 0.0, values)
    return jnp.append(values, orbits.multipliers[0, 0].real)


@partial(jax.jit, static_argnums=1)
def slopes(at, n):
    return jax.jacfwd(answer)(at, n), jax.jacrev(answer)(at, n)


AT = [
    ((0.9, 0.0, 0.5, 2.0), 2),
    ((0.9, 0.03, 0.5, 1.5), 1),
    ((0.9, 0.0, 0.5, 2.0), 1),
    ((1.0, 0.0, 0.4, 1.5), 1),
    ((0.8, 1.0, 0.5, 0.1), 1),
]


@pytest.mark.parametrize(("at", "n"), some(AT, AT[0]))
def test_gradients_agree_with_central_differences(at, n):
    at = jnp.array(at)
    forward, reverse = slopes(at, n)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-10)
    # At resonance the section is at the impact itself, where its state jumps, and the multiplier
    # is double, so that it has no derivative.
    kept = slice(3, 5) if at[0] == 1 else slice(None)
    h = 1e-5  # ξ may step below zero: the formulas continue there
    differences = [(answer(at + e, n) - answer(at - e, n)) / (2 * h) for e in h * jnp.eye(4)]
    np.testing.assert_allclose(forward[kept], jnp.stack(differences, 1)[kept], rtol=2e-6, atol=2e-7)


@pytest.mark.slow
def test_absent_motions_have_finite_derivatives_behind_a_where():
    @partial(jax.jit, static_argnums=1)
    @jax.grad
    def slope(at, n):
        orbits = solve(*at, n)
        fields = jnp.stack([getattr(orbits, name) for name in FIELDS[:6]])
        return jnp.where(orbits.exists, fields, 0.0).sum()

    for at, n in (((0.5, 0.0, 0.5, 2.0), 1), ((0.9, 0.0, 0.5, 9.0), 1), ((0.9, 0.1, 0.0, 2.0), 1)):
        assert jnp.isfinite(slope(jnp.array(at), n)).all()
