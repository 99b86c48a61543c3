"""Forces, gaps and thresholds that change within one step while the state does not. Motions are
compared with closed forms from event to event."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq
from scipy.special import erf

WAVES = (1, 2, 3, 5, 7)
STILL = vi.OscillatorState(jnp.array(0.0), jnp.array(0.0))


class Force:
    """steady + Σ size cos(n ω s + phase) + height exp(-((s - place)/width)²), and its integrals."""

    def __init__(self, steady, sizes, phases, cycle, height, place, width):
        self.steady, self.sizes, self.phases, self.cycle = steady, sizes, phases, cycle
        self.height, self.place, self.width = height, place, width

    def __call__(self, s):
        return self.steady + self._waves(s, 0) + self._pulse(s, 0)

    def moved(self, s, Y, V, t, drag=0.0):
        """Return position and velocity of a body at the times t under the force and a `drag`."""
        d, steady = t - s, self.steady - drag
        once = [self._waves(x, 1) + self._pulse(x, 1) for x in (s, t)]
        twice = [self._waves(x, 2) + self._pulse(x, 2) for x in (s, t)]
        V1 = V + steady * d + once[1] - once[0]
        return Y + V * d + 0.5 * steady * d * d + twice[1] - twice[0] - once[0] * d, V1

    def _waves(self, s, order):
        total = 0.0
        for n, size, phase in zip(WAVES, self.sizes, self.phases, strict=True):
            rate = 2 * np.pi * n / self.cycle
            total = total + size * np.cos(rate * s + phase - order * np.pi / 2) / rate**order
        return total

    def _pulse(self, s, order):
        z, scale = (s - self.place) / self.width, self.width * np.pi**0.5 / 2
        bell = np.exp(-z * z)
        each = bell, scale * erf(z), scale * self.width * (z * erf(z) + bell / np.pi**0.5)
        return self.height * each[order]


def first_root(function, begin, end, short):
    """Return where a function, negative after `begin`, first becomes positive, or infinity."""
    near = begin + short * 1.1 ** np.arange(400)
    grid = np.concatenate([near[near < begin + 1e-3], np.arange(begin + 1e-3, end, 1e-3), [end]])
    above = np.flatnonzero(function(grid) > 0)
    if not above.size:
        return np.inf
    n = above[0]
    return grid[0] if n == 0 else brentq(function, grid[n - 1], grid[n], xtol=1e-15)


def floor(force, k, end):
    """Return greatest height and last state of a body on a floor. Hops below 1e-10 are left out."""
    s, V, top = 0.0, 0.0, 0.0
    for _ in range(500):
        if V == 0:
            s = s if force(s) > 0 else first_root(force, s, end, 1e-6)
            if s >= end:
                return top, 0.0, 0.0
        short = 0.1 * V / abs(force(s)) if V else 1e-3
        hit = first_root(lambda t: -1e-14 - force.moved(s, 0.0, V, t)[0], s, end, short)  # noqa: B023
        grid = np.linspace(s, min(hit, end), 2000)
        top = max(top, force.moved(s, 0.0, V, grid)[0].max())
        if hit >= end:
            return top, *force.moved(s, 0.0, V, end)
        s, V = hit, -k * force.moved(s, 0.0, V, hit)[1]
        V = 0.0 if V < 1e-5 and force(s) < 0 else V
    raise AssertionError("the impacts had no end")


def block(force, level, end):
    """Return the greatest position and the last state of a block with dry friction."""
    s, Y, V, mode, top = 0.0, 0.0, 0.0, 0.0, 0.0
    for _ in range(500):
        if mode == 0:
            if abs(force(s)) <= level:
                s = first_root(lambda t: abs(force(t)) - level, s, end, 1e-6)
            if s >= end:
                return top, Y, 0.0
            mode = np.sign(force(s))
        drag = mode * level
        stop = first_root(lambda t: -mode * force.moved(s, Y, V, t, drag)[1], s, end, 1e-5)  # noqa: B023
        Y, V = force.moved(s, Y, V, min(stop, end), drag)
        if stop >= end:
            return max(top, Y), Y, V
        s, V, top = stop, 0.0, max(top, Y)
        mode = 0.0 if abs(force(s)) <= level else np.sign(force(s))
    raise AssertionError("the block never came to rest")


class Pushed(vi.AbstractMachine):
    sizes: Any = None
    phases: Any = None
    cycle: Any = 1.0
    height: Any = 0.0
    place: Any = 0.0
    width: Any = 1.0
    steady: Any = 0.0

    def push(self, s):
        waves = sum(
            size * jnp.cos(2 * np.pi * n * s / self.cycle + phase)
            for n, size, phase in zip(WAVES, self.sizes, self.phases, strict=True)
        )
        pulse = self.height * jnp.exp(-(((s - self.place) / self.width) ** 2))
        return self.steady + waves + pulse


class Floor(Pushed):
    contacts = vi.RigidStop(0.0, 0.5, "left")

    def field(self, s, x):
        return vi.OscillatorState(x.V, self.push(s))


class Block(Pushed):
    level: float = 0.5
    stiffness: Any = 0.0

    @property
    def contacts(self):
        return vi.DryFriction(self.level, on="V")

    def field(self, s, x):
        return vi.OscillatorState(x.V, self.push(s) - self.stiffness * x.Y)


def pushes(steady, count=20, seed=3):
    """Return forces of five waves, and four steady forces with a pulse."""
    random = np.random.default_rng(seed)
    size = np.linspace(0.3, 1.5, count)[:, None]
    sizes = random.normal(size=(count, 5))
    sizes *= size / np.linalg.norm(sizes, axis=1, keepdims=True)
    waves = [(a, random.uniform(0, 6.3, 5), 2 * np.pi, 0.0, 3.0, 1.0) for a in sizes]
    pulses = [(np.zeros(5), np.zeros(5), 12.0, 2.0, 5.0, w) for w in (0.7, 0.6, 0.5, 0.3)]
    return [Force(steady, *numbers) for numbers in (*waves, *pulses)]


def columns(forces):
    names = ("steady", "sizes", "phases", "cycle", "height", "place", "width")
    return {name: jnp.asarray([getattr(x, name) for x in forces]) for name in names}


def simulate_forces(make, forces, method):
    """Return the greatest position and the last state under each force."""

    @jax.jit
    @jax.vmap
    def run(force):
        run = vi.simulate(make(**force), STILL, 1, method=method)
        return run.y_max[0], run.last.Y, run.last.V, run.successful

    *found, good = run(columns(forces))
    assert np.all(np.asarray(good))
    return np.stack(found, axis=1)


@pytest.mark.parametrize("method", [None, vi.FixedStep(steps_per_cycle=20)], ids=["a", "f"])
def test_body_leaves_its_floor_under_every_pull(method):
    forces = pushes(-1.0)
    truth = np.array([floor(x, 0.5, x.cycle) for x in forces])
    # Published heights for the pulses.
    assert np.allclose(truth[-4:, 0], [0.868702, 0.638230, 0.443215, 0.159558], atol=1e-6)
    found = simulate_forces(Floor, forces, method)
    close = 1e-5 if method is None else 2e-3  # for pulses as short as a step
    assert np.abs(found - truth)[:-4].max() < 1e-5
    assert np.abs(found - truth)[-4:].max() < close


class Eased(vi.AbstractMachine):
    """A body on a floor; the pressing force decays and leaves a small pull."""

    cycle: float = 2 * np.pi
    contacts: tuple = (vi.RigidStop(0.0, 0.5, "left"),)

    def field(self, s, x):
        return vi.OscillatorState(x.V, 1e-5 - jnp.exp(-20 * s))


@pytest.mark.parametrize("method", [None, vi.FixedStep()], ids=["a", "f"])
def test_body_leaves_when_a_small_lasting_pull_begins(method):
    """The chord of the force over a step is zero near the step's end, at every iteration."""
    run, begin = vi.simulate(Eased(), STILL, 1, method=method), np.log(1e5) / 20
    d, fall = 2 * np.pi - begin, 1e-5 / 20  # e^(-20 begin) is 1e-5
    assert bool(run.successful)
    np.testing.assert_allclose(run.last.V, 1e-5 * d - fall, rtol=1e-6)
    np.testing.assert_allclose(run.last.Y, 0.5e-5 * d * d - fall * d + fall / 20, rtol=1e-6)


@pytest.mark.parametrize("method", [None, vi.Taylor(rtol=1e-10)], ids=["a", "t"])
def test_block_slips_under_every_sufficient_pull(method):
    forces = pushes(0.0)
    truth = np.array([block(x, 0.5, x.cycle) for x in forces])
    assert np.abs(simulate_forces(Block, forces, method) - truth).max() < 1e-6


@pytest.mark.slow
def test_block_on_a_spring_slips_and_sticks_in_turn():
    """Forty events in five cycles. Steps chosen from the state alone would grow to a fifth."""
    sizes = jnp.array([0.0, 0.55, 0.0, 0.0, 0.0])
    machine = Block(sizes=sizes, phases=jnp.zeros(5), cycle=2 * np.pi, stiffness=0.3)
    start = vi.OscillatorState(jnp.array(0.1), jnp.array(0.0))
    run = vi.simulate(machine, start, 5, event_log=10)
    kinds = np.asarray(run.event_log.kind)
    assert np.sum(kinds == vi.EVENTS.index("mode")) == 40
    assert abs(float(run.last.Y) - 0.0257) < 5e-5


class Dips(vi.AbstractMachine):
    """y' = 2 (s - 5); a reset adds 100 when y falls through zero."""

    cycle: float = 10.0
    events: tuple = (
        vi.Reset(lambda _, s, x: -x.Y, lambda _, s, x: vi.OscillatorState(x.Y + 100, x.V)),
    )

    def field(self, s, x):
        return vi.OscillatorState(2 * (s - 5), jnp.zeros_like(s))


def test_barely_reached_reset_happens_without_recorded_turning_points():
    depths = jnp.array([1.0, 0.01, 1e-4, 1e-6, -1e-6])

    @jax.vmap
    def run(depth):
        start = vi.OscillatorState(25 - depth, jnp.zeros(()))
        return vi.simulate(Dips(), start, 1, record="sections", method="reference").last.Y

    expected = np.where(depths > 0, 125.0, 25.0) - depths
    assert np.abs(np.asarray(run(depths)) - expected).max() < 1e-9


@pytest.mark.parametrize("name", ["Adaptive", "FixedStep", "Taylor", "ExactFlight"])
def test_error_estimates_use_half_as_long_steps(name):
    method, scene = getattr(vi, name)(), vi.Scene.ideal(frequency_ratio=0.9)
    place = scene, jnp.array(0.3), scene.start()
    assert float(method.tighter().longest(*place)) <= 0.5 * float(method.longest(*place))
