"""Forces of contacts as a measure."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._checks import count
from ..machine import contact_forces, stop_in_words, stops_of, with_modes
from .measures import AbstractMeasure


class ContactForces(AbstractMeasure):
    """Forces of all contacts over the observed cycles, and impulses of impacts.

    For a contact called "floor", results are `floor_normal` and `floor_tangential`, the mean forces
    (see `contact_forces`), and `floor_normal_max` and `floor_tangential_max`, the greatest sizes.
    They are those at evenly spaced instants. For a rigid stop, `floor_impulse` and `floor_drag` are
    the sums of the impulses of impacts across and along it in a cycle, on average. The mean force
    of the stop is `floor_normal + floor_impulse / duration`. Spaces in names become underscores.

    **Arguments:**

    - `samples`: instants in a cycle at which forces are computed; static.
    - `impacts`: the most impacts in a cycle whose impulses are counted; static.
    """

    samples: int = eqx.field(static=True, default=64, kw_only=True)
    impacts: int = eqx.field(static=True, default=32, kw_only=True)

    def __check_init__(self):
        count("samples", self.samples, least=1)
        count("impacts", self.impacts)

    @property
    def instants(self):
        return self.samples

    @property
    def listed(self):
        return self.impacts

    def __call__(self, machine, run):
        at, log, cycles = run.samples, run.impact_log, run.impacts.shape[-1]
        assert at is not None
        states = with_modes(at.state, at.modes or None)
        forces = jax.vmap(lambda z, s: contact_forces(machine, z, s))
        found: dict[str, Any] = {}
        for name, parts in forces(states, machine.cycle * at.cycles).items():
            for part, row in vars(parts).items():
                key = f"{name}_{part}".replace(" ", "_")
                found[key] = 0.5 * jnp.mean(row[1:] + row[:-1])
                found[f"{key}_max"] = jnp.max(jnp.abs(row))
        if log is None:
            return found
        for number, stop in enumerate(stops_of(machine)):
            for part in ("impulse", "drag"):
                key = f"{stop_in_words(machine, stop)}_{part}".replace(" ", "_")
                struck = jnp.where(log.stop == number, getattr(log, part), 0.0)
                found[key] = jnp.sum(struck) / cycles
        return found
