"""`jax.checkpoint` changes no derivative: values that are not stored are simulated again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=0.5, damping_ratio=0.1)


def last(V):
    return vi.simulate(SCENE, SCENE.start(V=V), 3).last.Y


def cycle_by_cycle(wrapped):
    def end(V):
        def cycle(state, _):
            run = vi.simulate(SCENE, state, 1, rests=False)
            return run.last, run.y_min[0]

        state, lowest = jax.lax.scan(wrapped(cycle), SCENE.start(V=V), length=3)
        return state.Y + jnp.sum(lowest)

    return end


def slope_of(f, V, h=1e-6):
    return (f(V + h) - f(V - h)) / (2 * h)


def test_a_checkpoint_in_a_scan():
    truth = slope_of(cycle_by_cycle(lambda f: f), 0.1)
    np.testing.assert_allclose(jax.grad(cycle_by_cycle(jax.checkpoint))(0.1), truth, rtol=1e-5)


@pytest.mark.slow
def test_policies_and_second_derivatives():
    checked = jax.checkpoint(last, policy=jax.checkpoint_policies.dots_saveable)
    truth = slope_of(last, 0.1)
    np.testing.assert_allclose(jax.jit(jax.grad(checked))(0.1), truth, rtol=1e-5)
    value, along = jax.linearize(checked, 0.1)
    np.testing.assert_allclose([value, along(1.0)], [last(0.1), truth], rtol=1e-5)
    lanes = jax.grad(lambda V: jnp.sum(jax.vmap(checked)(V)))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(lanes, [truth, slope_of(last, 0.2)], rtol=1e-5)
    second = slope_of(jax.jit(jax.grad(last)), 0.1)
    for twice in (jax.grad(jax.grad(checked)), jax.jacfwd(jax.grad(checked))):
        np.testing.assert_allclose(twice(0.1), second, rtol=1e-5)
    np.testing.assert_allclose(jax.grad(jax.checkpoint(jax.grad(last)))(0.1), second, rtol=1e-5)
