"""Implicit solvers handle stiff systems: strong motors and strong dashpots."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from differences import check_derivatives
from truth import integrated

IMPLICIT = vi.Adaptive(diffrax.Kvaerno5(), rtol=1e-9)


def strong(torque, *, control=0.9, gap=0.08):
    return vi.Parameters(torque=torque, control=control, gap=gap).scene()


@pytest.mark.slow
def test_strong_motor_matches_scipy():
    scene = strong(1e4)
    drive, (stop,), start = scene.drive, scene.stops, scene.start()
    truth = integrated(
        {
            "tau0": float(drive.strength), "kappa": float(drive.control),
            "eps": float(drive.coupling), "mu": float(drive.slider_inertia),
            "w0": float(drive.no_load_speed),
        },
        float(scene.damping_ratio), ((1, float(stop.gap), float(stop.restitution)),),
        (float(start.Y), float(start.V), float(start.W)), 4,
        method="Radau", rtol=1e-10, atol=1e-11,
    )  # fmt: skip
    for clock in ("phase", "time"):
        run = vi.simulate(scene, scene.start(), 4, method=IMPLICIT, clock=clock)
        found = np.stack([getattr(run.sections, name) for name in "YVW"], axis=-1)
        np.testing.assert_allclose(found, truth.sections, atol=1e-7)
        np.testing.assert_array_equal(run.impacts, truth.impacts)
        assert bool(run.successful) and int(run.impacts.sum()) >= 3


def test_steps_do_not_grow_with_the_strength_of_the_motor():
    @vi.jit
    @jax.vmap
    def steps(torque):
        scene = strong(torque)
        return vi.simulate(scene, scene.start(), 20, method=IMPLICIT).steps

    counts = steps(jnp.array([1e1, 1e2, 1e4, 1e6, 1e8]))
    assert int(counts.max()) < 1.2 * int(counts.min())


@pytest.mark.slow
def test_derivatives():
    method = vi.Adaptive(diffrax.Kvaerno5(), rtol=1e-11)

    def last(x):
        scene = strong(1e4, control=x[0], gap=0.04 * x[1])
        run = vi.simulate(scene, scene.start(Y=x[2]), 4, method=method)
        return run.last, run.impacts

    check_derivatives(
        last, [0.9, 1.25, 0.3], tolerance=2e-6, impacts=3,
    )  # fmt: skip


def test_strong_dashpot_matches_explicit_steps():
    """The stop has ten times its critical damping."""
    base = vi.Scene.ideal(frequency_ratio=0.9, gap=None, damping_ratio=0.02)
    stop = vi.SoftStop(1.0, 1e3, damping=20 * 1e3**0.5)
    scene = dataclasses.replace(base, soft_stops=(stop,))
    explicit, implicit = (
        vi.simulate(scene, scene.start(), 5, method=method)
        for method in (vi.Adaptive(rtol=1e-9), IMPLICIT)
    )
    assert bool(explicit.successful) and bool(implicit.successful)
    np.testing.assert_allclose(implicit.sections.Y, explicit.sections.Y, atol=1e-6)
    assert 10 * int(implicit.steps) < int(explicit.steps)


@pytest.mark.slow
def test_suggest_method_tries_implicit_solvers_for_stiff_scenes():
    found = vi.suggest_method(strong(1e3), error=1e-5, cycles=4, lanes=16)
    assert found.reached and found.error <= 1e-5
    assert any("Kvaerno5" in t.name for t in found.tried)
    assert not any("FixedStep" in t.name for t in found.tried)
