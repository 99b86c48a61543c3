"""What a settled motion is: its period in drive cycles."""

from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int


def least_period(
    sections: Any, *, longest: int, tolerance: Float[Array, ""] | float = 1e-6
) -> Int[Array, ""]:
    """The fewest drive cycles after which a motion repeats, or 0 if it does not.

    **Arguments:** section states one after the other, a pytree with leaves (cycles,); the longest
    period looked for; how far sections a period apart may differ (relative to 1 + |state|).
    """
    period = jnp.zeros((), jnp.int32)
    for p in range(longest, 0, -1):
        apart = [
            jnp.max(jnp.abs(x[p:] - x[:-p]) / (1 + jnp.abs(x[p:])))
            for x in jtu.tree_leaves(sections)
        ]
        period = jnp.where(jnp.max(jnp.stack(apart)) <= tolerance, p, period)
    return period
