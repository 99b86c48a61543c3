"""A body that dry friction holds and brakes, under a force of any kind, for several files."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import vi_jax as vi


def friction(level, force, **options):
    """Dry friction of a body with place Y and velocity V; its force acts on V."""
    stopped = lambda machine, x: vi.OscillatorState(x.Y, jnp.zeros_like(x.V))
    return vi.DryFriction(
        level, velocity=lambda machine, x: x.V, force=force, stopped=stopped, **options
    )


class Rubbing(vi.AbstractMachine):
    """x'' = force(machine, s, x) - level · load(machine, s, x) · friction, with numbers of its own
    by name."""

    force: Callable = eqx.field(static=True)
    level: Any = 1.0
    numbers: dict[str, Any] = eqx.field(default_factory=dict)
    load: Callable | None = eqx.field(static=True, default=None)
    stops: tuple = ()
    cycle: float = 2 * np.pi

    @property
    def switches(self):
        return (friction(self.level, self.force, load=self.load),)

    def field(self, s, x, mode):
        rubs = self.switches[0].contribution(self, s, x, mode)
        return vi.OscillatorState(x.V, self.force(self, s, x) + rubs)
