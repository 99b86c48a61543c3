"""Bodies that rest on contacts whose place is no number of the state, or moves along with it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp


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
    def stops(self):
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
    def stops(self):
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
@pytest.mark.parametrize("radius", [0.0, 0.25])
def test_balls_with_a_radius_rest_on_one_another(radius):
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
