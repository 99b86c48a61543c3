"""What a settled motion is: its period in drive cycles, or why it has none."""

from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

_SLACK = 100.0


class REGIMES(IntEnum):
    """What stands in `period` for a motion that has none: numbers that are no periods."""

    unsettled = 0, "unsettled"
    chaotic = -1, "chaotic"
    failed = -2, "failed"
    transient = -3, "transiently chaotic"

    meaning: str

    def __new__(cls, code: int, meaning: str):
        """A number with a meaning in words."""
        self = int.__new__(cls, code)
        self._value_, self.meaning = code, meaning
        return self


LABELS = {
    regime: -1 - place
    for place, regime in enumerate(
        (REGIMES.chaotic, REGIMES.unsettled, REGIMES.failed, REGIMES.transient)
    )
}
"""The same as labels of basins, where 0 is a motion."""


def flags(codes: Mapping[str, int]) -> dict[str, Any]:
    """Attributes of a variable that say what its special numbers mean."""
    return {"flag_values": list(codes.values()), "flag_meanings": " ".join(codes)}


def least_period(
    sections: Any, *, longest: int, tolerance: Float[Array, ""] | float = 1e-6
) -> Int[Array, ""]:
    """The fewest drive cycles after which a motion repeats, or 0 if it does not.

    A motion that still spirals in may repeat better after several turns of the spiral than after
    its period. So it counts as settled if some period fits within the tolerance, and of the
    periods that fit within a hundred times the tolerance the least is taken.

    **Arguments:** section states one after the other, a pytree with leaves (cycles,), more than
    `longest` of them; the longest period looked for; how far sections a period apart may differ
    (relative to 1 + |state|).
    """
    states = jnp.stack(jtu.tree_leaves(sections))
    size = states.shape[1] - longest
    last = states[:, longest:]
    scale = 1 + jnp.abs(last)

    def compared(carry, p):
        period, least = carry
        before = jax.lax.dynamic_slice_in_dim(states, longest - p, size, axis=1)
        apart = jnp.max(jnp.abs(last - before) / scale)
        return (jnp.where(apart <= _SLACK * tolerance, p, period), jnp.minimum(apart, least)), None

    periods = jnp.arange(longest, 0, -1, dtype=jnp.int32)
    begin = jnp.zeros((), jnp.int32), jnp.full((), jnp.inf, states.dtype)
    (period, least), _ = jax.lax.scan(compared, begin, periods)
    return jnp.where(least <= tolerance, period, 0)


def impacts_of(impacts: Float[Array, " cycles"], period: Int[Array, ""]) -> Float[Array, ""]:
    """Impacts in a period of a motion; in a cycle, on average, where it has none."""
    last = jnp.arange(impacts.size) >= impacts.size - period
    total = jnp.sum(jnp.where(last, impacts, 0.0))
    return jnp.where(period > 0, total, jnp.mean(impacts))
