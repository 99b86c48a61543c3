"""Bodies that rest on several contacts, on a curved one, on one whose place is no number of the
state or moves along with it, or are moved while they rest."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from chain import Balls, Chain, balls


class Stack(Chain):
    """Two equal bodies, one against the other and that one against a wall at y = 0."""

    restitution: Any = 0.3
    masses: tuple[float, ...] = (1.0, 1.0)
    wall: float | None = 0.0
    length: Any = 2 * np.pi
    forces: Any = None
    """Constant ones on both, and the strength of one on the first that goes by cos s."""

    def field(self, s, z):
        (u, v), (first, second, turning) = z.v, self.forces
        return Balls(z.v, (first + turning * jnp.cos(s) - 0.1 * u, second - 0.1 * v))


AT_REST = balls((0, 0), (0, 0))


@pytest.mark.slow
def test_a_stack_pressed_on_a_wall_stays_there():
    """Whichever of them is pressed; and the outer body leaves where its own force turns."""

    def run(forces):
        return vi.simulate(Stack(forces=forces), AT_REST, 1, event_log=6)

    runs = jax.vmap(run)(jnp.array([(1.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.5, 0.2, 1.0)]))
    assert bool(runs.successful.all())
    for numbers in jax.tree.leaves(runs.last):
        np.testing.assert_allclose(numbers[:2], 0.0, atol=1e-14)
    leaves = runs.event_log.phase[2][runs.event_log.kind[2] == 2]
    np.testing.assert_allclose(leaves, [2 * np.pi / 3], atol=1e-9)
    np.testing.assert_allclose(runs.last.x[1][2], 0.0, atol=1e-14)

    def free(s, z):
        return z[1], 0.5 + np.cos(s) - 0.1 * z[1]

    there = solve_ivp(free, (2 * np.pi / 3, 2 * np.pi), (0, 0), rtol=1e-11, atol=1e-13).y[:, -1]
    np.testing.assert_allclose([runs.last.x[0][2], runs.last.v[0][2]], there, atol=1e-8)


class Thrown(Stack):
    """The first one twice as heavy, both thrown off the wall by one and the same acceleration."""

    masses: tuple[float, ...] = (2.0, 1.0)

    def field(self, s, z):
        return Balls(z.v, (1 + 2 * jnp.cos(s),) * 2)


@pytest.mark.slow
def test_a_stack_is_thrown_off_as_one_and_comes_back():
    """As one body, which leaves where 1 + 2 cos s = 0, flies, and bounces to rest or goes on."""
    run = vi.simulate(Thrown(), AT_REST, 3, event_log=12, max_impacts=2000)
    assert bool(run.successful)
    leaves = run.event_log.phase[0][run.event_log.kind[0] == 2]
    begin = 2 * np.pi / 3
    np.testing.assert_allclose(leaves, begin, atol=1e-8)
    for numbers in (run.sections.x, run.sections.v):
        np.testing.assert_allclose(*numbers, atol=1e-9)
    long = 2 * np.pi - begin
    flight = long**2 / 2 - 2 * (1 - np.cos(begin)) - 2 * np.sin(begin) * long
    assert flight < 0 and float(run.sections.x[1][1]) == pytest.approx(flight, abs=1e-8)
    assert int(run.impacts.sum()) > 2 and float(jnp.max(run.sections.x[1])) <= 1e-12


class Put(vi.AbstractMachine):
    """A body pressed on a stop with unit force, that is moved as each cycle begins."""

    by: Any
    kick: Any

    @property
    def contacts(self):
        return (vi.RigidStop(0.5, 0.0),)

    @property
    def cycle(self):
        return 2.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, 1.0 + 0 * state.Y)

    def renewed(self, state):
        return vi.OscillatorState(state.Y - self.by, state.V - self.kick)


def test_a_body_that_is_moved_while_it_rests_is_free_again():
    start = vi.OscillatorState(jnp.array(0.5), jnp.array(0.0))

    def run(by, kick):
        return vi.simulate(Put(by, kick), start, 4, impact_log=2)

    runs = jax.vmap(run)(jnp.array([0.0, 0.2, 0.0]), jnp.array([0.0, 0.0, 0.3]))
    assert bool(runs.successful.all())
    assert runs.impacts.tolist() == [[0] * 4, [0, 1, 1, 1], [0, 1, 1, 1]]
    # It falls back, √0.4 long, or flies for twice its speed.
    np.testing.assert_allclose(runs.impact_log.phase[1, 1:, 0], np.sqrt(0.4), rtol=1e-8)
    np.testing.assert_allclose(runs.impact_log.phase[2, 1:, 0], 0.6, rtol=1e-8)
    np.testing.assert_allclose(runs.sections.Y[:, 1:], np.array([[0.5], [0.3], [0.5]]) * np.ones(4))
    np.testing.assert_allclose(runs.sections.V[:, 1:], np.array([[0], [0], [-0.3]]) * np.ones(4))


class Point(eqx.Module):
    x: Any
    u: Any
    y: Any
    v: Any


class Dome(vi.AbstractMachine):
    """A particle on a smooth dome of radius one, under gravity."""

    contacts: tuple = (vi.RigidStop(-1.0, 0.3, "left"),)

    def position(self, z):
        return jnp.hypot(z.x, z.y)

    def velocity(self, z):
        return (z.x * z.u + z.y * z.v) / jnp.hypot(z.x, z.y)

    def placed(self, z, Y, V):
        r = jnp.hypot(z.x, z.y)
        cos, sin = z.x / r, z.y / r
        along = cos * z.v - sin * z.u
        return Point(Y * cos, V * cos - along * sin, Y * sin, V * sin + along * cos)

    @property
    def cycle(self):
        return 2.0

    def field(self, s, z):
        return Point(z.u, 0 * z.x, z.v, -1 + 0 * z.x)


@pytest.mark.slow
def test_a_particle_slides_off_a_dome():
    """It leaves where cos θ = (2 + v²)/3, from an angle where it had v²/2 + cos θ of energy."""
    angles, speed = jnp.linspace(0.05, 0.5, 16), 0.1

    def run(angle):
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        start = Point(sin, speed * cos, cos, -speed * sin)
        return vi.simulate(Dome(), start, 1, event_log=2)

    def energy(z):
        return 0.5 * (z.u**2 + z.v**2) + z.y

    runs = jax.vmap(run)(angles)
    assert bool(runs.successful.all())
    np.testing.assert_allclose(energy(runs.last), 0.5 * speed**2 + np.cos(angles), atol=1e-8)
    gone = np.asarray(runs.event_log.kind[:, 0, 0]) == 2
    assert gone.sum() >= 6

    def rate(_, z):
        return z[1], np.sin(z[0])

    def leaves(s, z):
        return np.cos(z[0]) - z[1] ** 2

    leaves.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    for angle, phase in zip(angles[gone], runs.event_log.phase[gone, 0, 0], strict=True):
        begin = float(angle), speed
        truth = solve_ivp(rate, (0, 2), begin, events=leaves, rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(phase, truth.t_events[0][0], atol=1e-8)
    # Through the release: beside differences.
    slope = jax.vmap(jax.jacfwd(lambda angle: run(angle).last.x))(angles)
    h = 1e-5
    apart = jax.vmap(lambda angle: run(angle).last.x)(jnp.stack([angles + h, angles - h]).ravel())
    np.testing.assert_allclose(slope, (apart[:16] - apart[16:]) / (2 * h), rtol=1e-5, atol=1e-5)


def number(default):
    return eqx.field(default=default, converter=lambda x: jnp.asarray(x, float))


class Pair(eqx.Module):
    x: Any
    u: Any
    y: Any
    v: Any


class Pressed(vi.AbstractMachine):
    """Two balls of a radius, driven and pressed together."""

    radius: Any = number(0.25)

    @property
    def contacts(self):
        return (vi.RigidStop(0.0, 0.3),)

    @property
    def coordinates(self):
        def apart(z, Y, V):
            far, fast = 0.5 * (Y - (z.x - z.y + 2 * self.radius)), 0.5 * (V - (z.u - z.v))
            return Pair(z.x + far, z.u + fast, z.y - far, z.v - fast)

        return (
            vi.Coordinate(
                lambda z: z.x - z.y + 2 * self.radius, lambda z: z.u - z.v, apart, 0.5
            ),
        )  # fmt: skip

    @property
    def cycle(self):
        return 2 * jnp.pi

    def field(self, s, z):
        first, second = 1 + 0.3 * jnp.cos(s) - 0.2 * z.x, -1 + 0.1 * jnp.sin(s) - 0.2 * z.y
        return Pair(z.u, first, z.v, second)

    def start(self):
        x, y = -0.5 - self.radius, 0.3 + self.radius
        return Pair(x, jnp.zeros_like(x), y, jnp.zeros_like(y))


def middle(cycles):
    """Of both balls: no impact between them moves it."""

    def rate(t, c):
        return c[1], 0.15 * np.cos(t) + 0.05 * np.sin(t) - 0.2 * c[0]

    return solve_ivp(rate, (0, 2 * np.pi * cycles), (-0.1, 0.0), rtol=1e-12, atol=1e-13).y[:, -1]


class Ball(eqx.Module):
    height: Any
    speed: Any
    phase: Any


class Table(vi.AbstractMachine):
    """A ball on a shaken table, seen from the laboratory, with the table's phase in the state."""

    strength: Any = number(0.9)

    @property
    def contacts(self):
        return (vi.RigidStop(0.0, 0.4, "left"),)

    def position(self, z):
        return z.height - self.strength * jnp.sin(z.phase)

    def velocity(self, z):
        return z.speed - self.strength * jnp.cos(z.phase)

    def placed(self, z, Y, V):
        at, speed = self.strength * jnp.sin(z.phase), self.strength * jnp.cos(z.phase)
        return Ball(Y + at, V + speed, z.phase)

    @property
    def cycle(self):
        return 2 * jnp.pi

    def field(self, s, z):
        return Ball(z.speed, -jnp.ones_like(s), jnp.ones_like(s))

    def start(self):
        return Ball(jnp.array(0.3), jnp.array(0.0), jnp.array(0.0))


@pytest.mark.slow
def test_balls_with_a_radius_rest_on_one_another():
    radius = 0.25
    balls = Pressed(radius)
    run = vi.simulate(balls, balls.start(), 3)
    place, speed = middle(3)
    assert bool(run.successful) and int(run.rests.sum()) == 1
    np.testing.assert_allclose(
        [run.last.x, run.last.y], [place - radius, place + radius], rtol=1e-8
    )
    np.testing.assert_allclose([run.last.u, run.last.v], speed, rtol=1e-8)
    # On from there, whatever rounding made of their distance.
    for cycles in (4, 5, 6):
        run = vi.simulate(balls, run.last, 1)
        place, _ = middle(cycles)
        assert bool(run.successful) and int(run.impacts.sum()) == 0
        np.testing.assert_allclose([run.last.x, run.last.y], [place - radius, place + radius],
                                   rtol=1e-7)  # fmt: skip


@pytest.mark.slow
def test_derivatives_of_balls_that_rest_on_one_another():
    def places(radius):
        balls = Pressed(radius)
        last = vi.simulate(balls, balls.start(), 3).last
        return jnp.stack([last.x, last.u, last.y, last.v])

    # Of the middle nothing depends on the radius. What is left is the chatter completed at once.
    np.testing.assert_allclose(jax.jacfwd(places)(0.25), [-1, 0, 1, 0], atol=1e-9)


def test_a_ball_moves_with_the_table_on_which_it_rests():
    def motion(strength):
        table = Table(strength)
        run = vi.simulate(table, table.start(), 4, samples=5)
        return run.samples.state, run

    state, run = motion(0.9)
    assert bool(run.successful) and int(run.rests.sum()) == 1
    settled = slice(10, None)  # the second cycle on
    height, phase = np.asarray(state.height)[settled], np.asarray(state.phase)[settled]
    np.testing.assert_allclose(height, 0.9 * np.sin(phase), atol=1e-9)
    slope = jax.jacfwd(lambda x: motion(x)[0].height)(0.9)[settled]
    np.testing.assert_allclose(slope, np.sin(phase), atol=1e-8)
