"""A user's own scene: a ball bouncing on a floor under constant force, beside its closed form."""

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


class BouncingBall(vi.AbstractScene):
    """Free fall on a floor at Y = 0, looked at once a second: all that `simulate` has to know."""

    gravity: jax.Array
    stops: tuple[vi.RigidStop, ...]

    @property
    def cycle(self):
        return 1.0

    def field(self, s, state):
        return Ball(state.V, -self.gravity)


def ball(gravity=2.0, restitution=0.8):
    return BouncingBall(jnp.asarray(gravity), (vi.RigidStop(0.0, restitution, "left"),))


def impact_times(height, gravity, restitution, count):
    """Closed form: the fall, then flights that each last k times the one before."""
    fall = np.sqrt(2 * height / gravity)
    flights = 2 * fall * restitution ** np.arange(1, count)
    return fall + np.concatenate([[0.0], np.cumsum(flights)])


@pytest.mark.parametrize("method", [vi.Adaptive(), vi.FixedStep()], ids=["adaptive", "fixed"])
def test_bounces_of_a_ball(method):
    scene, height = ball(), 1.5
    start = Ball(jnp.asarray(height), jnp.asarray(0.0))
    run = vi.simulate(scene, start, 6, method=method, impact_log=4)
    log = run.impact_log
    cycle, place = np.nonzero(np.asarray(log.stop) >= 0)
    times = cycle + np.asarray(log.phase)[cycle, place]
    speeds = np.asarray(log.speed)[cycle, place]
    truth = impact_times(height, 2.0, 0.8, len(times))
    np.testing.assert_allclose(times, truth, atol=1e-10)
    first = np.sqrt(2 * 2.0 * height)
    np.testing.assert_allclose(speeds, first * 0.8 ** np.arange(len(times)), atol=1e-10)
    assert len(times) == 3 and run.frequency_ratio is None
    np.testing.assert_allclose(run.duration, 1.0)


def test_endless_bounces_end_in_rest():
    start = Ball(jnp.asarray(1.0), jnp.asarray(0.0))
    run = vi.simulate(ball(restitution=0.3), start, 10, method=vi.Adaptive())
    assert bool(run.successful) and int(run.rests.sum()) == 1
    assert float(run.sections.Y[-1]) == 0.0 and float(run.sections.V[-1]) == 0.0
    # Left out of the program, rest is told from other failures, however rounding has it end.
    for restitution in (0.3, 0.5, 0.2):
        scene = ball(restitution=restitution)
        without = vi.simulate(scene, start, 10, method=vi.Adaptive(), rests=False)
        assert bool(without.result == vi.RESULTS.chatter)


def test_derivative_of_the_first_impact():
    def time(gravity):
        start = Ball(jnp.asarray(1.5), jnp.asarray(0.0))
        run = vi.simulate(ball(gravity), start, 2, method=vi.Adaptive(), impact_log=1)
        return run.impact_log.phase[1, 0]

    # t = √(2h/g), dt/dg = -t/(2g)
    value, slope = jax.jvp(time, (2.0,), (1.0,))
    assert float(value) == pytest.approx(np.sqrt(1.5) - 1, abs=1e-10)
    assert float(slope) == pytest.approx(-np.sqrt(1.5) / 4, abs=1e-9)


def test_own_scenes_have_their_own_clock_and_no_closed_form():
    start = Ball(jnp.asarray(1.0), jnp.asarray(0.0))
    with pytest.raises(ValueError, match=r"`clock` must be left out.*'time'"):
        vi.simulate(ball(), start, 1, clock="time")
    with pytest.raises(ValueError, match=r"`ExactFlight` needs a `Scene`.*BouncingBall"):
        vi.simulate(ball(), start, 1, method=vi.ExactFlight())


class Wrong(BouncingBall):
    """What a machine may be told wrong."""

    kind: str = eqx.field(static=True, default="")

    @property
    def cycle(self):
        return (lambda: 1.0) if self.kind == "cycle" else 1.0

    def field(self, s, state):
        if self.kind == "tuple":
            return state.V, -self.gravity
        if self.kind == "shape":
            return Ball(state.V, jnp.ones(2))
        if self.kind == "if" and state.Y > 0:
            return Ball(state.V, state.V)
        return Ball(state.V, -self.gravity)


@pytest.mark.parametrize("verb", [lambda m, x: vi.simulate(m, x, 2), vi.find_orbit])
@pytest.mark.parametrize(
    ("kind", "stops", "told"),
    [
        ("cycle", (), "`cycle` of a Wrong must be a number"),
        ("tuple", (), "`field` of a Wrong must return"),
        ("shape", (), "`field` of a Wrong must return"),
        ("if", (), "`jnp.where`, not `if`"),
        ("", (0.5,), "`stops` of a Wrong must be a tuple"),
        ("", vi.RigidStop(0.5, 0.5), "`stops` of a Wrong must be a tuple"),
        ("", (vi.RigidStop(0.5, 0.5, coordinate=1),), "limits coordinate 1, but there are 1"),
    ],
)
def test_a_machine_that_is_none_is_told_what_is_wrong(kind, stops, told, verb):
    machine = Wrong(jnp.asarray(1.0), stops, kind)
    with pytest.raises((TypeError, ValueError), match=told):
        verb(machine, Ball(*map(jnp.asarray, (0.1, 0.0))))


class Carried(BouncingBall):
    """The same ball, whose height above a lift is what the floor limits."""

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


@pytest.mark.parametrize("clock", ["phase", "time"])
def test_samples_cost_nothing_before_they_are_taken(clock):
    scene = vi.Parameters(control=0.9).scene()
    options = {"clock": clock, "samples": 64}
    whole = vi.simulate(scene, scene.start(), 33, **options)
    settled = vi.simulate(scene, scene.start(), 3, settle=30, **options)
    assert int(settled.steps) < 0.35 * int(whole.steps)
    for name in "YVW":
        a, b = (getattr(run.samples.state, name) for run in (settled, whole))
        np.testing.assert_allclose(a, b[30 * 64 :], atol=1e-6)
    np.testing.assert_allclose(settled.duration, whole.duration[30:], atol=1e-8)
    np.testing.assert_array_equal(settled.impacts, whole.impacts[30:])
