"""Averages and quantities of a machine, checked with the energy balance.

In any cycle of a driven oscillator, the work of the drive is the sum of three terms: losses to
damping, losses in impacts, and the growth of the energy.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from vi_jax.flow import average_names

from shaken_oscillator import Shaken


class AveragedScene(vi.Scene):
    def averages(self, s, state):
        return {"taken": jnp.cos(s) * state.V, "lost": 2 * self.damping_ratio * state.V**2}

    def quantities(self, s, state):
        return {"energy": 0.5 * (state.V**2 + state.Y**2)}


class Driven(vi.Scene):
    """A motor scene that averages its speed. The mean is one turn per cycle."""

    def averages(self, s, state):
        return {"speed": state.W}


def averaged_scene(gap):
    stop = vi.RigidStop(gap, 0.5)
    return AveragedScene(damping_ratio=0.05, drive=vi.IdealDrive(0.7), stops=(stop,))


def begin(gap=0.5):
    return vi.OscillatorState(jnp.minimum(0.1, gap), jnp.asarray(0.2))


def energy_defects(run):
    work = (run.averages["taken"] - run.averages["lost"]) * run.duration
    return work - run.impact_energy - jnp.diff(run.quantities["energy"])


@pytest.mark.parametrize(
    ("method", "close"),
    [(vi.Adaptive(), 1e-9), pytest.param(vi.Taylor(), 1e-10, marks=pytest.mark.slow)],
)
def test_energy_is_balanced_through_impacts_chatter_and_rest(method, close):
    def one(gap):
        return vi.simulate(Shaken(gap=gap), begin(gap), 12, method=method, samples=8)

    run = jax.vmap(one)(jnp.array([0.5, -0.3]))
    assert int(run.impacts.sum(axis=1).min()) > 20 and run.rests.sum(axis=1).tolist() == [0, 1]
    left = jax.vmap(energy_defects)(run)
    np.testing.assert_allclose(left, 0.0, atol=close)
    push = np.cos(np.arange(97) * np.pi / 4)
    np.testing.assert_allclose(run.samples.quantities["push"], [push, push], atol=1e-12)


@pytest.mark.parametrize("gap", [1.3, 0.1], ids=["impacts", "chatter and rest"])
def test_energy_is_balanced_with_exact_flight(gap):
    scene = averaged_scene(gap)
    run = vi.simulate(scene, scene.start(Y=0.05), 12)
    assert int(run.impacts.sum()) > 10 and (run.rests is not None) == (gap < 1)
    np.testing.assert_allclose(energy_defects(run), 0.0, atol=1e-13)


def test_mean_speed_of_a_motor_is_one_turn_in_a_cycle():
    ready = vi.Parameters(torque=10.0, restitution=0.5, gap=0.05, control=1.2).scene()
    scene = Driven(
        damping_ratio=ready.damping_ratio, drive=ready.drive, stops=ready.stops, crank=ready.crank
    )
    run = vi.simulate(scene, scene.start(), 8)
    assert int(run.impacts.sum()) > 5
    np.testing.assert_allclose(run.averages["speed"], 2 * np.pi / run.duration, rtol=1e-14)
    assert float(jnp.ptp(run.duration)) > 0.01  # so the mean of the means would differ
    mean = run.mean_averages()["speed"]
    np.testing.assert_allclose(mean, 8 * 2 * np.pi / run.duration.sum(), rtol=1e-14)


class Sawtooth(NamedTuple):
    place: jax.Array


class Switching(vi.AbstractMachine):
    """A sawtooth: at height 1 a reset returns it to 0 and changes the sign of the mode."""

    cycle = 3.0

    @property
    def events(self):
        return (vi.Reset(lambda m, s, x, mode: x.place - 1.0, self._again, modes=self._other),)

    @staticmethod
    def _again(machine, s, state, mode):
        return Sawtooth(jnp.zeros_like(state.place))

    @staticmethod
    def _other(machine, s, state, mode):
        return (-mode,)

    def modes(self, s, state):
        return (1.0,)

    def field(self, s, state, mode):
        return Sawtooth(jnp.ones_like(state.place))

    def averages(self, s, state, mode):
        return {"upward": 0.5 * (1 + mode), "height": state.place}


def test_averages_with_modes_and_resets():
    """The mode is +1 for 1.75 s of the first cycle of 3 s, and for 1.25 s of the second."""
    run = vi.simulate(Switching(), Sawtooth(jnp.asarray(0.25)), 2)
    np.testing.assert_allclose(run.averages["upward"], [1.75 / 3, 1.25 / 3], atol=1e-12)
    height = (0.5 - 0.25**2 / 2 + 0.5 + 0.5 + 0.25**2 / 2) / 3
    np.testing.assert_allclose(run.averages["height"], [height, height], atol=1e-9)


@pytest.mark.parametrize(
    ("said", "kind", "match"),
    [
        ({"impacts": 1.0}, ValueError, "'impacts' is taken"),
        ({"Y": 1.0}, ValueError, "'Y' is taken"),
        ({"gap": 1.0}, ValueError, "'gap' is taken"),
        ({"energy": 1.0}, ValueError, "one of its `quantities` too"),
        ({"a b": 1.0}, ValueError, "identifiers, but got 'a b'"),
        ({"pair": jnp.zeros(2)}, TypeError, r"'pair' is an array of shape \(2,\)"),
        ({"word": "high"}, TypeError, "'word' is 'high'"),
        (3.0, TypeError, "mapping of names to numbers, but returned float"),
    ],
)
def test_invalid_averages_raise_before_any_work(said, kind, match):
    class Named(Shaken):
        def averages(self, s, state):
            return said

    with pytest.raises(kind, match=match):
        vi.simulate(Named(), begin(), 1)


class Observed(vi.AbstractMachine):
    """A driven body with a stop; the function of an average is given."""

    amplitude: float = 1.0
    level: float = 0.3

    cycle = 2 * np.pi
    contacts = vi.RigidStop(0.6, 0.5, on=("x", "u"))

    def field(self, t, z, *modes):
        push = self.amplitude * jnp.cos(t) + 0.5 * jnp.sin(2 * t)
        return dict(x=z.u, u=push - 1.3 * z.x - 0.2 * z.u)


JUMPS = {
    "sign": lambda m, t, z: jnp.sign(z.u),
    "share of time": lambda m, t, z: jnp.where(z.x > 1e-7, 1.0, 0.0),
    "a power above a level": lambda m, t, z: jnp.where(z.x > m.level, z.u**2, 0.0),
    "floor": lambda m, t, z: jnp.floor(3 * z.x),
    "a jump in time": lambda m, t, z: jnp.where(t < 1.0, z.x, 0.0),
}
CONTINUOUS = {
    "|u|": lambda m, t, z: jnp.abs(z.u) + jnp.maximum(z.x, 0.0),
    "two branches": lambda m, t, z: jnp.where(z.x > m.level, (z.x - m.level) ** 2, 0.0),
    "a root": lambda m, t, z: jnp.where(z.x > 0, jnp.sqrt(jnp.where(z.x > 0, z.x, 1.0)), 0.0),
    "a parameter": lambda m, t, z: jnp.where(m.amplitude > 0, z.x, -z.x),
    "an angle": lambda m, t, z: jnp.sin(jnp.mod(z.x, 2 * np.pi)),
}


def names_of(function, machine):
    kind = type("Given", (Observed,), {"averages": lambda m, t, z: {"mean": function(m, t, z)}})
    return average_names(kind(*machine), vi.State(x=0.0, u=0.0))


@pytest.mark.parametrize("traced", [False, True])
def test_averages_that_jump_are_refused(traced):
    call = lambda function: (
        jax.eval_shape(lambda a: [names_of(function, (a, a))] and a, 1.0)
        if traced
        else names_of(function, (1.0, 0.3))
    )
    for function in JUMPS.values():
        with pytest.raises(ValueError, match=r"continuous, but 'mean' jumps.*`Switch`"):
            call(function)
    for function in CONTINUOUS.values():
        call(function)


class ByMode(Observed):
    events = vi.Switch(lambda m, t, z: z.x - m.level)

    def averages(self, t, z, side):
        return {"above": 0.5 * (1 + side), "power": 0.5 * (1 + side) * z.u**2}


def test_the_mode_of_a_switch_gives_averages_with_a_jump():
    def means(amplitude):
        run = vi.simulate(ByMode(amplitude), vi.State(x=0.0, u=0.0), 2, method="reference")
        return jnp.stack([run.averages["above"][1], run.averages["power"][1]])

    value, slope = jax.jvp(means, (1.0,), (1.0,))
    np.testing.assert_allclose(slope, (means(1.0001) - means(0.9999)) / 2e-4, rtol=1e-6)
    # The share of samples above the level.
    x = vi.simulate(ByMode(), vi.State(x=0.0, u=0.0), 2, samples=20000).samples.state.x
    np.testing.assert_allclose(value[0], np.mean(np.asarray(x)[20001:] > 0.3), atol=1e-4)
