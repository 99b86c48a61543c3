"""Tori of maps of a ring, whose curves, exponents and windows have closed forms."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.orbit.torus import _start_equations
from vi_jax.orbit.torus_equations import _solve_bordered

from kicked import SHEAR, TWIST, Alternating, Repelling, Ring, at, rotation_of


@pytest.fixture(scope="module")
def torus():
    return vi.find_torus(Ring(0.21, 0.1), at(0.3, 0.1), settle=500)


def test_a_torus_from_a_run(torus):
    assert torus.successful and not torus.reason, torus
    assert torus.rotation == pytest.approx(rotation_of(0.21, 0.1), abs=1e-13)
    np.testing.assert_allclose(torus.exponents, [0, np.log(0.8)], atol=1e-11)
    assert torus.tail < 1e-11 and torus.residual < 1e-12
    x, y = torus.at(np.linspace(0, 1, 50))
    np.testing.assert_allclose(np.hypot(x, y - SHEAR * x**2), np.sqrt(0.1), atol=1e-12)
    turned = np.unwrap(np.arctan2(y - SHEAR * x**2, x)) / (2 * np.pi)
    np.testing.assert_allclose(np.abs(np.diff(turned)), 1 / 49, atol=1e-12)
    assert torus.clearance == torus.slowest_impact == np.inf
    assert torus.states[0].shape == (torus.nodes,) and "rotation number 0.2147" in repr(torus)


def test_the_picture_of_a_torus_shows_its_curve_and_a_run(torus):
    run = vi.simulate(torus.machine, at(0.3, 0.1), 50, settle=500)
    dots, curve = vi.plot_torus(torus, run=run, ax=Figure().subplots()).lines
    assert len(dots.get_xdata()) == 51
    x, y = curve.get_data()
    np.testing.assert_allclose(np.hypot(x, y - SHEAR * x**2), np.sqrt(0.1), atol=1e-12)


def test_too_few_nodes_are_noticed_by_tail_and_residual():
    machine = Ring(0.3, 0.1, locking=1.0)
    coarse = vi.find_torus(machine, at(0.3, 0.1), settle=500, nodes=9)
    assert not coarse.successful and coarse.tail > 1e-4 and coarse.residual > 1e-4
    assert "not resolved by 9 nodes" in coarse.reason


def test_a_family_ends_at_the_neimark_sacker_point(torus):
    family = vi.continue_torus(torus, parameter="b", bounds=(-0.1, 0.2), step=0.15)
    assert family.ends == ("neimark-sacker", "bounds"), family
    b = family.parameter
    assert 0 < b[0] < 0.05 and b[-1] == 0.2
    np.testing.assert_allclose(family.rotation, rotation_of(0.21, b), atol=1e-12)
    np.testing.assert_allclose(family.exponents[:, 1], np.log(1 - 2 * b), atol=1e-9)
    (line, mark) = vi.plot_torus(family, y="exponents", ax=Figure().subplots()).lines[1:3]
    np.testing.assert_array_equal(line.get_ydata(), family.exponents[:, 1])
    assert mark.get_label() == "neimark-sacker"
    there = family.at(0.15)
    machine: Any = there.machine
    assert float(machine.b) == pytest.approx(0.15, abs=1e-14)
    assert there.rotation == pytest.approx(rotation_of(0.21, 0.15), abs=1e-12)
    with pytest.raises(ValueError, match="`value` must lie between"):
        family.at(0.3)


def torus_at(machine, start, cycles=1):
    """Return the torus at the Neimark–Sacker point of a branch in b, which is at b = 0."""
    orbit = vi.find_orbit(machine, start, cycles, throw=True)
    branch = vi.continue_orbit(orbit, parameter="b", bounds=(-0.2, 0.2))
    (point,) = (point for point in branch.special if point.kind == "neimark-sacker")
    assert point.parameter == pytest.approx(0, abs=1e-12)
    return point.switch(distance=0.1)


@pytest.mark.slow
def test_an_unstable_torus():
    torus = torus_at(Repelling(0.21, 0.05), at(0.01, 0.01))
    family = vi.continue_torus(torus, parameter="b", bounds=(0.001, 0.2))
    assert family.ends[1] == "bounds" and all(torus.successful for torus in family.tori)
    b = family.parameter
    assert b[-1] == 0.2
    np.testing.assert_allclose(family.rotation, rotation_of(0.21, b), atol=1e-12)
    np.testing.assert_allclose(family.exponents[:, 0], np.log(1 + 2 * b), atol=1e-9)
    np.testing.assert_array_equal(family.exponents[:, 1], 0)
    # A simulation from the curve leaves it, at that rate.
    last = family.tori[-1]
    run = vi.simulate(last.machine, jax.tree.map(jnp.asarray, last.at(0.1)), 150)
    x, y = (np.asarray(a) for a in run.sections)
    off = np.abs(np.hypot(x, y - SHEAR * x**2) - np.sqrt(0.2))
    assert off[20] < 1e-10 and np.nanmax(off) > 0.1


@pytest.mark.slow
def test_a_torus_of_two_closed_curves():
    machine = Alternating(0.21, 0.1)
    with pytest.raises(ValueError, match="Give the number of `cycles`"):
        vi.find_torus(machine, at(2.3, 0.1), settle=500)
    found = vi.find_torus(machine, at(2.3, 0.1), cycles=2, settle=500)
    branched = torus_at(Alternating(0.21, -0.05), at(2.01, 0.01), cycles=2)
    family = vi.continue_torus(found, parameter="b", bounds=(0.05, 0.15))
    for torus in (found, branched, *family.tori):
        b = float(torus.machine.b)
        assert torus.successful and torus.cycles == 2
        assert torus.rotation == pytest.approx(2 * rotation_of(0.21, b), abs=1e-12)
        # Close to a ratio p:q, here to 3:7, averages converge slowly.
        np.testing.assert_allclose(torus.exponents, [0, np.log(1 - 2 * b)], atol=1e-7)
        x, y = torus.at(np.linspace(0, 1, 50))
        x = x - 2 * np.sign(x[0])
        np.testing.assert_allclose(np.hypot(x, y - SHEAR * x**2), np.sqrt(b), atol=1e-11)


@pytest.mark.slow
def test_a_window_of_locking():
    """On r = √b the angle moves by 2πa + 0.3 b + locking b³ᐟ² sin 3φ: it locks to 1:3 where that is
    2π/3 at some φ."""
    b = 0.1
    torus = vi.find_torus(Ring(0.32, 0.1, locking=0.05), at(0.3, 0.1), settle=500)
    family = vi.continue_torus(torus, parameter="a", bounds=(0.31, 0.35))
    assert family.ends == ("bounds", "resonance") and "locks to 1:3" in family.details[1]
    (window,) = (window for window in family.windows if window.q == 3)
    middle = 1 / 3 - TWIST * b / (2 * np.pi)
    half = 0.05 * b**1.5 / (2 * np.pi)
    assert (window.p, window.q) == (1, 3)
    np.testing.assert_allclose(
        [window.low, window.high], [middle - half, middle + half], atol=1e-12
    )
    few = vi.continue_torus(torus, parameter="a", bounds=(0.31, 0.35), max_nodes=65)
    assert few.ends == ("bounds", "coarse") and few.parameter[-1] < family.parameter[-1] - 1e-4
    orbit = window.orbit
    assert orbit.successful and orbit.stable and int(orbit.cycles) == 3
    locked: Any = orbit.machine
    assert window.low < float(locked.a) < window.high
    assert 0 < window.low - family.parameter[-1] < 0.1 * (window.high - window.low)


def test_motions_that_are_no_torus_are_refused():
    with pytest.raises(ValueError, match="this one repeats after 1 cycle: find"):
        vi.find_torus(Ring(0.21, -0.2), at(0.1, 0.1))
    with pytest.raises(ValueError, match="this one repeats after 5 cycles: find"):
        vi.find_torus(Ring(0.2 - TWIST * 0.1 / (2 * np.pi), 0.1), at(0.3, 0.1))
    with pytest.raises(ValueError, match=r"agree to [0-4]\.?\d* digits only"):
        vi.find_torus(Ring(0.21, 1.4), at(0.3, 0.1))
    with pytest.raises(ValueError, match="`nodes` must be odd"):
        vi.find_torus(Ring(0.21, 0.1), at(0.3, 0.1), nodes=32)


class Rubbed(vi.AbstractMachine):
    cycle = 2 * jnp.pi
    contacts = vi.DryFriction(0.1, on="u", mass=1.0)

    def field(self, t, z):
        return dict(x=z.u, u=jnp.cos(t) - 0.5 * z.x)


def test_curves_with_different_events_are_refused():
    rows, start = np.array([[0.0, 0.0], [0.0, 9.0]]), vi.State(x=0.0, u=0.0)
    with pytest.raises(ValueError, match="same events in the same order"):
        _start_equations(Rubbed(), vi.FixedStep(steps_per_cycle=24), start, 1, rows, 0.1)


def test_the_elimination_of_unknowns_of_single_rows():
    """The dense system of all unknowns has the same solution."""
    rng, count, width, extra = np.random.default_rng(0), 5, 4, 2
    own, after = rng.normal(size=(2, count, width, width))
    after[:, :, [1, 3]] = 0
    shift, shared = rng.normal(size=(count, count)), rng.normal(size=(count, width, extra))
    left, right = (
        rng.normal(size=(extra, count * width + extra)),
        rng.normal(size=(count, width, 2)),
    )
    values = rng.normal(size=(extra, 2))
    blocks = np.einsum("jab,ji->jaib", after, shift) + np.einsum("jab,ji->jaib", own, np.eye(count))
    rows = np.hstack([blocks.reshape(20, 20), shared.reshape(20, extra)])
    dense = np.linalg.solve(np.vstack([rows, left]), np.vstack([right.reshape(20, 2), values]))
    found = _solve_bordered(own, after, shift, shared, left, right, values)
    np.testing.assert_allclose(found, dense, atol=1e-11 * np.abs(dense).max())
