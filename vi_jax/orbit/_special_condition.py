"""The condition that a motion is special, by which curves in two parameters are followed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._conditions import AbstractCondition
from ._corrector import jacobian_at
from ._shooting import Shooting
from ._symmetry import images
from .floquet import compound
from .special import DOUBLING, TORUS, TOUCHING


class SymmetryCondition(eqx.Module):
    """The condition that a motion is its own image under the symmetry of its machine, in the place
    of one of its equations.

    The motions x of the equations F(x, p) = 0 from event to event are symmetric where D(x), their
    difference from their own image (`images`), vanishes. Where they lose their symmetry F cannot be
    solved for x: its Jacobian J = ∂F/∂x has a null vector r, along which the motion departs from
    its image, and a left null vector l, so that l·F = 0 is met by every symmetric motion close by
    to first order. That combination of the equations gives way to w·D = 0, where w picks out of D
    how far the motion has gone along r:

        F + l (w·D - l·F) = 0,   w = DD r/|DD r|²,   DD the derivative of D by x.

    These equations are regular, and the curve's own condition det(M - I) = 0 is added to them.
    """

    left: Float[Array, " equations"]
    """l, the left null vector of J where the symmetry is lost."""
    weight: Float[Array, " differences"]
    """w, which picks out of D how far the motion has gone along r."""

    def instead(self, problem: Shooting, missing: Array, x: Array) -> Array:
        """The equations' residual F, given as `missing`, with the combination l·F exchanged for
        w·D."""
        departs = self.weight @ images(problem, x)
        return missing + self.left * (departs - self.left @ missing)


def symmetry_condition(problem: Shooting, x: np.ndarray) -> SymmetryCondition:
    """The condition at a motion that loses its symmetry, by the singular vectors of its Jacobian
    without the columns of the parameters."""
    count = len(problem.parameters)
    left, _, right = np.linalg.svd(np.asarray(jacobian_at(problem, jnp.asarray(x)))[:, :-count])
    direction = jnp.append(jnp.asarray(right[-1]), jnp.zeros(count))
    change = jax.jvp(lambda x: images(problem, x), (jnp.asarray(x),), (direction,))[1]
    return SymmetryCondition(jnp.asarray(left[:, -1]), change / (change @ change))


class Special(AbstractCondition):
    """The condition that a motion is special.

    With the monodromy matrix M that is det(M - I) = 0 at a fold or where a symmetry is lost,
    det(M + I) = 0 at a period doubling, and where a pair of multipliers leaves the unit circle that
    the product of two is 1, det(M₂ - I) = 0 with the compound matrix M₂ (see `compound`). M has
    poles where an impact grazes, which the speeds of approach take away. At a grazing the condition
    is V⁻ = 0 of the impact that is lost, or a clearance of zero.
    """

    kind: str = eqx.field(static=True)
    impact: int | None = eqx.field(static=True)
    """The event that grazes; `None` at a touch, and where nothing grazes."""
    symmetry: SymmetryCondition | None = None

    def exchanged(self, problem, x, missing):
        """Where a symmetry is lost, one of the equations is exchanged (see `SymmetryCondition`)."""
        return missing if self.symmetry is None else self.symmetry.instead(problem, missing, x)

    def missing(self, problem, x, seen):
        """The determinant, V⁻ or the clearance."""
        if self.kind in TOUCHING:
            return seen.nearest.room if self.impact is None else seen.approach[self.impact]
        matrix = compound(seen.monodromy) if self.kind == TORUS else seen.monodromy
        sign = 1 if self.kind == DOUBLING else -1
        identity = jnp.eye(matrix.shape[0], dtype=x.dtype)
        return jnp.linalg.det(matrix + sign * identity) * jnp.prod(seen.approach)
