"""What a machine of one's own may be: two bodies with three contacts, states of any kind."""

import dataclasses
import warnings
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp

from differences import check_derivatives, some
from two_bodies import Pair, TwoBodies

matplotlib.use("Agg")

CLOSE = vi.Adaptive(rtol=1e-12)
PI = np.pi


def flown(gap, k, force, ratio, x, duration):
    """State, impacts and energy lost in them by SciPy's DOP853, the laws written out again; `None`
    for a motion with impacts too weak to be distinguished from rest."""

    def rate(t, x):
        spring = 0.5 * (x[0] - x[2])
        first = force * np.cos(t) - x[0] - spring - 0.1 * x[1]
        return [x[1], first, x[3], (spring - x[2] - 0.05 * x[3]) / ratio]

    events = [lambda t, x: x[0] - gap, lambda t, x: -x[2] - gap, lambda t, x: x[0] - x[2] - 0.4]
    for event in events:
        event.terminal, event.direction = True, 1
    t, x, impacts, lost = 0.0, np.array(x, float), [0, 0, 0], 0.0

    def energy(x):
        return 0.5 * x[1] ** 2 + 0.5 * ratio * x[3] ** 2

    while t < duration - 1e-14:
        found = solve_ivp(
            rate, (t, duration), x, method="DOP853", rtol=1e-13, atol=1e-14, events=events,
            max_step=0.05,
        )  # fmt: skip
        t, x = found.t[-1], found.y[:, -1].copy()
        if found.status != 1:
            continue
        before = energy(x)
        (which,) = (i for i in range(3) if found.t_events[i].size)
        impacts[which] += 1
        speed = (x[1], -x[3], x[1] - x[3])[which]
        if speed < 1e-3:
            return None
        if which == 0:
            x[:2] = gap, -k * x[1]
        elif which == 1:
            x[2:] = -gap, -k * x[3]
        else:
            impulse = (1 + k) * speed * ratio / (1 + ratio)
            x[1], x[3] = x[1] - impulse, x[3] + impulse / ratio
            middle = (x[0] + ratio * x[2]) / (1 + ratio)
            x[0], x[2] = middle + 0.4 * ratio / (1 + ratio), middle - 0.4 / (1 + ratio)
        lost += before - energy(x)
    return x, impacts, lost


def drawn(number):
    draw = np.random.default_rng(1).uniform
    numbers = np.stack([draw(0.3, 1, number), draw(0.3, 0.9, number), draw(0.3, 1.2, number),
                        draw(0.4, 2, number)])  # fmt: skip
    first = draw(-0.2, 0.2, number)
    zero = np.zeros(number)
    return numbers, np.stack([first, zero, first - draw(-0.05, 0.05, number), zero])


def lane(numbers, start, cycles=4, **options):
    return vi.simulate(TwoBodies(*numbers), Pair(*start), cycles, **options)


METHODS = {
    "adaptive": CLOSE, "fixed": vi.FixedStep(steps_per_cycle=48), "taylor": vi.Taylor(18, 12),
}  # fmt: skip


@pytest.mark.slow
def test_two_bodies_with_three_contacts():
    numbers, starts = drawn(100)
    runs = [
        vi.jit(jax.vmap(lambda p, x, m=m: lane(p, x, method=m, impact_log=40), in_axes=1))(
            jnp.asarray(numbers), jnp.asarray(starts)
        )
        for m in METHODS.values()
    ]
    compared, several = 0, np.zeros(3, int)
    for i in range(100):
        wanted = flown(*numbers[:, i], starts[:, i], 8 * PI)
        if wanted is None:
            continue
        x, impacts, lost = wanted
        for run in runs:
            assert bool(run.successful[i])
            found = [leaf[i, -1] for leaf in jax.tree.leaves(run.sections)]
            np.testing.assert_allclose(found, x, atol=2e-7)
            stop = np.asarray(run.impact_log.stop[i])
            assert [int((stop == j).sum()) for j in range(3)] == impacts
            assert float(run.impact_energy[i].sum()) == pytest.approx(lost, abs=1e-7)
        found = [leaf[i, -1] for leaf in jax.tree.leaves(runs[0].sections)]
        np.testing.assert_allclose(found, x, atol=1e-8)
        compared, several = compared + 1, several + impacts
    assert compared > 80 and (several > 100).all()


@pytest.mark.exhaustive
def test_derivatives_of_two_bodies():
    """By all their numbers and their start, through impacts of all three kinds."""
    numbers, starts = drawn(100)
    log = vi.jit(jax.vmap(lambda p, x: lane(p, x, 2, impact_log=16).impact_log.stop, in_axes=1))(
        jnp.asarray(numbers), jnp.asarray(starts)
    )
    kinds = np.stack([(np.asarray(log) == j).any(axis=(1, 2)) for j in range(3)])
    i = int(np.flatnonzero(kinds.all(axis=0))[0])

    def last(x):
        run = lane(x[:4], x[4:], 2, method=vi.FixedStep(steps_per_cycle=64))
        return run.last, run.impacts

    at = [*numbers[:, i], *starts[:, i]]
    check_derivatives(last, at, step=1e-6, tolerance=2e-6, impacts=3)


@pytest.mark.parametrize("method", some(METHODS, "adaptive"))
def test_contacts_that_share_bodies_and_come_together(method):
    """Mirror images of each other meet their walls at once, and are 0.4 apart there, as far as they
    can be: that contact closes twice as fast, and is struck first, alone."""
    bodies = TwoBodies(gap=0.2, force=0.0, restitution=0.5, damping=0.05)
    start = Pair(*map(jnp.asarray, (0.1, 1.0, -0.1, -1.0)))
    run = vi.simulate(bodies, start, 2, impact_log=6, method=METHODS[method])
    assert bool(run.successful)
    stops = np.asarray(run.impact_log.stop)
    assert (stops[stops >= 0] == 2).all() and int(run.impacts.sum()) >= 2
    speed = float(run.impact_log.speed[0, 0])

    def wall(_, x):
        return x[0] - 0.2

    wall.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    path = solve_ivp(
        lambda _, x: (x[1], -2 * x[0] - 0.05 * x[1]), (0, 1), (0.1, 1.0), events=wall, rtol=1e-10,
        atol=1e-12,
    )  # fmt: skip
    assert speed == pytest.approx(2 * path.y[1, -1], abs=1e-7)
    np.testing.assert_allclose(run.sections.x1, -run.sections.x2, atol=1e-9)


@pytest.mark.parametrize("method", some(METHODS, "taylor"))
def test_events_that_come_together(method):
    """Mirror images of each other meet their walls at once, neither of which the other feels."""
    gap = 0.15
    bodies = TwoBodies(gap=gap, force=0.0, restitution=0.5, damping=0.05)
    start = Pair(*map(jnp.asarray, (0.1, 1.0, -0.1, -1.0)))
    run = vi.simulate(bodies, start, 2, impact_log=6, method=METHODS[method])
    assert bool(run.successful)
    for time, stop in zip(run.impact_log.phase, run.impact_log.stop, strict=True):
        met = np.asarray(time)[np.asarray(stop) >= 0].reshape(-1, 2)
        np.testing.assert_allclose(met[:, 0], met[:, 1], atol=1e-9)
        assert sorted(np.asarray(stop)[np.asarray(stop) >= 0]) == [0] * len(met) + [1] * len(met)
    assert int(run.impacts.sum()) >= 4
    np.testing.assert_allclose(run.sections.x1, -run.sections.x2, atol=1e-9)
    assert float(run.y_max.max()) <= gap + 1e-12


class Slowed(eqx.Module):
    """A coefficient that falls with the speed of approach."""

    rate: Any

    def __call__(self, approach):
        return 1 / (1 + self.rate * approach)


@pytest.mark.exhaustive
def test_restitution_that_depends_on_the_speed():
    machine = dataclasses.replace(TwoBodies(), restitution=Slowed(0.4))
    run = vi.simulate(machine, machine.start(), 6, impact_log=8, method=CLOSE)
    speed, stop = np.asarray(run.impact_log.speed), np.asarray(run.impact_log.stop)
    assert (stop >= 0).sum() > 6
    k = 1 / (1 + 0.4 * speed)
    mass = np.array([1.0, 1.0, 0.5])[stop]
    lost = np.nansum(0.5 * mass * (1 - k * k) * speed**2, axis=1)
    np.testing.assert_allclose(run.impact_energy, lost, atol=1e-12)

    def last(rate):
        machine = dataclasses.replace(TwoBodies(), restitution=Slowed(rate))
        return vi.simulate(machine, machine.start(), 2, method=vi.FixedStep()).last.x1

    slope = (last(0.4 + 1e-6) - last(0.4 - 1e-6)) / 2e-6
    _, forward = jax.jvp(last, (0.4,), (1.0,))
    assert float(forward) == pytest.approx(float(slope), abs=1e-6)


class Named(NamedTuple):
    y: Any
    v: Any


@jax.tree_util.register_dataclass
@dataclasses.dataclass
class Plain:
    y: Any
    v: Any


class Own(vi.AbstractMachine):
    """A body on a spring before a wall, in a state of some kind."""

    kind: Any = eqx.field(static=True)
    amplitude: Any = 2.0

    def state(self, y, v):
        return {"y": y, "v": v} if self.kind is dict else self.kind(y, v)

    def position(self, x):
        return x["y"] if self.kind is dict else x.y

    def velocity(self, x):
        return x["v"] if self.kind is dict else x.v

    def placed(self, x, Y, V):
        return self.state(Y, V)

    @property
    def stops(self):
        return (vi.RigidStop(0.5, 0.6),)

    @property
    def cycle(self):
        return 2 * PI

    def field(self, s, x):
        y, v = self.position(x), self.velocity(x)
        return self.state(v, self.amplitude * jnp.cos(s) - 1.7 * y - 0.1 * v)

    def start(self):
        return self.state(jnp.asarray(0.1), jnp.asarray(0.2))


def quietly(call):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # lanes of a scan that fail are not what this is about
        return call()


@pytest.mark.parametrize("kind", some([dict, Named, Plain], dict))
def test_a_state_of_any_kind(kind):
    machine, plain = Own(kind), Own(Plain)
    run = vi.simulate(machine, machine.start(), 5, samples=8)
    wanted = vi.simulate(plain, plain.start(), 5, samples=8)
    assert type(run.last) is kind
    np.testing.assert_array_equal(machine.position(run.sections), wanted.sections.y)
    np.testing.assert_array_equal(machine.velocity(run.samples.state), wanted.samples.state.v)
    assert "y = " in str(run) and "v = " in str(run)
    vi.plot_history(run, machine=machine)
    vi.plot_phase_portrait(run, machine)
    slope = jax.grad(
        lambda a: machine.position(vi.simulate(Own(kind, a), machine.start(), 1).last)
    )(2.0)
    assert np.isfinite(slope) and slope != 0
    data = quietly(
        lambda: vi.scan(
            machine, {"amplitude": [1.9, 2.0], "start.y": [0.1, 0.2]}, settle=20, cycles=128,
            measure=[vi.Regime(), vi.Sections()],
        )
    )  # fmt: skip
    assert data["y"].shape[:2] == (2, 2)
    found = quietly(
        lambda: vi.basins(machine, {"start.y": (0.0, 0.4), "start.v": (-1.0, 1.0)}, resolution=3,
                          settle=20)
    )  # fmt: skip
    assert found.data.sizes == {"start.y": 3, "start.v": 3}
    orbit = vi.find_orbit(machine, vi.simulate(machine, machine.start(), 1, settle=200).last)
    assert "y = -0.25498230" in str(orbit) and "position in [-1.8579" in str(orbit)
    both = jax.tree.map(lambda x: jnp.stack([x, x]), orbit)
    assert "v = -0.221262" in str(vi.distinct_orbits(both)[0])


@pytest.mark.slow
def test_single_precision():
    numbers, starts = drawn(6)
    with jax.enable_x64(False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs = []
        for i in range(6):
            single = [jnp.asarray(x, jnp.float32) for x in numbers[:, i]]
            start = [jnp.asarray(x, jnp.float32) for x in starts[:, i]]
            runs.append(lane(single, start, 2))
    for i, run in enumerate(runs):
        assert run.last.x1.dtype == jnp.float32 and bool(run.successful)
        x, impacts, _ = flown(*numbers[:, i], starts[:, i], 4 * PI)
        assert int(run.impacts.sum()) == sum(impacts)
        np.testing.assert_allclose(jax.tree.leaves(run.last), x, atol=2e-3)
