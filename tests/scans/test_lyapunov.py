"""Lyapunov exponents, compared with damping, Floquet multipliers and mean contraction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.scans._lyapunov import _weighted

from rimless_wheel import Wheel


def ideal(zeta=0.9, k=0.5, xi=0.0, gap=2.0):
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, damping_ratio=xi, gap=gap)


def test_linear_oscillator():
    """The directions rotate, slowly for ξ = 0.9; the weights average this out. For ξ > 1 the
    exponents differ."""
    for xi, cycles in ((0.02, 1000), (0.9, 1000), (1.5, 400)):
        scene = ideal(xi=xi, gap=None)
        found = vi.lyapunov(scene, scene.start(Y=1.0), cycles)
        rates = -xi + np.array([1, -1]) * np.sqrt(max(xi**2 - 1, 0.0))
        np.testing.assert_allclose(found.exponents, rates, atol=1e-9)


def test_the_largest_exponent_alone_agrees_with_all():
    """A single direction is normalised only occasionally, several ones after every cycle."""
    cycles = 23
    scene = ideal(zeta=0.7, k=0.8, xi=0.003)
    alone = vi.lyapunov(scene, scene.start(), cycles, number=1)
    whole = vi.lyapunov(scene, scene.start(), cycles)
    np.testing.assert_allclose(alone.exponents, whole.exponents[:1], rtol=1e-9)
    np.testing.assert_allclose(alone.per_cycle, whole.per_cycle[:1], rtol=1e-9)
    np.testing.assert_allclose(alone.spread, whole.spread, rtol=1e-9)
    np.testing.assert_allclose(alone.state.Y, whole.state.Y, rtol=1e-9)


def test_exponents_do_not_underflow_in_a_long_cycle():
    """A direction shrinks to e^-283 in one cycle, and its square underflows."""
    scene = ideal(zeta=0.02, xi=0.9, gap=None)
    found = vi.lyapunov(scene, scene.start(Y=1.0), 16, settle=1, number=1)
    np.testing.assert_allclose(found.exponents, -0.9, atol=2e-3)


def test_exponents_in_single_precision():
    with jax.enable_x64(False):
        scene = ideal(xi=0.9, gap=None)
        for number in (1, 2):
            found = vi.lyapunov(scene, scene.start(Y=1.0), 400, number=number)
            assert found.exponents.dtype == jnp.float32
            np.testing.assert_allclose(found.exponents, -0.9, atol=1e-3)


@pytest.mark.slow
def test_the_sum_of_exponents_is_the_mean_contraction():
    """Volumes shrink by e^{-2ξ} per unit time and by k² per impact in any motion.

    Impacts are counted in another run with the same weights. The cycles are so few that rounding
    does not separate the two runs.
    """
    zeta, k, xi, cycles = 0.7, 0.8, 0.003, 16
    scene = ideal(zeta=zeta, k=k, xi=xi)
    starts = vi.simulate(
        scene, scene.start(Y=0.3), 200, settle=500, method=vi.ExactFlight()
    ).sections
    found = jax.vmap(lambda x: vi.lyapunov(scene, x, cycles, settle=0))(starts)
    # The exponents leave out the first cycle.
    options = {"settle": 1, "method": vi.ExactFlight()}
    runs = jax.vmap(lambda x: vi.simulate(scene, x, cycles, **options))(starts)
    place = (np.arange(cycles) + 0.5) / cycles
    weight = np.exp(-1 / (place * (1 - place)))
    impacts = np.asarray(runs.impacts) @ (weight / weight.sum())
    contraction = -2 * xi + 2 * np.log(k) * impacts * zeta / (2 * np.pi)
    np.testing.assert_allclose(found.exponents.sum(axis=1), contraction, atol=1e-9)
    assert impacts.max() > 0.5


def test_failed_runs_and_bad_arguments():
    scene = ideal()
    lost = jax.vmap(lambda Y: vi.lyapunov(scene, vi.OscillatorState(Y, 0.0 * Y), 8))(
        jnp.array([0.0, 5.0])
    )
    assert np.isfinite(lost.exponents[0]).all()
    assert list(np.asarray(lost.successful)) == [True, False]
    assert np.isnan(lost.exponents[1]).all()
    with pytest.raises(ValueError, match="`number` must be at most 2"):
        vi.lyapunov(scene, scene.start(), number=3)
    with pytest.raises(ValueError, match="`cycles` must be at least 8"):
        vi.lyapunov(scene, scene.start(), 2)
    with pytest.raises(ValueError, match="both a section and a `renewed`"):
        vi.lyapunov(Wheel(), Wheel().start(), cycles=16)


@pytest.mark.slow
def test_exponents_of_a_motion_with_rests_are_minus_infinity():
    # The outermost weights of the default 400 cycles are 0.
    scene = ideal(zeta=0.17, k=0.6, xi=0.02, gap=0.5)
    start = scene.start(Y=-0.5, V=0.1)
    found = vi.lyapunov(scene, start)
    assert bool(found.successful) and (np.asarray(found.exponents) == -np.inf).all()
    assert (np.asarray(found.per_cycle) == -np.inf).all() and float(found.spread) == 0
    # An exponent of -∞ means that two starts end in the same state.
    ends = [vi.simulate(scene, scene.start(Y=Y), 1, settle=40).last for Y in (-0.5, -0.4)]
    np.testing.assert_allclose(*(jnp.stack(jax.tree.leaves(end)) for end in ends), rtol=1e-12)


@pytest.mark.slow
def test_one_rest_makes_an_exponent_minus_infinity():
    # A direction lost in any cycle stays lost, even if the weight of this cycle is 0.
    rates, duration = np.full((400, 2), -0.1), np.ones(400)
    rates[-1, 1] = -np.inf
    mean, halves = _weighted(jnp.asarray(rates), jnp.asarray(duration))
    np.testing.assert_allclose([*mean, *halves], [-0.1, -np.inf, -0.1, -0.1])


@pytest.mark.slow
def test_a_body_at_rest_does_not_change_the_exponent_of_another():
    def greatest(damping):
        row = vi.machines.Structure(
            mass=[1, 1], damping=jnp.diag(jnp.stack([2.0, damping])), frequency=1.0,
            stiffness=np.diag([1.0, 0.01]), contacts=(vi.RigidStop(-0.5, 0.5, at=[1, 0]),),
        )  # fmt: skip
        start = row.start(displacement=[-0.5, 1.0])
        return vi.lyapunov(row, start, 100).exponents[0]

    root = np.sqrt(0.3**2 - 0.04)
    wanted = (root - 0.3) / 2, (0.3 / root - 1) / 2
    np.testing.assert_allclose(jax.value_and_grad(greatest)(0.3), wanted, rtol=1e-6)
