"""Closed branches (isolas) and closed boundaries, compared with closed forms."""

import numpy as np
import pytest
import vi_jax as vi

from kicked import Kicked, at

pytestmark = pytest.mark.slow


class Ring(Kicked):
    """x ← x + (x² + a² + 4b² - 1)/2: fixed points on an ellipsoid, folds on its equator."""

    def kick(self, x, y):
        return x + 0.5 * (x**2 + self.a**2 + 4 * self.b**2 - 1), 0.3 * y


@pytest.fixture(scope="module")
def ring():
    machine = Ring(0.3, 0.1)
    orbit = vi.find_orbit(machine, at(-np.sqrt(0.87), 0.0), throw=True)
    return vi.continue_orbit(orbit, parameter="a", bounds=(-3.0, 3.0))


def test_a_closed_branch_is_traversed_once(ring):
    assert ring.ends == ("closed", "closed")
    x, a = ring.column("section_0"), ring.parameter
    np.testing.assert_allclose(x**2 + a**2, 0.96, rtol=1e-11)
    angle = np.unwrap(np.arctan2(x, a))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi, abs=1e-9)
    assert (np.diff(angle) * np.sign(angle[-1] - angle[0]) > 0).all()
    assert a[0] == a[-1] == 0.3
    folds = [point.parameter for point in ring.special if point.kind == "fold"]
    assert len(folds) == len(ring.special) == 2
    np.testing.assert_allclose(np.sort(folds), [-np.sqrt(0.96), np.sqrt(0.96)], atol=1e-10)
    for value in (0.3, 0.0, -0.5):
        found = [float(orbit.state[0]) for orbit in ring.at(value)]
        root = np.sqrt(0.96 - value**2)
        np.testing.assert_allclose(np.sort(found), [-root, root], atol=1e-11)


def test_a_closed_boundary_is_traversed_once(ring):
    curve = vi.boundary(ring.special[0], parameter="b", bounds=((-3.0, 3.0), (-3.0, 3.0)))
    assert curve.ends == ("closed", "closed")
    a, b = curve.parameters.T
    np.testing.assert_allclose(a**2 + 4 * b**2, 1, rtol=1e-10)
    angle = np.unwrap(np.arctan2(2 * b, a))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi, abs=1e-9)


class Hairpin(Kicked):
    """x ← x + 100 (x - 1)² + a/10⁴: two sheets joined by a fold at a = 0."""

    def kick(self, x, y):
        return x + 100 * (x - 1) ** 2 + 1e-4 * self.a, 0.3 * y


def test_a_branch_that_comes_near_itself_is_not_closed():
    """At the start the other sheet is 1/15 of a step away, as the scale of x is 1/2."""
    orbit = vi.find_orbit(Hairpin(-0.5, 0.0), at(1 - np.sqrt(0.5) / 1000, 0.0), throw=True)
    branch = vi.continue_orbit(orbit, parameter="a", bounds=(-3.0, 3.0))
    assert branch.ends == ("bounds", "bounds") and len(branch.special) == 1
    assert branch.special[0].parameter == pytest.approx(0, abs=1e-10)
    np.testing.assert_allclose(branch.parameter[[0, -1]], -3, atol=1e-12)
    other = branch.parameter[branch.column("section_0") > 1]
    beside = np.sort(np.abs(other + 0.5))[:2].sum() / 3
    assert beside > 15 * np.sqrt(0.5) / 250


class Twisted(Kicked):
    """z ← -z - G/5 in the plane, with G = 0 where x² - y² = a and x² + y² = 1. Motions of two
    cycles alternate between z and -z; a round of their isola leads from z to -z."""

    def kick(self, x, y):
        first, second = x**2 - y**2 - self.a, x**2 + y**2 - 1
        return -x - 0.2 * (x * first + y * second), -y - 0.2 * (y * first - x * second)


def test_a_branch_closes_at_the_same_motion_a_cycle_later():
    x, y = np.sqrt([0.65, 0.35])
    orbit = vi.find_orbit(Twisted(0.3, 0.0), at(x, y), cycles=2, throw=True)
    branch = vi.continue_orbit(orbit, parameter="a", bounds=(-3.0, 3.0))
    assert branch.ends == ("closed", "closed")
    x, y = branch.column("section_0"), branch.column("section_1")
    np.testing.assert_allclose(x**2 - y**2, branch.parameter, atol=1e-10)
    turned = np.unwrap(np.arctan2(y, x))
    assert abs(turned[-1] - turned[0]) == pytest.approx(np.pi, abs=1e-6)
    folds = [point.parameter for point in branch.special if point.kind == "fold"]
    np.testing.assert_allclose(np.sort(folds), [-1, 1], atol=1e-9)


class Star(vi.AbstractMachine):
    """z ← R (z - G/5) in the plane, with a turn R by 2π/7, and G = 0 where |z| = 1 and z⁷ has the
    real part a. A clock that starts again at each kick ends the cycles, which no drive counts."""

    a: float
    cycle = 1.0

    @property
    def events(self):
        return (vi.Reset(lambda machine, s, x: x.t - 1, Star.kick, ends_cycle=True),)

    def kick(self, s, x):
        c, d = 1.0, 0.0
        for _ in range(7):
            c, d = c * x.x - d * x.y, c * x.y + d * x.x
        first, second = x.x**2 + x.y**2 - 1, c - self.a
        u, v = x.x - 0.2 * (x.x * first - x.y * second), x.y - 0.2 * (x.y * first + x.x * second)
        c, d = np.cos(2 * np.pi / 7), np.sin(2 * np.pi / 7)
        return vi.State(x=c * u - d * v, y=d * u + c * v, t=0.0)

    def field(self, s, x):
        return vi.State(x=0.0 * x.x, y=0.0 * x.y, t=1.0)


def test_a_branch_without_a_drive_closes_at_the_same_motion_a_cycle_later():
    """A round of the isola leads from z to the next of the seven z, the motion one cycle later."""
    angle = np.arccos(0.3) / 7
    start = vi.State(x=np.cos(angle), y=np.sin(angle), t=0.0)
    orbit = vi.find_orbit(Star(0.3), start, 7, throw=True)
    branch = vi.continue_orbit(orbit, parameter="a", bounds=(-3.0, 3.0))
    assert branch.ends == ("closed", "closed")
    angles = np.unwrap(np.arctan2(branch.column("section_y"), branch.column("section_x")))
    np.testing.assert_allclose(np.cos(7 * angles), branch.parameter, atol=1e-10)
    assert abs(angles[-1] - angles[0]) == pytest.approx(2 * np.pi / 7, abs=1e-6)
    folds = [point.parameter for point in branch.special]
    np.testing.assert_allclose(np.sort(folds), [-1, 1], atol=1e-9)
