"""Equations that are singular because something in a motion is neutral.

A multiplier that is exactly 1 belongs to what a motion keeps, or to a place at which it may be as
well as at any other: a number carried along in the state, a body that slides freely. Its orbits are
a family, of which the one nearest to the guess is looked for; or there is none, where it drifts.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

Matrix = Float[Array, "n n"]

# Where the greatest singular value is larger than this, a motion is so unstable that its rounding
# hides what is neutral: a choice.
_STEEP = 1e3


def rounding(dtype: object) -> float:
    """The share of the greatest singular value below which one is zero to rounding: 2e-12 in double
    and 6e-6 in single precision."""
    return float(jnp.finfo(dtype).eps) ** 0.75


class Neutral(NamedTuple):
    """Projections on the null space of a matrix and on what it does not reach."""

    filled: Matrix
    """To be added to it: an image for each direction that has none, so that it can be inverted.
    Solutions then have no part in those directions, if there are any. Zero if it is regular."""
    unmet: Matrix
    """Projects on what no direction is mapped to."""


def neutral(matrix: Matrix) -> Neutral:
    """The directions that a matrix maps to zero and those it maps nothing to, to rounding."""
    left, sizes, right = jnp.linalg.svd(stop_gradient(matrix))
    lost = sizes <= rounding(matrix.dtype) * jnp.minimum(sizes[0], _STEEP)
    size = jnp.where(sizes[0] > 0, sizes[0], 1.0)
    lost = lost.astype(matrix.dtype)
    return Neutral((left * (lost * size)) @ right, (left * lost) @ left.T)


def least(matrix: Matrix, missing: Array) -> Array:
    """What solves `matrix @ step = missing`, where many do, the smallest one."""
    return jnp.linalg.solve(matrix + neutral(matrix).filled, missing)
