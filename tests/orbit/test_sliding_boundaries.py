"""Curves of sliding bifurcations in two parameters, compared with closed forms and SciPy."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from belts import Belt
from den_hartog import den_hartog
from rough_floor import Rough, branch_of, on_both_sides

pytestmark = pytest.mark.slow


class Belted(Rough):
    """The same body on a belt that is faster than the body while it slips."""

    belt: Any = 2.0

    @property
    def contacts(self):
        return vi.DryFriction(self.level, on="V", mass=self.omega, slip=lambda x: x.V - self.belt)


def test_grazing_sliding_of_a_linear_motion():
    """While the body slips, friction is constant and x' has amplitude ω/|1 - ω² + iδω|. The body
    just reaches a belt of this speed."""
    damping = 0.3

    def reached(omega):
        return omega / np.hypot(1 - omega**2, damping * omega)

    machine = Belted(omega=0.75, level=0.2, damping=damping, belt=1.1 * reached(0.75))
    start = vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(0.0))
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 1, settle=200).last, throw=True)
    bounds = (0.2, 5.0)
    branch = vi.continue_orbit(orbit, parameter="belt", bounds=bounds, progress=False)
    (point,) = branch.special
    assert point.kind == "grazing-sliding" and point.touches
    assert point.parameter == pytest.approx(reached(0.75), abs=1e-10)
    curve = vi.boundary(point, parameter="omega", bounds=(bounds, (0.4, 1.6)))
    assert curve.kind == "grazing-sliding" and len(curve.parameters) > 10
    belt, omega = curve.parameters.T
    assert np.ptp(omega) == pytest.approx(1.2)
    np.testing.assert_allclose(belt, reached(omega), rtol=1e-9)


def test_sticking_begins_on_den_hartogs_curve():
    """Follow the curve from the motion without stops, and from the one with stops."""
    limit = den_hartog(0.75, 0.0)[1]
    bounds = (0.6 * limit, 1.3 * limit)
    branch = branch_of("level", bounds, omega=0.75, level=0.7 * limit)
    assert branch.ends == ("bounds", "crossing-sliding") and len(branch.problem.events) == 2
    (point,) = branch.special
    sides = point, on_both_sides(point, "level", bounds)
    for side, words in zip(sides, ("beyond is held there", "no longer"), strict=True):
        assert side.kind == "crossing-sliding" and words in side.detail
        assert side.parameter == pytest.approx(limit, abs=1e-10)
        curve = vi.boundary(
            side, parameter="omega", bounds=((0.01, 2.0), (0.7, 0.8)), progress=False
        )
        assert curve.kind == "crossing-sliding" and curve.ends == ("bounds", "bounds")
        for i in (0, len(curve.steps) // 2, -1):
            friction, omega = curve.parameters[i]
            assert friction == pytest.approx(den_hartog(omega, 0.0)[1], abs=1e-8)


class Walled(Rough):
    """The same body with a wall that it does not reach."""

    contacts = property(lambda self: (vi.RigidStop(5.0, 0.5), Rough.contacts.fget(self)))


def test_clearance_where_friction_reverses_the_body_at_its_turn():
    limit = den_hartog(0.75, 0.0)[1]
    start = vi.OscillatorState(jnp.asarray(0.1), jnp.asarray(0.0))
    machine = Walled(omega=0.75, level=0.7 * limit)
    orbit = vi.find_orbit(machine, vi.simulate(machine, start, 1, settle=200).last)
    bounds = (0.6 * limit, 0.9 * limit)
    branch = vi.continue_orbit(orbit, parameter="level", bounds=bounds, progress=False)
    amplitudes = [den_hartog(0.75, level)[0] for level in branch.parameter]
    np.testing.assert_allclose(branch.clearance, 5 - np.array(amplitudes), rtol=1e-8)


class Damped(Belt):
    """A belt whose section is at the body's greatest position."""

    damping: Any = 0.1
    cycle = vi.falling("V", usual=2 * np.pi)

    def field(self, s, x):
        return vi.OscillatorState(x.V, -x.Y - self.damping * x.V)


@pytest.mark.exhaustive
def test_grazing_sliding_of_a_motion_that_sticks():
    """The segment of sticking vanishes where the greatest velocity after a release equals the belt
    speed. Compare with shooting by SciPy."""
    machine = Damped()
    stuck = vi.simulate(machine, machine.start(V=1.5), 1, settle=40).last
    branch = vi.continue_orbit(
        vi.find_orbit(machine, stuck, throw=True), parameter="speed", bounds=(1.3, 1.9)
    )
    point = branch.special[-1]
    assert point.kind == "grazing-sliding" and "no longer" in point.detail
    curve = vi.boundary(point, parameter="damping", bounds=((0.5, 3.5), (0.05, 0.3)))
    assert curve.ends == ("bounds", "bounds")
    ends = np.sort(curve.parameters[[0, -1], 0])
    np.testing.assert_allclose(ends, [0.727689234646, 3.024654895060], atol=1e-10)
    for speed, damping in curve.parameters[5::12]:
        assert excess_velocity(speed, damping) == pytest.approx(0, abs=1e-8)


def excess_velocity(speed, damping):
    """Return the greatest velocity after a release from the belt, minus `speed`, by SciPy."""

    def field(_, x):
        slip = max(speed - x[1], 0.0)
        return [x[1], -x[0] - damping * x[1] + 0.5 + 0.5 * np.exp(-2 * slip)]

    def fastest(_, x):
        return field(0, x)[1]

    fastest.terminal, fastest.direction = True, -1
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    x = solve_ivp(field, (0, 2), [1 - damping * speed, speed], **options).y[:, -1]
    return solve_ivp(field, (2, 12), x, events=fastest, **options).y[1, -1] - speed
