"""The units of one coordinate do not change what is found of another."""

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from grazings import grazing_of

OMEGA = 1.3


class Uncoupled(vi.Mechanical):
    """Two bodies without a spring between them. The first coordinate has a unit of its own; the
    second body touches a stop, and stays 1e-4 away from another one."""

    q = ("y", "x")
    cycle = 2 * np.pi / OMEGA
    unit: float = 1.0
    amplitude: float = 0.3

    @property
    def contacts(self):
        return (
            vi.RigidStop(5.0 * self.unit, 0.8, on="y"),
            vi.RigidStop(1.0, 0.8, on="x"),
            vi.RigidStop(1.0001, 0.8, "left", on="x"),
        )

    def mass(self, q):
        return 1 / self.unit**2, 1.0

    def force(self, t, q, v):
        drive = jnp.cos(OMEGA * t)
        y = (-4 * q.y / self.unit - 0.2 * v.y / self.unit + drive) / self.unit
        return {"y": y, "x": -q.x - 0.3 * v.x + self.amplitude * drive}


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_clearance_of_the_nearest_stop(unit):
    """It is that of the stop that is nearest as a share of the motion, here the second body's."""
    machine = Uncoupled(unit)
    orbit = vi.find_orbit(machine, machine.at(), throw=True)
    near = 1 - 0.3 / np.hypot(1 - OMEGA**2, 0.3 * OMEGA)
    for found in (orbit, vi.simulate(machine, orbit.state, 3, impact_log=1)):
        np.testing.assert_allclose(found.clearance, near, rtol=0, atol=1e-9)
    bounds = (0.1, 0.7)
    branch = vi.continue_orbit(orbit, parameter="amplitude", bounds=bounds, progress=False)
    swing = branch.parameter / np.hypot(1 - OMEGA**2, 0.3 * OMEGA)
    np.testing.assert_allclose(branch.clearance, 1 - swing, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_local_map_of_a_grazing():
    """The motion is linear up to the touch, whose kick changes the velocity of x alone."""
    grazes = np.hypot(1 - OMEGA**2, 0.3 * OMEGA)
    reference = None
    for unit in (1.0, 1e6, 1e-6):
        machine = Uncoupled(unit=unit)
        found = vi.grazing(grazing_of(machine, "amplitude", (0.1, 2.0), machine.at()), check=False)
        assert found.value == pytest.approx(grazes, rel=1e-11)
        assert (found.touched, found.outcome) == ("right stop of x", vi.SCENARIOS.nonsmooth_fold)
        kick = -np.sqrt(2.0) * OMEGA * 1.8  # a = 1 by the phase
        by_size = found.kick * [1 / unit, 1, 1 / unit, 1]
        np.testing.assert_allclose(np.sort(by_size[0]), [kick, 0, 0, 0], rtol=1e-8, atol=1e-9)
        reference = found if reference is None else reference
        np.testing.assert_allclose(found.entries, reference.entries, rtol=1e-8)
        np.testing.assert_array_equal(found.forecast.period, reference.forecast.period)


class Slaved(vi.AbstractMachine):
    """A van der Pol oscillator with a spring that lags: p' = x - p, in units of p and of the
    parameter of their own. At rest λ³ + (1 - g) λ² + (1 - g) λ + 0.9 = 0."""

    unit: float
    scale: float
    growth: float
    cycle = vi.rising("v", usual=6.3)

    def field(self, s, state):
        growth = self.growth / self.scale - state.x**2
        pull = growth * state.v - state.x + 0.1 * state.p / self.unit
        return {"x": state.v, "v": pull, "p": self.unit * state.x - state.p}


@pytest.mark.slow
def test_hopf_bifurcation():
    """There (1 - g)² = 0.9, and the frequency is 0.9^(1/4)."""
    for unit, scale in ((1.0, 1.0), (1e6, 1.0), (1e-6, 1.0), (1.0, 1e6), (1.0, 1e-6)):
        machine = Slaved(unit, scale, 0.5 * scale)
        start = vi.simulate(machine, vi.State(x=-1.0, v=0.0, p=-0.5 * unit), 1, settle=60).last
        orbit = vi.find_orbit(machine, start, throw=True)
        branch = vi.continue_orbit(orbit, parameter="growth", bounds=(-0.5 * scale, 0.6 * scale))
        assert branch.ends == ("hopf", "bounds"), (unit, scale)
        (point,) = branch.special
        assert point.parameter / scale == pytest.approx(1 - np.sqrt(0.9), abs=1e-12)
        assert float(point.orbit.duration) == pytest.approx(2 * np.pi / 0.9**0.25, rel=1e-10)
