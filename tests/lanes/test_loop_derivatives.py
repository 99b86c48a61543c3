"""Derivatives of loops: forward, in several directions at once, and reverse by columns."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax import lanes
from vi_jax.lanes import _backward

from lanes.toys import fall, logistic


def test_forward_derivatives():
    """First and second derivatives through the event, in one and several directions."""
    time = lambda height, gravity: fall(height, gravity)[0][0]
    h, g = 1.7, 9.81
    slope = jax.jacfwd(time, (0, 1))(h, g)
    np.testing.assert_allclose(slope, [0.5 * np.sqrt(2 / h / g), -0.5 * np.sqrt(2 * h / g**3)])
    bend = jax.jacfwd(jax.jacfwd(time))(h, g)
    np.testing.assert_allclose(bend, -0.25 * np.sqrt(2 / h**3 / g))
    many = jax.vmap(jax.jacfwd(time, (0, 1)), (0, None))(np.linspace(1, 2, 11), g)
    np.testing.assert_allclose(many[0], 0.5 * np.sqrt(2 / np.linspace(1, 2, 11) / g))
    one = jax.jit(lambda x: jax.jvp(lambda x: logistic(x, 3.7, 6.0), (x,), (1.0,)))(0.3)
    two = jax.jit(lambda x: jax.jvp(lambda x: logistic(x, 3.7, 6.0, backend="xla"), (x,), (1.0,)))(
        0.3
    )
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        if a.dtype != jax.dtypes.float0:
            np.testing.assert_allclose(a, b, rtol=1e-12)


def test_rules_that_fail_raise():
    """An error within a rule is passed on. A `custom_vjp` has no forward rule and raises."""
    forward, backward = jax.custom_jvp(jnp.sin), jax.custom_vjp(jnp.sin)
    forward.defjvp(lambda primals, tangents: int("mine"))
    backward.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (g * jnp.cos(x),))
    with pytest.raises(ValueError, match="'mine'"):
        jax.grad(lambda x: lanes.once(forward, x))(0.5)
    assert float(lanes.once(backward, 0.5)) == pytest.approx(np.sin(0.5))
    with pytest.raises(TypeError, match=r"define it by `jax\.custom_jvp`"):
        jax.grad(lambda x: lanes.once(backward, x))(0.5)


def test_empty_arrays():
    """Gradients of empty arrays are empty; integers joined with them stay integers."""
    value = lambda x, y: lanes.once(lambda v: jnp.sum(v[0]) + jnp.sum(v[1] ** 2), (x, y))
    slopes = jax.vmap(jax.grad(value, (0, 1)))(jnp.zeros((3, 0)), jnp.ones((3, 2)))
    assert slopes[0].shape == (3, 0)
    np.testing.assert_array_equal(slopes[1], np.full((3, 2), 2.0))
    assert jax.grad(lambda x: value(x, jnp.ones(2)))(jnp.zeros(0)).shape == (0,)
    joined = lanes.once(jnp.concatenate, (jnp.zeros(0, jnp.int32), jnp.array([1, 2], jnp.int32)))
    np.testing.assert_array_equal(joined, np.array([1, 2], np.int32), strict=True)


INNER = {
    "scan": lambda x: jax.lax.scan(lambda a, b: (a * b, a), x, jnp.stack([x, 2 * x]))[0],
    "fori_loop": lambda x: jax.lax.fori_loop(0, 3, lambda i, a: a * a, x),
    "while_loop": lambda x: jax.lax.while_loop(lambda a: a < 5, lambda a: a * a, x),
    "cond": lambda x: jax.lax.cond(x > 1, lambda a: a * a, lambda a: a, x),
    "checkpoint": lambda x: jax.checkpoint(jnp.sin)(x),
    "custom_jvp": lambda x: with_custom_derivative(x),
}


@jax.custom_jvp
def with_custom_derivative(x):
    return jax.lax.stop_gradient(x)


with_custom_derivative.defjvps(lambda slope, out, x: 3 * x * slope)


@pytest.mark.parametrize("name", INNER)
def test_derivatives_of_inner_control_flow(name):
    def lane(x, y):
        def begin(inputs):
            return inputs[0], lanes.Emitted(True, False, None)

        def step(inputs, carry):
            return INNER[name](carry) * inputs[1], lanes.Emitted(False, False, None)

        return lanes.run(begin, step, lambda inputs, carry: carry, (x, y), rows=0)[0]

    def plain(x, y):
        return INNER[name](x) * y

    wanted = jax.jit(jax.jacfwd(plain, (0, 1)))(1.5, 2.5)
    for along in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(along(lane, (0, 1)))(1.5, 2.5), wanted, rtol=1e-15)


@jax.custom_jvp
def drifted(time, place, speed):
    """Return (place, speed), with the derivatives of (place + time · speed, speed) at time 0."""
    return place, speed


@drifted.defjvp
def _(primals, tangents):
    time, _, speed = primals
    along = drifted(time, *tangents[1:])  # for derivatives of higher order
    return drifted(*primals), (along[0] + tangents[0] * speed, along[1])


@pytest.mark.slow
@pytest.mark.parametrize("most_columns", [0, 9])
def test_derivatives_of_a_branch_with_more_inputs_than_its_value(monkeypatch, most_columns):
    """Derivatives up to third order, forward, by a tape, and by columns."""
    monkeypatch.setattr(_backward, "_BY_COLUMNS", most_columns)

    def lane(x):
        def step(x, carry):
            place, speed = jax.lax.cond(
                x[1] > 0, lambda: drifted(x[0], jnp.ones_like(x[0]), x[1]), lambda: (x[0], x[1])
            )
            return place * speed, lanes.Emitted(False, False, None)

        begin = lambda x: (x[0], lanes.Emitted(True, False, None))
        return lanes.run(begin, step, lambda x, carry: carry, x, rows=0)[0]

    x, weights = jnp.asarray([0.0, 1.5]), jnp.asarray([0.3, 0.7])
    closed = lambda x: (1 + x[0] * x[1]) * x[1]
    along = lambda order, f: functools.reduce(
        lambda f, derivative: lambda x: derivative(f)(x) @ weights, order, f
    )
    orders = [*itertools.product((jax.jacfwd, jax.jacrev), repeat=2), (jax.jacfwd,) * 3]
    for order in (*orders, (jax.jacrev,) * 3):
        np.testing.assert_allclose(along(order, lane)(x), along(order, closed)(x), rtol=1e-14)


def test_linearize_and_stop_gradient():
    def last(x):
        return logistic(x, 3.7, 6.0)[0][0]

    value, along = jax.linearize(last, 0.3)
    np.testing.assert_allclose(value, last(0.3))
    np.testing.assert_allclose(along(1.0), jax.jacfwd(last)(0.3))
    slope = jax.grad(lambda x: x * jax.lax.stop_gradient(last(x)))
    np.testing.assert_allclose(slope(0.3), last(0.3))
