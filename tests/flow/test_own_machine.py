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


class Wrong(BouncingBall):
    """A machine with one wrong part, chosen by `kind`."""

    kind: str = eqx.field(static=True, default="")

    @property
    def cycle(self):
        return (lambda: 1.0) if self.kind == "cycle" else 1.0

    def field(self, s, state):
        return Ball(state.V, jnp.ones(2) if self.kind == "shape" else -self.gravity)


@pytest.mark.parametrize(
    ("kind", "stops", "told"),
    [
        ("cycle", (), "`cycle` of a Wrong must be a number"),
        ("shape", (), "`field` of a Wrong must return"),
        ("", (0.5,), "`contacts` of a Wrong must be a tuple of contacts"),
        ("", (vi.RigidStop(0.5, 0.5, coordinate=1),), "limits coordinate 1, but there are 1"),
    ],
)
def test_wrong_parts_raise(kind, stops, told):
    machine = Wrong(jnp.asarray(1.0), stops, kind)
    with pytest.raises((TypeError, ValueError), match=told):
        vi.simulate(machine, Ball(*map(jnp.asarray, (0.1, 0.0))), 2)


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
        (Swapped, "`field` of a Swapped must take `s` first and then the state"),
        (Clockless, "`field` of a Clockless must take `s`, the state: too many"),
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


@pytest.mark.slow
def test_field_of_another_period_than_its_cycle_warns_once():
    start, floor = Ball(*map(jnp.asarray, (1.0, 0.3))), ()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for frequency, length in ((1.0, 6.28318), (2.0, np.pi), (3.0, 2 * np.pi)):
            vi.simulate(Shaken(jnp.asarray(1.0), floor, frequency, length), start, 2)
        # Traced values cannot be compared, so there is no warning.
        machine = Shaken(jnp.asarray(1.0), floor, 1.1)
        jax.jit(lambda x: vi.simulate(machine, x, 2).last.Y)(start)
    verbs = (
        lambda m: vi.simulate(m, start, 2),
        lambda m: vi.find_orbit(m, start),
        lambda m: vi.sweep(m, "gravity", [0.9, 1.0], start=start, settle=2, cycles=8),
        lambda m: vi.scan(m, {"gravity": [0.9, 1.0]}, start=start, settle=2, cycles=8,
                          measure="extremes"),
        lambda m: vi.lyapunov(m, start, 8),
    )  # fmt: skip
    for verb in verbs:
        own = type("Own", (Shaken,), {})
        machine = own(jnp.asarray(1.0), floor, 1.1)
        words = "`field` of a Own is not the same .* the rate of its V differs"
        with pytest.warns(UserWarning, match=words) as told:
            verb(machine)
            verb(machine)
        told = [w for w in told if "is not the same" in str(w.message)]
        assert len(told) == 1 and told[0].filename == __file__


class Carried(BouncingBall):
    """A ball in a lift at height 1. The floor limits the height above the lift."""

    @property
    def coordinates(self):
        def place(state):
            return state.Y - 1.0

        return (vi.Coordinate(place, lambda x: x.V, lambda x, Y, V: Ball(Y + 1.0, V)),)


def test_extremes_are_those_of_the_first_coordinate():
    lifted = Carried(jnp.asarray(2.0), (vi.RigidStop(0.0, 0.8, "left"),))
    start = Ball(*map(jnp.asarray, (1.5, 0.0)))
    run, plain = vi.simulate(lifted, start, 3), vi.simulate(ball(), Ball(start.Y - 1, start.V), 3)
    np.testing.assert_allclose(run.y_min, plain.y_min, atol=1e-12)
    np.testing.assert_allclose(run.y_max, plain.y_max, atol=1e-12)
    assert float(lifted.position(start)) == 0.5 and lifted.placed(start, start.V, start.V).Y == 1


class CallsSuper(BouncingBall):
    @property
    def coordinates(self):
        return super().coordinates


def test_coordinates_can_call_super():
    start, stop = Ball(*map(jnp.asarray, (1.5, 0.0))), vi.RigidStop(0.0, 0.8, "left")
    run, plain = (vi.simulate(kind(2.0, (stop,)), start, 3) for kind in (CallsSuper, BouncingBall))
    jax.tree.map(np.testing.assert_array_equal, run.sections, plain.sections)
    assert int(run.impacts.sum()) > 0


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
    with pytest.raises(
        ValueError, match=f"`cycle` of a Shaken must be positive .*, but is {cycle}"
    ):
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
