"""`jax.checkpoint` changes no derivative: what it does not keep is simulated again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from differences import some

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


@pytest.mark.slow
def test_reverse_mode_through_a_checkpoint():
    truth = slope_of(last, 0.1)
    checked = jax.checkpoint(last)
    np.testing.assert_allclose(jax.grad(checked)(0.1), truth, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.grad(checked))(0.1), truth, rtol=1e-5)
    value, along = jax.linearize(checked, 0.1)
    np.testing.assert_allclose([value, along(1.0)], [last(0.1), truth], rtol=1e-5)
    lanes = jax.grad(lambda V: jnp.sum(jax.vmap(checked)(V)))(jnp.array([0.1, 0.2]))
    np.testing.assert_allclose(lanes, [truth, slope_of(last, 0.2)], rtol=1e-5)


def test_a_checkpoint_in_a_scan():
    truth = slope_of(cycle_by_cycle(lambda f: f), 0.1)
    np.testing.assert_allclose(jax.grad(cycle_by_cycle(jax.checkpoint))(0.1), truth, rtol=1e-5)


POLICIES = ["everything_saveable", "nothing_saveable", "dots_saveable"]


@pytest.mark.parametrize("policy", some(POLICIES, "dots_saveable"))
def test_policies_and_second_derivatives(policy):
    checked = jax.checkpoint(last, policy=getattr(jax.checkpoint_policies, policy))
    np.testing.assert_allclose(jax.grad(checked)(0.1), slope_of(last, 0.1), rtol=1e-5)
    second = slope_of(jax.jit(jax.grad(last)), 0.1)
    for twice in (jax.grad(jax.grad(checked)), jax.jacfwd(jax.grad(checked))):
        np.testing.assert_allclose(twice(0.1), second, rtol=1e-5)
    np.testing.assert_allclose(jax.grad(jax.checkpoint(jax.grad(last)))(0.1), second, rtol=1e-5)


@pytest.mark.exhaustive
def test_a_checkpoint_around_an_orbit():
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
    guess = scene.start(Y=1.6, V=-1.9)

    def lowest(zeta):
        moved = vi.Scene.ideal(frequency_ratio=zeta, damping_ratio=0.0)
        return vi.find_orbit(moved, guess, cycles=2).y_min

    found = jax.grad(jax.checkpoint(lowest))(0.9)
    np.testing.assert_allclose(found, slope_of(lowest, 0.9, 1e-5), rtol=1e-6)


@pytest.mark.slow
def test_a_checkpoint_on_the_other_road():
    with vi.backend("xla"):
        found = jax.grad(jax.checkpoint(lambda V: last(V)))(0.1)  # traced anew
    np.testing.assert_allclose(found, slope_of(last, 0.1), rtol=1e-5)
