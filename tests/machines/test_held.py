"""Bodies that rest on several, curved or moving contacts, or that are displaced at rest."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from chain import Chain, row


class Thrown(Chain):
    """A body a against b, and b against a wall at y = 0, with the same acceleration off it."""

    restitution: Any = 0.3
    weights: tuple[float, ...] = (2.0, 1.0)
    wall: float | None = 0.0
    length: Any = 2 * np.pi

    def force(self, t, q, v):
        pull = 1 + 2 * jnp.cos(t)
        return dict(a=2 * pull, b=pull)


@pytest.mark.slow
def test_a_stack_is_thrown_off_as_one_and_comes_back():
    """Both bodies leave together at 1 + 2 cos s = 0, fly, and come back to the wall."""
    run = vi.simulate(Thrown(), Thrown().start(), 3, event_log=12, max_impacts=2000)
    assert bool(run.successful)
    leaves = run.event_log.phase[0][run.event_log.kind[0] == 2]
    begin = 2 * np.pi / 3
    np.testing.assert_allclose(leaves, begin, atol=1e-8)
    for numbers in row(run.sections):
        np.testing.assert_allclose(*numbers, atol=1e-9)
    long = 2 * np.pi - begin
    flight = long**2 / 2 - 2 * (1 - np.cos(begin)) - 2 * np.sin(begin) * long
    assert flight < 0 and float(run.sections.b[1]) == pytest.approx(flight, abs=1e-8)
    assert int(run.impacts.sum()) > 2 and float(run.sections.b.max()) <= 1e-12


class Displaced(vi.AbstractMachine):
    """A body pressed on a stop with unit force. Each new cycle displaces or kicks it."""

    by: Any
    kick: Any

    @property
    def contacts(self):
        return (vi.RigidStop(0.5, 0.0),)

    cycle = 2.0

    def field(self, s, state):
        return vi.OscillatorState(state.V, 1.0 + 0 * state.Y)

    def renewed(self, state):
        return vi.OscillatorState(state.Y - self.by, state.V - self.kick)


def test_body_displaced_at_rest_is_free_again():
    start = vi.OscillatorState(jnp.array(0.5), jnp.array(0.0))

    def run(by, kick):
        return vi.simulate(Displaced(by, kick), start, 4, impact_log=2)

    runs = jax.vmap(run)(jnp.array([0.0, 0.2, 0.0]), jnp.array([0.0, 0.0, 0.3]))
    assert bool(runs.successful.all())
    assert runs.impacts.tolist() == [[0] * 4, [0, 1, 1, 1], [0, 1, 1, 1]]
    # The body falls back for √0.4, or flies for twice its speed.
    np.testing.assert_allclose(runs.impact_log.phase[1, 1:, 0], np.sqrt(0.4), rtol=1e-8)
    np.testing.assert_allclose(runs.impact_log.phase[2, 1:, 0], 0.6, rtol=1e-8)
    np.testing.assert_allclose(runs.sections.Y[:, 1:], np.array([[0.5], [0.3], [0.5]]) * np.ones(4))
    np.testing.assert_allclose(runs.sections.V[:, 1:], np.array([[0], [0], [-0.3]]) * np.ones(4))


class Dome(vi.Mechanical):
    """A particle on a smooth dome of radius one, under gravity."""

    q = ("x", "y")
    mass = (1.0, 1.0)
    cycle = 2.0
    contacts = vi.RigidStop(-1.0, 0.3, "left", on=lambda q: jnp.hypot(q.x, q.y))

    def force(self, t, q, v):
        return dict(x=0.0, y=-1.0)


@pytest.mark.slow
def test_a_particle_slides_off_a_dome():
    """The particle leaves where cos θ is the square of its speed. Compare with SciPy."""
    angles, speed = jnp.linspace(0.05, 0.5, 16), 0.1

    def run(angle):
        sin, cos = jnp.sin(angle), jnp.cos(angle)
        start = Dome().at(x=sin, y=cos, v=dict(x=speed * cos, y=-speed * sin))
        return vi.simulate(Dome(), start, 1, event_log=2)

    def energy(z):
        return 0.5 * (z.v.x**2 + z.v.y**2) + z.y

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
    # Compare derivatives through the release with differences.
    slope = jax.vmap(jax.jacfwd(lambda angle: run(angle).last.x))(angles)
    h = 1e-5
    apart = jax.vmap(lambda angle: run(angle).last.x)(jnp.stack([angles + h, angles - h]).ravel())
    np.testing.assert_allclose(slope, (apart[:16] - apart[16:]) / (2 * h), rtol=1e-5, atol=1e-5)


class Pressed(vi.Mechanical):
    """Two driven balls with a radius, pressed against each other."""

    radius: Any = 0.25
    q = ("x", "y")
    mass = (1.0, 1.0)
    cycle = 2 * np.pi

    @property
    def contacts(self):
        return vi.RigidStop(-2 * self.radius, 0.3, on=lambda q: q.x - q.y)

    def force(self, t, q, v):
        return dict(x=1 + 0.3 * jnp.cos(t) - 0.2 * q.x, y=-1 + 0.1 * jnp.sin(t) - 0.2 * q.y)

    def start(self):
        return self.at(x=-0.5 - self.radius, y=0.3 + self.radius)


def middle(cycles):
    """Return position and speed of the midpoint, which impacts between the balls do not change."""

    def rate(t, c):
        return c[1], 0.15 * np.cos(t) + 0.05 * np.sin(t) - 0.2 * c[0]

    return solve_ivp(rate, (0, 2 * np.pi * cycles), (-0.1, 0.0), rtol=1e-12, atol=1e-13).y[:, -1]


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
    np.testing.assert_allclose([run.last.v.x, run.last.v.y], speed, rtol=1e-8)
    # Continue from there, with the rounding error of their distance.
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
        return jnp.stack([last.x, last.v.x, last.y, last.v.y])

    # The midpoint does not depend on the radius. The error is that of the completed chatter.
    np.testing.assert_allclose(jax.jacfwd(places)(0.25), [-1, 0, 1, 0], atol=1e-9)


class Lying(vi.Mechanical):
    """A body b lies on a body a, and a lies on a floor whose height depends on x."""

    q, mass, cycle = ("a", "b", "x"), (1.0, 0.6, 0.8), 2 * jnp.pi
    contacts = (
        vi.RigidStop(0.0, 0.4, "left", on=lambda q: q.a + 0.1 * q.x),
        vi.RigidStop(0.0, 0.4, "left", on=lambda q: q.b - q.a),
        vi.DryFriction(0.2, on="x"),
    )
    push: Any = 1.0

    def force(self, t, q, v):
        lift = self.push * jnp.cos(t)
        return dict(a=lift - 1.0, b=0.3 * jnp.sin(2 * t) - 0.6, x=0.6 * jnp.sin(t) - q.x)


@pytest.mark.slow
def test_motion_with_several_rests_continues_from_any_section():
    one = lambda push, z, settle: vi.simulate(Lying(push=push), z, 6, settle=settle)
    run = vi.jit(jax.vmap(one, in_axes=(0, 0, None)))
    push = jnp.linspace(0.5, 2.0, 24)
    start = jax.vmap(lambda push: Lying(push=push).at(a=0.4, b=0.8))(push)
    first, whole = run(push, start, 0), run(push, start, 6)
    second = run(push, first.last, 0)
    assert bool(whole.successful.all() & second.successful.all()) and int(second.rests.sum()) > 48
    for a, b in zip(*map(jax.tree.leaves, (second.last, whole.last)), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-8)
