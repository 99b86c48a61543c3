"""The kinds of motions without a period, and the least period of a motion."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._types import Number, State
from ..machine import in_rows, nearest_images

# The largest difference of sections a period apart; its factor for the least period, if some period
# fits; and the largest ratio of differences of two periods that fit. Choices.
_TOLERANCE, _SLACK, _WORSE = 1e-6, 100.0, 1e4

# The least tolerance of sections: multiples of their error by the method, and of rounding: choices.
_WANDERS, _ROUNDINGS = 10.0, 64.0


class REGIMES(IntEnum):
    """Negative values of `period` for motions without a period, and of the `label` of basins for
    starts that settle on no motion."""

    chaotic = -1, "chaotic"
    unsettled = -2, "unsettled"
    failed = -3, "failed"
    transient = -4, "transiently chaotic"
    quasiperiodic = -5, "quasi-periodic"

    meaning: str

    def __new__(cls, code: int, meaning: str):
        self = int.__new__(cls, code)
        self._value_, self.meaning = code, meaning
        return self


CODES = {regime.name: int(regime) for regime in sorted(REGIMES)}
"""The numbers of the regimes by name, the least first."""


def flags(codes: Mapping[str, int]) -> dict[str, Any]:
    """Return attributes of a variable with the meanings of its special numbers."""
    return {"flag_values": list(codes.values()), "flag_meanings": " ".join(codes)}


def least_period(
    sections: State,
    impacts: Int[Array, " cycles"],
    *,
    longest: int,
    tolerance: Number | None = None,
    wander: Number = 0.0,
    sizes: Any = 1.0,
    angles: np.ndarray | None = None,
) -> Int[Array, ""]:
    """Return the fewest drive cycles after which a motion repeats, its impacts too, or
    `REGIMES.unsettled`.

    A motion that still spirals in may repeat better after several turns of the spiral than after
    its period. So it counts as settled if some period fits within the tolerance. The least period
    that fits within a hundred times the tolerance is returned. But a period is left out if another
    fits ten thousand times better; in a spiral none does. A period fits only if the impacts of each
    cycle agree: near a grazing, sections hardly differ.

    **Arguments:** `sections`, more than `longest`; `impacts` of the cycle before each; `tolerance`,
    relative to `sizes` (`row_sizes`) + |state|, by default the larger of 1e-6 and ten times
    `wander`, the error of sections under their method; `angles`, True for angles.
    """
    states = in_rows(sections).T
    if tolerance is None:
        tolerance = jnp.maximum(_TOLERANCE, _WANDERS * jnp.asarray(wander, states.dtype))
    rows = jnp.concatenate([states, impacts[None].astype(states.dtype)])
    count = states.shape[1] - longest
    last = rows[:, longest:]
    angles = None if angles is None else np.append(angles, False)
    scale = jnp.asarray(sizes)[..., None] + jnp.abs(last[:-1])

    def compared(_, p):
        before = jax.lax.dynamic_slice_in_dim(rows, longest - p, count, axis=1)
        now = last if angles is None else nearest_images(angles, last.T, before.T).T
        difference = jnp.abs(now - before)
        return _, jnp.where(jnp.any(difference[-1] > 0), jnp.inf, jnp.max(difference[:-1] / scale))

    periods = jnp.arange(1, longest + 1, dtype=jnp.int32)
    _, difference = jax.lax.scan(compared, None, periods)
    least = jnp.min(difference)
    noise = jnp.maximum(wander, _ROUNDINGS * float(jnp.finfo(states.dtype).eps))
    most = jnp.minimum(_SLACK * tolerance, _WORSE * jnp.maximum(least, noise))
    period = jnp.min(jnp.where(difference <= most, periods, longest))
    return jnp.where(least <= tolerance, period, REGIMES.unsettled)
