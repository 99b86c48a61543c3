"""Bifurcations that are closer to each other than the steps along a branch."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from kicked import Kicked, at

pytestmark = pytest.mark.slow


class Bubble(Kicked):
    """x ← μ x with μ = (a - 0.3)² - 1 - b: the motion is doubled for |a - 0.3| < √b."""

    def kick(self, x, y):
        return ((self.a - 0.3) ** 2 - 1 - self.b) * x, 0.2 * y


@pytest.mark.parametrize("width", [1e-2, 1e-3, 1e-4])
def test_a_narrow_bubble_of_doublings(width):
    orbit = vi.find_orbit(Bubble(0.0, width**2), at(0.0, 0.0), throw=True)
    branch = vi.continue_orbit(orbit, parameter="a", bounds=(-1.0, 1.0), progress=False)
    assert [point.kind for point in branch.special] == ["period-doubling"] * 2
    places = np.sort([point.parameter for point in branch.special])
    np.testing.assert_allclose(places, [0.3 - width, 0.3 + width], atol=1e-9)


class Hysteresis(Kicked):
    """x ← x + (a - x³ + b x)/2: folds at x = ±√(b/3)."""

    def kick(self, x, y):
        return x + 0.5 * (self.a - x**3 + self.b * x), 0.2 * y


@pytest.mark.parametrize("share", [1e-2, 1e-4])
def test_two_folds_within_a_step(share):
    orbit = vi.find_orbit(Hysteresis(0.9, share), at(0.9, 0.0), throw=True)
    branch = vi.continue_orbit(orbit, parameter="a", bounds=(-1.0, 1.0), progress=False)
    assert [point.kind for point in branch.special] == ["fold"] * 2
    fold = 2 * (share / 3) ** 1.5
    places = np.sort([point.parameter for point in branch.special])
    np.testing.assert_allclose(places, [-fold, fold], atol=1e-12)


class Bubbles(Bubble):
    """Folds at x = a = 0 for all b, with another multiplier that passes -1 twice."""

    def kick(self, x, y):
        return x + self.a - x**2, ((self.b - 0.3) ** 2 - 1 - 1e-6) * y


def test_two_points_of_codimension_two_within_a_step():
    orbit = vi.find_orbit(Bubbles(0.25, 0.0), at(0.5, 0.0), throw=True)
    branch = vi.continue_orbit(orbit, parameter="a", bounds=(-1.0, 1.0), progress=False)
    fold, doubling = branch.special
    assert doubling.kind == "period-doubling" and abs(doubling.parameter - 1) < 1e-15  # a bound
    assert len(branch.at(1.0)) == 2 and set(branch.parameter[[0, -1]]) == {1.0}
    curve = vi.boundary(fold, parameter="b", bounds=((-1.0, 1.0), (-1.0, 1.0)), progress=False)
    assert [point.kind for point in curve.special] == ["fold-flip"] * 2
    places = np.array([point.parameters for point in curve.special])
    np.testing.assert_allclose(places, [[0, 0.299], [0, 0.301]], atol=1e-9)


class Turned(vi.Mechanical):
    """A motor turns an unbalanced rotor between a rigid and a soft stop."""

    q = ("x", "phi")
    control: float = 1.4
    cycle = vi.turn_of("phi", usual=5.0)
    contacts = (
        vi.RigidStop(0.25, 0.7, on="x"),
        vi.SoftStop(0.2, 30.0, dashpot=0.4, side="left", on="x"),
    )

    def mass(self, q):  # pyright: ignore[reportIncompatibleVariableOverride]
        across = -0.2 * jnp.sin(q.phi)
        return [[1.0, across], [across, 1.0]]

    def force(self, t, q, v):
        return dict(x=-q.x - 0.1 * v.x, phi=0.3 * (self.control - v.phi))


def test_a_torus_beside_a_fold_and_a_grazing_does_not_depend_on_the_steps():
    """All three lie within one step. Beside the pole at the grazing the test was rounding."""
    machine = Turned()
    settled = vi.simulate(machine, machine.at(v=dict(phi=1.3)), 1, settle=400).last
    orbit = vi.find_orbit(machine, settled)
    found = []
    for bounds in ((0.8, 2.0), (0.9, 1.5)):
        branch = vi.continue_orbit(orbit, parameter="control", bounds=bounds)
        assert [point.kind for point in branch.special] == ["grazing", "fold", "neimark-sacker"]
        found.append(branch.special[-1])
    assert float(found[0].parameter) == pytest.approx(float(found[1].parameter), abs=1e-13)
    for point in found:
        assert abs(abs(point.orbit.multipliers[0]) - 1) < 1e-9
