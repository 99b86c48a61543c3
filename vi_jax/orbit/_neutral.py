"""Equations that are singular because something in a motion is neutral.

A multiplier that is exactly 1 belongs to what a motion keeps, or to a place at which it may be as
well as at any other: a number carried along in the state, a body that slides freely. Its orbits are
a family, of which the one nearest to the guess is looked for; or there is none, where it drifts.
"""

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


def smallest_solution(matrix: Matrix, missing: Array, least: float | None = None) -> Array:
    """What solves `matrix @ step = missing`, where many do, the smallest one. What no step reaches
    is left over: `missing - matrix @ step`.

    **Arguments:** the equations; the share of the greatest singular value below which one is zero,
    by default that of rounding.
    """
    left, sizes, right = jnp.linalg.svd(stop_gradient(matrix))
    least = rounding(matrix.dtype) if least is None else least
    lost = sizes <= least * jnp.minimum(sizes[0], _STEEP)
    size = jnp.where(sizes[0] > 0, sizes[0], 1.0)
    # An image for each direction that has none, so that the matrix can be inverted.
    filled = (left * (lost.astype(matrix.dtype) * size)) @ right
    return jnp.linalg.solve(matrix + filled, missing)
