"""Floquet multipliers and what they say about a periodic motion."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..flow import NamedEnumeration
from ..lanes import pin


class STABILITY(NamedEnumeration):
    """The stability of a periodic motion, or the way in which it was lost."""

    stable = "stable"
    fold = "unstable: a real multiplier above 1 (past a fold or where branches cross)"
    period_doubling = "unstable: a real multiplier below -1 (past a period doubling)"
    neimark_sacker = "unstable: a complex pair outside the unit circle (past a Neimark–Sacker)"
    neutral = "neutral: neither stable nor unstable to rounding, a multiplier has modulus 1"
    unknown = "without multipliers"


# A modulus is 1 within this, in double precision: a choice, ten times `Newton`'s tolerance.
NEUTRAL = 1e-9


def multipliers_of(monodromy: Float[Array, "n n"]) -> Complex[Array, " n"]:
    """Eigenvalues of a monodromy matrix, the largest modulus first; NaN if it is not finite."""
    finite = jnp.all(jnp.isfinite(monodromy))
    safe = jnp.where(finite, monodromy, jnp.eye(monodromy.shape[0], dtype=monodromy.dtype))
    if monodromy.shape == (2, 2):
        half = 0.5 * (safe[0, 0] + safe[1, 1])
        values = eigenvalues(half, safe[0, 0] * safe[1, 1] - safe[0, 1] * safe[1, 0])
    else:
        values = jnp.linalg.eigvals(safe)
    order = jnp.argsort(-jnp.abs(values))
    return jnp.where(finite, values[order], jnp.nan)


def eigenvalues(
    half: Float[Array, "..."], determinant: Float[Array, "..."]
) -> Complex[Array, "... 2"]:
    """Eigenvalues of 2x2 matrices from half their trace and their determinant."""
    # Pinned: computed again with other rounding, it would be zero for one of those who ask, and not
    # for another (seen with JAX 0.12: 1 ± 0.7 for 1 and 1).
    square = pin(half * half - determinant).astype(jnp.result_type(half, jnp.complex64))
    double = square == 0  # where the derivative of the root is infinite
    root = jnp.where(double, 0.0, jnp.sqrt(jnp.where(double, 1.0, square)))
    return jnp.stack([half + root, half - root], axis=-1)


def stability_of(multipliers: Complex[Array, " n"]) -> STABILITY:
    """The verdict of a set of multipliers: that of the largest."""
    largest = multipliers[jnp.argmax(jnp.abs(multipliers))]
    size = jnp.abs(largest)
    real = jnp.abs(largest.imag) <= NEUTRAL * size
    how = STABILITY.where(
        real & (largest.real > 0),
        STABILITY.fold,
        STABILITY.where(real, STABILITY.period_doubling, STABILITY.neimark_sacker),
    )
    verdict = STABILITY.where(size < 1, STABILITY.stable, how)
    rounding = max(NEUTRAL, 100 * float(jnp.finfo(size.dtype).eps))
    verdict = STABILITY.where(jnp.abs(size - 1) <= rounding, STABILITY.neutral, verdict)
    return STABILITY.where(jnp.isnan(size), STABILITY.unknown, verdict)


def compound(matrix: Float[Array, "n n"]) -> Float[Array, "pairs pairs"]:
    """The second compound matrix, of all determinants of two rows and two columns: its eigenvalues
    are the products of two of the eigenvalues."""
    first, second = np.triu_indices(len(matrix), 1)
    rows, others = matrix[first], matrix[second]
    return rows[:, first] * others[:, second] - rows[:, second] * others[:, first]
