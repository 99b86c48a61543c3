"""Orbits and branches of machines with switches, with a section of their own, and with a drift."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from differences import some


class Slider(eqx.Module):
    """A body on a rough plane."""

    x: jnp.ndarray
    v: jnp.ndarray


def _velocity(machine, state):
    return state.v


def _force(machine, s, state):
    return machine.amplitude * jnp.cos(s) - state.x


def _stopped(machine, state):
    return Slider(state.x, jnp.zeros_like(state.v))


class Rubbing(vi.AbstractMachine):
    """A driven oscillator with dry friction: x'' + x = A cos ωt - f sign x', by the phase ωt."""

    amplitude: jnp.ndarray = eqx.field(converter=jnp.asarray)
    omega: jnp.ndarray = eqx.field(converter=jnp.asarray)
    friction: jnp.ndarray = eqx.field(converter=jnp.asarray)
    stops: tuple = ()

    @property
    def cycle(self):
        return 2 * np.pi

    @property
    def switches(self):
        return (vi.DryFriction(self.friction, velocity=_velocity, force=_force, stopped=_stopped),)

    def field(self, s, state, mode):
        force = _force(self, s, state)
        acceleration = force + self.switches[0].contribution(self, s, state, mode)
        return Slider(state.v / self.omega, acceleration / self.omega)

    def position(self, state):
        return state.x

    def velocity(self, state):
        return state.v

    def placed(self, state, Y, V):
        return Slider(Y, V)

    def start(self):
        return Slider(jnp.asarray(0.1), jnp.asarray(0.0))


def soft_scene():
    return vi.Scene(
        oscillator=vi.Oscillator(0.02),
        drive=vi.IdealDrive(0.9),
        soft_stops=(vi.SoftStop(2.0, 400.0, restitution=0.5),),
    )


# The machine, settled cycles, period, the parameter, its bounds and another value of it.
CASES = {
    "valve": (vi.machines.ReliefValve(flow_rate=5.0), 300, 1, "flow_rate", (3.0, 6.0), 4.0),
    "stick-slip": (Rubbing(1.0, 0.3, 0.4), 60, 1, "omega", (0.2, 0.5), 0.305),
    "slip": (Rubbing(2.0, 0.8, 0.4), 60, 1, "omega", (0.6, 0.95), 0.7),
    "soft stop": (soft_scene(), 400, 2, "soft_stops.0.stiffness", (300.0, 600.0), 500.0),
    "capsule": (vi.machines.Capsule(), 300, 1, "gap", (0.3, 0.7), 0.45),
}


@pytest.fixture(scope="module", params=some(CASES, "stick-slip"))
def followed(request):
    """The case and its branch."""
    machine, settle, cycles, name, bounds, value = CASES[request.param]
    settled = vi.simulate(machine, machine.start(), 1, settle=settle).last
    orbit = vi.find_orbit(machine, settled, cycles)
    assert bool(orbit.successful), str(orbit)
    return orbit, vi.continue_orbit(orbit, parameter=name, bounds=bounds), name, value


@pytest.mark.slow
def test_a_branch_agrees_with_a_search(followed):
    """Two ways to an orbit and its multipliers: by the cycle map, whose derivative passes the
    events as they are met, and from event to event, by the saltation matrix."""
    orbit, branch, name, value = followed
    (there,) = branch.at(value)
    parts = name.split(".")
    if parts[0] == "soft_stops":
        machine = eqx.tree_at(
            lambda m: m.soft_stops[0].stiffness, orbit.machine, jnp.asarray(value)
        )
    else:
        machine = eqx.tree_at(lambda m: getattr(m, name), orbit.machine, jnp.asarray(value))
    found = vi.find_orbit(machine, there, int(there.cycles))
    assert bool(found.successful), str(found)
    for a, b in zip(vars(there.state).values(), vars(found.state).values(), strict=True):
        assert float(a) == pytest.approx(float(b), abs=2e-9)
    assert float(there.duration) == pytest.approx(float(found.duration), abs=1e-8)
    assert int(there.impacts) == int(found.impacts)
    assert np.abs(there.multipliers) == pytest.approx(np.abs(found.multipliers), abs=1e-6)
    assert float(there.y_max) == pytest.approx(float(found.y_max), abs=1e-8)


def equilibrium_growth(flow_rate: float) -> float:
    """The greatest real part of the eigenvalues of the open valve's equilibrium."""
    lift = brentq(lambda y: flow_rate - y * np.sqrt(y + 10), 1e-9, 50)
    pressure = lift + 10
    jacobian = np.array([
        [0, 1, 0],
        [-1, -1.25, 1],
        [-20 * np.sqrt(pressure), 0, -20 * lift / (2 * np.sqrt(pressure))],
    ])  # fmt: skip
    return float(np.linalg.eigvals(jacobian).real.max())


def valve_return(state: np.ndarray, flow_rate: float) -> tuple[np.ndarray, float]:
    """SciPy's next maximum of the lift after one, and the smallest lift on the way."""

    def field(_, y):
        return [y[1], -1.25 * y[1] - (y[0] + 10) + y[2], 20 * (flow_rate - y[0] * np.sqrt(y[2]))]

    def seat(_, y):
        return y[0]

    def turn(_, y):
        return y[1]

    seat.terminal, seat.direction = True, -1  # pyright: ignore
    turn.terminal, turn.direction = True, -1  # pyright: ignore
    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "events": (seat, turn)}
    begin, low, y = 1e-6, np.inf, np.array(state, float)
    y = solve_ivp(field, (0, begin), y, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    while True:
        out = solve_ivp(field, (0, 50), y, dense_output=True, **options)
        y = out.y[:, -1].copy()
        t = np.linspace(0, out.t[-1], 20001)
        low = min(low, out.sol(t)[0].min())
        if len(out.t_events[1]):
            return y, low
        y[0], y[1] = 0.0, -0.8 * y[1]


@pytest.mark.exhaustive
def test_the_valve_from_rest_to_chatter():
    """A Hopf bifurcation, a grazing and a period doubling in a row."""
    machine = vi.machines.ReliefValve(flow_rate=8.3)
    settled = vi.simulate(machine, machine.start(), 1, settle=400).last
    orbit = vi.find_orbit(machine, settled)
    branch = vi.continue_orbit(orbit, parameter="flow_rate", bounds=(0.5, 9.5))
    assert branch.ends == ("grazing", "hopf")
    graze, hopf = branch.special
    assert hopf.parameter == pytest.approx(brentq(equilibrium_growth, 8.0, 9.0), abs=1e-11)
    start = np.array([float(x) for x in vars(graze.orbit.state).values()])
    end, low = valve_return(start, graze.parameter)
    # SciPy's dense output finds a maximum to some 1e-8 of time; the pressure gains 150 in a unit.
    assert end == pytest.approx(start, abs=3e-6) and abs(low) < 1e-8

    hitting = vi.continue_orbit(graze.switch(), parameter="flow_rate", bounds=(0.5, 9.5))
    assert hitting.ends == ("bounds", "grazing")
    # The flights of both branches have steps of their own, with 11 digits.
    assert hitting.special[-1].parameter == pytest.approx(graze.parameter, abs=1e-8)
    doubling = next(p for p in hitting.special if p.kind == "period-doubling" and p.parameter > 3)
    state = np.array([float(x) for x in vars(doubling.orbit.state).values()])
    # Across the section: lift and pressure there.
    jacobian = np.zeros((2, 2))
    for k, i in enumerate((0, 2)):
        step = np.zeros(3)
        step[i] = 1e-5
        ends = [valve_return(state + sign * step, doubling.parameter)[0] for sign in (1, -1)]
        jacobian[:, k] = (ends[0] - ends[1])[[0, 2]] / 2e-5
    assert np.linalg.eigvals(jacobian).real.min() == pytest.approx(-1, abs=1e-5)
    doubled = doubling.switch()
    assert int(doubled.cycles) == 2 and bool(doubled.successful)


@pytest.mark.slow
def test_a_flow_has_a_zero_exponent():
    """Along an autonomous motion nothing grows or fades."""
    machine = vi.machines.ReliefValve(flow_rate=5.0)
    settled = vi.simulate(machine, machine.start(), 1, settle=300).last
    found = vi.lyapunov(machine, settled, 400, settle=20)
    assert bool(found.successful)
    assert abs(float(found.exponents[0])) < 1e-4
    orbit = vi.find_orbit(machine, settled)
    slowest = np.log(np.abs(complex(orbit.multipliers[0]))) / float(orbit.duration)
    assert float(found.exponents[1]) == pytest.approx(slowest, abs=1e-3)
    assert float(orbit.trajectory(samples=64).duration.sum()) == pytest.approx(
        float(orbit.duration), abs=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("method", [vi.Adaptive(), vi.Taylor(rtol=1e-12)])
def test_a_branch_refuses_steps_of_no_fixed_length(method):
    """Rather than replacing them."""
    machine = vi.machines.ImpactPair(half_gap=2.0)
    orbit = vi.find_orbit(machine, machine.start(place=-1.137, speed=0.785))
    with pytest.raises(ValueError, match="`method` must be of fixed steps"):
        vi.continue_orbit(orbit, parameter="half_gap", bounds=(1.5, 2.5), method=method)


class Counted(vi.AbstractMethod):
    """A method of one's own, of so many equal steps in a cycle."""

    steps_per_cycle: int = eqx.field(static=True, default=20)  # pyright: ignore

    @property
    def inner(self):
        return vi.FixedStep(steps_per_cycle=self.steps_per_cycle)

    def step(self, smooth, s0, s1, state, beside):
        return self.inner.step(smooth, s0, s1, state, beside)

    def tighter(self):
        return Counted(2 * self.steps_per_cycle)


DUFFING = vi.machines.Duffing(
    amplitude=0.6, frequency=0.7, damping=0.05, stiffness=1.0, cubic=0.3, gap=0.8, restitution=0.6,
)  # fmt: skip


def duffing_orbit(method=None):
    return vi.find_orbit(DUFFING, DUFFING.start(Y=0.709689275, V=0.323053158), method=method)


def followed_by(wanted, orbit, asked=None):
    """Checks that the branch of an orbit is followed by this method, and leads through the orbit
    to rounding."""
    branch = vi.continue_orbit(
        orbit, parameter="frequency", bounds=(0.69, 0.71), max_points=2, method=asked
    )  # fmt: skip
    (same,) = branch.at(0.7)
    assert branch.problem.method == wanted
    assert float(same.state.Y) == pytest.approx(float(orbit.state.Y), abs=1e-12)
    np.testing.assert_allclose(same.multipliers, orbit.multipliers, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("method", [Counted(60), vi.Taylor(20, 40)])
def test_a_branch_takes_any_method_of_fixed_steps(method):
    """One of one's own, and `Taylor` without a tolerance."""
    known = duffing_orbit(vi.FixedStep(steps_per_cycle=60))
    followed_by(method, known, asked=method)


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [pytest.param(Counted(60), marks=pytest.mark.exhaustive), vi.Taylor(20, 40)]
)
def test_a_branch_is_followed_by_the_method_of_its_orbit_if_its_steps_are_fixed(method):
    followed_by(method, duffing_orbit(method))
