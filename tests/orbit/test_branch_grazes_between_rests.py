"""A stop that is touched between rests, from either side, and other ends of a branch with rests."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq


class Uneven(vi.AbstractMachine):
    """A body on a spring, between a stop on which it rests and one that it strikes once."""

    frequency: Any = 0.55
    restitution: Any = 0.4

    @property
    def stops(self):
        return vi.RigidStop(0.1, self.restitution), vi.RigidStop(1.9, 0.6, "left")

    @property
    def cycle(self):
        return 2 * np.pi

    def field(self, s, x):
        pull = 0.35 * jnp.sin(2 * s) - jnp.cos(s) - 0.16 * x.V - x.Y
        return vi.OscillatorState(x.V / self.frequency, pull / self.frequency)


def released(frequency):
    """How far from the other stop the body of `Uneven` turns after its rest, without that stop."""

    def pull(s, y, v):
        return 0.35 * np.sin(2 * s) - np.cos(s) - 0.16 * v - y

    let_go = brentq(lambda s: pull(s, 0.1, 0.0), 3.5, 5.5, xtol=1e-14)

    def turns(s, x):
        return x[1]

    turns.terminal, turns.direction = True, 1
    flight = solve_ivp(
        lambda s, x: [x[1] / frequency, pull(s, *x) / frequency], (let_go, let_go + 6), [0.1, 0.0],
        method="DOP853", events=turns, rtol=1e-12, atol=1e-13, max_step=0.05,
    )  # fmt: skip
    return flight.y[0, -1] + 1.9


@pytest.mark.slow
def test_a_branch_passes_its_section_and_ends_at_a_graze_or_a_bound():
    """An impact comes upon the section, where the corrector finds a solution far beyond the bounds;
    then the body just reaches the other stop, where its release alone says: at one place both
    motions lead back, at the other one the motion goes on. Restitution 0 is a bound beyond which
    there is no machine."""
    start = vi.OscillatorState(jnp.zeros(()), jnp.zeros(()))
    settled = vi.simulate(Uneven(), start, 1, settle=40).last
    orbit = vi.find_orbit(Uneven(), settled, impact_log=64, throw=True)
    wanted = [brentq(released, *bracket, xtol=1e-13) for bracket in ((0.37, 0.385), (0.55, 0.6))]
    for longest in (0.1, 0.5):  # a step of 0.5 leads over both
        branch = vi.continue_orbit(
            orbit, parameter="frequency", bounds=(0.2, 0.6), step=longest, max_step=longest
        )
        assert branch.ends == ("grazing", "grazing")
        np.testing.assert_allclose([p.parameter for p in branch.special], wanted, atol=1e-10)
    soft = vi.continue_orbit(orbit, parameter="restitution", bounds=(0.0, 0.45))
    assert soft.ends == ("bounds", "bounds") and soft.parameter[0] == 0.0
