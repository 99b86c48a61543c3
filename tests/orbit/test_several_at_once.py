"""Bifurcations that coincide, or nearly so; branches that begin at a special point.

The numbers of the two Duffing oscillators are from an independent shooting code. SciPy checks them
by variational equations.
"""

import functools
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from kicked import Kicked, at

pytestmark = pytest.mark.slow


class Twins(vi.AbstractMachine):
    """Two oscillators Y'' + 0.15 Y' - Y + Y³ = f cos ωs, coupled by κ (Y2 - Y1)."""

    force: float = 0.15
    coupling: float = 0.0
    excess: float = 0.0
    omega: float = 1.2

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega

    def field(self, s, state):
        y1, v1, y2, v2 = (state[name] for name in ("y1", "v1", "y2", "v2"))
        push, pull = self.force * jnp.cos(self.omega * s), self.coupling * (y2 - y1)
        return {
            "y1": v1, "v1": -0.15 * v1 + y1 - y1**3 + push + pull,
            "y2": v2, "v2": -0.15 * v2 + y2 - y2**3 + (1 + self.excess) * push - pull,
        }  # fmt: skip


@functools.cache
def branch_of(coupling, excess=0.0):
    """Return the branch on which both oscillators move alike in one well."""
    machine = Twins(coupling=coupling, excess=excess)
    start = {"y1": 0.9, "v1": 0.2, "y2": 0.9, "v2": 0.2}
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 200).last, 1, throw=True)
    return vi.continue_orbit(orbit, parameter="force", bounds=(0.05, 0.25), progress=False)


def places(branch, kind):
    """Return the sorted parameters of the special points of a kind."""
    return sorted(point.parameter for point in branch.special if point.kind == kind)


def monodromy(point):
    """Return the monodromy matrix at a special point, by SciPy."""
    machine = point.orbit.machine
    numbers = machine.force, machine.coupling, machine.excess, machine.omega
    f, k, e, omega = map(float, numbers)

    def rate(s, y):
        (y1, v1, y2, v2), M = y[:4], y[4:].reshape(4, 4)
        push, pull = f * np.cos(omega * s), k * (y2 - y1)
        J = np.array([
            [0, 1, 0, 0], [1 - 3 * y1**2 - k, -0.15, k, 0],
            [0, 0, 0, 1], [k, 0, 1 - 3 * y2**2 - k, -0.15],
        ])  # fmt: skip
        first = v1, -0.15 * v1 + y1 - y1**3 + push + pull
        second = v2, -0.15 * v2 + y2 - y2**3 + (1 + e) * push - pull
        return np.concatenate([first, second, (J @ M).ravel()])

    state = point.orbit.state
    begin = [float(state[name]) for name in ("y1", "v1", "y2", "v2")]
    end = solve_ivp(
        rate, (0, 2 * np.pi / omega), [*begin, *np.eye(4).ravel()], method="DOP853", rtol=1e-12,
        atol=1e-13,
    ).y[:, -1]  # fmt: skip
    np.testing.assert_allclose(end[:4], begin, atol=1e-9)
    return end[4:].reshape(4, 4)


def test_each_bifurcation_of_two_oscillators_is_found():
    """Two multipliers of uncoupled, weakly coupled or slightly different oscillators pass 1 or -1
    within one step, so that no determinant changes its sign."""
    one, weak, unlike = (branch_of(*at) for at in ((0.0,), (0.003,), (0.0, 0.001)))
    doublings = [places(branch, "period-doubling") for branch in (one, weak, unlike)]
    np.testing.assert_allclose(doublings[0], [0.19582944], atol=1e-8)
    np.testing.assert_allclose(doublings[1], [0.19582944, 0.19916897], atol=1e-8)
    np.testing.assert_allclose(doublings[2], [0.19563381, 0.19582944], atol=1e-8)
    assert all("twice" in point.detail for point in one.special)
    fold = next(point for point in one.special if point.kind == "fold")
    with pytest.raises(ValueError, match="a fold of two motions at once"):
        vi.boundary(fold, parameter="omega", bounds=((0.02, 0.25), (1.0, 1.4)))
    assert len(places(one, "fold")) == len(places(weak, "fold")) == 2
    np.testing.assert_allclose(places(weak, "branch-point")[0], 0.08000716, atol=1e-8)
    for branch in (one, weak, unlike):
        for point in branch.special:
            off = 1.0 if point.kind == "period-doubling" else -1.0
            values = np.linalg.eigvals(monodromy(point))
            assert np.abs(values + off).min() < 1e-6, (point, values)


def test_a_branch_that_leaves_another_to_both_sides():
    """The branch of unequal motions turns back in its parameter where it meets that of equal ones.
    This is a branch point, not a fold, and a switch leads to the other branch."""
    branch = branch_of(0.1)
    wanted = [0.1034185332, 0.1281540734]
    np.testing.assert_allclose(places(branch, "branch-point"), wanted, atol=1e-10)
    point = next(point for point in branch.special if point.kind == "branch-point")
    off = vi.continue_orbit(point.switch(), parameter="force", bounds=(0.05, 0.25), progress=False)
    assert off.ends == ("closed", "closed")
    np.testing.assert_allclose(places(off, "branch-point"), wanted, atol=1e-10)
    assert len(places(off, "fold")) == 6
    again = next(point for point in off.special if point.kind == "branch-point").switch().state
    assert abs(float(again["y1"] - again["y2"])) < 1e-9


@pytest.mark.exhaustive
def test_curves_of_branch_points():
    """Both curves end at folds of the uncoupled oscillators. One touches the curve of folds, which
    is no resonance, since the double multiplier 1 has two eigenvectors."""
    points = [point for point in branch_of(0.1).special if point.kind == "branch-point"]
    bounds = ((0.02, 0.25), (0.0, 0.3))
    for point, fold in zip(points, (0.1082731067, 0.0799657809), strict=True):
        curve = vi.boundary(point, parameter="coupling", bounds=bounds, progress=False)
        assert (curve.kind, curve.ends, curve.special) == ("branch-point", ("bounds",) * 2, [])
        np.testing.assert_allclose(curve.parameters[0], [fold, 0.0], atol=1e-7)
        for i in range(0, len(curve.steps), 15):
            values = np.linalg.eigvals(monodromy(SimpleNamespace(orbit=curve.orbit(i))))
            assert np.abs(values - 1).min() < 1e-6
    with pytest.raises(ValueError, match="but they separate when excess changes"):
        vi.boundary(point, parameter="excess", bounds=((0.02, 0.25), (-0.1, 0.1)))


def test_a_branch_that_begins_at_a_grazing_goes_to_one_side():
    """The gap at the grazing is the amplitude of the linear motion."""
    zeta, xi = 0.31, 0.25
    grazes = 1 / np.hypot(1 - zeta**2, 2 * xi * zeta)
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=0.76, gap=1.2, damping_ratio=xi)
    orbit = vi.find_orbit(scene, vi.simulate(scene, scene.start(), 100).last, throw=True)
    options = {"parameter": "stops.0.gap", "bounds": (1.0, 1.4), "progress": False}
    (point,) = vi.continue_orbit(orbit, **options).special
    assert point.kind == "grazing" and point.parameter == pytest.approx(grazes, abs=1e-10)
    again = vi.continue_orbit(point.orbit, **options)
    assert again.ends == ("grazing", "bounds") and again.admissible.all()
    assert again.parameter.min() == pytest.approx(grazes, abs=1e-10)


def test_watch_locates_the_zero_of_a_function():
    """Locate the point at which the greatest position is 1.3."""
    scene = vi.Scene.ideal(frequency_ratio=0.31, restitution=0.76, gap=9.0, damping_ratio=0.25)
    orbit = vi.find_orbit(scene, scene.start(), throw=True)
    options = {"parameter": "drive.frequency_ratio", "bounds": (0.1, 0.9), "progress": False}
    watched = {
        "amplitude": lambda orbit: orbit.y_max - 1.3,
        "begin": lambda orbit: orbit.machine.drive.frequency_ratio - 0.31,
    }
    branch = vi.continue_orbit(orbit, watch=watched, **options)
    begin, point = branch.special
    assert (begin.quantity, begin.parameter) == ("begin", 0.31)
    assert len(branch.at(0.31)) == 1 and branch.parameter[begin.index] == 0.31
    amplitude = 1 / np.hypot(1 - point.parameter**2, 0.5 * point.parameter)
    assert (point.kind, point.quantity) == ("watched", "amplitude")
    assert amplitude == pytest.approx(1.3, abs=1e-12)
    for wrong in ({"amplitude": 1.3}, {"amplitude": lambda orbit: orbit.state}, ["amplitude"]):
        with pytest.raises(TypeError, match="`watch` must"):
            vi.continue_orbit(orbit, watch=wrong, **options)


class Turning(Kicked):
    """x ← x + 0.3 x (a - (x - b)²): the fold at a = 0 is at x = b, the crossing at x = 0."""

    def kick(self, x, y):
        return x + 0.3 * x * (self.a - (x - self.b) ** 2), 0.3 * y


def test_a_fold_and_a_branch_point_in_one_step():
    """Regression: a single branch point was reported, at the fold. A branch that begins at the fold
    also has the branch point."""
    orbit = vi.find_orbit(Turning(0.495**2, 0.005), at(0.5, 0.0), throw=True)
    options = {"parameter": "a", "bounds": (-1.0, 0.6), "max_step": 0.3}
    branch = vi.continue_orbit(orbit, **options)
    assert [point.kind for point in branch.special] == ["branch-point", "fold"]
    places = [point.parameter for point in branch.special]
    np.testing.assert_allclose(places, [0.005**2, 0.0], atol=1e-12)
    begun = vi.continue_orbit(branch.special[1].orbit, **options)
    # Rounding decides whether the fold at its own start is listed: it is with AVX2.
    later = [point for point in begun.special if abs(point.parameter) > 1e-12]
    assert [point.kind for point in later] == ["branch-point"]


def test_a_curve_of_touches_ends_where_the_other_stop_is_touched():
    """The amplitude of the linear oscillator equals the other gap at the end."""
    stops = vi.RigidStop(9.0, 0.5), vi.RigidStop(10.0, 0.5, "left")
    scene = vi.Scene(damping_ratio=0.005, drive=vi.IdealDrive(0.9), stops=stops)
    orbit = vi.find_orbit(scene, scene.start(Y=5.2, V=0.2), throw=True)
    branch = vi.continue_orbit(orbit, parameter="stops.0.gap", bounds=(3.0, 9.5))
    (touch,) = branch.special
    bounds = (3.0, 30.0), (0.7, 1.2)
    curve = vi.boundary(touch, parameter="drive.frequency_ratio", bounds=bounds)
    gap, zeta = curve.parameters.T
    amplitude = 1 / abs(1 - zeta**2 + 0.01j * zeta)
    np.testing.assert_allclose(gap, amplitude, rtol=1e-12)
    assert gap.max() == pytest.approx(10.0, abs=1e-6) and gap.min() == pytest.approx(3.0)
