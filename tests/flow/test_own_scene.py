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
    # Left out of the program, rest is told from other failures.
    without = vi.simulate(ball(restitution=0.3), start, 10, method=vi.Adaptive(), rests=False)
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
