"""Branches of motions that rest on a stop for a part of their period."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from two_coupled import Two

ZETA, GAP = "drive.frequency_ratio", 0.3


def scene_at(zeta, restitution=0.3, gap=GAP, damping=0.05):
    """Return a scene whose body chatters to rest once a cycle, and flies on the section."""
    scene = vi.Scene.ideal(
        frequency_ratio=zeta, restitution=restitution, gap=gap, damping_ratio=damping
    )
    return scene.at_section(np.pi)


def settled(scene, cycles=40):
    return vi.simulate(scene, scene.start(Y=0.0), cycles).last


@pytest.fixture(scope="module")
def orbit():
    return vi.find_orbit(scene_at(0.7), settled(scene_at(0.7)), impact_log=32, throw=True)


@pytest.fixture(scope="module")
def branch(orbit):
    return vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.6, 0.8))


@pytest.mark.slow
@pytest.mark.parametrize("q", [("y", "x"), ("x", "y")])
def test_rests_with_another_body_in_motion(q):
    """Newton's method leaves the resting body a velocity of 1e-28, which is no impact."""
    stop = vi.RigidStop(0, 0.5, "left", on="y")
    base = dict(q=q, mass=(1.0, 1.0), cycle=2 * np.pi, contacts=stop)
    force = lambda _, t, q, v: {"y": -1 + 1.5 * jnp.sin(t), "x": jnp.cos(t) - 0.3 * (q.x + v.x)}
    machine = type("Beside", (vi.Mechanical,), base | {"force": force})()
    last = vi.simulate(machine, machine.at(y=0.2), 1, settle=60).last
    orbit = vi.find_orbit(machine, last.replace(y=last.y + 1e-3), throw=True)
    assert (int(orbit.impacts), int(orbit.rests)) == (19, 1)


def rate(zeta, clock, y, v):
    """Return d(y, v)/ds of the body in flight, at a clock from the section."""
    scene = scene_at(zeta)
    x = scene.start(Y=y, V=v)
    return np.asarray(ravel_pytree(RATE(scene, clock, x))[0])


RATE = jax.jit(lambda scene, clock, x: scene.field(clock, x))


@pytest.mark.slow
def test_motions_of_the_branch_are_flights_from_release(branch):
    """Compare with SciPy from the release, where the contact force is zero, to the section."""
    assert set(branch.rests) == {1}
    for i in (0, len(branch.parameter) // 2):
        zeta = float(branch.parameter[i])

        def pressed(clock, zeta=zeta):
            return rate(zeta, clock, GAP, 0.0)[1]

        clocks = np.linspace(0.0, 2 * np.pi, 60)
        pressing = np.array([pressed(s) for s in clocks])
        (k,) = np.flatnonzero((pressing[:-1] > 0) & (pressing[1:] <= 0))
        release = brentq(pressed, clocks[k], clocks[k + 1], xtol=1e-14)
        flight = solve_ivp(
            lambda s, x, zeta=zeta: rate(zeta, s, *x), (release, 2 * np.pi), [GAP, 0.0],
            method="DOP853", rtol=1e-11, atol=1e-13,
        )  # fmt: skip
        assert flight.y[0, 1:].max() < GAP
        x = [branch.column("section_Y")[i], branch.column("section_V")[i]]
        np.testing.assert_allclose(np.ravel(x), flight.y[:, -1], atol=1e-9)
        np.testing.assert_allclose(branch.multipliers[i], 0, atol=1e-12)


@pytest.mark.slow
def test_a_branch_reports_rests(branch):
    pressed = scene_at(0.7, gap=-3.0)
    held = vi.find_orbit(pressed, pressed.start(Y=-3.0), impact_log=32)
    assert int(held.rests) == 0 and "0 impacts and rest on a stop, stable" in str(held)
    point = branch.orbit(0)
    again = vi.find_orbit(point.machine, point, impact_log=32, throw=True)
    for motion in (point, again):
        assert int(motion.rests) == 1 and "impacts and 1 rest on a stop, stable" in str(motion)
    assert int(point.impacts) == branch.impacts[0] == len(point.impact_speed)
    np.testing.assert_allclose(point.impact_phase, again.impact_phase, atol=1e-8)
    np.testing.assert_allclose(point.impact_speed, again.impact_speed, atol=1e-8)
    assert "rest on a stop" in str(branch)
    drawn, *_ = vi.plot_branch(branch).get_legend().get_texts()
    assert drawn.get_text() == "2π, rest on a stop"
    (lost,) = branch.special
    beyond = lost.switch()
    assert beyond.rests == 0 and beyond.impacts == len(beyond.impact_speed)


@pytest.mark.exhaustive
def test_a_stop_on_the_other_side_is_grazed_where_the_body_turns():
    """Before the graze the left stop has no effect, so that the least position gives its gap."""
    scene = scene_at(0.7)
    other = vi.RigidStop(gap=2.5, restitution=0.3, side="left")
    scene = dataclasses.replace(scene, stops=(*scene.stops, other))
    orbit = vi.find_orbit(scene, settled(scene), impact_log=32, throw=True)
    branch = vi.continue_orbit(orbit, parameter="stops.1.gap", bounds=(1.5, 2.6), max_step=0.3)
    assert branch.ends == ("grazing", "bounds")
    point = branch.special[0]
    assert point.parameter == pytest.approx(-float(orbit.y_min), abs=1e-10)
    beyond = point.switch()  # strikes the left stop
    again = vi.simulate(beyond.machine, beyond.state, 1, impact_log=64)
    assert 1 in again.impact_log.stop[0] and again.rests[0] == beyond.rests == 1
    last = [float(again.last.Y), float(again.last.V)]
    np.testing.assert_allclose([float(beyond.state.Y), float(beyond.state.V)], last, atol=1e-9)
    with pytest.raises(ValueError, match="without rest on a stop"):
        vi.grazing(point)


@pytest.mark.exhaustive
def test_a_rest_leaves_one_multiplier_of_a_motor():
    """A rest makes two of three multipliers zero. Compare with differences of the map."""
    motor = vi.Parameters(torque=10.0, control=0.55, restitution=0.3, gap=0.006)
    scene = motor.scene(drive="motor").at_section(np.pi)
    orbit = vi.find_orbit(scene, settled(scene, 100), impact_log=32, throw=True)
    bounds = tuple(np.array([0.95, 1.0]) * float(scene.stops[0].gap))
    branch = vi.continue_orbit(orbit, parameter="stops.0.gap", bounds=bounds, max_step=0.3)
    there = branch.orbit(0)
    # Both phases are crank angles, not clocks from the section.
    turns = (branch.impact_phase[0, 0] - float(there.impact_phase[0])) / (2 * np.pi)
    assert turns == pytest.approx(round(turns), abs=1e-12)
    x, unravel = ravel_pytree(there.state)

    def mapped(x):
        run = vi.simulate(there.machine, unravel(x), 1, method=there.method)
        return np.asarray(ravel_pytree(run.last)[0])

    h = 1e-4
    differences = [(mapped(x + h * e) - mapped(x - h * e)) / (2 * h) for e in np.eye(3)]
    expected = np.linalg.eigvals(np.stack(differences, axis=-1))
    expected = expected[np.argsort(-np.abs(expected))]
    assert abs(expected[0]) > 1e-5
    np.testing.assert_allclose(branch.multipliers[0], expected, atol=1e-7)


class Pair(vi.machines.ImpactPair):
    """A ball in a shaken box, whose section is at the phase `since`."""

    since: float = 1.0

    def field(self, s, state):
        return super().field(s + self.since, state)


def wall_impacts(half_gap, restitution=0.5):
    """Return the phases of the ball's impacts on the right wall, and the speeds after them, for
    y'' = sin s. The left wall releases the ball at phase 0. The list ends when hops are as short
    as rounding, or when one lasts beyond phase π, where the right wall releases the ball."""
    s = brentq(lambda s: s - np.sin(s) - 2 * half_gap, 0.0, np.pi, xtol=1e-15)
    v = restitution * (1 - np.cos(s))
    found = [(s, v)]

    def pressed(d):
        """Return the mean velocity that the drive gives towards the wall over a time d."""
        short = d * d / 6 if d < 1e-3 else 1 - np.sin(d) / d
        return np.cos(s) * short + 2 * np.sin(s) * np.sin(d / 2) ** 2 / d

    while v > 1e-14 and np.pi - s > 1e-13 and pressed(np.pi - s) > v:
        d = brentq(lambda d, v=v: pressed(d) - v, 1e-30, np.pi - s, xtol=1e-18, rtol=1e-14)
        v = restitution * (2 * np.sin(s + d / 2) * np.sin(d / 2) - v)
        s += d
        found.append((s, v))
    return found


def largest_half_gap():
    """Return the largest half gap with which the hops end before the wall releases the ball."""
    low, high = 0.1, 0.25
    while high - low > 1e-12:
        middle = 0.5 * (low + high)
        over = wall_impacts(middle)[-1][1] < 1e-14
        low, high = (middle, high) if over else (low, middle)
    return low


@pytest.mark.slow
def test_chatter_and_rest_pass_over_the_section():
    """The ball rests on each wall for a part of the cycle. It flies on the section at first. As
    the gap decreases, its first impact reaches the section; the state jumps, the branch goes on."""
    pair = Pair(half_gap=0.1, since=1.0)
    last = vi.simulate(pair, pair.start(), 60).last
    orbit = vi.find_orbit(pair, last, impact_log=64, throw=True)
    branch = vi.continue_orbit(orbit, parameter="half_gap", bounds=(0.05, 0.3))
    assert set(branch.rests) == {2} and branch.ends == ("bounds", "rest")
    places, speeds = branch.column("section_place"), branch.column("section_v.place")
    for i in (0, 1, -2):
        (hit, speed), *_ = wall_impacts(float(branch.parameter[i]))
        # At phase 1 the ball flies from the left wall, or back from its first impact.
        y, v, s = -branch.parameter[i], 0.0, 0.0
        if hit < 1.0:
            y, v, s = branch.parameter[i], -speed, hit
        y += (v + np.cos(s)) * (1.0 - s) - np.sin(1.0) + np.sin(s)
        v += np.cos(s) - np.cos(1.0)
        np.testing.assert_allclose([places[i], speeds[i]], [y, v], atol=1e-9)
    assert wall_impacts(float(branch.parameter[0]))[0][0] < 1.0 < wall_impacts(0.1)[0][0]
    (point,) = branch.special
    assert point.parameter == pytest.approx(largest_half_gap(), abs=1e-9)


class Uneven(vi.AbstractMachine):
    """A body on a spring, between a stop on which it rests and one that it strikes once."""

    frequency: Any = 0.55
    restitution: Any = 0.4

    @property
    def contacts(self):
        return vi.RigidStop(0.1, self.restitution), vi.RigidStop(1.9, 0.6, "left")

    cycle = 2 * np.pi

    def field(self, s, x):
        pull = 0.35 * jnp.sin(2 * s) - jnp.cos(s) - 0.16 * x.V - x.Y
        return vi.OscillatorState(x.V / self.frequency, pull / self.frequency)


def clearance(frequency):
    """Return the distance from the left stop at which the body turns after its rest."""

    def pull(s, y, v):
        return 0.35 * np.sin(2 * s) - np.cos(s) - 0.16 * v - y

    let_go = brentq(lambda s: pull(s, 0.1, 0.0), 3.5, 5.5, xtol=1e-14)

    def turns(s, x):
        return x[1]

    turns.terminal, turns.direction = True, 1
    flight = solve_ivp(
        lambda s, x: [x[1] / frequency, pull(s, *x) / frequency], (let_go, let_go + 6), [0.1, 0.0],
        method="DOP853", events=turns, rtol=1e-12, atol=1e-13, max_step=0.05,
    )  # fmt: skip
    return flight.y[0, -1] + 1.9


@pytest.mark.slow
def test_a_branch_passes_its_section_and_ends_at_a_graze():
    """As an impact reaches the section, the corrector finds a solution far beyond the bounds. The
    branch ends where the body grazes the left stop after its release: one graze is a fold, at the
    other the motion persists."""
    start = vi.OscillatorState(jnp.zeros(()), jnp.zeros(()))
    settled = vi.simulate(Uneven(), start, 1, settle=40).last
    orbit = vi.find_orbit(Uneven(), settled, impact_log=64, throw=True)
    wanted = [brentq(clearance, *bracket, xtol=1e-13) for bracket in ((0.37, 0.385), (0.55, 0.6))]
    over_both = {"step": 0.5, "max_step": 0.5}
    branch = vi.continue_orbit(orbit, parameter="frequency", bounds=(0.2, 0.6), **over_both)
    assert branch.ends == ("grazing", "grazing")
    np.testing.assert_allclose([p.parameter for p in branch.special], wanted, atol=1e-10)


def with_listed_impacts(orbit, count):
    """Return the orbit as if it was found with `impact_log=count`."""
    listed = {name: getattr(orbit, f"impact_{name}")[:count] for name in ("phase", "speed", "stop")}
    return dataclasses.replace(orbit, **{f"impact_{name}": x for name, x in listed.items()})


@pytest.mark.slow
def test_a_branch_of_motions_at_rest_on_their_section():
    """Follow chatter, an impact that sticks, and permanent rest, with a single impact listed."""
    for gap, k in ((0.3, 0.3), (0.3, 0.0), (-3.0, 0.3)):
        scene = vi.Scene.ideal(frequency_ratio=0.5, restitution=k, gap=gap, damping_ratio=0.05)
        orbit = vi.find_orbit(scene, scene.start(Y=gap), impact_log=32, throw=True)
        assert (int(orbit.impacts) > 1) == (gap > 0)
        listed, bounds = with_listed_impacts(orbit, 1), (0.4, 0.6)
        branch = vi.continue_orbit(listed, parameter=ZETA, bounds=bounds, max_step=0.3)
        assert branch.ends == ("bounds", "bounds") and not branch.special
        np.testing.assert_allclose(branch.multipliers, 0.0, atol=1e-12)
        for i in (0, -1):  # at the last one the stop has released it
            there = branch.orbit(i)
            run = vi.simulate(there.machine, there.machine.start(Y=gap), 3)
            last = [float(run.last.Y), float(run.last.V)]
            section = [branch.column("section_Y")[i], branch.column("section_V")[i]]
            np.testing.assert_allclose(section, last, atol=1e-9)
            assert branch.impacts[i] == run.impacts[-1] and branch.rests[i] == run.rests[-1]
    scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
    moving = vi.find_orbit(scene, scene.start(Y=1.6, V=-1.9), cycles=2, throw=True)
    with pytest.raises(ValueError, match=r"list all its 1 impacts, .* larger `impact_log`"):
        vi.continue_orbit(with_listed_impacts(moving, 0), parameter=ZETA, bounds=(0.5, 1.9))


class Busy(vi.AbstractMachine):
    """x'' + 0.1 x' + x + 2 (x - z) = cos(ωt + 2.6), x ≤ d; z'' + 0.1 z' + z/2 + 2 (z - x) = 0 with
    dry friction. A switch makes the spring stiffer below d - 0.1. A reset at d - 0.25 reduces the
    velocity of x as it leaves, and sets a mode until x returns."""

    omega: Any = 0.35
    restitution: Any = 0.4
    gap: Any = -0.4
    level: Any = 0.1
    modes = {"braked": 0.0}  # noqa: RUF012

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega

    @property
    def contacts(self):
        stop = vi.RigidStop(self.gap, self.restitution, on=("x", "u"))
        return stop, vi.DryFriction(self.level, on="v")

    @property
    def events(self):
        def braking(machine, s, q, *modes):
            return q._replace(u=jnp.where(q.u < 0, 0.9, 1.0) * q.u)

        def noting(machine, s, q, *modes):
            return {"braked": jnp.where(q.u < 0, 1.0, 0.0)}

        far = lambda machine, s, q, *modes: q.x - machine.gap + 0.25
        brake = vi.Reset(far, direction="both", reset=braking, modes=noting)
        return vi.Switch(lambda machine, s, q: q.x - machine.gap + 0.1), brake

    def field(self, s, q, side, braked):
        pull = 2.0 * (q.x - q.z) + jnp.where(side < 0, 0.5 * (q.x - self.gap + 0.1), 0.0)
        push = jnp.cos(self.omega * s + 2.6) - q.x - 0.1 * q.u - 0.1 * braked
        return Two(q.u, push - pull, q.v, 2.0 * (q.x - q.z) - 0.1 * q.v - 0.5 * q.z)


@pytest.mark.slow
def test_a_rest_with_friction_a_switch_and_a_reset():
    """All of them act in every cycle, and the friction sticks. Compare with settled simulations and
    differences of their map."""

    def after(omega, start):
        return vi.simulate(Busy(omega=omega), start, 1, event_log=64)

    def settled_after(omega, start):
        for _ in range(81):
            run = after(omega, start)
            start = run.last
        return run

    start = Two(*map(jnp.asarray, (-0.5, 0.0, 0.0, 0.0)))
    run = settled_after(jnp.asarray(0.35), start)
    kinds = run.event_log.kind
    assert all((kinds == kind).any(axis=1).all() for kind in range(len(vi.EVENTS)))
    orbit = vi.find_orbit(Busy(), run.last, impact_log=64, throw=True)
    options = {"parameter": "omega", "step": 0.5, "max_step": 0.5}
    branch = vi.continue_orbit(orbit, bounds=(0.348, 0.352), **options)
    assert branch.ends == ("bounds", "bounds") and (branch.rests == 1).all()
    for i in (0, -1):
        there = branch.orbit(i)
        omega, (x, unravel) = there.machine.omega, ravel_pytree(there.state.state)
        settled = settled_after(omega, there.state)
        assert settled.rests.tolist() == [1] and branch.impacts[i] == settled.impacts.sum()
        np.testing.assert_allclose(x, ravel_pytree(settled.last.state)[0], atol=1e-9)

        def mapped(x, omega=omega, unravel=unravel, there=there):
            start = dataclasses.replace(there.state, state=unravel(x))
            return np.asarray(ravel_pytree(after(omega, start).last.state)[0])

        h = 1e-4
        differences = [(mapped(x + h * e) - mapped(x - h * e)) / (2 * h) for e in np.eye(4)]
        expected = np.linalg.eigvals(np.stack(differences, axis=-1))
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(
            branch.multipliers[i].real, sorted(expected.real, key=lambda m: -abs(m)), atol=1e-6
        )
