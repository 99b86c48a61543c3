"""Contacts that are met at one instant: in turn where one leads to the other, refused where nothing
says which goes first."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


class Three(eqx.Module):
    x: Any
    u: Any
    y: Any
    v: Any
    z: Any
    w: Any


class Cradle(vi.AbstractScene):
    """Newton's: three equal masses, each on its own spring; they touch at the springs' rest."""

    restitution: Any = eqx.field(default=1.0, converter=lambda x: jnp.asarray(x, float))
    springs: Any = eqx.field(default=(1.0, 1.0, 1.0), converter=lambda x: jnp.asarray(x, float))

    @property
    def stops(self):
        return tuple(vi.RigidStop(0.0, self.restitution, coordinate=i) for i in range(2))

    @property
    def coordinates(self):
        def first(s, Y, V):
            far, fast = 0.5 * (Y - (s.x - s.y)), 0.5 * (V - (s.u - s.v))
            return Three(s.x + far, s.u + fast, s.y - far, s.v - fast, s.z, s.w)

        def second(s, Y, V):
            far, fast = 0.5 * (Y - (s.y - s.z)), 0.5 * (V - (s.v - s.w))
            return Three(s.x, s.u, s.y + far, s.v + fast, s.z - far, s.w - fast)

        return (
            vi.Coordinate(lambda s: s.x - s.y, lambda s: s.u - s.v, first, 0.5),
            vi.Coordinate(lambda s: s.y - s.z, lambda s: s.v - s.w, second, 0.5),
        )

    @property
    def cycle(self):
        return 2 * jnp.pi

    def field(self, s, z):
        a, b, c = self.springs
        return Three(z.u, -a * z.x, z.v, -b * z.y, z.w, -c * z.z)


def at(x, y, z):
    zero = jnp.array(0.0)
    return Three(*(jnp.asarray(p, float) if q else zero for p in (x, y, z) for q in (1, 0)))


def energy(s, springs=(1.0, 1.0, 1.0)):
    a, b, c = springs
    return 0.5 * (a * s.x**2 + s.u**2 + b * s.y**2 + s.v**2 + c * s.z**2 + s.w**2)


@pytest.mark.parametrize("rests", [True, False])
@pytest.mark.parametrize("samples", [0, 16])  # 16: the balls meet where an interval ends
def test_a_blow_passes_through_balls_that_touch(rests, samples):
    run = vi.simulate(Cradle(), at(-1, 0, 0), 3, rests=rests, samples=samples, impact_log=6)
    assert bool(run.successful)
    assert run.impacts.tolist() == [4, 4, 4]
    assert run.impact_log.stop[:, :4].tolist() == [[0, 1, 1, 0]] * 3
    np.testing.assert_allclose(run.impact_log.speed[:, :4], 1.0, rtol=1e-8)
    np.testing.assert_allclose(jax.tree.leaves(run.last), [-1, 0, 0, 0, 0, 0], atol=2e-9)
    np.testing.assert_allclose(jax.vmap(energy)(run.sections), 0.5, rtol=1e-8)


def test_without_restitution_the_balls_go_on_together():
    run = vi.simulate(Cradle(0.0), at(-1, 0, 0), 1, max_impacts=200)
    assert bool(run.successful)
    # A third of the momentum each.
    np.testing.assert_allclose(jax.tree.leaves(run.last), [-1 / 3, 0] * 3, atol=1e-9)


@pytest.mark.parametrize("start", [(-1, 0, 1), (-1, 0, 0.5)])
def test_blows_from_both_sides_at_once_end_with_a_reason(start):
    run = vi.simulate(Cradle(0.9), at(*start), 1)
    assert bool(run.result == vi.RESULTS.simultaneous)


def test_energy_never_grows():
    """On springs of their own, from starts some of which touch."""
    springs = jnp.array([1.0, 1.7, 0.6])
    starts = jnp.sort(jax.random.uniform(jax.random.key(0), (64, 3), minval=-1, maxval=1), axis=1)
    starts = starts.at[:16, 2].set(starts[:16, 1]).at[8:24, 1].set(starts[8:24, 0])
    starts = starts.at[24:32].set(starts[24:32, :1])

    def one(start, restitution):
        return vi.simulate(Cradle(restitution, springs), at(*start), 4)

    restitution = jnp.tile(jnp.array([1.0, 0.9, 0.5, 0.0]), 16)
    run = jax.vmap(one)(starts, restitution)
    total = np.asarray(jax.vmap(jax.vmap(lambda x: energy(x, springs)))(run.sections))
    told = (run.result == vi.RESULTS.simultaneous) | (run.result == vi.RESULTS.chatter)
    assert bool(jnp.all(run.successful | told))
    assert int(jnp.sum(run.successful)) >= 60
    assert np.nanmax(np.diff(total, axis=1)) <= 1e-8  # NaN where a lane has ended
