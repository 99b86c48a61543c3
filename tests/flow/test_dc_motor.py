"""A motor with its armature: SciPy, closed forms, the limit without inductance, energy, verbs."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from differences import check_derivatives

NUMBERS = {
    "strength": 0.65, "control": 0.9, "coupling": 0.0093, "slider_inertia": 0.0053,
    "no_load_speed": 1.1, "electrical_time": 0.4,
}  # fmt: skip
XI, GAP, K = 0.0448, 2.0, 0.6


def machine(clock="phase", stops=None, xi=XI, crank=None, **numbers):
    return vi.Scene(
        oscillator=vi.Oscillator(xi),
        drive=vi.DCMotor(**{**NUMBERS, **numbers}),
        stops=(vi.RigidStop(GAP, K),) if stops is None else stops,
        crank=crank or vi.CosineCrank(),
        clock_name=clock,
    )


def drawn(seed):
    """A machine and its start, of numbers such as one meets."""
    draw = np.random.default_rng(seed).uniform
    numbers = {
        "strength": draw(0.1, 2.0), "control": draw(0.6, 1.6), "coupling": draw(0.0, 0.1),
        "slider_inertia": draw(0.0, 0.1), "no_load_speed": draw(0.8, 1.3),
        "electrical_time": draw(0.05, 2.0), "xi": draw(0.0, 0.1), "gap": draw(1.05, 2.0),
        "k": draw(0.3, 0.9),
    }  # fmt: skip
    start = {"Y": draw(-1, 1), "V": draw(-1, 1), "W": draw(0.5, 1.2), "M": draw(-0.2, 0.5)}
    return numbers, start


def integrated(n, start, cycles, te):
    """The sections by SciPy's DOP853 in time, from L i' + R i + K_e φ' = u and Lagrange's
    equations, written out again here; and the number of impacts."""

    def rates(t, x):
        Y, V, W, M, phi = x
        U, slope, bend = np.cos(phi), -np.sin(phi), -np.cos(phi)
        shaft = M + n["coupling"] * slope * (Y - U) - n["slider_inertia"] * slope * bend * W * W
        steady = n["strength"] * (n["control"] - W / n["no_load_speed"])
        return [
            V, U - Y - 2 * n["xi"] * V, shaft / (1 + n["slider_inertia"] * slope**2),
            (steady - M) / te, W,
        ]  # fmt: skip

    def contact(t, x):
        return x[0] - n["gap"]

    def section(t, x):
        return x[4] - 2 * np.pi * (len(kept) + 1)

    contact.terminal = section.terminal = True
    contact.direction = section.direction = 1
    x, kept, impacts = np.array([*start.values(), 0.0]), [], 0
    while len(kept) < cycles:
        found = solve_ivp(
            rates, (0, 1e3), x, "DOP853", rtol=1e-12, atol=1e-13, max_step=0.1,
            events=(contact, section),
        )  # fmt: skip
        x = found.y[:, -1].copy()
        if found.t_events[0].size:
            x[:2] = n["gap"], -n["k"] * x[1]
            impacts += 1
        else:
            kept.append(x[:4].copy())
    return np.array(kept), impacts


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["phase", "time"])
def test_beside_scipy(clock):
    cases, cycles = [drawn(seed) for seed in range(16)], 5
    columns = [jnp.asarray([c[i][name] for c in cases]) for i in (0, 1) for name in cases[0][i]]
    names = list(cases[0][0])

    def lane(*values):
        n, start = dict(zip(names, values, strict=False)), values[len(names) :]
        stop = (vi.RigidStop(n.pop("gap"), n.pop("k")),)
        scene = machine(clock, stop, n.pop("xi"), **n)
        begin = scene.start(**dict(zip("YVWM", start, strict=True)))
        return vi.simulate(scene, begin, cycles, method=vi.Adaptive(rtol=1e-12))

    run = vi.jit(jax.vmap(lane))(*columns)
    assert bool(run.successful.all())
    found = np.stack([getattr(run.sections, name)[:, 1:] for name in "YVWM"], axis=-1)
    several = 0
    for i, (numbers, start) in enumerate(cases):
        wanted, impacts = integrated(numbers, start, cycles, numbers["electrical_time"])
        np.testing.assert_allclose(found[i], wanted, atol=1e-9)
        assert int(run.impacts[i].sum()) == impacts
        several += impacts
    assert several > 40


@pytest.mark.parametrize("te", [0.1, 4.0], ids=["overdamped", "swinging"])
def test_a_run_up_from_rest_as_in_closed_form(te):
    """Without load speed and current are a linear system of two equations."""
    scene = machine("time", stops=(), coupling=0.0, slider_inertia=0.0, electrical_time=te)
    start = scene.start(W=0.0, M=0.0)
    run = vi.simulate(scene, start, 3, method=vi.Adaptive(rtol=1e-12), samples=8)
    tau, kappa, free = (NUMBERS[x] for x in ("strength", "control", "no_load_speed"))
    rates = np.array([[0, 1], [-tau / free / te, -1 / te]])
    steady = np.array([kappa * free, 0.0])
    wanted = np.array([steady - expm(rates * float(t)) @ steady for t in run.samples.time])
    np.testing.assert_allclose(run.samples.state.W, wanted[:, 0], atol=1e-10)
    np.testing.assert_allclose(run.samples.state.M, wanted[:, 1], atol=1e-10)
    assert (float(run.samples.state.W.max()) > 1.1 * kappa * free) == (te > 1)


@pytest.mark.slow
def test_with_less_and_less_inductance_it_is_the_straight_line():
    times, cycles = jnp.geomspace(0.01, 0.001, 5), 6
    plain = {name: x for name, x in NUMBERS.items() if name != "electrical_time"}
    scene = machine()
    line = eqx.tree_at(lambda s: s.drive, scene, vi.Motor(**plain))
    start = {"Y": 0.4, "V": 0.1, "W": 0.7}
    method = vi.Adaptive(rtol=1e-12)
    limit = vi.simulate(line, line.start(**start), cycles, method=method)
    assert int(limit.impacts.sum()) > 2

    def last(time):
        lagging = machine(electrical_time=time)
        return vi.simulate(lagging, lagging.start(**start), cycles, method=method).last

    found = vi.jit(jax.vmap(last))(times)
    for name in "YVW":
        apart = np.abs(np.asarray(getattr(found, name)) - float(getattr(limit.last, name)))
        order, _ = np.polyfit(np.log(np.asarray(times)), np.log(apart), 1)
        assert order == pytest.approx(1.0, abs=0.05), name


@pytest.mark.slow
@pytest.mark.parametrize("crank", [vi.CosineCrank(), vi.SliderCrank(1 / 3)], ids=["cos", "slider"])
def test_clocks_agree(crank):
    scene = machine(crank=crank)
    start, method = scene.start(Y=0.2, W=0.8, M=0.1), vi.Adaptive(rtol=1e-12)
    phase, time = (vi.simulate(scene, start, 20, method=method, clock=c) for c in ("phase", "time"))
    for name in ("Y", "V", "W", "M"):
        a, b = getattr(phase.sections, name), getattr(time.sections, name)
        np.testing.assert_allclose(a, b, atol=1e-9)
    np.testing.assert_array_equal(phase.impacts, time.impacts)
    assert int(phase.impacts.sum()) > 10


class Books(eqx.Module):
    """A state beside what was supplied and lost on the way to it (unit: J ω²)."""

    state: Any
    supplied: Any
    heat: Any
    damped: Any


class Booked(vi.AbstractMachine):
    """A scene that keeps books of its energy."""

    scene: vi.Scene

    @property
    def stops(self):
        return self.scene.stops

    @property
    def cycle(self):
        return self.scene.cycle

    def field(self, s, books):
        state, drive = books.state, self.scene.drive
        pace = self.scene.pace(s, state)
        pace = 1.0 if pace is None else pace
        supplied = drive.control * drive.no_load_speed * state.M
        heat = state.M**2 * drive.no_load_speed / drive.strength
        damped = drive.coupling * 2 * self.scene.damping_ratio * state.V**2
        return Books(self.scene.field(s, state), pace * supplied, pace * heat, pace * damped)

    def position(self, books):
        return books.state.Y

    def velocity(self, books):
        return books.state.V

    def placed(self, books, Y, V):
        return eqx.tree_at(lambda b: b.state, books, self.scene.placed(books.state, Y, V))

    def clock(self, books):
        return self.scene.clock(books.state)

    def rewound(self, books):
        return eqx.tree_at(lambda b: b.state, books, self.scene.rewound(books.state))


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["phase", "time"])
def test_energy_is_accounted_for(clock):
    scene = machine(clock, coupling=0.05, electrical_time=0.8)
    drive = scene.drive

    def stored(state, phase=0.0):
        slide = scene.crank.slide(jnp.asarray(phase))
        body = (state.V**2 + (state.Y - slide.U) ** 2) / 2 * drive.coupling
        shaft = drive.inertia(slide) * state.W**2 / 2
        return (
            body
            + shaft
            + drive.electrical_time * state.M**2 * drive.no_load_speed / (2 * drive.strength)
        )

    books = Books(scene.start(Y=0.4, W=0.7, M=0.0), *jnp.zeros(3))
    run = vi.simulate(Booked(scene), books, 40, method=vi.Adaptive(rtol=1e-12))
    assert bool(run.successful) and int(run.impacts.sum()) > 20
    last = run.last
    lost = drive.coupling * run.impact_energy.sum()
    balance = last.supplied - last.heat - last.damped - lost
    change = stored(last.state) - stored(books.state)
    assert float(last.supplied) > 1 and float(lost) > 0.1 and abs(float(change)) > 0.01
    assert float(balance - change) == pytest.approx(0.0, abs=1e-10)


@pytest.mark.slow
def test_derivatives_beside_differences():
    """By an electrical, a mechanical and a starting number at once."""

    def last(values):
        scene = machine(electrical_time=values[0], control=values[1])
        start = scene.start(Y=0.4, W=0.7, M=values[2])
        run = vi.simulate(scene, start, 3, method=vi.FixedStep(steps_per_cycle=24),
            record="sections", rests=False,
        )  # fmt: skip
        return run.last, run.impacts

    check_derivatives(last, [0.4, 0.9, 0.1], tolerance=1e-7, impacts=2)


def test_a_stall_points_to_the_time_clock():
    scene = machine(control=-0.5)
    run = vi.simulate(scene, scene.start(V=0.5, W=0.5, M=0.0), 20)
    assert bool(run.result == vi.RESULTS.stalled)
    with pytest.raises(ValueError, match=r"W > 0 in the phase clock"):
        vi.simulate(scene, scene.start(W=0.0, M=0.0), 2)


@pytest.mark.slow
@pytest.mark.parametrize("te", [0.004, 0.3, 30.0])
def test_fixed_steps_stay_stable(te):
    """However fast the current settles, or however slowly it swings with the shaft."""
    scene = machine(electrical_time=te, strength=5.0)
    run = vi.simulate(scene, scene.start(W=0.9), 4)
    exact = vi.simulate(scene, scene.start(W=0.9), 4, method=vi.Adaptive(rtol=1e-12))
    np.testing.assert_allclose(run.last.M, exact.last.M, atol=1e-6)
    np.testing.assert_allclose(run.last.Y, exact.last.Y, atol=1e-6)


@pytest.mark.slow
def test_periodic_motions_and_what_follows_from_them():
    scene = machine()
    settled = vi.simulate(scene, scene.start(Y=1.5, V=1.0), 1, settle=300).last
    orbit = vi.find_orbit(scene, settled, throw=True)
    assert bool(orbit.stable) and orbit.multipliers.shape == (4,)
    # Where there is no chaos, exponents are the multipliers' logarithms.
    spectrum = vi.lyapunov(scene, orbit.state, cycles=96)
    growth = np.sort(np.log(np.abs(orbit.multipliers)))[::-1] / float(orbit.duration)
    np.testing.assert_allclose(spectrum.exponents, growth, atol=2e-3)
    timed = vi.lyapunov(scene, scene.in_clock("time").adopt(orbit.state), cycles=96)
    np.testing.assert_array_equal(timed.exponents, spectrum.exponents)
    # The motor's mean torque pays for the mean load: over a period the armature keeps nothing.
    run = orbit.trajectory(samples=256)
    drive, state = scene.drive, run.samples.state
    mean = float(np.trapezoid(np.asarray(state.M), np.asarray(run.samples.time)))
    steady = float(drive.strength) * (
        float(drive.control) - float(orbit.frequency_ratio) / float(drive.no_load_speed)
    )
    assert mean / float(orbit.duration) == pytest.approx(steady, rel=1e-4)
    branch = vi.continue_orbit(orbit, parameter="drive.electrical_time", bounds=(0.2, 1.0))
    assert branch.parameter.min() == pytest.approx(0.2) and branch.parameter.max() > 0.99


@pytest.mark.slow
def test_grids_and_sweeps():
    scene = machine()
    data = vi.scan(
        scene, {"drive.electrical_time": [0.2, 0.5], "start.M": [0.0, 0.1]}, settle=50, cycles=128,
        measure=["regime", "extremes"],
    )  # fmt: skip
    assert (np.asarray(data["period"]) == 1).all()
    swept = vi.sweep(scene, "drive.control", np.linspace(0.8, 0.9, 3), settle=50, cycles=8)
    assert bool(np.isfinite(np.asarray(swept.y_min)).all())


def test_from_numbers_in_si():
    table = vi.Parameters(torque=10.0, control=0.9, electrical_time=0.01)
    scene = table.scene()
    assert isinstance(scene.drive, vi.DCMotor)
    assert float(scene.drive.electrical_time) == pytest.approx(0.15930782, abs=5e-9)
    plain = vi.Parameters(torque=10.0, control=0.9).scene()
    assert type(plain.drive) is vi.Motor
    assert float(scene.drive.strength) == float(plain.drive.strength)
    assert isinstance(vi.Parameters(electrical_time=0.01).scene(drive="ideal").drive, vi.IdealDrive)


def test_starts():
    scene = machine()
    assert isinstance(scene.start(), vi.DCMotorState)
    assert float(scene.start().M) == 0.0  # at no load
    assert float(scene.start(W=0.0).M) == pytest.approx(0.65 * 0.9)
    timed = scene.in_clock("time")
    assert isinstance(timed.start(), vi.TimedDCMotorState)
    assert isinstance(timed.adopt(scene.start()), vi.TimedDCMotorState)
    plain = vi.Parameters().scene()
    with pytest.raises(TypeError, match=r"must be a `DCMotorState`.*got a `MotorState`"):
        vi.simulate(scene, plain.start(), 1)
    with pytest.raises(ValueError, match=r"`M` must be left out: only a `DCMotor`"):
        plain.start(M=0.1)
    with pytest.raises(ValueError, match=r"`electrical_time`.*\(0, inf\).*0"):
        vi.DCMotor(0.65, 0.9, 0.0093, 0.0053, electrical_time=0.0)
    with pytest.raises(ValueError, match=r"`electrical_time`"):
        vi.Parameters(electrical_time=-1.0)
