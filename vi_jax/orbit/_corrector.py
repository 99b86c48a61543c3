"""Solutions of an orbit's equations along a curve: the corrector, and the programs that it needs.

A curve is the solutions of n - 1 equations in n unknowns (pseudo-arclength).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._programs import compiled
from .._types import Flag, Scalar
from ._neutral import smallest_solution
from ._observed import Observed
from ._shooting import Shooting
from ._symmetry import halves

Vector = Float[Array, " n"]

# The largest component of a last correction, in scaled unknowns.
_TOLERANCE = 1e-11

# Along a curve of double folds one direction changes nothing in the equations to first order: a
# singular value is zero within this share of the greatest. A choice.
_DOUBLE = 1e-6

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
    """What is observed there, an `Observed` of arrays of the host."""


def way(here: Step, at: Step, scale: np.ndarray) -> float:
    """How far along the first one's tangent the second lies, in unknowns divided by `scale`."""
    return float(np.dot(here.tangent, (at.x - here.x) / scale))


def array_of(tree: object) -> Any:
    """Host copies of a compiled call's results, so that what follows costs no dispatch."""
    return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, tree)


def _jacobian(function: Callable[..., Any], x: Array) -> tuple[Array, Array]:
    """Derivative and value. Unlike `jax.jacfwd` it does not ask for a value that is the same for
    all directions: loops within a function may not give one."""

    def along(direction):
        return jax.jvp(function, (x,), (direction,))

    values, columns = jax.vmap(along)(jnp.eye(x.size, dtype=x.dtype))
    return columns.T, values[0]


@compiled
def _advanced(problem: Shooting, x: Vector, tangent: Vector, scale: Vector, length: Scalar) -> Step:
    """As `advance`. Newton's method on the equations and the plane: nothing is close to singular at
    a fold, since the parameter is one of the unknowns."""

    def equations(y):
        return jnp.concatenate([problem.residual(y * scale), jnp.dot(tangent, y - y0)[None]])

    def newton(carry):
        y, before, count, *_ = carry
        jacobian, missing = _jacobian(equations, y)
        both = jnp.stack([missing, jnp.zeros_like(y).at[-1].set(1.0)], axis=-1)
        if problem.is_double:
            move, along = smallest_solution(jacobian, both, _DOUBLE).T
        else:
            move, along = jnp.linalg.solve(jacobian, both).T
        return y - move, jnp.max(jnp.abs(move)), count + 1, along, before <= _TOLERANCE

    def going(carry):
        _, size, count, _, done = carry
        return ~done & (size < 10.0) & (count < 13)

    y0 = x / scale + length * tangent
    start = (y0, jnp.ones((), x.dtype), jnp.zeros((), jnp.int32), y0, jnp.zeros((), bool))
    # One correction more than it takes: the tangent is then that of the solution.
    y, size, count, along, _ = jax.lax.while_loop(going, newton, start)
    along = along / jnp.linalg.norm(along)
    # Rounding may keep the last correction above the tolerance where the curve is steep.
    good = (size <= 1e3 * _TOLERANCE) & jnp.all(jnp.isfinite(along))
    return Step(y * scale, along, size, count, good, problem.observe(y * scale))


def advance(
    problem: Shooting, x: Unknowns, tangent: Unknowns, scale: Unknowns, length: float | Array
) -> Step:
    """The solution on the plane across a tangent.

    **Arguments:** the equations; `x`, the unknowns from where; `tangent`, a unit vector, and
    `length`, how far along it, both in unknowns divided by `scale`.
    """
    return array_of(_advanced(problem, *map(jnp.asarray, (x, tangent, scale, length))))


@compiled
def _compiled_observe(problem, x):
    return problem.observe(x)


def observe(problem: Shooting, x: np.ndarray) -> Observed:
    """What is observed of a solution: multipliers, extremes, clearance, speeds of approach."""
    return array_of(_compiled_observe(problem, jnp.asarray(x)))


@compiled
def _compiled_lacks(problem, x):
    ends = problem.lacks(x)[: problem.legs * problem.states]
    return ends.reshape(-1, problem.states) / problem.sizes[1:]


def off_by(problem: Shooting, x: Unknowns) -> float:
    """How much twice the steps change the states where each flight ends, relative to their
    sizes."""
    finer = dataclasses.replace(problem, steps=2 * problem.steps)
    one, other = (_compiled_lacks(each, jnp.asarray(x)) for each in (finer, problem))
    return float(np.max(np.abs(np.asarray(one) - np.asarray(other))))


@compiled
def _tangent(problem, x, scale):
    jacobian, _ = _jacobian(lambda y: problem.residual(y * scale), x / scale)
    tangent = jnp.linalg.svd(jacobian, full_matrices=True)[2][-1]
    return tangent * jnp.where(tangent[-1] < 0, -1.0, 1.0)


def tangent_at(problem: Shooting, x: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The unit tangent (scaled) of the solutions through `x`, the last unknown rising."""
    if not problem.is_double:
        return np.asarray(_tangent(problem, jnp.asarray(x), jnp.asarray(scale)))
    jacobian = np.asarray(jacobian_at(problem, jnp.asarray(x))) * scale
    plane = np.linalg.svd(jacobian)[2][-2:]  # one direction in it moves the parameters
    tangent = np.linalg.svd(plane[:, -2:])[0][:, 0] @ plane
    return tangent * np.copysign(1.0, tangent[-1])


@compiled
def state_at(problem: Shooting, x, leg, s):
    """The state at clock `s` within the leg of this number."""
    return problem.state_at(x, leg, s)


@compiled
def jacobian_at(problem: Shooting, x):
    """The derivatives of the equations by all unknowns."""
    return jax.jacfwd(problem.residual)(x)


@compiled
def _compiled_halves(problem: Shooting, x, mirrored: bool):
    return halves(problem, x, mirrored)


def halves_apart(problem: Shooting, step: Step, *, mirrored: bool = False) -> np.ndarray:
    """How the second half of the period differs from the first one, or from its image under the
    symmetry of the machine, in the sizes of the unknowns."""
    apart = _compiled_halves(problem, jnp.asarray(step.x), mirrored)
    return np.asarray(apart) / problem.half_scale()
