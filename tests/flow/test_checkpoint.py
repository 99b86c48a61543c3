"""`jax.checkpoint` changes no derivative: values that are not stored are simulated again."""

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

SCENE = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=0.5, damping_ratio=0.1)


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
