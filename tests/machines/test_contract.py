"""User-defined machines: two bodies with three contacts, states of any kind."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import vi_jax as vi

from differences import check_derivatives
from event_by_event import followed
from two_bodies import TwoBodies

matplotlib.use("Agg")

CLOSE = vi.Adaptive(rtol=1e-12)
PI = np.pi


def integrate_with_scipy(gap, k, force, ratio, x, duration):
    """Return state, impacts and lost energy from SciPy's DOP853, with laws written independently,
    or `None` for a motion with impacts too weak to be distinguished from rest."""

    def rate(t, x):
        spring = 0.5 * (x[0] - x[2])
        first = force * np.cos(t) - x[0] - spring - 0.1 * x[1]
        return [x[1], first, x[3], (spring - x[2] - 0.05 * x[3]) / ratio]

    def hit(which):
        def jump(t, x):
            nonlocal lost
            before, speed = x.copy(), (x[1], -x[3], x[1] - x[3])[which]
            if which == 0:
                x[:2] = gap, -k * x[1]
            elif which == 1:
                x[2:] = -gap, -k * x[3]
            else:
                impulse = (1 + k) * speed * ratio / (1 + ratio)
                x[1], x[3] = x[1] - impulse, x[3] + impulse / ratio
                middle = (x[0] + ratio * x[2]) / (1 + ratio)
                x[0], x[2] = middle + 0.4 * ratio / (1 + ratio), middle - 0.4 / (1 + ratio)
            lost += 0.5 * np.dot((1, ratio), before[1::2] ** 2 - x[1::2] ** 2)
            return None if speed < 1e-3 else x

        return jump

    guards = [lambda t, x: x[0] - gap, lambda t, x: -x[2] - gap, lambda t, x: x[0] - x[2] - 0.4]
    lost, events = 0.0, [(guard, hit(i)) for i, guard in enumerate(guards)]
    t, x, met = followed(rate, x, duration, events, max_step=0.05)
    return None if t < duration - 1e-12 else (x, [met.count(i) for i in range(3)], lost)


def random_cases(number):
    draw = np.random.default_rng(1).uniform
    numbers = np.stack([draw(0.3, 1, number), draw(0.3, 0.9, number), draw(0.3, 1.2, number),
                        draw(0.4, 2, number)])  # fmt: skip
    first = draw(-0.2, 0.2, number)
    zero = np.zeros(number)
    return numbers, np.stack([first, zero, first - draw(-0.05, 0.05, number), zero])


def lane(numbers, start, cycles=4, **options):
    machine, (x, u, y, v) = TwoBodies(*numbers), start
    return vi.simulate(machine, machine.at(x=x, y=y, v=dict(x=u, y=v)), cycles, **options)


def list_components(z):
    return [z.x, z.v.x, z.y, z.v.y]


METHODS = {
    "adaptive": CLOSE, "fixed": vi.FixedStep(steps_per_cycle=48), "taylor": vi.Taylor(18, 12),
}  # fmt: skip


@pytest.mark.slow
def test_two_bodies_with_three_contacts():
    numbers, starts = random_cases(100)
    runs = [
        vi.jit(jax.vmap(lambda p, x, m=m: lane(p, x, method=m, impact_log=40), in_axes=1))(
            jnp.asarray(numbers), jnp.asarray(starts)
        )
        for m in METHODS.values()
    ]
    # A turning point of one coordinate must not hide that of the other at the end of a step.
    plain = vi.jit(
        jax.vmap(
            lambda p, x: lane(p, x, method=vi.Taylor(20, rtol=1e-12), record="sections"), in_axes=1
        )
    )(jnp.asarray(numbers), jnp.asarray(starts))
    compared, several = 0, np.zeros(3, int)
    for i in range(100):
        wanted = integrate_with_scipy(*numbers[:, i], starts[:, i], 8 * PI)
        if wanted is None:
            continue
        x, impacts, lost = wanted
        for run in runs:
            assert bool(run.successful[i])
            found = [leaf[i, -1] for leaf in list_components(run.sections)]
            np.testing.assert_allclose(found, x, atol=2e-7)
            stop = np.asarray(run.impact_log.stop[i])
            assert [int((stop == j).sum()) for j in range(3)] == impacts
            assert float(run.impact_energy[i].sum()) == pytest.approx(lost, abs=1e-7)
        for run in (runs[0], plain):
            found = [leaf[i, -1] for leaf in list_components(run.sections)]
            np.testing.assert_allclose(found, x, atol=1e-8)
        assert int(plain.impacts[i].sum()) == sum(impacts)
        compared, several = compared + 1, several + impacts
    assert compared > 80 and (several > 100).all()


@pytest.mark.slow
def test_derivatives_of_two_bodies():
    """Derivatives with respect to all parameters and the start, through all three contacts."""
    numbers, starts = random_cases(100)
    log = vi.jit(jax.vmap(lambda p, x: lane(p, x, 2, impact_log=16).impact_log.stop, in_axes=1))(
        jnp.asarray(numbers), jnp.asarray(starts)
    )
    kinds = np.stack([(np.asarray(log) == j).any(axis=(1, 2)) for j in range(3)])
    i = int(np.flatnonzero(kinds.all(axis=0))[0])

    def last(x):
        run = lane(x[:4], x[4:], 2, method=vi.FixedStep(diffrax.Tsit5(), steps_per_cycle=200))
        return run.last, run.impacts

    at = [*numbers[:, i], *starts[:, i]]
    check_derivatives(last, at, step=1e-6, tolerance=2e-6, impacts=3)


class Own(vi.AbstractMachine):
    """A body on a spring before a stop; its state is a dictionary."""

    amplitude: Any = 2.0

    def position(self, x):
        return x["y"]

    def velocity(self, x):
        return x["v"]

    def placed(self, x, Y, V):
        return {"y": Y, "v": V}

    @property
    def contacts(self):
        return (vi.RigidStop(0.5, 0.6),)

    cycle = 2 * PI

    def field(self, s, x):
        pull = self.amplitude * jnp.cos(s) - 1.7 * x["y"] - 0.1 * x["v"]
        return {"y": x["v"], "v": pull}

    def start(self):
        return {"y": jnp.asarray(0.1), "v": jnp.asarray(0.2)}


@pytest.mark.slow
def test_state_can_be_a_dictionary():
    machine = Own()
    run = vi.simulate(machine, machine.start(), 5, samples=8)
    plain = vi.machines.Duffing(
        amplitude=2.0, frequency=1.0, damping=0.1, stiffness=1.7, cubic=0.0, gap=0.5,
        restitution=0.6, two_sided=False,
    )  # fmt: skip
    wanted = vi.simulate(plain, plain.start(Y=0.1, V=0.2), 5, samples=8)
    assert type(run.last) is dict
    np.testing.assert_allclose(run.sections["y"], wanted.sections.Y, atol=1e-8)
    np.testing.assert_allclose(run.samples.state["v"], wanted.samples.state.V, atol=1e-8)
    assert "y = " in str(run) and "v = " in str(run)
    vi.plot_history(run, machine=machine)
    vi.plot_phase_portrait(run, machine)


@pytest.mark.slow
def test_bodies_that_push_each_other_onto_walls():
    """Without restitution, ever weaker impacts alternate between two contacts until both close."""
    draw = np.random.default_rng(7).uniform
    first, speeds = draw(-0.2, 0.2, 64), draw(-1, 1, (2, 64))
    starts = map(jnp.asarray, (first, speeds[0], 0.5 * first - 0.1, speeds[1]))

    @vi.jit
    @jax.vmap
    def one(x, u, y, v):
        pushed = TwoBodies(gap=0.25, restitution=0.0, drive=1.5)
        return vi.simulate(pushed, pushed.at(x=x, y=y, v=dict(x=u, y=v)), 30)

    run = one(*starts)
    assert bool(run.successful.all())
    assert int(run.rests.sum()) > 1000
    assert (np.asarray(run.impact_energy) >= 0).all()
    gap = 0.25 + 1e-12
    assert float(run.sections.x.max()) <= gap and float(run.sections.y.min()) >= -gap
    assert float((run.sections.x - run.sections.y).max()) <= 0.4 + 1e-12


class Filter(vi.AbstractMachine):
    """x' = cos s - rate·x and y' = x - 2y."""

    rate: jax.Array
    cycle = 2 * np.pi

    def field(self, s, z):
        return dict(x=jnp.cos(s) - self.rate * z.x, y=z.x - 2 * z.y)

    def start(self):
        return vi.State(x=0.3, y=0.1)


@pytest.mark.slow
def test_a_machine_without_stops_needs_no_position():
    """The extremes are those of the first number of the state."""
    machine = Filter(jnp.asarray(1.0))
    orbit = vi.find_orbit(machine, machine.start())
    run = vi.simulate(machine, orbit.state, 1)
    x = 1 / (1j + 1)
    wanted = x.real, (x / (1j + 2)).real
    for state in (orbit.state, run.last):
        np.testing.assert_allclose([state.x, state.y], wanted, atol=1e-9)
    assert float(run.y_max[0]) == pytest.approx(abs(x), abs=1e-8)
    np.testing.assert_allclose(orbit.multipliers, np.exp([-2 * np.pi, -4 * np.pi]), atol=1e-9)
    branch = vi.continue_orbit(orbit, parameter="rate", bounds=(0.5, 2.0))
    np.testing.assert_allclose(branch.y_max, 1 / np.abs(1j + branch.parameter), atol=1e-9)
    with pytest.raises(TypeError, match="`start` must hold real numbers, but got 'none'"):
        vi.simulate(machine, "none", 1)


class Apart(TwoBodies):
    """Only the second body reaches its stop."""

    @property
    def contacts(self):
        far = vi.RigidStop(9.0, self.restitution, on="x")
        return far, vi.RigidStop(0.05, self.restitution, "left", on="y")


@pytest.mark.slow
def test_a_stop_of_another_coordinate_does_not_limit_the_first():
    machine = Apart(damping=0.5)
    orbit = vi.find_orbit(machine, vi.simulate(machine, machine.at(x=0.1), 1, settle=200).last)
    assert bool(orbit.successful) and int(orbit.impacts) == 2
    assert float(orbit.y_min) < -0.05 and bool(orbit.admissible)
