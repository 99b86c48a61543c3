"""Tori of an oscillator with impacts and of one with a motor, compared with SciPy.

Two bodies in a row, the first driven by cos(ωt - 2) against a stop. Values: a Neimark–Sacker point
at ω = 1.010619167160, a window of locking 1:7 and a grazing of the torus at ω = 0.977835259227.
"""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from vi_jax.orbit.torus import torus_of

from event_by_event import followed

pytestmark = pytest.mark.slow

GAP, RESTITUTION = 1.1, 0.8


class Two(vi.Mechanical):
    q = ("a", "b")
    omega: Any = 1.0
    gap: Any = GAP

    @property
    def mass(self):
        return (1.0, 0.5)

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega

    def force(self, t, q, v):
        link = q.a - q.b + 0.05 * (v.a - v.b)
        return dict(a=jnp.cos(self.omega * t - 2) - q.a - 0.1 * v.a - link, b=link)

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, RESTITUTION, on="a")


class Driven(Two):
    """The same machine with a motor, whose crank turns once in a cycle."""

    q = ("a", "b", "phi")
    cycle = vi.turn_of("phi", usual=6.28)

    @property
    def mass(self):
        return (1.0, 0.5, 5.0)

    def force(self, t, q, v):
        link = q.a - q.b + 0.05 * (v.a - v.b)
        motor = 5.0 * (self.omega - v.phi) - 0.05 * q.a * jnp.sin(q.phi - 2)
        return dict(a=jnp.cos(q.phi - 2) - q.a - 0.1 * v.a - link, b=link, phi=motor)


def rates(omega, t, x, phase=None):
    a, b, u, v = x[:4]
    link = a - b + 0.05 * (u - v)
    phase = omega * t if phase is None else phase
    return [u, v, np.cos(phase - 2) - a - 0.1 * u - link, link / 0.5]


def strike(t, x):
    x[2], x[0] = -RESTITUTION * x[2], GAP
    return x


TIGHT = {"rtol": 3e-14, "atol": 1e-15}
STOP = (lambda t, x: x[0] - GAP, strike)


def as_row(state):
    return np.array([state.a, state.b, state.v.a, state.v.b]).T


def largest_deviation(torus, omega, cycles=40):
    """Return the largest distance of SciPy's sections from the curve."""
    x, worst, period = as_row(torus.at(0.0)), 0.0, 2 * np.pi / omega
    for n in range(cycles):
        _, x, _ = followed(lambda t, x: rates(omega, t, x), x, period, [STOP], **TIGHT)
        wanted = as_row(torus.at((n + 1) * torus.rotation))
        worst = max(worst, np.abs(x - wanted).max())
    return worst


@pytest.fixture(scope="module")
def torus():
    machine = Two(omega=1.005)
    return vi.find_torus(machine, machine.at(a=0.1, b=0.2))


@pytest.fixture(scope="module")
def family(torus):
    return vi.continue_torus(torus, parameter="omega", bounds=(0.97, 1.02))


@pytest.mark.parametrize(
    "omega, rotation, exponents",
    [
        (1.005, 0.14686432679003, [0, -0.06469075, -0.97228889, -0.97228889]),
        (0.995, 0.13928040397102, [0, -0.27663673, -0.79515095, -0.95318920]),
        (0.98, 0.13598505128659, None),
    ],
)
def test_curves_agree_with_scipy(family, omega, rotation, exponents):
    found = family.at(omega)
    assert found.successful, found
    assert found.rotation == pytest.approx(rotation, abs=1e-12)
    # An error of ρ would grow along the run, by some ten times its size in each cycle.
    assert largest_deviation(found, omega) < 3e-11
    total = -0.25 * 2 * np.pi / omega + 2 * np.log(RESTITUTION)
    assert found.exponents.sum() == pytest.approx(total, abs=1e-12)
    if exponents is not None:
        np.testing.assert_allclose(found.exponents, exponents, atol=1e-7)
    assert found.residual < 1e-11 and found.tail < 1e-11


def test_the_family_ends_at_the_point_and_at_a_grazing(family):
    assert family.ends == ("grazing", "neimark-sacker"), family
    graze = family.tori[0]
    omega = family.parameter[0]
    assert omega == pytest.approx(0.977835259227, abs=1e-9)
    assert graze.rotation == pytest.approx(0.135760137814, abs=1e-9)
    assert "touches a stop" in family.details[0] and graze.successful
    # SciPy from the angle of the touch: the body turns on the stop after its impact.
    angle = graze.margins[0].angle
    turn: Any = lambda t, x: -x[2]
    turn.direction = 1
    x, period, options = as_row(graze.at(angle)), 2 * np.pi / omega, {"method": "DOP853", **TIGHT}
    fast: Any = lambda t, x: x[0] - GAP if x[2] > 0.1 else -1.0
    fast.terminal, fast.direction = True, 1
    ode = lambda t, x: rates(omega, t, x)
    first: Any = solve_ivp(ode, (0, period), x, events=[fast, turn], **options)
    second: Any = solve_ivp(
        ode, (first.t[-1], period), strike(0, first.y[:, -1].copy()), events=turn, **options
    )
    turns = [*first.y_events[1], *second.y_events[0]]
    assert min(abs(y[0] - GAP) for y in turns) < 1e-9


def test_the_window_of_locking(family):
    (window,) = (w for w in family.windows if (w.p, w.q) == (1, 7))
    np.testing.assert_allclose([window.low, window.high], [1.00020823070, 1.00021985417], atol=1e-9)
    orbit = window.orbit
    omega = float(orbit.machine.omega)
    assert orbit.stable and int(orbit.cycles) == 7 and window.low < omega < window.high
    x, period = as_row(orbit.state), 7 * 2 * np.pi / omega
    _, last, met = followed(lambda t, x: rates(omega, t, x), x, period, [STOP], **TIGHT)
    np.testing.assert_allclose(last, x, atol=1e-11)
    assert len(met) == 7
    isola = vi.continue_orbit(orbit, parameter="omega", bounds=(1.0001, 1.0003))
    folds = sorted(point.parameter for point in isola.special if point.kind == "fold")
    np.testing.assert_allclose([folds[0], folds[-1]], [window.low, window.high], atol=1e-10)


def test_a_torus_from_a_neimark_sacker_point(family):
    machine = Two(omega=1.015)
    settled = vi.simulate(machine, machine.at(a=0.1, b=0.2), 1, settle=300).last
    orbit = vi.find_orbit(machine, settled, throw=True)
    branch = vi.continue_orbit(orbit, parameter="omega", bounds=(1.0, 1.02))
    (point,) = (point for point in branch.special if point.kind == "neimark-sacker")
    assert point.parameter == pytest.approx(1.010619167160, abs=1e-11)
    close, near, far = (point.switch(distance=distance) for distance in (0.015, 0.03, 0.3))
    assert close.successful and near.successful and far.successful
    # Both change in proportion to the amplitude², which at the point is zero.
    for of, wanted in (
        (lambda torus: torus.rotation, 0.152023165123),
        (lambda torus: float(torus.machine.omega), point.parameter),
    ):
        assert abs(of(near) - wanted) < 1e-4
        assert (4 * of(close) - of(near)) / 3 == pytest.approx(wanted, abs=2e-8)
    omega = float(far.machine.omega)
    assert far.rotation == pytest.approx(family.at(omega).rotation, abs=1e-11)


def test_solutions_that_are_no_torus_have_a_reason(family, torus):
    """Each solves the equations to rounding."""
    x = torus.curve.x
    point = torus.curve._replace(x=0 * x + x.mean(axis=0), rotation=0.3)
    assert "shrunk to a periodic motion" in dataclasses.replace(torus, curve=point).reason
    # A jump of the parameter past the Neimark–Sacker point.
    equations, points, _ = family._walked
    beyond = equations.solve_near(points[-1].curve, 1.012)
    if beyond is not None:
        assert not torus_of(beyond, equations).successful


def test_a_curve_beyond_its_grazing_is_noticed(family):
    equations, points, _ = family._walked
    begin = points[1].curve
    beyond = equations.solve_near(begin, family.parameter[0] - 2e-4)
    assert beyond is not None
    missed = torus_of(beyond, equations)
    assert missed.clearance < -1e-3 and not missed.successful
    assert "other events than the equations: it touches" in missed.reason
    assert missed.residual > 1e-3  # though the equations hold at the nodes


def test_steps_by_a_tolerance_are_refused():
    """Their error, some 5e-10, would keep Newton's method from converging near the point."""
    machine = Two(omega=1.005)
    with pytest.raises(ValueError, match="`method` must be of fixed steps"):
        vi.find_torus(machine, machine.at(a=0.1, b=0.2), method=vi.Adaptive(rtol=1e-9))


def test_a_machine_whose_motor_counts_its_turns():
    machine = Driven(omega=1.003)
    torus = vi.find_torus(machine, machine.at(a=0.1, b=0.2, v=dict(phi=1.0)))
    assert torus.successful and len(torus.exponents) == 5

    def ode(t, z):
        a, b, phi, u, v, w = z
        x = rates(None, t, [a, b, u, v], phase=phi)
        motor = 5.0 * (1.003 - w) - 0.05 * a * np.sin(phi - 2)
        return [u, v, w, x[2], x[3], motor / 5.0]

    def bounce(t, z):
        z[3], z[0] = -RESTITUTION * z[3], GAP
        return z

    row = lambda z: np.array([z.a, z.b, z.phi, z.v.a, z.v.b, z.v.phi])
    events = [(lambda t, z: z[0] - GAP, bounce), (lambda t, z: z[2] - 2 * np.pi, lambda t, z: None)]
    x, worst = row(torus.at(0.0)), 0.0
    for n in range(20):
        _, x, _ = followed(ode, x, 100.0, events, **TIGHT)
        x[2] -= 2 * np.pi
        worst = max(worst, np.abs(x - row(torus.at((n + 1) * torus.rotation))).max())
    assert worst < 1e-10
