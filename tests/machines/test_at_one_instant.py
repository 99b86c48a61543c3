"""Contacts that are met at one instant: the one that closes fastest first, equal ones together."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from chain import Balls, Chain, balls, dropped, passed
from differences import quick, some


class Three(eqx.Module):
    x: Any
    u: Any
    y: Any
    v: Any
    z: Any
    w: Any


class Cradle(vi.AbstractMachine):
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_without_restitution_the_balls_go_on_together():
    run = vi.simulate(Cradle(0.0), at(-1, 0, 0), 1, max_impacts=200)
    assert bool(run.successful)
    # A third of the momentum each.
    np.testing.assert_allclose(jax.tree.leaves(run.last), [-1 / 3, 0] * 3, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("start", [(-1, 0, 1), (-1, 0, 0.5)])
def test_blows_from_both_sides_at_once(start):
    """All springs come to rest at once; a symmetric blow leaves a symmetric motion."""
    run = vi.simulate(Cradle(0.9), at(*start), 1, impact_log=8)
    assert bool(run.successful)
    v, struck = passed((1.0, 0.0, -start[2]), 0.9, np.ones(3))
    # Half a period later all meet again; a quarter later all are as far out as they are fast.
    last, again = passed(-v, 0.9, np.ones(3))
    assert run.impact_log.stop[0, : int(run.impacts[0])].tolist() == [*struck, *again]
    np.testing.assert_allclose([run.last.x, run.last.y, run.last.z], last, atol=1e-8)
    if start[2] == 1:
        np.testing.assert_allclose(v, (-0.9, 0, 0.9), atol=1e-15)


def flown(machine, x, v, cycles=1, **options):
    run = vi.simulate(machine, balls(x, v), cycles, impact_log=160, **options)
    assert bool(run.successful), run.result
    stops = np.asarray(run.impact_log.stop)
    return run, stops[stops >= 0]


CRADLES = [(3, 1.0), (3, 0.9), (5, 0.9), (5, 1.0), (5, 0.5)]


@pytest.mark.slow
@pytest.mark.parametrize(("count", "k"), some(CRADLES, *CRADLES[:3]))
def test_newtons_cradle(count, k):
    """One ball upon others that touch. Five with k = .9: the first keeps .0435250820."""
    speeds = np.eye(count)[0]
    run, stops = flown(Chain(k, (1.0,) * count), (-0.5,) + (0,) * (count - 1), speeds)
    wanted, struck = passed(speeds, k, np.ones(count))
    np.testing.assert_allclose(run.last.v, wanted, atol=1e-12)
    assert stops.tolist() == struck
    if (count, k) == (5, 0.9):
        assert float(run.last.v[0]) == pytest.approx(0.0435250820, abs=1e-10)
    lost = 0.5 * (1 - np.sum(wanted**2))
    assert float(run.impact_energy[0]) == pytest.approx(lost, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "impacts"), [(100.0, 31), (10_000.0, 314)])
def test_a_light_ball_between_a_wall_and_a_heavy_one(ratio, impacts):
    """Galperin's count of the digits of pi, all blows in one instant."""
    run, _ = flown(Chain(1.0, (ratio, 1.0), 0.0), (-0.5, 0), (1, 0), max_impacts=400)
    assert int(run.impacts[0]) == impacts
    energy = 0.5 * (ratio * run.last.v[0] ** 2 + run.last.v[1] ** 2)
    assert float(energy) == pytest.approx(0.5 * ratio, rel=1e-12)


class Shaken(Chain):
    """Balls on springs, one above the other on a table that is shaken, seen from it."""

    springs: Any = (0.5, 1.0)

    def field(self, s, z):
        force = 1 + 1.5 * jnp.sin(s)
        pull = (force - w * x for w, x in zip(self.springs, z.x, strict=True))
        return Balls(z.v, tuple(pull))


@pytest.mark.slow
def test_a_stack_is_let_go_of_as_one():
    """Its bodies part by what grows with the third power of the time; beside SciPy."""
    masses = 0.78, 2.46

    def run(springs):
        machine = Shaken(0.0, masses, 0.0, length=5.0, springs=springs)
        return vi.simulate(machine, balls((0, 0), (0, 0)), 1)

    with warnings.catch_warnings():  # the field jumps where its cycle begins again
        warnings.simplefilter("ignore")
        springs = jnp.array([(0.5, 1.0), (0.0, 1.0), (0.2, 0.7)])
        runs = jax.vmap(lambda x: run(tuple(x)))(springs)
    assert bool(runs.successful.all())
    begin = np.pi + np.arcsin(2 / 3)
    for i, pair in enumerate(springs):
        for x, w in zip(runs.last.x, pair, strict=True):

            def rate(s, z, w=float(w)):
                return z[1], 1 + 1.5 * np.sin(s) - w * z[0]

            there = solve_ivp(rate, (begin, 5.0), (0.0, 0.0), rtol=1e-11, atol=1e-13).y[0, -1]
            assert float(x[i]) == pytest.approx(there, abs=1e-8)


@pytest.mark.exhaustive
def test_blows_that_feel_each_other_through_others_come_together():
    """Two balls upon a pair that touches, from both sides at once: symmetric before and after."""
    machine = Chain(0.6, (1.0, 2.0, 2.0, 1.0), length=2.0)
    run, stops = flown(machine, (-1, 0, 0, 1), (1, 0, 0, -1))
    wanted, struck = passed((1, 0, 0, -1), 0.6, (1, 2, 2, 1))
    assert stops.tolist() == struck == [0, 2, 1, 0, 2]
    np.testing.assert_allclose(run.last.v, wanted, atol=1e-12)


@pytest.mark.slow
def test_without_an_end_a_sequence_goes_to_its_limit():
    """Five balls that touch, without restitution, share the momentum."""
    run, _ = flown(Chain(0.0, (1.0,) * 5), (-0.5, 0, 0, 0, 0), (1, 0, 0, 0, 0))
    np.testing.assert_allclose(run.last.v, 0.2, atol=1e-12)
    assert float(run.impact_energy[0]) == pytest.approx(0.4, abs=1e-12)


@pytest.mark.exhaustive
def test_a_stack_that_falls_on_a_wall_stays_there():
    """Whatever height it came from, which derivatives say as well."""
    stack = Chain(0.2, (1.0,) * 3, 0.0, force=1.0, length=3.0)

    def last(height):
        zero = jnp.zeros_like(height)
        run = vi.simulate(stack, Balls((-height,) * 3, (zero,) * 3), 2)
        return run.last, (run.impact_energy.sum(), run.successful)

    lies, slope, (lost, good) = jax.jvp(last, (jnp.array(0.5),), (jnp.array(1.0),), has_aux=True)
    assert bool(good)
    np.testing.assert_allclose(jax.tree.leaves(lies), 0.0, atol=1e-12)
    np.testing.assert_allclose(jax.tree.leaves(slope), 0.0, atol=1e-9)
    assert float(lost) == pytest.approx(1.5, abs=1e-10)


def test_two_balls_before_a_wall():
    """Equal balls at speeds 2 and 0, .01 apart, and .01 before a wall: 0 and -2 after .015."""
    machine = Chain(1.0, (1.0, 1.0), 0.01, length=0.015)
    run, stops = flown(machine, (-0.01, 0), (2, 0))
    assert stops.tolist() == [0, 1, 0]
    np.testing.assert_allclose([*run.last.x, *run.last.v], (0, 0, -2, 0), atol=1e-12)


@pytest.mark.parametrize("k", quick([0.5, 0.8], 0.8))
def test_two_balls_bounce_to_rest_one_above_the_other(k):
    """Of masses 1 and 2: as by flights in closed form, until they lie on each other."""
    masses = (1.0, 2.0)
    machine = Chain(k, masses, 0.0, force=1.0, length=2.0)
    run = vi.simulate(machine, balls((-1, -0.5), (0, 0)), 8, impact_log=20)
    assert bool(run.successful)
    np.testing.assert_allclose([*run.last.x, *run.last.v], 0.0, atol=1e-12)
    assert float(run.impact_energy.sum()) == pytest.approx(2.0, abs=1e-9)
    wanted = dropped((1.0, 0.5), k, masses, 2.0 if k == 0.5 else 4.5)
    phase, stops = np.asarray(run.impact_log.phase), np.asarray(run.impact_log.stop)
    times = (phase + 2.0 * np.arange(8)[:, None])[stops >= 0]
    number = len(wanted) - 1
    assert number >= 4 and stops[stops >= 0][:number].tolist() == [i for _, i in wanted[:-1]]
    np.testing.assert_allclose(times[:number], [t for t, _ in wanted[:-1]], atol=1e-9)


class Table(vi.AbstractMachine):
    """Two balls on one table that is shaken, seen from it."""

    shaking: Any = 2.0
    stops: tuple = tuple(vi.RigidStop(0.0, 0.3, "left", coordinate=k) for k in range(2))

    @property
    def coordinates(self):
        return tuple(
            vi.Coordinate(
                lambda z, k=k: z.x[k],
                lambda z, k=k: z.v[k],
                lambda z, Y, V, k=k: Balls(
                    tuple(Y if i == k else x for i, x in enumerate(z.x)),
                    tuple(V if i == k else v for i, v in enumerate(z.v)),
                ),
            )
            for k in range(2)
        )

    @property
    def cycle(self):
        return 2 * jnp.pi

    def field(self, s, z):
        force = -1 + self.shaking * jnp.sin(s)
        return Balls(z.v, tuple(force + 0 * v for v in z.v))


@pytest.mark.slow
def test_two_balls_are_let_go_of_together():
    run = vi.simulate(Table(), balls((0, 0), (0, 0)), 3, event_log=40)
    assert bool(run.successful)
    leaves = np.asarray(run.event_log.phase)[np.asarray(run.event_log.kind) == 2]
    np.testing.assert_allclose(leaves[:2], np.arcsin(0.5), atol=1e-9)
    np.testing.assert_allclose(run.sections.x[0], run.sections.x[1], atol=1e-12)


@pytest.mark.slow
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
    known = (run.result == vi.RESULTS.simultaneous) | (run.result == vi.RESULTS.chatter)
    assert bool(jnp.all(run.successful | known))
    assert int(jnp.sum(run.successful)) >= 60
    assert np.nanmax(np.diff(total, axis=1)) <= 1e-8  # NaN where a lane has ended
