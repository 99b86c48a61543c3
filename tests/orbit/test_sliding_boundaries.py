"""Sliding bifurcations and their curves in two parameters, compared with closed forms and SciPy."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from belts import Belt
from den_hartog import den_hartog
from rough_floor import SINCE, Rough, branch_of, on_both_sides, settled

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
    """The branches of the motion without stops and of the one with stops end at one point."""
    limit = den_hartog(0.75, 0.0)[1]
    bounds = (0.6 * limit, 1.3 * limit)
    branch = branch_of("level", bounds, omega=0.75, level=0.7 * limit)
    assert branch.ends == ("bounds", "crossing-sliding") and len(branch.problem.events) == 2
    (point,) = branch.special
    sides = point, on_both_sides(point, "level", (0.95 * limit, 1.1 * limit))
    for side, words in zip(sides, ("beyond is held there", "no longer"), strict=True):
        assert side.kind == "crossing-sliding" and words in side.detail
        assert side.parameter == pytest.approx(limit, abs=1e-10)
    curve = vi.boundary(point, parameter="omega", bounds=((0.01, 2.0), (0.7, 0.8)), progress=False)
    assert curve.kind == "crossing-sliding" and curve.ends == ("bounds", "bounds")
    for i in (0, len(curve.steps) // 2, -1):
        friction, omega = curve.parameters[i]
        assert friction == pytest.approx(den_hartog(omega, 0.0)[1], abs=1e-8)


def test_a_curve_ends_where_another_segment_vanishes():
    """Regression: a curve of grazing-sliding went on with a segment of negative length. It ends at
    the crossing-sliding of the branch with that damping."""
    numbers, bounds = dict(omega=0.3, second=0.05), (0.05, 0.25)
    point = branch_of("level", bounds, level=0.15, damping=0.1, **numbers).special[-1]
    curve = vi.boundary(point, parameter="damping", bounds=(bounds, (0.05, 0.15)), progress=False)
    assert curve.kind == "grazing-sliding" and curve.ends == ("crossing-sliding", "bounds")
    level, damping = curve.parameters[0]
    first = {}
    for change in (-1e-4, 0.0, 1e-4):
        given = dict(level=0.15, damping=damping + change, **numbers)
        first[change] = branch_of("level", (0.05, 0.16), **given).special[0]
    assert first[0.0].parameter == pytest.approx(level, abs=1e-8)  # where both kinds meet
    assert first[-1e-4].kind == "crossing-sliding" and first[1e-4].kind == "grazing-sliding"


def test_a_motion_that_ceases():
    """Friction of the size of the drive, 1, holds the body throughout, anywhere: both slips vanish
    at once, and the motion without them has a multiplier 1."""
    branch = branch_of("level", (0.7, 1.2), omega=0.3, level=0.8, damping=0.1)
    assert branch.ends == ("bounds", "adding-sliding")
    (point,) = branch.special
    assert point.kind == "adding-sliding" and "held there throughout" in point.detail
    assert point.parameter == pytest.approx(1, abs=1e-7)
    with pytest.raises(ValueError, match="Several of its events vanish at once"):
        vi.boundary(point, parameter="omega", bounds=((0.7, 1.2), (0.2, 0.4)))


def excess_force(omega, numbers, near):
    """Return the excess of the force over the friction level, where the body stops near a phase."""
    events = settled(omega, numbers["level"], numbers["second"], numbers["damping"])
    phase, Y, *_ = min(events, key=lambda e: abs((e[0] - SINCE) % (2 * np.pi) - near))
    force = np.cos(phase) + numbers["second"] * np.cos(2 * phase + 1) - Y
    return abs(force) - numbers["level"]


@pytest.mark.exhaustive
def test_a_slip_between_two_segments_of_sticking():
    """At phase 2π, where the drive is strongest, the force just reaches the friction level."""
    numbers = {"level": 0.5, "second": 0.0, "damping": 0.04}
    branch = branch_of("omega", (0.15, 0.7), omega=0.25, **numbers)
    point, last = branch.special
    assert branch.ends == ("adding-sliding", "crossing-sliding")
    assert last.kind == "crossing-sliding" and "floor is just held" in point.detail

    def excess(omega):
        """Return the excess of the force at phase 2π, on the body that stopped before."""
        events = settled(omega, **numbers)
        Y = [e[1] for e in events if e[3] == 0 and e[1] > 0]
        return 1.0 - Y[0] - 0.5 if Y[0] < 1 else Y[0] - 1.5

    truth = brentq(excess, point.parameter - 1e-5, point.parameter + 1e-5, xtol=1e-10)
    assert point.parameter == pytest.approx(truth, abs=1e-8)
    back = on_both_sides(point, "omega", (0.15, 0.2))
    assert back.kind == "adding-sliding" and "no longer" in back.detail
    assert back.parameter == pytest.approx(point.parameter, abs=1e-8)


def test_the_first_of_several_changes_within_a_step():
    """A long step passes the point beyond which a turning body no longer sticks at once. It also
    passes a fold and a vanishing segment of solutions that are no motions."""
    omega, numbers = 0.2, {"level": 0.11102, "second": 0.9535, "damping": 0.1122}
    branch = branch_of("level", (0.01, 1.5), omega=omega, max_step=0.4, **numbers)
    point = branch.special[0]
    assert branch.ends[0] == point.kind == "switching-sliding"
    near = float(point.detail.split("clock ")[1].split()[0])
    # On this side friction holds the body, with a margin that falls linearly to zero.
    levels = point.parameter + np.array([1e-6, 2e-6])
    left = [excess_force(omega, {**numbers, "level": level}, near) for level in levels]
    assert max(left) < 0
    truth = levels[0] - left[0] * (levels[1] - levels[0]) / (left[1] - left[0])
    assert point.parameter == pytest.approx(truth, abs=1e-8)


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
    orbit = vi.find_orbit(machine, stuck, throw=True)
    branch = vi.continue_orbit(orbit, parameter="speed", bounds=(1.3, 1.9))
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


class Held(vi.AbstractMachine):
    """Dry friction holds the second body while the first one pulls by less than its limit."""

    amplitude: float = 0.3
    cycle = 2 * np.pi / 0.8
    contacts = vi.DryFriction(1.0, on="w", mass=1.0)

    def field(self, t, z):
        u = self.amplitude * jnp.cos(0.8 * t) - z.x - 0.2 * z.u
        return {"x": z.u, "u": u, "w": 0.1 * z.x}


def test_friction_that_holds_a_body_for_the_whole_cycle():
    """The body slips once 0.1 x passes 1; the motion of x is linear up to there."""
    orbit = vi.find_orbit(Held(), vi.State(x=0.1, u=0.0, w=0.0), throw=True)
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.2, 8.0), progress=False)
    assert branch.ends == ("bounds", "adding-sliding")
    slips = 10 * np.hypot(1 - 0.8**2, 0.2 * 0.8)
    assert branch.special[0].parameter == pytest.approx(slips, rel=1e-12)
    assert "friction 0 is just held" in branch.special[0].detail
    np.testing.assert_allclose(np.abs(branch.multipliers[:, 2]), 0, atol=1e-12)


class Carried(vi.Mechanical):
    """The same bodies with the position of the second, which may be anywhere."""

    q, mass, cycle = ("x", "p"), (1.0, 1.0), 2 * np.pi / 0.8
    amplitude: float = 0.3
    contacts = vi.DryFriction(1.0, on="p")

    def force(self, t, q, v):
        return {"x": self.amplitude * jnp.cos(0.8 * t) - q.x - 0.2 * v.x, "p": 0.1 * q.x}


def test_a_body_held_anywhere_is_refused():
    orbit = vi.find_orbit(Carried(), Carried().at(x=0.1), throw=True)
    with pytest.raises(ValueError, match="the place at which dry friction holds a body"):
        vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.2, 0.4))
