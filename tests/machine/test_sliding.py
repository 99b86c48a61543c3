"""Motions that slide along the surface of a switch, by Filippov's convention."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi


def place(machine, s, z):
    return z.x


class Relay(vi.AbstractMachine):
    """x' = a sin s - m, y' = m with m = sgn x; the motion slides on x = 0 while |a sin s| < 1."""

    amplitude: Any = 0.5
    events = vi.Switch(place, slides=True)
    cycle = 2 * jnp.pi

    def field(self, s, z, mode):
        return dict(x=self.amplitude * jnp.sin(s) - mode, y=mode)


def at(x, y):
    return vi.State(x=x, y=y)


@pytest.mark.slow
def test_sliding_follows_the_mean_rate_on_the_surface():
    def last(amplitude, x):
        run = vi.simulate(Relay(amplitude), at(x, 0.0), 1, event_log=8)
        return (run.last.x, run.last.y), (run.event_log, run.successful)

    (x, y), (log, good) = vi.jit(last)(0.5, 0.2)
    assert bool(good) and abs(float(x)) < 1e-12
    # The motion reaches the surface where .2 + .5 (1 - cos s) = s.
    met = float(log.phase[0, 0])
    assert 0.2 + 0.5 * (1 - np.cos(met)) == pytest.approx(met, abs=1e-9)
    assert float(y) == pytest.approx(met + 0.5 * (np.cos(met) - 1), abs=1e-8)
    # Derivatives with respect to both numbers, through the event at which sliding begins.
    slope = jax.jacfwd(lambda p: jnp.stack(last(*p)[0]))(jnp.array([0.5, 0.2]))
    h = 1e-4
    for j in range(2):
        step = h * np.eye(2)[j]
        ahead, behind = (np.array(last(*(np.array([0.5, 0.2]) + d * step))[0]) for d in (1, -1))
        np.testing.assert_allclose(slope[:, j], (ahead - behind) / (2 * h), atol=1e-7)


def test_sliding_ends_where_one_side_points_away():
    a = 1.5
    method = vi.FixedStep(steps_per_cycle=48)
    run = vi.simulate(Relay(a), at(-1e-3, 0.0), 1, event_log=12, method=method)
    kinds, phases = np.asarray(run.event_log.kind[0]), np.asarray(run.event_log.phase[0])
    modes = np.asarray(run.event_log.value[0])[kinds == 3]
    assert bool(run.successful)
    leaves = phases[kinds == 3][modes == 1.0]
    np.testing.assert_allclose(leaves, [np.arcsin(1 / a)], atol=1e-8)
    leaves = phases[kinds == 3][modes == -1.0]
    np.testing.assert_allclose(leaves, [np.pi + np.arcsin(1 / a)], atol=1e-8)


class Moving(vi.AbstractMachine):
    """x' = 0.3 - m, with the sign m of x - y(s). It slides while |0.3 - y'| < 1."""

    c: Any = 1.0

    @property
    def events(self):
        surface = lambda m, s, z: z.x - m.c * jnp.sin(s) + 0.2 * jnp.sin(2 * s)
        return vi.Switch(surface, slides=True)

    cycle = 2 * jnp.pi

    def field(self, s, z, mode):
        return dict(x=0.3 - mode)


def test_sliding_on_a_moving_surface_ends_at_any_accuracy():
    """The motion drifts off the surface by the error of the steps, to either side."""
    c = jnp.linspace(0.8, 1.2, 12)
    method = vi.Adaptive(diffrax.Tsit5(), rtol=1e-5)

    def run(c):
        found = vi.simulate(Moving(c), vi.State(x=-0.1), 1, event_log=4, method=method)
        return found.successful, found.event_log

    good, log = vi.jit(jax.vmap(run))(c)
    assert good.all()
    np.testing.assert_array_equal(log.value[:, 0, :2], np.tile([0.0, 1.0], (12, 1)))
    leaves = np.arccos((c - np.sqrt(c**2 + 3.52)) / 1.6)  # y' = c cos s - 0.4 cos 2s = -0.7
    np.testing.assert_allclose(log.phase[:, 0, 1], leaves, atol=1e-7)


class Both(vi.AbstractMachine):
    """x and y meet; then both slide on x = y with the mean of their rates, by Filippov's rule."""

    events = vi.Switch(lambda m, t, z: z.x - z.y, slides=True)
    cycle = 1.0

    def field(self, t, z, mode):
        return dict(x=-2.0 * mode, y=jnp.where(-mode > 0, -3.0, 1.5))


class Twice(Both):
    events = (Both.events, vi.Switch(lambda m, t, z: z.y - z.x, slides=True))

    def field(self, t, z, mode, other):
        return dict(x=-2.0 * mode, y=jnp.where(other > 0, -3.0, 1.5))


def test_one_surface_needs_one_switch():
    """They meet at t = 1/7. With the weight w of the upper side, 2 - 4w = -3 + 4.5w gives the rate
    -6/17 of both."""
    start = vi.State(x=1.5, y=1.0)
    run = vi.simulate(Both(), start, 1)
    expected = 1.5 - 2 / 7 - 6 / 17 * 6 / 7
    np.testing.assert_allclose([run.last.x, run.last.y], expected, atol=1e-12)
    with pytest.raises(ValueError, match=r"of a Twice must have .* 0 and 1 are multiples"):
        vi.simulate(Twice(), start, 1)
