"""Simultaneous events, chains of events, guards that jump, and events that change a mode."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

CLOSE = vi.Adaptive(rtol=1e-11)


def pick(machine, *cases):
    return jnp.stack([jnp.asarray(x, float) for x in cases])[machine.case]


P = 0.7
CASES = ("end of the cycle", "set off", "set off back", "same guard", "jump", "clock", "for ever")


class Cases(vi.AbstractMachine):
    """A field and two resets, all chosen by the number `case`."""

    case: Any
    p: Any = P
    cycle: float = 5.0

    @property
    def events(self):
        def first(m, s, z):
            jumps = jnp.where(z.x > np.sqrt(2), 1.0, -1.0)
            return pick(m, s - 5, s - 0.5, z.x - 1, z.x - 1, jumps, 2 - s, z.x - 1)

        def moved(m, s, z):
            x = z.x
            return dict(x=pick(m, x + 1, x + 2, 2 * x, 0 * x, x - 1, x, -3 * x))

        def second(m, s, z):
            x = z.x
            return pick(m, s - 5, x - 1, x - 1.5, x - 1, -1 - x, -1 - x, -x)

        def counted(m, s, z):
            x, n = z.x, z.n
            return dict(x=pick(m, x, x, -x, x, x, x, -x), n=n + pick(m, 1, 1, x, 1, 1, 1, 1))

        return vi.Reset(first, moved), vi.Reset(second, counted)

    def field(self, s, z):
        still, p = 0 * z.x, self.p + 0 * z.x
        return dict(
            x=pick(self, -z.x, still, p, p, p, p, p),
            n=pick(self, -z.n, still, z.x, still, still, z.x, still),
        )


@pytest.fixture(scope="module")
def cases():
    """Simulate each case for three cycles, with derivatives with respect to p."""

    def run(p):
        return jax.vmap(
            lambda case: vi.simulate(
                Cases(case, p), vi.State(x=0.0, n=0.0), 3, event_log=4, method=CLOSE
            )
        )(jnp.arange(len(CASES)))

    return jax.jvp(run, (jnp.asarray(P),), (jnp.asarray(1.0),))


def select_case(cases, name):
    """Return the states on the sections after the start, their derivatives, and the run."""
    run, slope = (jax.tree.map(lambda x: x[CASES.index(name)], y) for y in cases)
    return *((y.sections.x[1:], y.sections.n[1:]) for y in (run, slope)), run


def test_two_events_at_the_end_of_a_cycle(cases):
    (x, n), _, run = select_case(cases, "end of the cycle")
    shares = np.cumsum(np.exp(-5.0) ** np.arange(3))
    np.testing.assert_allclose([x, n], [shares, shares], rtol=1e-10)
    assert run.event_log.number[:, :3].tolist() == [[0, 1, -1]] * 3


def test_event_triggers_another_once(cases):
    (x, n), _, run = select_case(cases, "set off")
    np.testing.assert_allclose([x, n], [[2, 4, 6], [1, 1, 1]], rtol=1e-14)
    assert run.event_log.number[0, :3].tolist() == [0, 1, -1]


def test_derivatives_pass_through_an_event_that_another_triggers(cases):
    """At t = 1/p, x jumps from 1 to 2, n grows by 2, and x becomes -2: 1/2p + 2 + ∫(pt - 3)dt."""
    (x, n), (dx, dn), _ = select_case(cases, "set off back")
    np.testing.assert_allclose([x[0], n[0]], [5 * P - 3, 12.5 * P + 3 / P - 13], rtol=1e-10)
    np.testing.assert_allclose([dx[0], dn[0]], [5.0, 12.5 - 3 / P**2], rtol=1e-9)


def test_two_events_with_the_same_guard_both_happen(cases):
    """The second happens although the first has already made the guard negative."""
    (x, n), _, _ = select_case(cases, "same guard")
    way = 5 * P * np.arange(1, 4)
    np.testing.assert_allclose([x, n], [way % 1, way // 1], atol=1e-9)


def test_guard_that_jumps_is_located(cases):
    (x, n), _, run = select_case(cases, "jump")
    way = 5 * P * np.arange(1, 4)
    times = np.ceil(way - np.sqrt(2))
    np.testing.assert_allclose([x, n], [way - times, 0 * way], atol=1e-10)
    clock = [(np.sqrt(2) + k) / P for k in range(3)]
    np.testing.assert_allclose(run.event_log.phase[0, :3], clock, atol=1e-10)


def test_restart_of_the_clock_triggers_a_guard(cases):
    """The guard 2 - s jumps from -3 to 2 at the start of each cycle but the first."""
    _, _, run = select_case(cases, "clock")
    assert run.event_log.number[:, 0].tolist() == [-1, 0, 0]
    np.testing.assert_array_equal(run.event_log.phase[1:, 0], 0.0)


def test_endless_chain_of_events_fails_the_lane(cases):
    assert bool(select_case(cases, "for ever")[-1].result == vi.RESULTS.simultaneous)
    assert int(cases[0].successful.sum()) == len(CASES) - 1


class Furnace(vi.AbstractMachine):
    """A furnace, off above 296 and on below 294: T' = -2 (T - 285) + 25 if on."""

    cycle: float = 1.0
    events: tuple = (
        vi.Reset(lambda m, s, T, on: 294 - T[0], lambda m, s, T, on: T, modes=lambda *_: (1.0,)),
        vi.Reset(lambda m, s, T, on: T[0] - 296, lambda m, s, T, on: T, modes=lambda *_: (0.0,)),
    )

    def modes(self, s, T):
        return (0.0,)

    def field(self, s, T, on):
        return (25 * on - 2 * (T[0] - 285),)


def heated(T, time):
    """Return the temperature from the closed form between the thresholds."""
    on = T < 294
    while True:
        limit, edge = (297.5, 296.0) if on else (285.0, 294.0)
        away = (edge - limit) / (T - limit)
        wait = -np.log(away) / 2 if 0 < away < 1 else np.inf
        if wait >= time:
            return limit + (T - limit) * np.exp(-2 * time)
        T, time, on = edge, time - wait, not on


def test_a_furnace_with_two_thresholds():
    begins = np.array([300.0, 295.0, 296.5, 310.0])
    runs = [
        jax.vmap(lambda T, m=m: vi.simulate(Furnace(), (T,), 4, method=m))(jnp.asarray(begins))
        for m in (CLOSE, vi.FixedStep(steps_per_cycle=40))
    ]
    for run in runs:
        assert bool(run.successful.all())
        np.testing.assert_allclose(run.last[0], [heated(T, 4) for T in begins], rtol=1e-11)
    assert heated(300.0, 4) == pytest.approx(294.497730558, abs=1e-9)
    np.testing.assert_allclose(runs[0].y_max[:, 2:], 296.0, rtol=1e-12)  # switched off there


@pytest.mark.slow
def test_last_state_keeps_its_modes():
    """Compare runs of one cycle with a long run. Between the thresholds both modes are possible."""
    furnace = Furnace(cycle=0.37)
    whole = vi.simulate(furnace, (jnp.asarray(300.0),), 12, method=CLOSE)
    state, found = (jnp.asarray(300.0),), []
    for _ in range(12):
        state = vi.simulate(furnace, state, 1, method=CLOSE).last
        found.append(float(state[0]))
    np.testing.assert_allclose(found, whole.sections[0][1:], rtol=1e-13)
    np.testing.assert_allclose(found[-1], heated(300.0, 12 * 0.37), rtol=1e-11)
    assert state.modes == (whole.modes[0][-1],)
    with pytest.raises(ValueError, match="1 mode, a number each"):
        vi.simulate(furnace, vi.HybridState((jnp.asarray(300.0),), (0.0, 1.0)), 1)


class Wave(vi.AbstractMachine):
    """x' = ±1 - κx; the sign changes at s = 5, and back as the next cycle begins."""

    decay: Any = 0.0
    cycle: float = 10.0
    events = vi.Switch(lambda m, s, x: s - 5)

    def field(self, s, x, side):
        return (jnp.where(side > 0, 1.0, -1.0) - self.decay * x[0],)


def test_a_rate_that_changes_its_sign_with_a_mode():
    run = jax.vmap(lambda k: vi.simulate(Wave(k), (0 * k,), 3, method=CLOSE))(jnp.array([0.0, 0.3]))
    fades = np.exp(-0.3 * 5)
    x, level = [0.0], 1 / 0.3
    for _ in range(3):
        half = -level + (x[-1] + level) * fades
        x.append(level + (half - level) * fades)
    np.testing.assert_allclose(run.sections[0], [np.zeros(4), x], atol=1e-9)
    np.testing.assert_allclose(run.y_min[0], -5.0, rtol=1e-12)


class Bodies(vi.Mechanical):
    """Two bodies without forces, each with a stop."""

    q = ("x", "y")
    mass = (1.0, 1.0)
    contacts = (vi.RigidStop(1.0, 0.5, on="x"), vi.RigidStop(1.0, 0.25, on="y"))
    cycle = 1.0

    def force(self, t, q, v):
        return dict(x=0.0, y=0.0)


def test_two_bodies_land_together_as_a_cycle_ends():
    start = Bodies().at(y=-1.0, v=dict(x=1.0, y=2.0))
    run = vi.simulate(Bodies(), start, 1, rests=False)
    np.testing.assert_allclose([run.last.v.x, run.last.v.y], [-0.5, -0.5], rtol=1e-12)
    assert int(run.impacts[0]) == 2


class WithReset(vi.AbstractMachine):
    """y'' = 2 - y, with a reset at y = 1."""

    cycle: float = 9.0
    events: tuple = (
        vi.Reset(lambda m, s, x: x.Y - 1, lambda m, s, x: vi.OscillatorState(x.Y, x.V + 1)),
    )

    def field(self, s, x):
        return vi.OscillatorState(x.V, 2 - x.Y)


def test_start_on_a_guard_does_not_trigger_it():
    """Only the last start falls by more than rounding, so it returns and triggers the reset."""
    places = 1 + jnp.array([0.0, -1e-16, 0.0, -1e-12, 0.0])
    speeds = jnp.array([-1e-17, -1e-17, -1e-9, 0.0, -0.1])
    starts = vi.OscillatorState(places, speeds)
    run = jax.vmap(lambda x: vi.simulate(WithReset(), x, 1, event_log=2))(starts)
    assert run.event_log.number[:, 0, 0].tolist() == [-1, -1, -1, -1, 0]
    phase = 2 * np.arctan(0.1)  # y - 2 = -cos s - sin(s)/10
    np.testing.assert_allclose(run.event_log.phase[-1, 0, 0], phase, rtol=1e-8)
