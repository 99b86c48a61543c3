"""User-defined machines: two bodies with three contacts."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi

from differences import check_derivatives
from event_by_event import followed
from two_bodies import TwoBodies

CLOSE = vi.Adaptive(rtol=1e-12)


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


def simulate_lanes(**options):
    numbers, starts = map(jnp.asarray, random_cases(100))
    return vi.jit(jax.vmap(lambda p, x: lane(p, x, **options), in_axes=1))(numbers, starts)


@pytest.fixture(scope="module")
def close():
    return simulate_lanes(method=CLOSE, impact_log=40)


@pytest.mark.slow
def test_two_bodies_with_three_contacts(close):
    numbers, starts = random_cases(100)
    runs = close, simulate_lanes(method=vi.FixedStep(steps_per_cycle=48), impact_log=40)
    # A turning point of one coordinate must not hide that of the other at the end of a step.
    plain = simulate_lanes(method=vi.Taylor(20, rtol=1e-12), record="sections")
    compared, several = 0, np.zeros(3, int)
    for i in range(40):  # SciPy is slow
        wanted = integrate_with_scipy(*numbers[:, i], starts[:, i], 8 * np.pi)
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
    assert compared > 35 and (several > 100).all()


@pytest.mark.slow
def test_derivatives_of_two_bodies(close):
    """Derivatives with respect to all parameters and the start, through all three contacts."""
    numbers, starts = random_cases(100)
    early = np.asarray(close.impact_log.stop)[:, :2]
    kinds = np.stack([(early == j).any(axis=(1, 2)) for j in range(3)])
    i = int(np.flatnonzero(kinds.all(axis=0))[0])

    def last(x):
        run = lane(x[:4], x[4:], 2, method=vi.FixedStep(diffrax.Tsit5(), steps_per_cycle=200))
        return run.last, run.impacts

    at = [*numbers[:, i], *starts[:, i]]
    check_derivatives(last, at, step=1e-6, tolerance=2e-6, impacts=3)
