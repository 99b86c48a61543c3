"""White noise as impulses: paths, random numbers, and stationary means in closed form.

The oscillator is x'' + 0.2 x' + x = 0.5 dW, with temperature σ²/(4ζ) = 0.625.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from jax.extend.random import threefry_2x32
from scipy.linalg import expm
from vi_jax.flow.noise import normal_pair

from free_oscillator import Free

SIGMA, CYCLE = 0.5, 2 * np.pi
START = vi.OscillatorState(jnp.array(1.0), jnp.array(0.0))


class Walled(Free):
    """A free oscillator with a rigid stop on its left."""

    restitution: jax.Array
    place: jax.Array

    @property
    def contacts(self):
        return (vi.RigidStop(-self.place, self.restitution, "left"),)

    def averages(self, s, x):
        return {"square": x.V**2}


def walled(restitution=0.7, place=0.0):
    return Walled(jnp.array(restitution), jnp.array(place))


def white_noise(impulses=16, amplitude=SIGMA):
    return vi.WhiteNoise({"V": amplitude}, impulses=impulses)


KEYS = jax.random.split(jax.random.key(5), 21)


def paths(keys=KEYS, machine=None, cycles=8, **options):
    machine = walled() if machine is None else machine

    def one(key):
        return vi.simulate(machine, START, cycles, noise=white_noise(), key=key, **options)

    return jax.vmap(one)(keys)


@pytest.fixture(scope="module")
def many():
    return paths()


def means(values):
    """Return the mean over lanes and its standard error, from the mean of each lane."""
    each = np.asarray(values).reshape(len(values), -1).mean(axis=1)
    return np.array([each.mean(), each.std(ddof=1) / len(each) ** 0.5])


def test_numbers_are_normal_and_independent():
    key, count = jax.random.key_data(jax.random.key(1)), jnp.arange(200_000, dtype=jnp.uint32)
    x, y = (np.asarray(a) for a in normal_pair(key, count // 64, count % 64, jnp.float64))
    n = len(x)
    for z in (x, y):
        for power, moment, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
            assert abs(np.mean(z**power) - moment) < 4 * (variance / n) ** 0.5
        assert abs(np.mean(z[1:] * z[:-1])) < 4 / n**0.5
    assert abs(np.mean(x * y)) < 4 / n**0.5
    assert abs(np.mean(x**2 * y**2) - 1) < 4 * (8 / n) ** 0.5


def test_the_path_is_the_linear_flow_with_jumps_between():
    key, n, cycles = KEYS[3], 16, 5
    run = vi.simulate(Free(), START, cycles, noise=white_noise(n), key=key)
    words, x, found = jax.random.key_data(key), np.array([1.0, 0.0]), [[1.0, 0.0]]
    flow = expm(np.array([[0.0, 1.0], [-1.0, -0.2]]) * CYCLE / n)
    for cycle in range(cycles):
        for instant in range(n):
            bits = np.asarray(threefry_2x32(words, jnp.array([cycle, instant], jnp.uint32)))
            u, turn = (bits[0] + 0.5) / 2**32, bits[1] / 2**32
            normal = np.sqrt(-2 * np.log(u)) * np.cos(2 * np.pi * turn)
            x = flow @ x + [0.0, SIGMA * np.sqrt(CYCLE / n) * normal]
        found.append(x)
    here = np.stack([run.sections.Y, run.sections.V], axis=1)
    np.testing.assert_allclose(here, found, atol=1e-9)


def test_samples_do_not_change_the_path(many):
    V = np.asarray(many.sections.V)
    np.testing.assert_allclose(paths(samples=4).sections.V, V, atol=1e-11)


def test_samples_lie_at_exact_instants():
    """Samples lie at impulses 49 and 98 of 98. In floats, 49 * (1 / 49) is less than 1."""
    run = vi.simulate(Free(), START, 3, samples=2, noise=white_noise(98, 0.0), key=KEYS[0])
    flow = expm(np.array([[0.0, 1.0], [-1.0, -0.2]]) * CYCLE / 2)
    path = [(1.0, 0.0)]
    for _ in range(6):
        path.append(flow @ path[-1])
    np.testing.assert_allclose(run.sections.Y, np.array(path)[::2, 0], atol=1e-9)
    np.testing.assert_allclose(run.samples.state.Y, np.array(path)[:, 0], atol=1e-9)


@pytest.mark.slow
def test_backends_do_not_change_the_path(many):
    with vi.backend("xla"):
        np.testing.assert_allclose(paths().sections.V, many.sections.V, atol=1e-11)


@pytest.mark.slow
def test_noise_counts_cycles_that_settle():
    whole = paths(record="sections").sections.V
    late = paths(cycles=5, settle=3, record="sections").sections.V
    assert np.array_equal(late, whole[:, 3:])


@pytest.mark.slow
def test_derivatives_follow_the_path():
    def last(x):
        noise = white_noise(16, x[0])
        return vi.simulate(walled(x[1]), START, 3, noise=noise, key=KEYS[0]).last.V

    at, step = jnp.array([0.5, 0.7]), 1e-6
    differences = [(last(at + e) - last(at - e)) / (2 * step) for e in step * jnp.eye(2)]
    for mode in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(mode(last)(at), differences, rtol=1e-6)


@pytest.mark.slow
def test_energy_is_balanced_with_rests_between_impulses():
    """The spring presses the body on its stop, where it rests between impulses."""
    restitution, place = 0.5, 0.3
    machine = walled(restitution, place)

    def one(key):
        options = {"settle": 20, "noise": white_noise(), "key": key, "impact_log": 96}
        run = vi.simulate(machine, START, 100, **options)
        speeds = jnp.nansum(run.impact_log.speed**2, axis=-1)
        lost = 0.2 * run.averages["square"] + 0.5 * (1 - restitution**2) * speeds / CYCLE
        return lost, run.impacts, run.y_min

    lost, impacts, lowest = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(2), 256))
    assert np.max(impacts) <= 96
    assert np.min(lowest) >= place - 1e-12
    mean, error = means(lost)
    assert error < 2e-3
    assert abs(mean - SIGMA**2 / 2) < 3 * error


class Growing(vi.AbstractMachine):
    """x' = 0.3 x, with a cycle of 1."""

    cycle = 1.0

    def field(self, s, x):
        return {"x": 0.3 * x["x"]}


def half_of_state(state):
    return 0.5 * state["x"]


def test_amplitude_that_depends_on_the_state_follows_ito():
    """Geometric Brownian motion dx = 0.3 x dt + 0.5 x dW has known moments for any number of
    impulses. Stratonovich's interpretation has a mean that is larger by exp(0.25), or 28 %."""
    noise, start = vi.WhiteNoise({"x": half_of_state}, impulses=8), {"x": jnp.array(1.0)}

    def last(key):
        return vi.simulate(Growing(), start, 2, noise=noise, key=key).last["x"]

    found = np.asarray(jax.jit(jax.vmap(last))(jax.random.split(jax.random.key(8), 20_000)))
    truth = (np.exp(0.6), np.exp(1.2) * (1 + 0.25 / 8) ** 16)
    for power, moment in enumerate(truth, 1):
        mean, error = means(found**power)
        assert error < 0.02 * moment
        assert abs(mean - moment) < 3 * error


def test_constant_function_equals_a_number():
    noise = vi.WhiteNoise({"V": lambda state: SIGMA}, impulses=16)
    run = vi.simulate(walled(), START, 8, noise=noise, key=KEYS[5])
    assert np.array_equal(run.sections.V, paths(KEYS[5:6]).sections.V[0])


class Reset(Free):
    """An oscillator with an event that a jump of the velocity can cross."""

    @property
    def events(self):
        return (vi.Reset(lambda machine, s, x: x.V - 9.0, lambda machine, s, x: x),)


VALVE = vi.machines.ReliefValve(flow_rate=5.0)


@pytest.mark.parametrize(
    "machine, options, message",
    [
        (walled(), {"noise": 0.5}, "must be a `WhiteNoise`"),
        (walled(), {"key": None}, "Argument `key` must be one key"),
        (walled(), {"key": KEYS}, "use `jax.vmap`"),
        (walled(), {"samples": 5}, "must divide the number of impulses"),
        (walled(), {"noise": vi.WhiteNoise({"W": 0.5})}, r"parts of the state \(Y, V\)"),
        (walled(), {"noise": vi.WhiteNoise({"Y": 0.5})}, "must change velocities only"),
        (walled(), {"noise": vi.WhiteNoise({"V": jnp.array([0.5, 1.0])})}, "one amplitude"),
        (walled(), {"noise": vi.WhiteNoise({"V": lambda x: jnp.ones(2)})}, "one returns shape"),
        (walled(), {"noise": vi.WhiteNoise({"V": lambda x: 1j})}, "must hold real numbers, but"),
        (VALVE, {}, r"as `machine.observed_every\(interval\)`"),
        (Reset(), {}, "without resets"),
    ],
)
def test_invalid_arguments_raise(machine, options, message):
    given = {"noise": white_noise(), "key": KEYS[0], **options}
    start = START if isinstance(machine, Free) else machine.start()
    with pytest.raises((TypeError, ValueError), match=message):
        vi.simulate(machine, start, 2, **given)


@pytest.mark.parametrize("amplitudes", [{}, 0.5, {"V": -1.0}, {"V": np.nan}, {"V": 1j}])
def test_amplitudes_are_checked(amplitudes):
    with pytest.raises((TypeError, ValueError), match="Argument `amplitudes`"):
        vi.WhiteNoise(amplitudes)
