"""Bodies that rest on one another, held by several coordinates and between walls."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

import two_bodies


class Pushed(eqx.Module):
    """Places and speeds of two bodies, or of one and of the other relative to it."""

    x: Any
    u: Any
    y: Any
    v: Any


class Cage(vi.AbstractMachine):
    """A body in a cage that is shaken, described by places or by differences of places."""

    restitution: Any = 0.3
    relative: bool = eqx.field(static=True, default=False)

    @property
    def stops(self):
        return (vi.RigidStop(0.35, self.restitution), vi.RigidStop(0.35, self.restitution, "left"))

    @property
    def coordinates(self):
        def place(state):
            return state.y if self.relative else state.y - state.x

        def speed(state):
            return state.v if self.relative else state.v - state.u

        def placed(state, Y, V):  # 0.2 is the body's share of the mass of both
            far, fast = Y - place(state), V - speed(state)
            x, u = state.x - 0.2 * far, state.u - 0.2 * fast
            if self.relative:
                return Pushed(x, u, Y, V)
            return Pushed(x, u, state.y + 0.8 * far, state.v + 0.8 * fast)

        return (vi.Coordinate(place, speed, placed, 0.2),)

    @property
    def cycle(self):
        return 2 * jnp.pi

    def field(self, s, state):
        x, u, y, v = state.x, state.u, state.y, state.v
        if self.relative:
            y, v = y + x, v + u
        cage = 0.9 * jnp.cos(s) - x - 0.05 * u
        body = -1.3 * y - 0.1 * v
        if self.relative:
            return Pushed(u, cage, v - u, body - cage)
        return Pushed(u, cage, v, body)


@pytest.mark.slow
@pytest.mark.parametrize("k", [0.0, 0.2, 0.5, 0.8])
def test_a_body_rests_on_another_where_their_distance_is_a_difference(k):
    """The difference of two rounded places is not the stop's to the last bit."""
    runs = []
    for relative in (False, True):
        cage = Cage(restitution=k, relative=relative)
        start = Pushed(*map(jnp.asarray, (0.0, 0.0, 0.1, 0.0)))
        runs.append(vi.simulate(cage, start, 60))
    assert all(bool(run.successful) for run in runs)
    if k < 0.4:
        assert int(runs[0].rests.sum()) > 50
    for kept, other in zip(runs[0].sections.__dict__.values(), "xu", strict=False):
        np.testing.assert_allclose(kept[:6], getattr(runs[1].sections, other)[:6], atol=1e-6)
    np.testing.assert_array_equal(runs[0].impacts[:5], runs[1].impacts[:5])
    np.testing.assert_array_equal(runs[0].rests[:5], runs[1].rests[:5])


@pytest.mark.slow
def test_bodies_that_push_each_other_onto_walls():
    """Without rebound impacts go to and fro between two contacts, ever weaker, until both hold."""
    draw = np.random.default_rng(7).uniform
    places, speeds = draw(-0.2, 0.2, 64), draw(-1, 1, (2, 64))
    starts = map(jnp.asarray, (places, speeds[0], 0.5 * places - 0.1, speeds[1]))

    @vi.jit
    @jax.vmap
    def one(x, u, y, v):
        pushed = two_bodies.TwoBodies(gap=0.25, restitution=0.0, force=1.5)
        return vi.simulate(pushed, two_bodies.Pair(x, u, y, v), 30)

    run = one(*starts)
    assert bool(run.successful.all())
    assert int(run.rests.sum()) > 1000
    assert (np.asarray(run.impact_energy) >= 0).all()
    gap = 0.25 + 1e-12
    assert float(run.sections.x1.max()) <= gap and float(run.sections.x2.min()) >= -gap
    assert float((run.sections.x1 - run.sections.x2).max()) <= 0.4 + 1e-12
