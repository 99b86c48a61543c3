"""Derivatives of failed lanes are NaN, never a zero that looks like a stationary point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

CYCLES = 4


# The first lane needs too many steps, the second is fine, the third is out of range.
GAPS, KS = jnp.asarray([-0.5, 1.5, 1.5]), jnp.asarray([0.5, 0.5, 2.0])
STEPS = 60


def run(gap, k):
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=k, gap=gap, damping_ratio=0.05)
    start = scene.start(Y=jnp.minimum(gap, 0.0) - 0.1)
    return vi.simulate(scene, start, CYCLES, max_steps=STEPS, rests=True)


def test_forward_derivatives_of_a_failed_lane_are_nan_and_its_values_stay():
    def found(gap, k):
        run_ = run(gap, k)
        return run_.sections.Y, run_.y_min, run_.impact_speed, run_.last.V

    def slopes(gap, k):
        return jax.jvp(lambda gap: found(gap, k), (gap,), (jnp.ones_like(gap),))

    plain = jax.jit(jax.vmap(found))(GAPS, KS)
    values, rates = jax.jit(jax.vmap(slopes))(GAPS, KS)
    for a, b, rate in zip(plain, values, rates, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isnan(rate[0]).all() and np.isnan(rate[2]).all()
        assert np.isfinite(rate[1]).all()
    # The lane failed midway; the sections before have values.
    assert np.isfinite(plain[0][0, 0]) and np.isnan(plain[0][0, -1])


def test_gradients_of_a_failed_lane_are_nan_unless_masked():
    def last(gap, k):
        run_ = run(gap, k)
        return run_.last.Y, run_.successful

    slopes, good = jax.jit(jax.vmap(jax.grad(last, has_aux=True)))(GAPS, KS)
    assert good.tolist() == [False, True, False]
    assert np.isnan(slopes).tolist() == [True, False, True]

    def masked(gap, k):
        value, good = last(gap, k)
        return jnp.where(good, value, 0.0)

    slopes_left_out = jax.jit(jax.vmap(jax.grad(masked)))(GAPS, KS)
    np.testing.assert_array_equal(slopes_left_out, jnp.where(good, slopes, 0.0))


def test_scan_returns_nan_slopes_for_failed_lanes():
    scene = vi.Scene.ideal(frequency_ratio=0.9, gap=-0.5, damping_ratio=0.05)
    options = {"cycles": CYCLES, "settle": 0, "max_steps": STEPS, "start": scene.start(Y=-0.6)}
    axes, slope = {"stops.0.gap": jnp.asarray([-0.5, 1.5])}, ("stops.0.gap",)
    with pytest.warns(UserWarning, match="failed"):
        data = vi.scan(scene, axes, measure="extremes", derivatives=slope, **options)
    assert (np.asarray(data.result) != 0).tolist() == [True, False]
    slopes = [name for name in data if str(name).startswith("d_")]
    assert slopes
    for name in slopes:
        assert np.isnan(np.ravel(data[name])).tolist() == [True, False], name
