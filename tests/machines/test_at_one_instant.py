"""Simultaneous impacts: the fastest approach is resolved first, equal ones together."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from chain import Chain, dropped, passed, row


class Cradle(Chain):
    """Newton's cradle: three equal masses on springs, which touch where the springs are at rest."""

    springs: Any = (1.0, 1.0, 1.0)
    length: Any = 2 * np.pi

    def force(self, t, q, v):
        return {name: -a * x for a, (name, x) in zip(self.springs, vars(q).items(), strict=True)}


def energy(z, springs=(1.0, 1.0, 1.0)):
    x, v = jax.tree.leaves(z)[:3], jax.tree.leaves(z)[3:]
    return 0.5 * sum(a * x**2 + v**2 for a, x, v in zip(springs, x, v, strict=True))


@pytest.mark.slow
# With 16 samples the balls meet at the end of an interval.
@pytest.mark.parametrize(("rests", "samples"), [(True, 16), (False, 0)])
def test_impact_passes_through_touching_balls(rests, samples):
    start = Cradle().balls((-1, 0, 0), (0, 0, 0))
    run = vi.simulate(Cradle(), start, 3, rests=rests, samples=samples, impact_log=6)
    assert bool(run.successful)
    assert run.impacts.tolist() == [4, 4, 4]
    assert run.impact_log.stop[:, :4].tolist() == [[0, 1, 1, 0]] * 3
    np.testing.assert_allclose(run.impact_log.speed[:, :4], 1.0, rtol=1e-8)
    np.testing.assert_allclose(jax.tree.leaves(run.last), [-1, 0, 0, 0, 0, 0], atol=2e-9)
    np.testing.assert_allclose(jax.vmap(energy)(run.sections), 0.5, rtol=1e-8)


def simulate_impacts(machine, x, v, cycles=1, **options):
    run = vi.simulate(machine, machine.balls(x, v), cycles, impact_log=160, **options)
    assert bool(run.successful), run.result
    stops = np.asarray(run.impact_log.stop)
    return run, stops[stops >= 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k", "masses", "speeds"),
    [(0.9, (1.0,) * 5, (1, 0, 0, 0, 0)), (0.6, (1.0, 2.0, 2.0, 1.0), (1, 0, 0, -1))],
)  # fmt: skip
def test_newtons_cradle(k, masses, speeds):
    """One ball hits touching balls: of five with k = .9 the first keeps .0435250820. Two balls hit
    a touching pair from both sides: impacts coupled by other contacts are resolved together."""
    places = -0.5 * np.array(speeds)
    run, stops = simulate_impacts(Chain(k, masses), places, speeds)
    wanted, struck = passed(speeds, k, np.array(masses))
    np.testing.assert_allclose(row(run.last)[1], wanted, atol=1e-12)
    assert stops.tolist() == struck
    if len(masses) == 5:
        assert float(run.last.v.a) == pytest.approx(0.0435250820, abs=1e-10)
    if len(masses) == 4:
        assert struck == [0, 2, 1, 0, 2]
    lost = 0.5 * np.dot(masses, np.square(speeds) - wanted**2)
    assert float(run.impact_energy[0]) == pytest.approx(lost, abs=1e-12)


@pytest.mark.slow
def test_a_light_ball_between_a_wall_and_a_heavy_one():
    """Galperin's billiard counts the digits of pi, with all impacts at one instant."""
    ratio, impacts = 10_000.0, 314
    run, _ = simulate_impacts(Chain(1.0, (ratio, 1.0), 0.0), (-0.5, 0), (1, 0), max_impacts=400)
    assert int(run.impacts[0]) == impacts
    energy = 0.5 * (ratio * run.last.v.a**2 + run.last.v.b**2)
    assert float(energy) == pytest.approx(0.5 * ratio, rel=1e-12)


class Shaken(Chain):
    """Two balls on springs, stacked on a shaken table, in the frame of the table."""

    springs: Any = (0.5, 1.0)

    def force(self, t, q, v):
        pull = [1 + 1.5 * jnp.sin(t) - w * x for w, x in zip(self.springs, (q.a, q.b), strict=True)]
        return dict(a=self.weights[0] * pull[0], b=self.weights[1] * pull[1])


@pytest.mark.slow
def test_stack_is_released_as_one():
    """The distance of the bodies grows with the third power of time. Compare with SciPy."""
    masses = 0.78, 2.46

    def run(springs):
        machine = Shaken(0.0, masses, 0.0, length=5.0, springs=springs)
        return vi.simulate(machine, machine.start(), 1)

    with warnings.catch_warnings():  # the field jumps between cycles
        warnings.simplefilter("ignore")
        springs = jnp.array([(0.5, 1.0), (0.0, 1.0), (0.2, 0.7)])
        runs = jax.vmap(lambda x: run(tuple(x)))(springs)
    assert bool(runs.successful.all())
    begin = np.pi + np.arcsin(2 / 3)
    for i, pair in enumerate(springs):
        for x, w in zip((runs.last.a, runs.last.b), pair, strict=True):

            def rate(s, z, w=float(w)):
                return z[1], 1 + 1.5 * np.sin(s) - w * z[0]

            there = solve_ivp(rate, (begin, 5.0), (0.0, 0.0), rtol=1e-11, atol=1e-13).y[0, -1]
            assert float(x[i]) == pytest.approx(there, abs=1e-8)


@pytest.mark.slow
def test_endless_sequence_of_impacts_goes_to_its_limit():
    """Five touching balls without restitution share the momentum."""
    run, _ = simulate_impacts(Chain(0.0, (1.0,) * 5), (-0.5, 0, 0, 0, 0), (1, 0, 0, 0, 0))
    np.testing.assert_allclose(row(run.last)[1], 0.2, atol=1e-12)
    assert float(run.impact_energy[0]) == pytest.approx(0.4, abs=1e-12)


def test_two_balls_before_a_wall():
    """Equal balls with speeds 2 and 0 and two gaps of .01 have speeds 0 and -2 after .015."""
    machine = Chain(1.0, (1.0, 1.0), 0.01, length=0.015)
    run, stops = simulate_impacts(machine, (-0.01, 0), (2, 0))
    assert stops.tolist() == [0, 1, 0]
    np.testing.assert_allclose(row(run.last), [(0, 0), (-2, 0)], atol=1e-12)


def test_two_balls_bounce_to_rest_one_above_the_other():
    """Compare masses 1 and 2 with closed-form flights, until both lie on each other."""
    masses, k = (1.0, 2.0), 0.8
    machine = Chain(k, masses, 0.0, pressed=1.0, length=2.0)
    run = vi.simulate(machine, machine.balls((-1, -0.5), (0, 0)), 8, impact_log=20)
    assert bool(run.successful)
    np.testing.assert_allclose(row(run.last), 0.0, atol=1e-12)
    assert float(run.impact_energy.sum()) == pytest.approx(2.0, abs=1e-9)
    wanted = dropped((1.0, 0.5), k, masses, 4.5)
    phase, stops = np.asarray(run.impact_log.phase), np.asarray(run.impact_log.stop)
    times = (phase + 2.0 * np.arange(8)[:, None])[stops >= 0]
    number = len(wanted) - 1
    assert number >= 4 and stops[stops >= 0][:number].tolist() == [i for _, i in wanted[:-1]]
    np.testing.assert_allclose(times[:number], [t for t, _ in wanted[:-1]], atol=1e-9)


@pytest.mark.slow
def test_energy_never_grows():
    """Balls have different springs, and some touch at the start."""
    springs = jnp.array([1.0, 1.7, 0.6])
    starts = jnp.sort(jax.random.uniform(jax.random.key(0), (64, 3), minval=-1, maxval=1), axis=1)
    starts = starts.at[:16, 2].set(starts[:16, 1]).at[8:24, 1].set(starts[8:24, 0])
    starts = starts.at[24:32].set(starts[24:32, :1])

    def one(start, restitution):
        machine = Cradle(restitution, springs=tuple(springs))
        return vi.simulate(machine, machine.at(a=start[0], b=start[1], c=start[2]), 4)

    restitution = jnp.tile(jnp.array([1.0, 0.9, 0.5, 0.0]), 16)
    run = jax.vmap(one)(starts, restitution)
    total = np.asarray(jax.vmap(jax.vmap(lambda x: energy(x, springs)))(run.sections))
    known = (run.result == vi.RESULTS.simultaneous) | (run.result == vi.RESULTS.chatter)
    assert bool(jnp.all(run.successful | known))
    assert int(jnp.sum(run.successful)) >= 60
    assert np.nanmax(np.diff(total, axis=1)) <= 1e-8  # NaN where a lane has ended


class Rod(vi.Mechanical):
    """A rod of mass 1 and inertia .3 that falls flat on feet at the positions `feet`."""

    restitution: Any
    feet: Any
    q = ("y", "tilt")
    mass = (1.0, 0.3)
    cycle = 1.0

    @property
    def contacts(self):
        feet = zip(self.restitution, self.feet, strict=True)
        return tuple(vi.RigidStop(0.0, k, on=lambda q, x=x: q.y + x * q.tilt) for k, x in feet)

    def force(self, t, q, v):
        return dict(y=0.0, tilt=0.0)


@pytest.mark.slow
def test_a_rod_lands_flat_on_its_feet():
    """If the far foot would have to pull, only the near one has an impact. Laws that would gain
    energy together gain none."""
    turns = -1.5 * 0.5 / 0.3 / (1 + 1 / 1.2)
    several = [
        (jnp.array(places), jnp.array(laws), wanted)
        for places, laws, wanted in (
            ((-0.5, 1.0), (0.5, 0.5), (-0.5, 0.0)),
            ((0.5, 1.0), (0.5, 0.5), (1 - 1.5 / (1 + 1 / 1.2), turns)),
            ((-0.5, 1.0), (0.0, 1.0), None),
            ((-1.0, 0.0, 1.0), (0.5,) * 3, (-0.5, 0.0)),  # one is redundant
        )
    ]

    @vi.jit
    def land(laws, places):
        rod = Rod(laws, places)
        return vi.simulate(rod, rod.at(y=-0.3, v=dict(y=1.0)), 1)

    for places, laws, wanted in several:
        run = land(laws, places)
        assert bool(run.successful)
        v, turn = float(run.last.v.y), float(run.last.v.tilt)
        assert v * v + 0.3 * turn * turn <= 1 + 1e-12
        assert (v + places * turn <= 1e-12).all()
        if wanted is not None:
            np.testing.assert_allclose((v, turn), wanted, atol=1e-12)


@pytest.mark.slow
def test_impacts_coupled_by_friction():
    """The faster impact is first: b from 2 to -1 takes .9 off a; a from .1 to -.05 gives b .045."""
    rough = dict(restitution=0.5, friction=0.3)
    a = vi.RigidStop(1.0, on="a", along="b", **rough)
    b = vi.RigidStop(2.0, on="b", along="a", **rough)
    for walls in ((a, b), (b, a)):
        machine = type("Corner", (Chain,), {"contacts": walls})(0.5, (1.0, 1.0), length=3.0)
        v = vi.simulate(machine, machine.balls((0, 0), (1, 2)), 1).last.v
        np.testing.assert_allclose((v.a, v.b), (-0.05, -0.955), atol=1e-12)


class PushedOn(vi.Mechanical):
    """Two bodies at a wall. At first a force acts on the second alone, which presses both on it."""

    q = ("a", "b")
    mass = (1.0, 2.0)
    cycle = 1.0
    growth: float = 0.0
    contacts = (vi.RigidStop(1.0, 0.5, on="a"), vi.RigidStop(0.0, 0.5, on=lambda q: q.b - q.a))

    def force(self, t, q, v):
        return dict(a=-self.growth * t, b=1.0 - 3 * jnp.maximum(t - 0.5, 0.0))


@pytest.mark.parametrize("growth", [0.0, 0.2, -0.2])
def test_a_body_that_another_one_presses_on_a_wall_rests_there_from_the_start(growth):
    """No force acts on it alone at the start, and it would move away if its own force grew."""
    machine = PushedOn(growth)
    run = vi.simulate(machine, machine.at(a=1.0, b=1.0), 1, event_log=6)
    kinds, numbers = (np.asarray(x[0]) for x in (run.event_log.kind, run.event_log.number))
    met = [(vi.EVENTS[k], n) for k, n in zip(kinds, numbers, strict=True) if k >= 0]
    if growth > 0:  # the wall's force 1 - 3 (t - 1/2) - t/5 vanishes first
        assert met[0] == ("release", 0)
        np.testing.assert_allclose(run.event_log.phase[0, 0], 2.5 / 3.2, rtol=1e-12)
    else:
        assert met == [("release", 1)]
        np.testing.assert_allclose(run.event_log.phase[0, 0], 0.5 + 1 / 3, rtol=1e-12)
