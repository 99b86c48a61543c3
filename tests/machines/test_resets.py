"""User-defined resets, modes that impacts change, and cycles that events end."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.optimize import brentq

from resets import Excited, StickSlip, Walker, legs

CLOSE = vi.Adaptive(rtol=1e-12)


class Strike(vi.AbstractEvent):
    """The event of `Walker`, as a subclass of `AbstractEvent`."""

    def guard(self, machine, s, x):
        return x.between - 2 * x.stance

    def after(self, machine, s, x):
        return legs(-x.stance, x.turning * jnp.cos(2 * x.stance)), ()

    def happens(self, machine, s, x):
        return x.between < -0.05

    def value(self, machine, s, x):
        return x.turning


class OwnWalker(Walker):
    @property
    def events(self):
        return (Strike(ends_cycle=True, name="strike"),)


@pytest.mark.slow
def test_own_class_of_events():
    """From the start of the periodic motion, by the script `walker` of `experiments/validated`."""
    stance = 0.200310900563820
    run = vi.simulate(OwnWalker(0.009), legs(stance, -0.199832473025474), 1, event_log=1)
    assert float(run.last.stance) == pytest.approx(stance, abs=1e-9)
    assert "reset (strike) at 3.88246" in str(run.event_log)
    # The impact multiplies the rate of the leg by the cosine.
    turning = float(run.last.turning) / np.cos(2 * stance)
    assert float(run.event_log.value[0, 0]) == pytest.approx(turning, abs=1e-9)


def sliding(q, v):
    return vi.State(q=q, v=v, u=0.0)


@pytest.mark.slow
def test_branch_ends_where_the_guard_of_a_reset_grazes():
    run = vi.simulate(StickSlip(0.4), sliding(0.1, 0.0), 1, settle=400, method=CLOSE)
    orbit = vi.find_orbit(StickSlip(0.5), run.last)
    branch = vi.continue_orbit(orbit, parameter="voltage", bounds=(0.45, 0.7))
    assert branch.ends[1] == "grazing"
    (touch,) = (point for point in branch.special if point.kind == "grazing")
    assert touch.parameter == pytest.approx(0.58751625042, abs=1e-10)
    assert "the guard of impact" in touch.detail
    with pytest.raises(ValueError, match=r"needs a machine without .* `events`"):
        touch.switch()


@pytest.mark.slow
def test_a_cycle_that_an_impact_ends():
    """Compare with x = e^(0.1 t)(cos w t + B sin w t) from impact to impact."""
    k, a = 0.6, 0.1
    w = np.sqrt(1 - a * a)

    def flight(speed):
        B = (-speed - a) / w

        def place(t):
            return np.exp(a * t) * (np.cos(w * t) + B * np.sin(w * t)) - 1

        times = np.linspace(0.5, 7.0, 200)
        rises = np.flatnonzero(place(times) > 0)[0]
        T = brentq(place, times[rises - 1], times[rises])
        turned = a * np.exp(a * T) * (np.cos(w * T) + B * np.sin(w * T))
        return T, turned + w * np.exp(a * T) * (B * np.cos(w * T) - np.sin(w * T))

    speed = brentq(lambda u: k * flight(u)[1] - u, 0.05, 3.0)
    start = vi.OscillatorState(jnp.asarray(1.0), jnp.asarray(-speed))
    orbit = vi.find_orbit(Excited(k), start, method=CLOSE)
    assert int(orbit.impacts) == 1 and bool(orbit.successful)
    np.testing.assert_allclose(orbit.duration, flight(speed)[0], rtol=1e-10)
    np.testing.assert_allclose(orbit.state.V, -speed, rtol=1e-10)
    h = 1e-5
    slope = k * (flight(speed + h)[1] - flight(speed - h)[1]) / (2 * h)
    assert float(jnp.abs(orbit.multipliers).max()) == pytest.approx(abs(slope), rel=1e-7)
    with warnings.catch_warnings():  # equinox warns of an array as a constant of a program
        warnings.filterwarnings("error", message=".*being set as static")
        branch = vi.continue_orbit(orbit, parameter="restitution", bounds=(0.55, 0.65))
    assert branch.ends == ("bounds", "bounds")
    np.testing.assert_allclose(branch.at(0.6)[0].state.V, -speed, rtol=1e-9)


class Thrown(vi.AbstractMachine):
    """A body that a reset moves beyond its stop."""

    contacts: tuple = (vi.RigidStop(2.0, 0.5),)

    @property
    def events(self):
        return (
            vi.Reset(
                lambda machine, s, x: x.Y - 1.0,
                lambda machine, s, x: vi.OscillatorState(x.Y + 1.5, x.V),
            ),
        )

    cycle = 2.0

    def field(self, s, x):
        return vi.OscillatorState(x.V, 0 * x.V)


def test_reset_beyond_a_stop_fails_the_lane():
    start = vi.OscillatorState(jnp.asarray(0.0), jnp.asarray(1.0))
    run = vi.simulate(Thrown(), start, 2)
    assert bool(run.result == vi.RESULTS.bad_reset)
    assert np.isfinite(run.sections.Y[0]) and not np.isfinite(run.last.Y)


FLAT = {
    "cube": lambda m, t, z: (z.x - m.p) ** 3,
    "square": lambda m, t, z: (z.x - m.p) * jnp.abs(z.x - m.p),
    "sign": lambda m, t, z: jnp.sign(z.x - m.p) * jnp.abs(z.x - m.p),
    "jump": lambda m, t, z: jnp.where(z.x > m.p, 1.0, -1.0),
}


class Sawtooth(vi.AbstractMachine):
    """x' = 1, and x = 0 whenever it gets to p, by a guard that may have no slope there."""

    p: float
    guard: str = eqx.field(static=True)

    cycle = 5.0

    @property
    def events(self):
        return vi.Reset(FLAT[self.guard], lambda m, t, z: dict(x=0.0 * z.x))

    def field(self, t, z):
        return dict(x=1.0 + 0.0 * z.x)


@pytest.mark.parametrize("guard", FLAT)
def test_guards_without_a_slope(guard):
    def run(p):
        found = vi.simulate(Sawtooth(p, guard), vi.State(x=0.0), 1, event_log=7)
        return found.event_log.phase[0], found.last.x, found.successful

    # The event lies at x = p, so the k-th comes at the time k p.
    (phase, last, successful), (rates, slope, _) = jax.jvp(run, (0.7,), (1.0,))
    assert bool(successful)
    close = 1e-12 + 1e-11 * (guard == "jump")
    np.testing.assert_allclose(phase, 0.7 * np.arange(1, 8), rtol=0, atol=close)
    np.testing.assert_allclose(last, 0.1, atol=1e-11)
    for found, expected in ((rates, np.arange(1, 8)), (slope, -7.0)):
        right = np.isclose(found, expected, rtol=1e-9)
        assert np.all(right | np.isnan(found))
    if guard == "jump":
        assert np.all(np.isnan(rates))
    if guard == "cube":
        np.testing.assert_allclose(rates, np.arange(1, 8))
