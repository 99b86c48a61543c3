"""A cantilever by its modes: frequencies, shapes and responses in closed form; a stop; a bar."""

import jax
import numpy as np
import pytest
import vi_jax as vi

BETA = (1.8751040687119611, 4.694091132974175, 7.854757438237613, 10.995540734875467)


def test_frequencies_and_shapes():
    beam = vi.machines.Beam(modes=4, length=2.0, bending_stiffness=3.0, mass_per_length=0.5)
    wanted = np.square(BETA) * np.sqrt(3.0 / (0.5 * 2.0**4))
    np.testing.assert_allclose(beam.natural_frequencies, wanted, rtol=1e-13)
    # Orthonormal, clamped, and ±2 at the tip.
    nodes, weights = np.polynomial.legendre.leggauss(60)
    shapes = beam.shape(0.5 * (nodes + 1))
    products = np.einsum("i,ij,ik->jk", 0.5 * weights, shapes, shapes)
    np.testing.assert_allclose(products, np.eye(4), rtol=0, atol=1e-12)
    np.testing.assert_allclose(beam.shape(0.0), np.zeros(4), rtol=0, atol=1e-13)
    np.testing.assert_allclose(jax.jacfwd(beam.shape)(0.0), np.zeros(4), rtol=0, atol=1e-12)
    np.testing.assert_allclose(beam.shape(1.0), [2, -2, 2, -2], rtol=1e-13)
    many = vi.machines.Beam(modes=300)  # where cosh overflows
    assert np.isfinite(many.shape(np.linspace(0, 1, 9))).all()


def test_responses_of_the_whole_beam():
    """The tip of a shaken cantilever moves by (cos β + cosh β)/(1 + cos β cosh β) of its clamp, at
    ω = β² √(EI/ρA L⁴), and a constant force bends it by F L³/3EI: sums over many modes."""
    beta, many = 2.6, {"modes": 200, "length": 1.5, "bending_stiffness": 2.0, "amplitude": 0.3}
    omega = beta**2 * np.sqrt(2.0 / 1.5**4)
    beam = vi.machines.Beam(frequency=omega, **many)
    tip, force = np.asarray(beam.shape(1.0)), np.asarray(beam.forces[1])
    there = np.sum(tip * force / (beam.stiffness - omega**2 * np.asarray(beam.mass)))
    moved = (np.cos(beta) + np.cosh(beta)) / (1 + np.cos(beta) * np.cosh(beta))
    np.testing.assert_allclose(there, 0.3 * (moved - 1), rtol=1e-8)
    pushed = vi.machines.Beam(shaken="tip", place=0.6, **many)
    bent = np.sum(tip * np.asarray(pushed.forces[1]) / np.asarray(pushed.stiffness))
    np.testing.assert_allclose(bent, 0.3 * 1.5**3 / (3 * 2.0), rtol=1e-6)


@pytest.mark.slow
def test_a_bar_against_a_wall_approaches_wave_theory():
    """Of length, wave speed and speed 1: it touches the wall for a time 2, and leaves at 1. N equal
    elements err by N^(-2/3), as the front of a wave in a chain spreads."""
    errors = []
    for count in (8, 16, 32):
        mass = np.full(count + 1, 1 / count)
        mass[[0, -1]] /= 2
        line = 2 * np.eye(count + 1) - np.eye(count + 1, k=1) - np.eye(count + 1, k=-1)
        line[0, 0] = line[-1, -1] = 1
        wall = vi.RigidStop(0.0, 0.0, at=np.eye(count + 1)[-1])
        bar = vi.machines.Structure(
            mass=mass, stiffness=count * line, contacts=(wall,), frequency=2 * np.pi / 3
        )
        start = bar.start(displacement=-0.1, velocity=1.0)
        run = vi.simulate(bar, start, 1, event_log=8, record="sections")
        assert bool(run.successful)
        log = run.event_log
        kinds = [vi.EVENTS[int(kind)] for kind in log.kind[0] if kind >= 0]
        # It may hop once, for 1e-7, by the rounding of its speed after the impact.
        touch, leave = (float(log.phase[0, kinds.index(kind)]) for kind in ("impact", "release"))
        v, x = np.asarray(run.last.velocity), np.asarray(run.last.displacement)
        np.testing.assert_allclose(touch, 0.1, rtol=0, atol=1e-12)
        # The element at the wall loses its motion, and nothing else is lost.
        energy = 0.5 * (mass @ v**2 + x @ (count * line) @ x)
        np.testing.assert_allclose(energy, 0.5 - 0.25 / count, rtol=1e-10)
        errors.append((leave - touch - 2, 1 + mass @ v))
    rates = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (rates > 0.5).all() and (rates < 1.0).all()
