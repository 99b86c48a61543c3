"""Scenes: energy, stall, start from rest, strong motors; the ideal drive in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.linalg import expm
from vi_jax.flow.methods.exact import flight


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


def test_error_of_a_stall_suggests_the_time_clock():
    scene = vi.Parameters(torque=0.5, control=-0.5).scene()  # the motor brakes
    start = scene.start(V=0.5, W=0.5)
    run = vi.simulate(scene, start, 20)
    assert bool(run.result == vi.RESULTS.stalled)
    assert 'clock="time"' in vi.RESULTS[run.result]
    assert bool(jnp.isnan(run.sections.Y[-1])) and bool(jnp.isfinite(run.sections.Y[0]))
    # With the time clock the crank turns back and no cycle ends, so `max_steps` ends the run.
    carried = vi.simulate(scene, start, 20, clock="time", max_steps=2000)
    assert bool(carried.result == vi.RESULTS.max_steps)


def test_start_from_rest():
    scene = vi.Parameters(torque=10.0, control=0.9).scene()
    with pytest.raises(ValueError, match=r'W > 0 in the phase clock.*W = 0.*clock="time"'):
        vi.simulate(scene, scene.start(W=0.0), 5)
    run = vi.simulate(scene, scene.start(W=0.0), 60, method=vi.Adaptive(), clock="time")
    assert bool(run.successful)
    assert float(run.duration[0]) > float(run.duration[-1])
    assert float(run.frequency_ratio[-1]) == pytest.approx(0.9, abs=0.02)


@pytest.mark.slow
def test_fixed_steps_stay_stable_for_a_strong_motor():
    # The shaft returns to its speed within a small part of a cycle, above all at low speed.
    def last(torque, kappa, method):
        scene = vi.Parameters(torque=torque, control=kappa, gap=0.08).scene()
        run = vi.simulate(scene, scene.start(), 20, method=method)
        return run.sections.Y[-1], run.successful

    torques, kappas = jnp.repeat(jnp.array([1e2, 1e3]), 3), jnp.tile(jnp.array([0.3, 0.6, 1.2]), 2)
    (found, good), (exact, _) = (
        jax.vmap(lambda torque, kappa, m=m: last(torque, kappa, m))(torques, kappas)
        for m in (vi.FixedStep(), vi.Adaptive(rtol=1e-11))
    )
    assert bool(good.all())
    np.testing.assert_allclose(found, exact, atol=1e-6)


def generator(zeta, xi):
    """Return the matrix A with dx/dτ = A x between impacts, for x = (Y, V, cos φ, sin φ)."""
    matrix = np.zeros((*np.shape(zeta), 4, 4))
    matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1] = 1.0, -1.0, -2 * xi
    matrix[..., 1, 2], matrix[..., 2, 3], matrix[..., 3, 2] = 1.0, -zeta, zeta
    return matrix


def test_flight_is_the_matrix_exponential():
    """Weak, critical and strong damping, resonance, and both sides of the switch near resonance."""
    zetas = [1e-3, 0.4, 1.0, 1 + 1e-9, 1 - 1e-6, 1.001, 0.991, 1.011, 30.0]
    zeta, xi = map(np.ravel, np.meshgrid(zetas, [0.0, 1e-4, 0.3, 1.0, 1.5, 10.0]))
    draw = np.random.default_rng(0)
    phase, (Y, V) = draw.uniform(0, 6.28), draw.normal(size=2)
    tau = 0.4 * np.pi / np.maximum(1.0, np.maximum(zeta, xi))
    found = jax.jit(jax.vmap(lambda z, x, t: flight(z, x, phase, Y, V, t)))(
        *map(jnp.asarray, (zeta, xi, tau))
    )
    truth = expm(generator(zeta, xi) * tau[:, None, None]) @ [Y, V, np.cos(phase), np.sin(phase)]
    np.testing.assert_allclose(np.stack(found, -1), truth[:, :2], atol=2e-13)
