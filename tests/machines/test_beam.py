"""A cantilever by its modes: frequencies, shapes and responses in closed form; a stop; a bar."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from jax.flatten_util import ravel_pytree

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
    pushed = vi.machines.Beam(shaken="tip", **many)
    bent = np.sum(tip * np.asarray(pushed.forces[1]) / np.asarray(pushed.stiffness))
    np.testing.assert_allclose(bent, 0.3 * 1.5**3 / (3 * 2.0), rtol=1e-6)


def test_a_beam_without_a_stop():
    assert vi.machines.Beam(modes=2, gap=None).stops == ()


@pytest.mark.slow
def test_beside_adaptive_steps():
    """With a stop along it, and turning points and impacts recorded."""
    beam = vi.machines.Beam(modes=3, gap=0.06, place=0.8, restitution=0.6)
    runs = [vi.simulate(beam, beam.start(), 8, method=m) for m in (None, vi.Adaptive(rtol=1e-12))]
    assert int(runs[0].impacts.sum()) > 5
    np.testing.assert_array_equal(runs[0].impacts, runs[1].impacts)
    np.testing.assert_allclose(runs[0].y_min, runs[1].y_min, rtol=0, atol=1e-9)
    np.testing.assert_allclose(runs[0].y_max, 0.06, rtol=0, atol=1e-12)
    for a, b in zip(*(jax.tree.leaves(run.last) for run in runs), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-8)
    assert int(runs[0].steps) < int(runs[1].steps)


@pytest.mark.parametrize(
    ("argument", "value", "error"),
    [("modes", 0, ValueError), ("place", 0.0, ValueError),
     ("place", 1.1, ValueError), ("damping_ratio", [0.1, 0.1], ValueError),
     ("shaken", "middle", ValueError), ("length", 0.0, ValueError)],
)  # fmt: skip
def test_what_is_no_beam(argument, value, error):
    with pytest.raises(error, match=f"`{argument}`"):
        vi.machines.Beam(**{argument: value})


@pytest.mark.exhaustive
def test_a_periodic_motion_of_many_modes():
    """Newton's method on the cycle map, whose Jacobian is that of differences."""
    beam = vi.machines.Beam(
        modes=20, gap=0.3, restitution=0.6, damping_ratio=0.03, frequency=3.4, amplitude=0.02
    )
    with vi.backend("xla"):
        run = vi.simulate(beam, beam.start(), 1, settle=100, max_impacts=10_000)
        x, unravel = ravel_pytree(run.last)
        the_map = vi.cycle_map(beam)
        for _ in range(3):
            missing, slope = (
                ravel_pytree(the_map.residual(unravel(x)))[0],
                the_map.jacobian(unravel(x)),
            )
            x = x - jnp.linalg.solve(slope - jnp.eye(40), missing)
        assert int(run.impacts[0]) > 0 and np.abs(missing).max() < 1e-10
        for i in (0, 1, 20, 25):
            ends = [ravel_pytree(the_map(unravel(x.at[i].add(h))))[0] for h in (1e-7, -1e-7)]
            np.testing.assert_allclose((ends[0] - ends[1]) / 2e-7, slope[:, i], atol=1e-5)


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
