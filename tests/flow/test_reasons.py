"""Lanes that fail: each result names its reason, and derivatives are NaN."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


class Bounce(vi.AbstractMachine):
    """A constant force presses a body on a stop with any restitution law."""

    law: Any
    strength: Any = 1.0

    @property
    def contacts(self):
        return vi.RigidStop(0.0, self.law)

    cycle = 2 * jnp.pi

    def field(self, s, state):
        return vi.OscillatorState(state.V, self.strength + 0 * state.V)


START = vi.OscillatorState(jnp.asarray(-1.0), jnp.asarray(0.0))


class Law(eqx.Module):
    """k = slow up to a speed of 1, and fast above."""

    slow: Any
    fast: Any

    def __call__(self, speed):
        return jnp.where(speed > 1, self.fast, self.slow)


def test_law_out_of_range_fails_lanes_that_reach_it():
    """The first impact speed is √2, the second is √2 times the coefficient."""
    laws = Law(jnp.array([0.5, 0.5, 1.2, -0.1, 0.5]), jnp.array([0.9, 1.2, 0.5, 1.0, -0.5]))
    run = jax.vmap(lambda law: vi.simulate(Bounce(law), START, 2))(laws)
    bad = run.result == vi.RESULTS.bad_impact
    # The fourth lane never reaches the low speeds for which its law is invalid.
    assert bad.tolist() == [False, True, True, False, True]
    assert bool(run.successful[0] & run.successful[3])
    assert not np.isfinite(run.last.Y[bad]).any()


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (lambda v: 0.9 if v < 1 else 0.1, "`jnp.where`, not `if`"),
        (lambda v: np.exp(-v), "not with those of `numpy`"),
        (lambda v: jnp.array([0.1, 0.2]) * v, r"shape \(2,\)"),
        (lambda v, w: v, "function of the speed of approach"),
    ],
)
def test_invalid_laws_raise(law, words):
    with pytest.raises(TypeError, match=words):
        vi.simulate(Bounce(law), START, 1)


class Pushed(vi.AbstractMachine):
    """Forces on both sides of the switching line point towards it."""

    @property
    def events(self):
        return vi.Switch(lambda machine, s, x: x.Y + x.V)

    cycle = 2 * jnp.pi

    def field(self, s, state, mode):
        return vi.OscillatorState(state.V, -2.0 * mode + 0.1 * jnp.cos(s))


def test_a_sliding_mode_has_its_own_reason():
    for Y, V in ((1.0, 0.0), (1.0, -1.0)):  # arrives at the line; starts on it
        run = vi.simulate(Pushed(), vi.OscillatorState(jnp.asarray(Y), jnp.asarray(V)), 2)
        assert bool(run.result == vi.RESULTS.sliding)
        assert "slide" in str(run)


class Turned(vi.AbstractMachine):
    """An oscillator whose velocity is reversed at the start of each cycle."""

    cycle = 1.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, -state.Y)

    def renewed(self, state):
        return vi.OscillatorState(state.Y, -state.V)


def test_velocity_is_reversed_at_the_start_of_each_cycle():
    """The body retraces its path, so every second section equals the first."""
    run = vi.simulate(Turned(), vi.OscillatorState(jnp.asarray(1.0), jnp.asarray(0.5)), 4)
    first, top = np.arctan2(-0.5, 1.0), np.hypot(1.0, 0.5)
    places = top * np.cos(first + np.linspace(0, 1, 10001))
    assert bool(run.successful)
    np.testing.assert_allclose(run.sections.Y[::2], 1.0, atol=1e-9)
    np.testing.assert_allclose(run.y_max, top, atol=1e-9)
    np.testing.assert_allclose(run.y_min, places.min(), atol=1e-9)


class Damped(vi.AbstractMachine):
    """x'' + a x' + b x = cos s, without a rate of decay for the choice of steps."""

    damping: Any
    spring: Any
    cycle: Any = 2 * np.pi

    def field(self, s, state):
        force = jnp.cos(s) - self.spring * state.Y - self.damping * state.V
        return vi.OscillatorState(state.V, force)


@pytest.mark.parametrize("solver", [vi.Verner9(), diffrax.Tsit5()])
def test_unstable_fixed_steps_fail(solver):
    """With ten steps per cycle, both solvers are stable for damping up to about 5."""
    dampings, springs = jnp.asarray([[0.5, 3, 5, 8, 10, 30, 1e4, 0], [1.0] * 7 + [1e4]])
    start, method = vi.OscillatorState(jnp.asarray(1.0), jnp.asarray(0.0)), vi.FixedStep(solver)
    run = jax.vmap(lambda a, b: vi.simulate(Damped(a, b), start, 12, method=method))(
        dampings, springs
    )
    assert run.successful.tolist() == [True] * 3 + [False] * 5
    assert (run.result == vi.RESULTS.unstable).tolist() == [False] * 3 + [True] * 5
    by_error = jax.vmap(lambda a: vi.simulate(Damped(a, 1.0), start, 12).last.Y)(dampings[:3])
    np.testing.assert_allclose(run.last.Y[:3], by_error, rtol=0, atol=2e-4)


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
