"""A capsule with impacts inside and dry friction outside, in closed form."""

import dataclasses

import jax
import numpy as np
import vi_jax as vi

CAPSULE = vi.machines.Capsule


def test_a_mass_pressed_on_the_stop_pushes_the_capsule():
    """A pressed mass transmits the drive. Both stand still until the drive exceeds friction, then
    move as one body in closed form."""
    a, level, gamma, w = 1.5, 1.2, 2.0, 0.01
    capsule = CAPSULE(
        amplitude=a, friction=level, gap=0.1, frequency=w, mass_ratio=gamma, damping_ratio=0.0
    )
    fine = vi.Adaptive(rtol=1e-10)
    start = capsule.at(place=0.1)  # it sets off at once, at ωt = 0
    run = vi.simulate(capsule, start, 1, samples=100, method=fine)
    at = np.arange(12) * 2 * np.pi / 100  # it slows down, but does not stop before
    speed = (a * np.sin(at) - level * at) / (w * (1 + gamma))
    way = (a * (1 - np.cos(at)) - level * at**2 / 2) / (w**2 * (1 + gamma))
    states = jax.tree.map(lambda x: np.asarray(x)[:12], run.samples.state)
    np.testing.assert_allclose(states.v.travel, speed, atol=1e-8)
    np.testing.assert_allclose(states.travel, way, rtol=1e-8)
    np.testing.assert_array_equal(states.place, 0.1)
    np.testing.assert_array_equal(states.v.place, 0.0)
    # With friction above the drive, the capsule stands until the mass is pulled off.
    stuck = dataclasses.replace(capsule, friction=2.0)
    run = vi.simulate(stuck, start, 1, samples=100, method=fine)
    still = np.asarray(run.samples.state.place)[:23] == 0.1  # cos ωt > 0.1/1.5
    assert still.all()
    np.testing.assert_allclose(run.samples.state.v.travel[:23], 0, atol=1e-14)
    assert bool(run.successful)
