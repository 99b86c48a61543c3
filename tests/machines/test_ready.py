"""Ready machines in closed form: a cantilever, a capsule and a bouncing ball."""

import dataclasses

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


@pytest.mark.slow
def test_fold_and_period_doubling_of_a_bounce_match_closed_forms():
    e = 0.5
    w = np.pi * (1 - e) / (1 + e)
    table = 1.3 * w
    # Impacts repeat at one phase: a flight of 2π needs the table's speed Γ sin s to be w.
    at = np.pi - np.arcsin(w / table)
    left, since = e * (np.pi + w), 2 * np.pi - at
    ball = vi.machines.BouncingBall(acceleration=table, restitution=e)
    start = ball.start(
        height=left * since - since**2 / 2 + table * (1 - np.cos(at) + np.sin(at) * since),
        speed=left - since + table * np.sin(at),
    )
    orbit = vi.find_orbit(ball, start, throw=True)
    assert float(orbit.impact_speed[0]) == pytest.approx(np.pi + w, abs=1e-10)
    assert float(orbit.impact_phase[0]) == pytest.approx(at, abs=1e-10)
    branch = vi.continue_orbit(orbit, parameter="acceleration", bounds=(0.05, 2.0))
    (fold,) = (p for p in branch.special if p.kind == "fold")
    (doubling,) = (p for p in branch.special if p.kind == "period-doubling")
    assert fold.parameter == pytest.approx(w, abs=1e-9)
    doubles = np.hypot(w, 2 * (1 + e**2) / (1 + e) ** 2)
    assert doubling.parameter == pytest.approx(doubles, abs=1e-9)
    assert doubles == pytest.approx(1.5268237005, abs=1e-10)


M = vi.machines
NAN, ROTOR = float("nan"), vi.machines.UnbalancedRotor
WRONG = [
    (M.BouncingBall, "acceleration", -1.0), (M.BouncingBall, "restitution", 1.5),
    (M.ImpactPair, "half_gap", 0.0), (M.ImpactPair, "mass_ratio", NAN),
    (M.Duffing, "gap", -1.0), (M.Duffing, "frequency", 0.0),
    (M.Capsule, "mass_ratio", 0.0), (M.Capsule, "friction", -1.0),
    (M.Capsule, "static_ratio", 0.9), (M.Capsule, "frequency", 0.0),
    (M.Capsule, "restitution", 1.1), (M.Capsule, "damping_ratio", "x"),
    (ROTOR, "coupling", 1.0), (ROTOR, "strength", -1.0), (ROTOR, "no_load_speed", 0.0),
    (ROTOR, "gap", 0.0), (ROTOR, "restitution", 1.5), (ROTOR, "damping_ratio", -0.1),
    (ROTOR, "control", NAN), (ROTOR, "coupling", 0.0),
    (M.ReliefValve, "flow_rate", 0.0), (M.ReliefValve, "compressibility", -1.0),
    (M.Woodpecker, "friction", -0.1), (M.Woodpecker, "bird_mass", 0.0),
    (M.Woodpecker, "sleeve_radius", 0.0025),
    (M.Beam, "modes", 0), (M.Beam, "place", 0.0), (M.Beam, "place", 1.1),
    (M.Beam, "damping_ratio", [0.1, 0.1]), (M.Beam, "shaken", "middle"), (M.Beam, "length", 0.0),
]  # fmt: skip


@pytest.mark.parametrize(("make", "name", "value"), WRONG)
def test_wrong_parameters_raise_with_their_names(make, name, value):
    with pytest.raises((ValueError, TypeError), match=f"`{name}`"):
        make(**{name: value})
