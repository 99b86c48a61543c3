"""A motor with an unbalance: SciPy, the averaged Sommerfeld response, energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

ROTOR = vi.machines.UnbalancedRotor
METHOD = vi.Adaptive(rtol=1e-12)


def integrated(n, start, cycles, sides):
    """The sections (Y, V, W) by SciPy's DOP853 in time, and the number of impacts.

    The two equations are solved as a linear system with the mass matrix, and the jerk of an impact
    by the same matrix: the stop's push has no moment about the shaft.
    """

    def mass(phi):
        return np.array([[1.0, -np.sin(phi)], [-n["coupling"] * np.sin(phi), 1.0]])

    def rates(t, x):
        Y, V, W, phi = x
        motor = n["strength"] * (n["control"] - W / n["no_load_speed"])
        force = W * W * np.cos(phi) - Y - 2 * n["damping_ratio"] * V
        return [V, *np.linalg.solve(mass(phi), [force, motor]), W]

    def section(t, x):
        return x[3] - 2 * np.pi * (len(kept) + 1)

    events = [section]
    for sign in sides:

        def contact(t, x, sign=sign):
            return sign * x[0] - n["gap"]

        events.append(contact)
    for event in events:
        event.terminal, event.direction = True, 1
    x, t, kept, impacts = np.array([*start, 0.0]), 0.0, [], 0
    while len(kept) < cycles:
        found = solve_ivp(
            rates, (t, t + 1e3), x, "DOP853", rtol=1e-12, atol=1e-13, max_step=0.1, events=events
        )
        t, x = found.t[-1], found.y[:, -1].copy()
        if found.t_events[0].size:
            kept.append(x[:3].copy())
            continue
        impacts += 1
        # M dV = push; dW follows from the second row, on which nothing pushes.
        gained = -(1 + n["restitution"]) * x[1]
        x[1] += gained
        x[2] += n["coupling"] * np.sin(x[3]) * gained
    return np.array(kept), impacts


def drawn(seed):
    draw = np.random.default_rng(seed).uniform
    numbers = {
        "strength": draw(0.05, 1.0), "control": draw(0.6, 1.8), "no_load_speed": draw(0.8, 1.2),
        "coupling": draw(0.0, 0.3), "damping_ratio": draw(0.01, 0.2), "gap": draw(1.0, 2.5),
        "restitution": draw(0.3, 0.9),
    }  # fmt: skip
    return numbers, (draw(-0.8, 0.8), draw(-0.5, 0.5), draw(0.7, 1.3))


@pytest.mark.slow
@pytest.mark.parametrize("clock", ["phase", "time"])
@pytest.mark.parametrize("sides", [(), (1,), (1, -1)], ids=["free", "one stop", "two stops"])
def test_beside_scipy(clock, sides):
    cases, cycles = [drawn(seed) for seed in range(12)], 4
    names = list(cases[0][0])
    columns = [jnp.asarray([n[name] for n, _ in cases]) for name in names]
    starts = jnp.asarray([start for _, start in cases])

    def lane(start, *values):
        n = dict(zip(names, values, strict=True))
        if not sides:
            n.pop("gap")
        rotor = ROTOR(**n, two_sided=len(sides) == 2, clock_name=clock)
        begin = rotor.start(Y=start[0], V=start[1], W=start[2])
        return vi.simulate(rotor, begin, cycles, method=METHOD)

    run = vi.jit(jax.vmap(lane))(starts, *columns)
    assert bool(run.successful.all())
    assert run.rests is None or not int(run.rests.sum())
    found = np.stack([run.sections.Y, run.sections.V, run.sections.P], axis=-1)[:, 1:]
    several = 0
    for i, (numbers, start) in enumerate(cases):
        wanted, impacts = integrated(numbers, start, cycles, sides)
        np.testing.assert_allclose(found[i], wanted, atol=1e-9)
        assert int(run.impacts[i].sum()) == impacts
        several += impacts
    assert several > 20 or not sides


def test_it_runs_as_it_is():
    rotor = ROTOR()
    run = vi.simulate(rotor, rotor.start(), 30)
    assert bool(run.successful) and not rotor.stops
    assert float(run.frequency_ratio[-1]) == pytest.approx(0.87, abs=0.02)


@pytest.mark.slow
def test_the_sommerfeld_response_is_that_of_averaging_to_its_order():
    """Mean speed and amplitude beside the averaged ones, as ε and the motor's strength fall
    together, which leaves the averaged response as it is."""
    couplings = jnp.asarray([0.005, 0.0025, 0.00125, 0.000625])
    # On the rising side, near the peak, and beyond it.
    for zeta in (0.85, 0.98, 1.15):
        rotor = ROTOR(strength=0.2, coupling=0.02)
        kappa = rotor.averaged_control(zeta)
        reach = zeta**2 / ((1 - zeta**2) + 0.1j * zeta)

        def error(coupling, kappa=kappa, zeta=zeta, reach=reach):
            weak = ROTOR(strength=10 * coupling, control=kappa, coupling=coupling)
            guess = weak.start(Y=reach.real, V=-zeta * reach.imag, W=zeta)
            orbit = vi.find_orbit(weak, guess)
            return orbit.frequency_ratio - zeta, orbit.y_max - abs(reach), orbit.successful

        speed, amplitude, good = jax.vmap(error)(couplings)
        assert bool(good.all())
        order, _ = np.polyfit(np.log(couplings), np.log(np.abs(speed)), 1)
        assert order == pytest.approx(1.0, abs=0.1) and abs(float(speed[-1])) < 1e-4
        assert abs(float(amplitude[-1])) < 1e-3 * abs(reach)


@pytest.mark.slow
def test_a_weak_motor_jumps_where_the_averaged_line_folds():
    rotor = ROTOR(strength=0.02, coupling=0.002)
    speeds = np.linspace(0.5, 2.5, 200_001)
    kappa = np.asarray(rotor.averaged_control(speeds))
    falls = np.flatnonzero(np.diff(kappa) < 0)
    peak, trough = kappa[falls[0]], kappa[falls[-1] + 1]
    reach = 0.8**2 / (1 - 0.8**2 + 0.08j)
    guess = rotor.start(Y=reach.real, V=-0.8 * reach.imag, W=0.8)
    rotor = eqx.tree_at(lambda r: r.control, rotor, rotor.averaged_control(0.8))
    orbit = vi.find_orbit(rotor, guess, throw=True)
    branch = vi.continue_orbit(orbit, parameter="control", bounds=(0.7, 2.0))
    up, down = sorted((p.parameter for p in branch.special if p.kind == "fold"), reverse=True)
    assert up == pytest.approx(peak, rel=5e-3) and down == pytest.approx(trough, rel=5e-3)


@pytest.mark.parametrize("clock", ["phase", "time"])
def test_energy_is_kept_but_for_what_an_impact_takes(clock):
    rotor = ROTOR(
        strength=0.0, damping_ratio=0.0, coupling=0.2, gap=1.2, restitution=0.8, two_sided=True,
        clock_name=clock,
    )  # fmt: skip
    eps = 0.2

    def energy(state):  # on the section the coupling term is zero
        return state.V**2 / 2 + state.Y**2 / 2 + state.P**2 / (2 * eps)

    start = rotor.start(Y=0.9, V=0.7, W=0.8)
    run = vi.simulate(rotor, start, 12, method=METHOD, impact_log=6)
    assert bool(run.successful) and int(run.impacts.sum()) >= 6
    speed, phase = (np.asarray(x) for x in (run.impact_log.speed, run.impact_log.phase))
    lost = np.nansum(0.5 * (1 - 0.8**2) * (1 - eps * np.sin(phase) ** 2) * speed**2)
    assert float(energy(start) - energy(run.last)) == pytest.approx(lost, abs=1e-10)
    assert lost > 0.1


def test_an_elastic_impact_keeps_all():
    rotor = ROTOR(strength=0.0, damping_ratio=0.0, coupling=0.2, gap=1.0, restitution=1.0)
    run = vi.simulate(rotor, rotor.start(Y=0.9, V=0.7, W=1.2), 16, method=METHOD, clock="time")
    state = run.sections
    energy = state.V**2 / 2 + state.Y**2 / 2 + state.P**2 / 0.4
    assert int(run.impacts.sum()) > 10
    np.testing.assert_allclose(energy, energy[0], rtol=1e-10)


@pytest.mark.slow
def test_a_start_from_rest_and_a_stall():
    rotor = ROTOR(control=1.2, strength=0.3)
    with pytest.raises(ValueError, match=r"W > 0 in the phase clock.*W = 0"):
        vi.simulate(rotor, rotor.start(W=0.0), 2)
    run = vi.simulate(rotor, rotor.start(W=0.0), 60, clock="time")
    assert bool(run.successful)
    assert float(run.duration[0]) > 1.5 * float(run.duration[-1])
    slack = ROTOR(control=-0.5, strength=0.3)
    for method in (vi.Adaptive(), vi.FixedStep()):
        stalled = vi.simulate(slack, slack.start(W=0.5), 20, method=method)
        assert bool(stalled.result == vi.RESULTS.stalled)


@pytest.mark.slow
def test_a_body_pressed_on_comes_to_rest_and_leaves():
    """The unbalance presses the body on while W² cos φ exceeds the gap; in both clocks."""
    rotor = ROTOR(
        control=1.2, strength=2.0, gap=0.1, restitution=0.1, coupling=0.1, damping_ratio=0.6
    )
    method = vi.Adaptive(rtol=1e-11)
    start = rotor.start(Y=0.0, V=0.1)
    phase, time = (vi.simulate(rotor, start, 8, clock=c, method=method) for c in ("phase", "time"))
    assert int(phase.rests.sum()) > 4
    np.testing.assert_array_equal(phase.rests, time.rests)
    for name in "YVP":
        a, b = getattr(phase.sections, name), getattr(time.sections, name)
        np.testing.assert_allclose(a, b, atol=1e-7)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ROTOR(coupling=1.0), r"`coupling`.*\[0, 1\).*1"),
        (lambda: ROTOR(strength=-1.0), "`strength`"),
        (lambda: ROTOR(no_load_speed=0.0), "`no_load_speed`"),
        (lambda: ROTOR(gap=0.0), "`gap`"),
        (lambda: ROTOR(restitution=1.5), "`restitution`"),
        (lambda: ROTOR(damping_ratio=-0.1), "`damping_ratio`"),
        (lambda: ROTOR(control=float("nan")), "`control`"),
        (lambda: ROTOR(clock_name="wall"), "`clock_name`"),
        (lambda: ROTOR().in_clock("wall"), "`clock`"),
        (lambda: ROTOR().start(Y=float("inf")), "`Y`"),
    ],
)
def test_wrong_numbers_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
def test_an_orbit_of_the_time_clock_is_that_of_the_angle():
    """A search takes the machine by its angle, and states that were made for either clock."""
    timed = ROTOR(clock_name="time")
    settled = vi.simulate(timed, timed.start(), 1, settle=300, record="sections").last
    by_time = vi.find_orbit(timed, settled)
    by_angle = vi.find_orbit(ROTOR(), ROTOR().start())
    assert bool(by_time.stable) and bool(by_angle.stable)
    for name in "YVP":
        values = [float(getattr(x, name)) for x in (settled, by_time.state, by_angle.state)]
        assert values == pytest.approx(values[:1] * 3, abs=1e-6)
    midway = eqx.tree_at(lambda x: x.phase, settled, jnp.asarray(1.3))
    with pytest.raises(ValueError, match=r"`guess` must lie on the section, .* but has 1.3"):
        vi.find_orbit(timed, midway)


def test_a_start_of_another_kind_is_refused():
    rotor = ROTOR()
    with pytest.raises(TypeError, match=r"must be a `RotorState`.*got a `OscillatorState`"):
        vi.simulate(rotor, vi.Scene.ideal(frequency_ratio=0.9).start(), 1)
