"""Branches of autonomous machines: a passive walker, a body on a belt, a rimless wheel."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

import resets
from belts import Belt
from resets import legs
from rimless_wheel import MULTIPLIER, Wheel

pytestmark = pytest.mark.slow


class Walker(resets.Walker):
    """The walker of `resets`, with its heel strike at a section instead of a reset."""

    @property
    def events(self):
        return ()

    cycle = vi.rising(lambda m, x: x.between - 2 * x.stance, usual=4.0)

    def renewed(self, x):
        return legs(-x.stance, x.turning * jnp.cos(2 * x.stance))


def step_by_scipy(slope, stance, turning):
    def field(_, x):
        falls = np.sin(x[0] - slope)
        pull = (x[1] ** 2 - np.cos(x[0] - slope)) * np.sin(x[2])
        return [x[1], falls, x[3], falls + pull]

    def strikes(_, x):
        return x[2] - 2 * x[0]

    strikes.terminal, strikes.direction = True, 1
    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    x = [stance, turning, 2 * stance, turning * (1 - np.cos(2 * stance))]
    x = solve_ivp(field, (0, 1), x, **options).y[:, -1]  # the start is on the section
    x = solve_ivp(field, (1, 10), x, events=strikes, **options).y[:, -1]
    return np.array([-x[0], x[1] * np.cos(2 * x[0])])


def test_period_doubling_of_a_walker():
    """Each cycle begins with a jump of the first coordinate."""
    orbit = vi.find_orbit(Walker(0.009), legs(0.2003, -0.1998))
    assert float(orbit.duration) == pytest.approx(3.88246375285, abs=1e-9)
    branch = vi.continue_orbit(orbit, parameter="slope", bounds=(0.008, 0.017))
    stance = np.array([float(branch.orbit(i).state.stance) for i in (0, -1)])
    np.testing.assert_allclose(branch.y_min[[0, -1]], -stance, atol=1e-12)
    np.testing.assert_allclose(branch.y_max[[0, -1]], stance, atol=1e-12)
    (doubling,) = branch.special
    assert doubling.kind == "period-doubling"
    at = [float(doubling.orbit.state.stance), float(doubling.orbit.state.turning)]
    np.testing.assert_allclose(step_by_scipy(doubling.parameter, *at), at, atol=1e-10)
    h = 2e-6
    ends = [[step_by_scipy(doubling.parameter, *(np.array(at) + sign * h * e)) for sign in (1, -1)]
            for e in np.eye(2)]  # fmt: skip
    jacobian = np.array([(up - down) / (2 * h) for up, down in ends]).T
    assert np.linalg.eigvals(jacobian).real.min() == pytest.approx(-1, abs=3e-7)


class BeltAtGreatestPosition(Belt):
    """A belt whose section is at the body's greatest position."""

    cycle = vi.falling("V", usual=2 * np.pi)


def test_stick_slip_branches_end_at_grazing_sliding():
    """Branches of motions that stick and of motions that only slide end at the same point. The
    sliding ones begin at a Hopf point: the friction 0.5 + 0.5 exp(-2v) of a body at rest has the
    slope -exp(-2v), which cancels the damping 0.1 at v = ½ ln 10."""
    # At this speed the greatest velocity after a release equals the belt speed, by SciPy.
    ending = 1.83660097221
    sliding = vi.OscillatorState(jnp.asarray(1.7), jnp.asarray(0.0))
    stuck = vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(1.5))
    sticking = vi.simulate(BeltAtGreatestPosition(), stuck, 1, settle=40).last
    for start, bounds in ((sticking, (1.3, 1.9)), (sliding, (1.1, 1.9))):
        orbit = vi.find_orbit(BeltAtGreatestPosition(), start)
        branch = vi.continue_orbit(orbit, parameter="speed", bounds=bounds)
        assert branch.ends[1] == "grazing-sliding"
        assert branch.parameter[-1] == pytest.approx(ending, abs=1e-10)
    hopf = branch.special[0]
    assert branch.ends[0] == hopf.kind == "hopf"
    assert hopf.parameter == pytest.approx(0.5 * np.log(10), abs=1e-13)
    assert float(hopf.orbit.state.Y) == pytest.approx(0.55, abs=1e-5)
    assert float(hopf.orbit.duration) == pytest.approx(2 * np.pi, abs=1e-12)
    assert abs(hopf.orbit.multipliers[0]) == pytest.approx(1, abs=1e-6)


def test_a_branch_ends_near_a_homoclinic_motion():
    """On gentler slopes a rimless wheel slows down ever more as it passes its upright rest."""
    wheel = Wheel()
    orbit = vi.find_orbit(wheel, vi.simulate(wheel, wheel.start(), 40).last)
    branch = vi.continue_orbit(orbit, parameter="slope", bounds=(0.02, 0.2))
    assert branch.ends == ("long", "bounds") and 0.0289 < branch.parameter.min() < 0.03
    np.testing.assert_allclose(np.abs(branch.multipliers[:, 0]), MULTIPLIER, atol=1e-10)


class PressedByItsCycle(vi.AbstractMachine):
    """A limit cycle whose y presses x on a stop."""

    cycle = vi.rising("y", usual=6.3)
    contacts = vi.RigidStop(0.0, 0.5, on=("x", "v"))

    def field(self, t, z):
        return {"x": z.v, "v": 3 - 0.1 * z.v + 0.2 * z.y, "y": z.w, "w": (1 - z.y**2) * z.w - z.y}


def test_a_body_at_rest_at_an_equilibrium_is_no_orbit():
    """Regression: the force on its stop counted as motion, so rounding was an orbit. The other
    motion has the period of the van der Pol oscillator."""
    pressed = PressedByItsCycle()
    still, moving = (vi.find_orbit(pressed, vi.State(x=0.0, v=0.0, y=0.0, w=w)) for w in (0.1, 2.0))
    assert still.result == vi.ORBIT_RESULTS.equilibrium
    assert bool(moving.successful) and float(moving.duration) == pytest.approx(6.6632868593)
