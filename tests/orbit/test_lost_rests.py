"""Curves in two parameters on which a rest on a stop is lost or divided."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from dragging import Dragging
from two_coupled import Coupled, settled

ZETA = "drive.frequency_ratio"


def search(machine, start, cycles=40):
    last = vi.simulate(machine, start, 1, settle=cycles).last
    return vi.find_orbit(machine, last, impact_log=64, throw=True)


@pytest.mark.slow
def test_a_lost_rest_of_one_body():
    """Compare the point and the ends of its curve with flights in 60 digits, and the curve between
    with simulations. Long steps make the corrector begin far off."""
    scene = vi.Scene.ideal(frequency_ratio=0.6, restitution=0.5, gap=0.0, damping_ratio=0.05)
    branch = vi.continue_orbit(search(scene, scene.start(Y=0.0)), parameter=ZETA, bounds=(0.5, 0.8))
    (point,) = branch.special
    assert point.kind == "rest" and point.parameter == pytest.approx(0.65836157060536189, abs=1e-11)
    beyond = point.switch()
    assert beyond.rests == 0 and beyond.impacts > 5
    assert float(beyond.machine.drive.frequency_ratio) > point.parameter
    within = {"parameter": "stops.0.restitution", "bounds": ((0.3, 1.2), (0.3, 0.7))}
    curve = vi.boundary(point, **within, max_step=0.3)
    assert curve.ends == ("bounds", "bounds")
    ends = [0.952471322875, 0.44400204982114795]
    np.testing.assert_allclose(curve.parameters[[0, -1], 0], ends, atol=1e-11)
    zeta, k = curve.parameters[-3]
    numbers = {"restitution": k, "gap": 0.0, "damping_ratio": 0.05}
    machine_at = lambda zeta: vi.Scene.ideal(frequency_ratio=zeta, **numbers)
    assert rests_around(machine_at, zeta) == [1, 0]


def rests_around(machine_at, value, by=1e-6):
    """Return the rests in a cycle of settled simulations on both sides of a value."""

    def rests(machine):
        start = machine.start(Y=-0.7) if isinstance(machine, vi.Scene) else machine.start()
        return int(vi.simulate(machine, start, 1, settle=100).rests[0])

    return [rests(machine_at(value + x)) for x in (-by, by)]


@pytest.mark.exhaustive
def test_a_rest_that_is_divided():
    """Compare point, curve and multipliers of two bodies with a shooting code with exact hops, and
    the rests on both sides of the curve with simulations."""
    options = {"parameter": "omega", "method": vi.FixedStep(steps_per_cycle=24)}
    bounds, orbit = (0.346, 0.3505), settled(Coupled())
    branch = vi.continue_orbit(orbit, bounds=bounds, step=0.3, max_step=0.3, **options)
    assert branch.ends == ("rest", "bounds") and (branch.rests == 1).all()
    point = branch.special[0]
    divided = point.switch()
    assert "divided" in point.detail and divided.rests == 2
    back = vi.continue_orbit(divided, bounds=(0.34708, 0.348), **options)
    joined = back.special[-1]
    assert "become one" in joined.detail and joined.switch().rests == 1
    assert joined.parameter == pytest.approx(point.parameter, abs=1e-5)
    assert point.parameter == pytest.approx(0.34710711379082, abs=1e-11)
    multipliers = branch.at(0.35)[0].multipliers
    np.testing.assert_allclose(multipliers, [-0.4504246148, -0.2437666313, 0, 0], atol=1e-8)
    bounds = ((0.33, 0.37), (0.45, 0.5205758665))
    curve = vi.boundary(point, parameter="restitution", bounds=bounds, max_step=0.3)
    assert curve.ends == ("bounds", "bounds")
    ends = curve.parameters[[0, -1], 0]
    np.testing.assert_allclose(ends, [0.3471331079, 0.3477575235], atol=1e-8)
    omega, k = curve.parameters[-2]
    rests = [int(settled(Coupled(omega + by, k)).rests) for by in (-1e-4, 1e-4)]
    assert rests == [2, 1]


class Switched(vi.AbstractMachine):
    """x'' + 0.1 x' + x = cos 0.6 t, x ≤ 0, with a switch at `phase` that changes nothing."""

    phase: float = 1.2

    cycle = 2 * np.pi / 0.6

    @property
    def contacts(self):
        return vi.RigidStop(0.0, 0.5, on=("Y", "V"))

    @property
    def events(self):
        return vi.Switch(lambda machine, s, x: jnp.sin(0.6 * s - machine.phase))

    def field(self, s, x, side):
        return vi.OscillatorState(x.V, jnp.cos(0.6 * s) - x.Y - 0.1 * x.V)

    def start(self):
        return vi.OscillatorState(jnp.asarray(-0.5), jnp.asarray(0.0))


@pytest.mark.exhaustive
def test_an_event_reaches_the_end_of_a_chatter():
    """The rest begins 1.1788045220098 before the drive changes its sign, by hops in 60 digits. The
    branch ends where the switch reaches the beginning of the rest."""
    orbit = search(Switched(), Switched().start())
    branch = vi.continue_orbit(orbit, parameter="phase", bounds=(0.5, 1.4), progress=False)
    assert branch.ends == ("grazing", "bounds") and (branch.rests == 1).all()
    (point,) = branch.special
    assert point.parameter == pytest.approx(0.5 * np.pi - 0.6 * 1.1788045220098, abs=1e-7)
    assert "(the end of the chatter on the right stop and switch 0, at clock 1.439" in point.detail


class Pressed(vi.Mechanical):
    """A body that a constant force presses on a stop, and a vibration lifts for a part of a cycle
    if its amplitude is greater."""

    q, mass, cycle = ("x",), (1.0,), 2 * np.pi
    amplitude: float = 0.6

    @property
    def contacts(self):
        return vi.RigidStop(0.0, 0.4, on="x")

    def force(self, t, q, v):
        return dict(x=0.5 + self.amplitude * jnp.cos(t) - q.x - 0.2 * v.x)


@pytest.mark.slow
def test_a_rest_that_joins_itself():
    """Regression: the motion beyond was one without rest, which does not exist."""
    machine = Pressed()
    settled = vi.simulate(machine, machine.at(x=-0.1), 1, settle=40, rests=True).last
    orbit = vi.find_orbit(machine, settled, throw=True)
    options = {"parameter": "amplitude", "bounds": (0.2, 0.7), "progress": False}
    branch = vi.continue_orbit(orbit, **options)
    point = next(x for x in branch.special if x.kind == "rest")
    assert point.parameter == pytest.approx(0.5, abs=1e-6) and "lasts for ever" in point.detail
    always = vi.continue_orbit(point.switch(), **options)
    (divided,) = always.special
    assert set(always.ends) == {"bounds", "rest"} and always.parameter.min() == 0.2
    assert divided.parameter == pytest.approx(0.5, abs=1e-9)
    assert int(divided.switch().rests) == 1


@pytest.mark.slow
def test_the_motion_beyond_a_rest_is_as_accurate_as_the_branch():
    """Regression: it was sought with fewer steps, and did not repeat by 5e-6."""
    machine = Dragging(
        1.5780551531102542, 0.5732534975700999, -0.15138035578735687, 0.5770427091485174,
        push=0.08617047024737454, second=0.3,
    )  # fmt: skip
    settled = vi.simulate(machine, machine.at(x=-0.6), 3, settle=300, rests=True).last
    orbit = vi.find_orbit(machine, settled, cycles=3, throw=True)
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=(0.947, 2.209), progress=False)
    lost = min((x for x in branch.special if x.kind == "rest"), key=lambda x: x.parameter)
    beyond = lost.switch(distance=0.005)
    last = vi.simulate(beyond.machine, beyond.state, 3).last
    assert beyond.rests == 0 and beyond.impacts == 11
    np.testing.assert_allclose(last.x, beyond.state.x, rtol=0, atol=1e-7)
