"""Merged programs compute the same as the functions that they were traced from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes
from vi_jax.lanes import _merge
from vi_jax.lanes._program import size_of


def merged(closed):
    return _merge.merged(closed)[0]


def evaluated(closed, *args):
    return jax.jit(lambda *x: jax.core.eval_jaxpr(closed.jaxpr, closed.consts, *x))(*args)


def names(jaxpr):
    return [eqn.primitive.name for eqn in jaxpr.eqns]


def test_results_are_the_same_bits_in_fewer_equations():
    table = np.arange(5.0)

    @jax.jit
    def part(x, y):
        return jnp.where(x > y, jnp.sin(x), jnp.cos(y)) * jnp.asarray(table)[2], x - y

    def branch(x):
        return jnp.sin(x) + jnp.sin(x) * part(x, 0.5)[0]

    def function(x, y, n):
        first = part(x, y)[0] + part(x, y)[1] + part(y, x)[1] + 0.0 - (-0.0)
        second = jax.lax.cond(n > 0, branch, lambda x: x + 1.0, x) + jnp.sin(x) + jnp.sin(x)
        loop = jax.lax.scan(lambda c, z: (jnp.sin(c) + jnp.sin(c) * z, c), x, jnp.ones(3))
        unused = jnp.exp(x) ** 2
        del unused
        rank, last = jax.lax.top_k(jnp.stack([x, y, x]), 2)
        again = jax.lax.top_k(jnp.stack([x, y, x]), 2)[1]
        return first, second, loop, rank.sum(), last, again, x, 3.0, n

    args = 0.3, 0.7, 1
    closed = jax.make_jaxpr(function)(*args)
    found = merged(closed)
    for a, b in zip(evaluated(closed, *args), evaluated(found, *args), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert size_of(found.jaxpr) < size_of(closed.jaxpr)
    flat = names(found.jaxpr)
    assert "exp" not in flat  # not needed
    assert flat.count("top_k") == 1
    assert merged(found) is not found and size_of(merged(found).jaxpr) == size_of(found.jaxpr)


def test_arithmetic_with_known_numbers_is_done():
    @jax.jit
    def part(x, mass):
        return x / mass, -(2.0 * jnp.ones_like(x)) / 3.0, jnp.sin(x), jnp.cos(x), jnp.exp(x)

    def function(x):
        y, third, sine, *_ = part(1.0 * x, 1.0)
        return y - 0.0, third * third, (sine + third) * 1.0, 0.0 * x, jnp.float32(third) - 1.0

    closed = jax.make_jaxpr(function)(0.1)
    found = merged(closed)
    for x in (0.3, -0.0, np.inf, np.nan):
        for a, b in zip(evaluated(closed, x), evaluated(found, x), strict=True):
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    flat = names(found.jaxpr)
    assert flat.count("mul") == 1 and "sub" not in flat  # a product with 0 may be NaN


def test_derivatives_are_the_same():
    @jax.custom_jvp
    def own(x):
        return x**2

    own.defjvp(lambda x, t: (own(*x), 5.0 * t[0]))  # not that of the body
    function = lambda x: own(x) + own(x) * jnp.maximum(x, 1.0) + jnp.where(x > 0, x, 0.0)
    found = merged(jax.make_jaxpr(function)(2.0))
    merged_function = lambda x: jax.core.eval_jaxpr(found.jaxpr, found.consts, x)[0]
    for derivative in (jax.grad, jax.jacfwd):
        found_slope, slope = jax.jit(
            lambda x, d=derivative: (d(merged_function)(x), d(function)(x))
        )(2.0)
        np.testing.assert_allclose(found_slope, slope)


def test_a_call_inlined_twice_has_variables_of_its_own():
    small = jax.jit(lambda x: jnp.sin(x) * 2.0 + x)
    found = merged(jax.make_jaxpr(lambda x, y: (small(x), small(y), small(x)))(0.1, 0.2))
    variables = [v for eqn in found.jaxpr.eqns for v in eqn.outvars]
    assert "jit" not in names(found.jaxpr) and len(set(variables)) == len(variables)
    assert names(found.jaxpr).count("sin") == 2
    one, two, three = evaluated(found, 0.1, 0.2)
    np.testing.assert_allclose([one, two], 2 * np.sin([0.1, 0.2]) + [0.1, 0.2], rtol=1e-15)
    assert one == three


def test_effects_stay():
    """A function that prints runs on XLA's backend."""
    seen = []

    def function(x):
        jax.debug.callback(lambda y: seen.append(float(y)), x)
        jax.debug.callback(lambda y: seen.append(float(y)), x)
        return x

    with pytest.warns(UserWarning, match="`debug_callback`"):
        lanes.once(function, 1.5)
    jax.effects_barrier()
    assert seen == [1.5, 1.5]
