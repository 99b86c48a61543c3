"""The results of branches, manifolds and methods, and each coordinate's, do not depend on units."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from own_units import Cranked, variants

pytestmark = pytest.mark.slow
OMEGA = 1.3


class Hardening(vi.AbstractMachine):
    """x'' + 0.1 x' + x + x³ = 0.4 cos 1.6 s, in given units of length and time."""

    length: float
    time: float

    @property
    def cycle(self):
        return 2 * np.pi * self.time / 1.6

    def field(self, s, state):
        x, v = state.x / self.length, state.v
        pull = 0.4 * jnp.cos(1.6 * s / self.time) - x - x**3
        return {"x": v, "v": pull * self.length / self.time**2 - 0.1 * v / self.time}


def test_manifolds_and_exponents_are_the_same_in_all_units():
    curves = []
    for length, time in ((1.0, 1.0), (1e-6, 1e-3)):
        machine = Hardening(length=length, time=time)
        guess = vi.State(x=-1.106 * length, v=1.224 * length / time)
        found = vi.manifold(vi.find_orbit(machine, guess), length=0.6, spacing=0.1, progress=False)
        assert found.lengths == pytest.approx((0.6, 0.6))
        curve = [[x.x / length, x.v * time / length] for x in found.branches]
        exponents = vi.lyapunov(machine, guess, 16, settle=20).exponents * time
        curves.append((curve, exponents))
    for other in curves[1:]:
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), other, curves[0])


def test_all_orbits_distinguishes_small_motions():
    """Regression: orbits of equal period were merged."""
    found = []
    numbers = {"frequency": 0.9, "damping": 0.04, "stiffness": 1.0, "cubic": 0.0}
    for size in (1.0, 1e-6):
        machine = vi.machines.Duffing(
            amplitude=size, gap=2.0 * size, restitution=0.5, two_sided=False, **numbers
        )
        region = {"start.Y": (-3 * size, 2 * size), "start.V": (-3 * size, 3 * size)}
        all_of_them = vi.all_orbits(machine, 2, region=region, starts=64)
        rows = zip(all_of_them.orbits, all_of_them.found.tolist(), strict=True)
        found.append([[int(orbit.impacts), *row] for orbit, row in rows])
    assert found[0] == found[1] and len(found[0]) == 4


def test_errors_of_methods_are_the_same_in_all_units():
    """Lengths are compared with lengths only, not with the crank's speed."""
    errors = []
    for machine in variants(Cranked):
        tried = vi.suggest_method(machine, cycles=4, lanes=2).tried
        errors.append(max(x.error for x in tried if x.name.startswith("FixedStep")))
    np.testing.assert_allclose(errors, errors[0], rtol=1e-3)


class Uncoupled(vi.Mechanical):
    """Two bodies without a spring between them. The coordinate of the first one has another unit.
    The second one touches a stop, and stays 1e-4 away from another stop."""

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
