"""What a settled motion is: its period in drive cycles, or why it has none."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int

from .._types import Scalar, State
from ..machine import AbstractMachine, in_rows, nearest_images, scales_known
from ..orbit import unit_of

Number = Scalar | float

# How far sections a period apart may differ; so many times that, if a longer period fits within it;
# and so many times what the longer one differs by. Choices.
_TOLERANCE, _SLACK, _WORSE = 1e-6, 100.0, 1e4

# The least that sections are held to: so many times what they wander by, and so many roundings.
# Choices.
_WANDERS, _ROUNDINGS = 10.0, 64.0


# Motions are small if no number of their states is as large: as the errors of steps are judged.
_SMALL = 1e-2


class REGIMES(IntEnum):
    """Negative values of `period` for motions without one, and of the `label` of basins for starts
    that settle on no motion."""

    chaotic = -1, "chaotic"
    unsettled = -2, "unsettled"
    failed = -3, "failed"
    transient = -4, "transiently chaotic"

    meaning: str

    def __new__(cls, code: int, meaning: str):
        """A number with a meaning in words."""
        self = int.__new__(cls, code)
        self._value_, self.meaning = code, meaning
        return self


CODES = {regime.name: int(regime) for regime in sorted(REGIMES)}
"""The numbers of the regimes by name, the least first."""


def flags(codes: Mapping[str, int]) -> dict[str, Any]:
    """Attributes of a variable that say what its special numbers mean."""
    return {"flag_values": list(codes.values()), "flag_meanings": " ".join(codes)}


def size_of(machine: AbstractMachine, *states: Any) -> Scalar | float:
    """Return what counts as 1 where states of a motion are compared: the largest number in these
    states if it is small, else 1; 1 for a machine whose numbers are about 1 by definition."""
    if scales_known(machine):
        return 1.0
    size = unit_of(jnp.concatenate([jnp.ravel(x) for x in jtu.tree_leaves(states)]))
    return jnp.where(size < _SMALL, size, 1.0)


def least_period(
    sections: State,
    impacts: Int[Array, " cycles"],
    *,
    longest: int,
    tolerance: Number | None = None,
    wander: Number = 0.0,
    size: Number = 1.0,
    angles: np.ndarray | None = None,
) -> Int[Array, ""]:
    """The fewest drive cycles after which a motion repeats, its impacts too, or
    `REGIMES.unsettled`.

    A motion that still spirals in may repeat better after several turns of the spiral than after
    its period. So it counts as settled if some period fits within the tolerance, and of the
    periods that fit within a hundred times the tolerance the least is taken; but none that fits ten
    thousand times worse than another, for no spiral does so. A period fits only if as many impacts
    come in each cycle: beside a grazing these tell apart what sections hardly do.

    **Arguments:** section states one after the other, a pytree with leaves (cycles,), more than
    `longest` of them; the impacts of the cycle that ends at each; the longest period looked for;
    how far sections a period apart may differ (relative to `size` + |state|), by default 1e-6 or,
    if that is more, ten times what they wander by; what the sections of a motion that repeats
    wander by under its method (`AbstractMethod.wander`); the size of the motion (`size_of`); which
    of their numbers are angles (`angles_in`).
    """
    states = in_rows(sections).T
    if tolerance is None:
        tolerance = jnp.maximum(_TOLERANCE, _WANDERS * jnp.asarray(wander, states.dtype))
    rows = jnp.concatenate([states, impacts[None].astype(states.dtype)])
    count = states.shape[1] - longest
    last = rows[:, longest:]
    angles = None if angles is None else np.append(angles, False)
    scale = size + jnp.abs(last[:-1])

    def compared(_, p):
        before = jax.lax.dynamic_slice_in_dim(rows, longest - p, count, axis=1)
        now = last if angles is None else nearest_images(angles, last.T, before.T).T
        apart = jnp.abs(now - before)
        return _, jnp.where(jnp.any(apart[-1] > 0), jnp.inf, jnp.max(apart[:-1] / scale))

    periods = jnp.arange(1, longest + 1, dtype=jnp.int32)
    _, apart = jax.lax.scan(compared, None, periods)
    least = jnp.min(apart)
    noise = jnp.maximum(wander, _ROUNDINGS * float(jnp.finfo(states.dtype).eps))
    most = jnp.minimum(_SLACK * tolerance, _WORSE * jnp.maximum(least, noise))
    period = jnp.min(jnp.where(apart <= most, periods, longest))
    return jnp.where(least <= tolerance, period, REGIMES.unsettled)


def impacts_of(impacts: Float[Array, " cycles"], period: Int[Array, ""]) -> Scalar:
    """Impacts in a period of a motion; in a cycle, on average, where it has none."""
    last = jnp.arange(impacts.size) >= impacts.size - period
    total = jnp.sum(jnp.where(last, impacts, 0.0))
    return jnp.where(period > 0, total, jnp.mean(impacts))
