"""Basins of a motion and of an equilibrium, in which motions die out to rounding."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from belts import Belt


class Observed(Belt):
    """Also at equal intervals, and with starts."""

    every: Any = None

    @property
    def cycle(self):
        return 2 * np.pi if self.every is None else self.every

    def section(self, state):
        return state.V if self.every is None else None

    def observed_every(self, interval):
        return Observed(self.speed, every=interval)

    def start(self, *, Y=0.0, V=0.0):
        return vi.OscillatorState(jnp.asarray(Y, float), jnp.asarray(V, float))


def area_of_sliding(speed):
    """What lies within the unstable cycle of sliding at V > 0, ∫ V dY = ∫ V² dt, by SciPy: backward
    in time motions go to that cycle."""

    def backward(t, x):
        pull = x[0] + 0.1 * x[1] - 0.5 - 0.5 * np.exp(-2 * (speed - x[1]))
        return [-x[1], pull, max(x[1], 0.0) ** 2]

    def stands(t, x):
        return x[1]

    def turn(Y):
        options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12, "max_step": 0.05}
        found = solve_ivp(backward, (0, 9), [Y, 0.0, 0.0], events=stands, **options)
        return found.y_events[0][found.t_events[0] > 4][0]

    low = brentq(lambda Y: turn(Y)[0] - Y, -0.8, -0.5, xtol=1e-11)
    return turn(low)[2]


@pytest.mark.exhaustive
def test_the_share_of_steady_sliding_is_the_area_of_its_basin():
    """Of starts in [-2, 2] × [0, 2]; none fails, though all that slide come to rest."""
    region = {"start.Y": (-2.0, 2.0), "start.V": (0.0, 2.0)}
    found = vi.basins(Observed(1.5), region, resolution=48, settle=200, progress=False)
    assert not any(found.irregular.values())
    (share,) = (x.fraction for x in found.attractors if abs(x.sections["Y"][0] - 0.5249) < 1e-3)
    truth = area_of_sliding(1.5) / 8
    assert truth == pytest.approx(0.30712, abs=1e-5)
    # The boundary cuts some 110 of 48² cells, each off by 0.3 of itself: three such errors.
    assert share == pytest.approx(truth, abs=3 * 0.3 * 110**0.5 / 48**2)
