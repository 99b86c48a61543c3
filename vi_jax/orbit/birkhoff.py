"""Averages of a motion over its sections with weights that vanish smoothly at both ends.

On quasi-periodic motions they converge faster than any power of the number of sections (Das, Saiki,
Sander and Yorke 2017), on chaotic ones as slowly as plain averages.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from .tolerances import ROUNDING

# Averages agree to so many digits at most, the rounding of double precision.
_MOST = 16.0


def weights(number: int) -> np.ndarray:
    """Return the weights of so many instants; their sum is 1."""
    place = (np.arange(number) + 0.5) / number
    weight = np.exp(-1 / (place * (1 - place)))
    return weight / weight.sum()


def without_angles(rows: Float[Array, "sections states"], angles: np.ndarray | None) -> Array:
    """Return the rows with the sine and cosine of each angle in its place."""
    if angles is None:
        return rows
    across, around = rows[:, ~angles], rows[:, angles]
    return jnp.concatenate([across, jnp.sin(around), jnp.cos(around)], axis=1)


def agreement(rows: Float[Array, "sections states"]) -> Scalar:
    """Return the number of digits to which averages over both halves of the sections agree: those
    of each component and of its square, relative to their spread."""
    values = jnp.concatenate([rows, rows**2], axis=1)
    half = len(rows) // 2
    difference = jnp.asarray(weights(half)) @ (values[:half] - values[half : 2 * half])
    return digits_of(difference, jnp.std(values, axis=0), jnp.mean(values, axis=0))


def digits_of(difference: Array, spread: Array, mean: Array) -> Scalar:
    """Return the number of digits to which averages agree that differ by this, relative to their
    spread; a spread that is rounding of the mean counts as that."""
    size = spread + ROUNDING * jnp.abs(mean)
    share = jnp.max(jnp.abs(difference) / jnp.where(size > 0, size, 1.0))
    return jnp.minimum(-jnp.log10(share + 10.0**-_MOST), _MOST)


def rotation_number(rows: Float[Array, "sections states"]) -> Scalar:
    """Return the mean angle, in turns from 0 to 1/2, by which sections move on around their mean.
    It is NaN for a fixed point.

    The angle is seen in the plane of the two directions of largest spread. Steps of the angle are
    counted from the middle of the widest gap between them, so a curve that is not a circle matters
    only if its steps leave no gap.
    """
    weight = jnp.asarray(weights(len(rows)))
    centred, size = rows - weight @ rows, jnp.std(rows, axis=0)
    moves = size > ROUNDING * jnp.max(jnp.abs(rows), axis=0)
    scaled = jnp.where(moves, centred / jnp.where(moves, size, 1.0), 0.0)
    _, directions = jnp.linalg.eigh(scaled.T @ scaled)
    x, y = (scaled @ directions[:, -2:]).T
    steps = jnp.mod(jnp.diff(jnp.arctan2(y, x)) / (2 * jnp.pi), 1.0)
    order = jnp.sort(steps)
    gaps = jnp.diff(jnp.append(order, order[0] + 1))
    widest = jnp.argmax(gaps)
    cut = order[widest] + 0.5 * gaps[widest]
    mean = jnp.asarray(weights(len(rows) - 1)) @ jnp.mod(steps - cut, 1.0)
    turn = jnp.mod(mean + cut, 1.0)
    return jnp.where(jnp.any(moves), jnp.minimum(turn, 1 - turn), jnp.nan)
