"""Solutions of an orbit's equations along a curve: the corrector, and the programs that it needs.

A curve is the solutions of n - 1 equations in n unknowns (pseudo-arclength).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._programs import compiled
from .._types import Flag, Scalar
from ._observed import Observed
from ._shooting import Shooting
from ._symmetry import images

Vector = Float[Array, " n"]

# Of an orbit, as numbers of the host or of a compiled call.
Unknowns = np.ndarray | Array


class Step(NamedTuple):
    """A point of the curve, as one corrector finds it."""

    x: Vector
    """The unknowns, the curve's parameter last."""
    tangent: Vector
    """Unit tangent in scaled unknowns, in the sense of the step."""
    size: Scalar
    """Largest component of the last correction (scaled)."""
    iterations: Int[Array, ""]
    """Corrections that it took."""
    good: Flag
    """Whether the corrector converged."""
    seen: Any
    """What is observed there, an `Observed` of a branch."""


def corrected(
    residual: Callable[[Vector], Vector],
    observe: Callable[[Vector, Vector], Any],
    x: Vector,
    tangent: Vector,
    scale: Vector,
    length: Scalar,
    *,
    tolerance: float = 1e-11,
) -> Step:
    """The point of the curve on the plane that lies `length` along the tangent from `x`.

    Newton's method on the equations and the plane. Nothing is close to singular at a fold, since
    the parameter is one of the unknowns.

    **Arguments:** `residual`, the equations; `observe`, what to observe of a point and its tangent;
    `x` and `tangent`, the last point and its unit tangent in unknowns divided by `scale`; `length`,
    that of the step; `tolerance`, for the largest component of a correction (scaled).
    """

    def plane(y):
        return jnp.dot(tangent, y - y0)

    def equations(y):
        return jnp.concatenate([residual(y * scale), plane(y)[None]])

    def newton(carry):
        y, before, count, *_ = carry
        jacobian, missing = _jacobian(equations, y)
        both = jnp.stack([missing, jnp.zeros_like(y).at[-1].set(1.0)], axis=-1)
        move, along = jnp.linalg.solve(jacobian, both).T
        return y - move, jnp.max(jnp.abs(move)), count + 1, along, before <= tolerance

    def going(carry):
        _, size, count, _, done = carry
        return ~done & (size < 10.0) & (count < 13)

    y0 = x / scale + length * tangent
    start = (y0, jnp.ones((), x.dtype), jnp.zeros((), jnp.int32), y0, jnp.zeros((), bool))
    # One correction more than it takes: the tangent is then that of the solution.
    y, size, count, along, _ = jax.lax.while_loop(going, newton, start)
    along = along / jnp.linalg.norm(along)
    # Rounding may keep the last correction above the tolerance where the curve is steep.
    good = (size <= 1e3 * tolerance) & jnp.all(jnp.isfinite(along))
    return Step(y * scale, along, size, count, good, observe(y * scale, along))


def _jacobian(function: Callable[..., Any], x: Array) -> tuple[Array, Array]:
    """Derivative and value. Unlike `jax.jacfwd` it does not ask for a value that is the same for
    all directions: loops within a function may not give one."""

    def along(direction):
        return jax.jvp(function, (x,), (direction,))

    values, columns = jax.vmap(along)(jnp.eye(x.size, dtype=x.dtype))
    return columns.T, values[0]


def first_tangent(residual: Callable[[Vector], Vector], x: Vector, scale: Vector) -> Vector:
    """Unit tangent (scaled) at a point that solves the equations, the last unknown rising."""
    jacobian, _ = _jacobian(lambda y: residual(y * scale), x / scale)
    tangent = jnp.linalg.svd(jacobian, full_matrices=True)[2][-1]
    return tangent * jnp.where(tangent[-1] < 0, -1.0, 1.0)


def way(here: Step, at: Step, scale: np.ndarray) -> float:
    """How far along the first one's tangent the second lies, in unknowns divided by `scale`."""
    return float(np.dot(here.tangent, (at.x - here.x) / scale))


def array_of(tree: object) -> Any:
    """Host copies of a compiled call's results, so that what follows costs no dispatch."""
    return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, tree)


@runtime_checkable
class Equations(Protocol):
    """What is solved here: an orbit's equations, or those with a condition beside them."""

    def residual(self, x: Vector) -> Vector:
        """What the unknowns `x` lack to be a solution."""
        ...

    def observe(self, x: Vector) -> Observed:
        """What is observed of a solution."""
        ...


@compiled
def _compiled_advance(equations, x, tangent, scale, length) -> Step:
    """As `advance`, of arrays.

    **Arguments:** as `advance`.
    """

    def observe(x, tangent):
        return equations.observe(x)

    return corrected(equations.residual, observe, x, tangent, scale, length)


def advance(
    equations: Equations, x: Unknowns, tangent: Unknowns, scale: Unknowns, length: float | Array
) -> Step:
    """The solution on the plane across a tangent (see `curve.corrected`).

    **Arguments:** `x`, the unknowns from where; `tangent`, a unit vector, and `length`, how far
    along it, both in unknowns divided by `scale`.
    """
    arguments = (jnp.asarray(a) for a in (x, tangent, scale, length))
    return array_of(_compiled_advance(equations, *arguments))


@compiled
def _compiled_observe(problem, x):
    return problem.observe(x)


def observe(problem: Shooting, x: np.ndarray) -> Observed:
    """What is observed of a solution: multipliers, extremes, clearance, speeds of approach."""
    return array_of(_compiled_observe(problem, jnp.asarray(x)))


@compiled
def _compiled_off(problem, x):
    finer = dataclasses.replace(problem, steps=2 * problem.steps)
    ends = (finer.lacks(x) - problem.lacks(x))[: problem.legs * problem.states]
    return jnp.max(jnp.abs(ends.reshape(-1, problem.states) / problem.sizes[1:]))


def off_by(problem: Shooting, x: Unknowns) -> float:
    """How much twice the steps change the states where each flight ends, relative to their
    sizes."""
    return float(_compiled_off(problem, jnp.asarray(x)))


@compiled
def _compiled_tangent(equations, x, scale):
    return first_tangent(equations.residual, x, scale)


def tangent_at(equations: Equations, x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The unit tangent of the solutions through `x`, in scaled unknowns."""
    return np.asarray(_compiled_tangent(equations, jnp.asarray(x), jnp.asarray(scale)))


@compiled
def state_at(problem: Shooting, x, leg, s):
    """The state at clock `s` within the leg of this number."""
    return problem.state_at(x, leg, s)


@compiled
def jacobian_at(problem: Shooting, x):
    """The derivatives of the equations by all unknowns."""
    return jax.jacfwd(problem.residual)(x)


@compiled
def _compiled_images(problem: Shooting, x):
    return images(problem, x)


def apart_from_image(problem: Shooting, step: Step) -> np.ndarray:
    """How far a motion is from being its own image under the symmetry of its machine, in the sizes
    of the unknowns."""
    apart = _compiled_images(problem, jnp.asarray(step.x))
    return np.asarray(apart) / problem.half_scale()
