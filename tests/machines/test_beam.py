"""Modes of a cantilever: frequencies, shapes and responses in closed form."""

import jax
import numpy as np
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
    """With ω = β² √(EI/ρA L⁴), tip and clamp move as (cos β + cosh β)/(1 + cos β cosh β) to 1. A
    constant force F bends the tip by F L³/3EI. Compare both with sums over many modes."""
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
