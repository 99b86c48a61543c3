"""What counts as rounding: of a guard far from zero, of a slip beside numbers in other units."""

from contextlib import nullcontext as nothing
from typing import ClassVar

import jax
import numpy as np
import pytest
import vi_jax as vi


class Thermostat(vi.AbstractMachine):
    """A furnace that is switched on and off at the ends of a narrow band around 295 K."""

    band: float
    length: float

    modes: ClassVar = {"on": 0.0}
    events = (
        vi.Reset(lambda m, t, z, on: 295 - m.band / 2 - z.T, modes=lambda *_: 1.0),
        vi.Reset(lambda m, t, z, on: z.T - 295 - m.band / 2, modes=lambda *_: 0.0),
    )

    @property
    def cycle(self):
        return self.length

    def field(self, t, z, on):
        return dict(T=25 * on - 2 * (z.T - 285))


@pytest.mark.parametrize(
    ("double", "band", "error"), [(True, 3e-6, 1e-12), (True, 1e-7, 1e-12), (False, 0.05, 1e-4)]
)
def test_guards_with_a_threshold_far_from_zero_arm(double, band, error):
    low, high = 295 - band / 2, 295 + band / 2
    first = 0.5 * np.log(10 / (low - 285))
    up, down = (
        0.5 * np.log((297.5 - low) / (297.5 - high)),
        0.5 * np.log((high - 285) / (low - 285)),
    )
    expected = np.cumsum([first, up, down, up, down])
    with jax.enable_x64(double), pytest.warns(UserWarning) if not double else nothing():
        machine = Thermostat(band, 1.1 * expected[-1])
        run = vi.simulate(machine, vi.State(T=295.0), 1, event_log=6)
        assert bool(run.successful)
        np.testing.assert_array_equal(run.event_log.number[0], [0, 1, 0, 1, 0, -1])
        np.testing.assert_allclose(run.event_log.phase[0, :5], expected, rtol=0, atol=error)
