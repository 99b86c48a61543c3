"""The DC motor, compared with SciPy, closed forms and the mean torque of a period."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.linalg import expm

from differences import check_derivatives
from event_by_event import followed

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


def random_case(seed):
    """Return random realistic parameters and a start."""
    draw = np.random.default_rng(seed).uniform
    numbers = {
        "strength": draw(0.1, 2.0), "control": draw(0.6, 1.6), "coupling": draw(0.0, 0.1),
        "slider_inertia": draw(0.0, 0.1), "no_load_speed": draw(0.8, 1.3),
        "electrical_time": draw(0.05, 2.0), "xi": draw(0.0, 0.1), "gap": draw(1.05, 2.0),
        "k": draw(0.3, 0.9),
    }  # fmt: skip
    start = {"Y": draw(-1, 1), "V": draw(-1, 1), "W": draw(0.5, 1.2), "M": draw(-0.2, 0.5)}
    return numbers, start


def integrate_with_scipy(n, start, cycles, te):
    """Return the sections and the number of impacts from SciPy's DOP853, for the equations
    L i' + R i + K_e φ' = u and Lagrange's equations, derived here independently."""

    def rates(t, x):
        Y, V, W, M, phi = x
        U, slope, bend = np.cos(phi), -np.sin(phi), -np.cos(phi)
        shaft = M + n["coupling"] * slope * (Y - U) - n["slider_inertia"] * slope * bend * W * W
        steady = n["strength"] * (n["control"] - W / n["no_load_speed"])
        return [
            V, U - Y - 2 * n["xi"] * V, shaft / (1 + n["slider_inertia"] * slope**2),
            (steady - M) / te, W,
        ]  # fmt: skip

    def ends(t, x):
        kept.append(x[:4])
        return None if len(kept) == cycles else x

    kept = []
    contact = lambda t, x: x[0] - n["gap"], lambda t, x: [n["gap"], -n["k"] * x[1], *x[2:]]
    section = lambda t, x: x[4] - 2 * np.pi * (len(kept) + 1), ends
    x = [*start.values(), 0.0]
    _, _, met = followed(rates, x, 1e3, [contact, section], rtol=1e-12, atol=1e-13, max_step=0.1)
    return np.array(kept), met.count(0)


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["phase", "time"])
def test_sections_match_scipy(clock):
    cases, cycles = [random_case(seed) for seed in range(16)], 5
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
        wanted, impacts = integrate_with_scipy(numbers, start, cycles, numbers["electrical_time"])
        np.testing.assert_allclose(found[i], wanted, atol=1e-9)
        assert int(run.impacts[i].sum()) == impacts
        several += impacts
    assert several > 40


@pytest.mark.parametrize("te", [0.1, 4.0], ids=["overdamped", "swinging"])
def test_start_from_rest_matches_closed_form(te):
    """Without a load, speed and current satisfy two linear equations."""
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
def test_derivatives_match_differences():
    """Derivatives with respect to the electrical time, the control and the starting torque."""

    def last(values):
        scene = machine(electrical_time=values[0], control=values[1])
        start = scene.start(Y=0.4, W=0.7, M=values[2])
        run = vi.simulate(scene, start, 3, method=vi.FixedStep(steps_per_cycle=24),
            record="sections", rests=False,
        )  # fmt: skip
        return run.last, run.impacts

    check_derivatives(last, [0.4, 0.9, 0.1], tolerance=1e-7, impacts=2)


def test_scene_from_parameters_in_si_units():
    table = vi.Parameters(torque=10.0, control=0.9, electrical_time=0.01)
    scene = table.scene()
    assert isinstance(scene.drive, vi.DCMotor)
    assert float(scene.drive.electrical_time) == pytest.approx(0.15930782, abs=5e-9)
    plain = vi.Parameters(torque=10.0, control=0.9).scene()
    assert type(plain.drive) is vi.Motor
    assert float(scene.drive.strength) == float(plain.drive.strength)
    assert isinstance(vi.Parameters(electrical_time=0.01).scene(drive="ideal").drive, vi.IdealDrive)


@pytest.mark.slow
def test_starts():
    scene = machine()
    assert isinstance(scene.start(), vi.DCMotorState)
    assert float(scene.start().M) == 0.0  # at no load
    assert float(scene.start(W=0.0).M) == pytest.approx(0.65 * 0.9)
    timed = scene.in_clock("time")
    assert isinstance(timed.start(), vi.TimedDCMotorState)
    assert isinstance(timed.convert_start(scene.start()), vi.TimedDCMotorState)
    plain = vi.Parameters().scene()
    with pytest.raises(TypeError, match=r"must be a `DCMotorState`.*got a `MotorState`"):
        vi.simulate(scene, plain.start(), 1)
    with pytest.raises(ValueError, match=r"`M` must be left out: only a `DCMotor`"):
        plain.start(M=0.1)
    with pytest.raises(ValueError, match=r"`electrical_time`.*\(0, inf\).*0"):
        vi.DCMotor(0.65, 0.9, 0.0093, 0.0053, electrical_time=0.0)
    with pytest.raises(ValueError, match=r"`electrical_time`"):
        vi.Parameters(electrical_time=-1.0)
