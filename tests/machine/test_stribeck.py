"""A body on a belt, with friction that falls with the speed of sliding: it slides on, or sticks and
slips; where the cycle of sticking and slipping ends."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from belts import Belt, level

CLOSE = vi.Adaptive(rtol=1e-11)


def friction(speed):
    """The same for SciPy."""
    return 0.5 + 0.5 * np.exp(-2 * speed)


def stuck(speed, before=0.0):
    """The body carried along by the belt, so far before it has to slip."""
    return vi.OscillatorState(jnp.asarray(1.0 - 0.1 * speed - before), jnp.asarray(speed))


def slip(speed, until):
    """A slip by SciPy, from where it begins."""

    def field(t, x):
        return [x[1], -x[0] - 0.1 * x[1] + friction(speed - x[1])]

    until.terminal, until.direction = True, 1
    start = [1.0 - 0.1 * speed, speed - 1e-13]
    found = solve_ivp(field, (0, 20), start, "DOP853", events=until, rtol=1e-12, atol=1e-13)
    return found.t_events[0][0], found.y_events[0][0]


def furthest_back(t, x):
    return x[1]


@pytest.fixture(scope="module")
def orbit():
    guess = vi.simulate(Belt(), stuck(1.5, 0.5), 3, method=CLOSE).last
    return vi.find_orbit(Belt(), guess, method=CLOSE)


@pytest.mark.slow
def test_it_sticks_and_slips(orbit):
    """One slip from the force that friction holds to the belt's speed, then sticking at it."""
    speed = 1.5
    slips, (Y, _) = slip(speed, lambda t, x: x[1] - speed + 1e-15 if t > 1 else -1.0)
    _, (back, _) = slip(speed, furthest_back)
    sticks = (1.0 - 0.1 * speed - Y) / speed
    assert float(orbit.duration) == pytest.approx(slips + sticks, abs=1e-8)
    assert float(orbit.y_min) == pytest.approx(back, abs=1e-8)
    # Sticking forgets how it was begun.
    np.testing.assert_allclose(np.abs(orbit.multipliers), 0.0, atol=1e-9)
    assert orbit.stable


@pytest.mark.exhaustive
def test_it_ends_as_a_branch_where_a_slip_only_touches_the_belt(orbit):
    """Independently of this package the cycle ends at 1.83660097."""
    coarse = vi.find_orbit(Belt(), orbit.state)
    branch = vi.continue_orbit(coarse, parameter="speed", bounds=(1.4, 1.9))
    assert float(branch.parameter.min()) == pytest.approx(1.4)
    (end,) = branch.special
    assert end.kind == branch.ends[1] == "grazing-sliding"
    assert end.parameter == pytest.approx(1.83660097, abs=1e-8)
    # There it meets the motion that only slides, which is unstable and ends there as well.
    slides = vi.continue_orbit(end.switch(), parameter="speed", bounds=(1.75, 1.9))
    assert not slides.stable.any() and slides.ends == ("bounds", "grazing-sliding")
    assert slides.special[-1].parameter == pytest.approx(end.parameter, abs=1e-10)
    again = slides.special[-1].switch()
    np.testing.assert_allclose(np.abs(again.multipliers), 0.0, atol=1e-9)


def test_sliding_is_steady_above_the_hopf_bifurcation():
    """x' = 0 where the spring holds friction; lost where friction falls by 0.1 with the speed."""
    lost = 0.5 * np.log(10)
    for speed, dies in ((lost + 0.02, True), (lost - 0.02, False)):
        rest = float(level(speed))
        near = vi.OscillatorState(jnp.asarray(rest + 1e-4), jnp.asarray(0.0))
        run = vi.simulate(Belt(speed=speed), near, 40, method=CLOSE)
        assert (abs(float(run.last.Y) - rest) < 1e-4) == dies


def test_the_end_of_sticking():
    """The cycle ends at the belt's speed that a slip only just comes back to."""

    def lacks(speed):
        """By how much the fastest forward motion after a slip falls short of the belt."""
        _, (_, V) = slip(speed, lambda t, x: x[0] + 0.1 * x[1] - friction(speed - x[1]))
        return speed - V

    truth = brentq(lacks, 1.7, 1.9, xtol=1e-11)
    assert truth == pytest.approx(1.83660097, abs=1e-8)

    def sticks_again(speed):
        run = vi.simulate(Belt(speed=speed), stuck(speed, 1e-9), 2, method=CLOSE, event_log=4)
        return run.event_log.kind[1, 0] >= 0

    lanes = vi.jit(jax.vmap(sticks_again))
    low, high = 1.7, 1.9
    for _ in range(3):
        speeds = jnp.linspace(low, high, 512)
        last = int(np.flatnonzero(np.asarray(lanes(speeds)))[-1])
        low, high = speeds[last], speeds[last + 1]
    assert float(0.5 * (low + high)) == pytest.approx(truth, abs=2e-8)
