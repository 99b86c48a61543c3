"""A body that dry friction holds and brakes, under a force of any kind, for several files."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
import vi_jax as vi


class Rubbing(vi.AbstractMachine):
    """x'' = force(machine, s, x) - level · load(machine, s, x) · friction, with numbers of its own
    by name."""

    force: Callable = eqx.field(static=True)
    level: Any = 1.0
    numbers: dict[str, Any] = eqx.field(default_factory=dict)
    load: Callable | None = eqx.field(static=True, default=None)
    cycle: float = 2 * np.pi

    @property
    def contacts(self):
        return vi.DryFriction(self.level, on="V", load=self.load)

    def field(self, s, x):
        return vi.OscillatorState(x.V, self.force(self, s, x))
