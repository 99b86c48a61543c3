"""Motor scenes: both clocks, energy, the ideal limit, stall and start from rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.machine.trig import sincos


@pytest.mark.slow
@pytest.mark.parametrize("crank", ["cosine", "slider"])
def test_clocks_agree(crank):
    scene = vi.Parameters(torque=10.0, control=0.9, restitution=0.5).scene(crank=crank)
    start = scene.start(Y=0.0, V=0.0, W=0.9)
    method = vi.Adaptive(rtol=1e-12)
    phase, time = (vi.simulate(scene, start, 50, method=method, clock=c) for c in ("phase", "time"))
    for name in ("Y", "V", "W"):
        a, b = getattr(phase.sections, name), getattr(time.sections, name)
        np.testing.assert_allclose(a, b, atol=1e-8)
    np.testing.assert_allclose(phase.duration, time.duration, atol=1e-8)
    np.testing.assert_allclose(phase.y_min, time.y_min, atol=1e-8)
    np.testing.assert_array_equal(phase.impacts, time.impacts)
    assert int(phase.impacts.sum()) > 30
    np.testing.assert_allclose(phase.frequency_ratio, 2 * np.pi / phase.duration, rtol=1e-14)


@pytest.mark.slow
def test_ideal_clocks_agree():
    scene = vi.Scene.ideal(frequency_ratio=0.7, restitution=0.6, gap=1.2, damping_ratio=0.02)
    start = scene.start(Y=0.3, V=0.1)
    for method in (vi.ExactFlight(), vi.Adaptive(rtol=1e-12)):
        a, b = (vi.simulate(scene, start, 15, method=method, clock=c) for c in ("phase", "time"))
        np.testing.assert_allclose(a.sections.Y, b.sections.Y, atol=1e-7)
        np.testing.assert_allclose(a.duration, 2 * np.pi / 0.7, rtol=1e-14)
        np.testing.assert_allclose(b.duration, 2 * np.pi / 0.7, rtol=1e-14)


@pytest.mark.parametrize("crank", ["cosine", "slider"])
def test_energy_is_conserved_through_impacts(crank):
    """E = ½V² + ½(Y - U)² + ½(1 + μU_φ²)W²/ε without torque, damping and loss at the stop."""
    table = vi.Parameters(torque=0.0, damping=0.0, restitution=1.0, gap=0.048)
    scene = table.scene(crank=crank)
    run = vi.simulate(scene, scene.start(Y=0.5, V=1.0, W=1.3), 260, method=vi.Adaptive(rtol=1e-12))
    assert bool(run.successful) and int(run.impacts.sum()) >= 200
    slide = scene.crank.slide(jnp.asarray(0.0))
    drive = scene.drive
    state = run.sections
    inertia = 1 + drive.slider_inertia * slide.U_phi**2
    energy = (
        state.V**2 / 2 + (state.Y - slide.U) ** 2 / 2 + inertia * state.W**2 / drive.coupling / 2
    )
    assert float(jnp.abs(energy / energy[0] - 1).max()) < 1e-9


def test_a_strong_motor_approaches_the_ideal_drive():
    ideal = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0448)
    truth = vi.simulate(ideal, ideal.start(), 30, method=vi.ExactFlight())
    differences = []
    for strength in (1e2, 1e3):
        drive = vi.Motor(strength=strength, control=0.9, coupling=0.00933, slider_inertia=0.00533)
        scene = vi.Scene(oscillator=ideal.oscillator, drive=drive, stops=ideal.stops)
        run = vi.simulate(scene, scene.start(), 30, method=vi.Adaptive(rtol=1e-10))
        differences.append(float(jnp.abs(run.sections.Y - truth.sections.Y).max()))
    assert differences[1] < 2e-4
    assert differences[0] / differences[1] == pytest.approx(10.0, rel=0.15)  # first order in 1/τ0


@pytest.mark.parametrize("method", [vi.Adaptive(), vi.FixedStep()], ids=["adaptive", "fixed"])
def test_a_stall_points_to_the_time_clock(method):
    scene = vi.Parameters(torque=0.5, control=-0.5).scene()  # the motor brakes
    start = scene.start(V=0.5, W=0.5)
    run = vi.simulate(scene, start, 20, method=method)
    assert bool(run.result == vi.RESULTS.stalled)
    assert 'clock="time"' in vi.RESULTS[run.result]
    assert bool(jnp.isnan(run.sections.Y[-1])) and bool(jnp.isfinite(run.sections.Y[0]))
    # Time carries on, the crank turns back, and cycles are never complete: bounded all the same.
    carried = vi.simulate(scene, start, 20, method=method, clock="time", max_steps=2000)
    assert bool(carried.result == vi.RESULTS.max_steps)


def test_start_from_rest():
    scene = vi.Parameters(torque=10.0, control=0.9).scene()
    with pytest.raises(ValueError, match=r'W > 0 in the phase clock.*W = 0.*clock="time"'):
        vi.simulate(scene, scene.start(W=0.0), 5)
    run = vi.simulate(scene, scene.start(W=0.0), 60, method=vi.Adaptive(), clock="time")
    assert bool(run.successful)
    assert float(run.duration[0]) > float(run.duration[-1])
    assert float(run.frequency_ratio[-1]) == pytest.approx(0.9, abs=0.02)


def test_sine_and_cosine_to_rounding():
    phase = jnp.linspace(-7.0, 14.0, 20001)
    sine, cosine = jax.jit(sincos)(phase)
    np.testing.assert_allclose(sine, np.sin(phase), atol=1e-15)
    np.testing.assert_allclose(cosine, np.cos(phase), atol=1e-15)
    slope = jax.vmap(jax.grad(jax.grad(lambda x: sincos(x)[0])))(phase[:50])
    np.testing.assert_allclose(slope, -np.sin(phase[:50]), atol=1e-15)


@pytest.mark.parametrize("torque", [100.0, 1000.0])
def test_fixed_steps_stay_stable_for_a_strong_motor(torque):
    # Its shaft comes back to speed within a small part of a cycle, at low speed most of all.
    def last(kappa, method):
        scene = vi.Parameters(torque=torque, control=kappa, gap=0.08).scene()
        run = vi.simulate(scene, scene.start(), 20, method=method)
        return run.sections.Y[-1], run.successful

    kappas = jnp.array([0.3, 0.6, 1.2])
    found, good = jax.vmap(lambda kappa: last(kappa, vi.FixedStep()))(kappas)
    exact, _ = jax.vmap(lambda kappa: last(kappa, vi.Adaptive(rtol=1e-11)))(kappas)
    assert bool(good.all())
    np.testing.assert_allclose(found, exact, atol=1e-6)
