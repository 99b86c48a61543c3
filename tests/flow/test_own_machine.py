"""User-defined machines: their parts, and the errors and warnings about wrong ones."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


class Ball(eqx.Module):
    """Height Y and velocity V of the ball."""

    Y: jax.Array
    V: jax.Array


class BouncingBall(vi.AbstractMachine):
    """Free fall on a floor at Y = 0, with a section every second: a machine of few parts."""

    gravity: jax.Array
    contacts: tuple[vi.RigidStop, ...]
    cycle = 1.0

    def field(self, s, state):
        return Ball(state.V, -self.gravity)


def ball(gravity=2.0, restitution=0.8):
    return BouncingBall(jnp.asarray(gravity), (vi.RigidStop(0.0, restitution, "left"),))


def test_own_machines_have_one_clock_and_no_closed_form():
    start = Ball(jnp.asarray(1.0), jnp.asarray(0.0))
    with pytest.raises(ValueError, match=r"`clock` must be left out.*'time'"):
        vi.simulate(ball(), start, 1, clock="time")
    with pytest.raises(ValueError, match=r"`ExactFlight` needs a `Scene`.*BouncingBall"):
        vi.simulate(ball(), start, 1, method=vi.ExactFlight())


class Swapped(BouncingBall):
    """A field that takes the state first, as in other libraries."""

    def field(self, state, s):  # pyright: ignore
        return Ball(state.V, -self.gravity * jnp.cos(s))


class Clockless(BouncingBall):
    def field(self, state):  # pyright: ignore
        return Ball(state.V, -self.gravity)


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        (Swapped, "`field` of a Swapped must take `t` first and then the state"),
        (Clockless, "`field` of a Clockless must take `t`, the state, but takes `"),
    ],
)
def test_field_with_other_arguments_raises(kind, told):
    with pytest.raises(TypeError, match=told):
        vi.simulate(kind(jnp.asarray(1.0), ()), Ball(*map(jnp.asarray, (0.1, 0.0))), 2)


class Shaken(BouncingBall):
    """A driven ball; its frequency and its cycle are independent parameters."""

    frequency: jax.Array = eqx.field(default=1.0, converter=jnp.asarray)
    length: jax.Array = eqx.field(default=2 * np.pi, converter=jnp.asarray)

    @property
    def cycle(self):
        return self.length

    def field(self, s, state):
        shaken = self.gravity * jnp.sin(self.frequency * s) * jnp.clip(state.Y, 1.0, 2.0)
        return Ball(state.V, shaken - state.Y - jax.nn.relu(state.V) ** 2)


def test_samples_cost_nothing_while_settling():
    scene = vi.Parameters(control=0.9).scene()
    options = {"clock": "time", "samples": 64}
    whole = vi.simulate(scene, scene.start(), 33, **options)
    settled = vi.simulate(scene, scene.start(), 3, settle=30, **options)
    assert int(settled.steps) < 0.35 * int(whole.steps)
    for name in "YVW":
        a, b = (getattr(run.samples.state, name) for run in (settled, whole))
        np.testing.assert_allclose(a, b[30 * 64 :], atol=1e-6)
    np.testing.assert_allclose(settled.duration, whole.duration[30:], atol=1e-8)
    np.testing.assert_array_equal(settled.impacts, whole.impacts[30:])


@pytest.mark.parametrize("cycle", [0.0, -1.0, np.nan])
def test_invalid_cycle_raises(cycle):
    start, machine = Ball(*map(jnp.asarray, (1.0, 0.3))), Shaken(jnp.asarray(1.0), (), 1.0, cycle)
    with pytest.raises(ValueError, match=f"`cycle` of a Shaken must be positive .*but is {cycle}"):
        vi.simulate(machine, start, 1)


class Neuron(vi.AbstractMachine):
    """A leaky integrator with a threshold; its state is a dictionary."""

    current: float = 1.5
    cycle = 1.0
    events = vi.Reset(
        lambda m, s, z: z["v"] - 1, lambda m, s, z: {"v": 0.0, "n": z["n"] + 1}, ends_cycle=True
    )

    def field(self, s, z):
        return {"v": self.current - z["v"], "n": 0.0}


def test_reset_of_a_dictionary_state():
    run = vi.simulate(Neuron(), {"v": 0.0, "n": 0.0}, 3)
    np.testing.assert_allclose(run.duration, np.log(3), rtol=1e-8)
    assert run.last["n"] == 3


class Guarded(BouncingBall):
    """A ball with events as a parameter."""

    events: tuple = ()


def _above_zero(machine, s, x):
    return jnp.maximum(x.Y - 1, 0.0)


def _partly_nan(machine, s, x):
    return jnp.sqrt(x.Y) - 1


@pytest.mark.parametrize(("guard", "number"), [(_above_zero, 1), (_partly_nan, 0)])
def test_guard_that_is_never_negative_warns_once(guard, number):
    event = vi.Reset(guard, lambda m, s, x: Ball(x.Y, -x.V), name="lid")
    machine = type("Own", (Guarded,), {})(jnp.asarray(1.0), (), (event,))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(2):
            vi.simulate(machine, Ball(*map(jnp.asarray, (0.5, 0.0))), 1)
    words = "guard of event 0 (lid) of a Own was not below zero"
    assert sum(words in str(x.message) for x in told) == number
