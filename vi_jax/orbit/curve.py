"""Pseudo-arclength: a curve of solutions of n - 1 equations in n unknowns, followed by steps."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._checks import count, given_number
from .._messages import Tell
from .._types import Flag, Scalar

Vector = Float[Array, " n"]


# A walk whose steps have to be shorter than this share of the longest stalls: a choice. The
# shortest that the branches of the tests need is 2e-3 of it.
_SHORTEST = 1e-6

# After a step that had to be cut so many have its length, before they grow again: a choice.
_STEADY = 3


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


def check_walk(*, step: object, max_step: object, max_points: object) -> dict[str, Any]:
    """The settings of `walk`. **Raises:** `ValueError` or `TypeError` that names the wrong one."""
    return {
        "step": given_number("step", step, low=0.0, open_low=True),
        "max_step": given_number("max_step", max_step, low=0.0, open_low=True),
        "max_points": count("max_points", max_points, least=2),
    }


# Ends of a walk that has not come to one: Ctrl-C was pressed, or the corrector has no answer.
INTERRUPTED, STALLED = "interrupted", "stalled"

# The tangents of two points close to each other on one curve have at least this product: a choice.
SAME_CURVE = 0.9


def way(here: Step, at: Step, scale: np.ndarray) -> float:
    """How far along the first one's tangent the second lies, in unknowns divided by `scale`."""
    return float(np.dot(here.tangent, (at.x - here.x) / scale))


# Stands for the reason to end where a step has led to another curve: it is to be shorter.
SHORTER = "shorter"


def walk(
    advance: Callable[[Vector, Vector, float], Step],
    steps: list[Step],
    *,
    stop: Callable[[Step, Step], tuple[Step, str] | None],
    tell: Tell,
    step: float,
    max_step: float,
    max_points: int,
) -> str:
    """Follow the curve from its first point in the sense of its tangent. Host-side.

    **Arguments:** `advance`, the compiled corrector, of unknowns, tangent and length; `steps`, the
    first point, to which the others are added; `stop`, asked after each step with the points before
    and after it: the last point and a reason to end, or `SHORTER` for one, or `None`; `tell`, told
    of each point; `step` and `max_step`, the first and the longest step length; `max_points`, the
    most points.

    **Returns:** why it ended.
    """
    length, failed, steady = step, 0, 0
    while len(steps) < max_points:
        here = steps[-1]
        new = advance(here.x, here.tangent, length)
        turn = float(np.dot(np.asarray(new.tangent), np.asarray(here.tangent)))
        ending = stop(here, new) if bool(new.good) and turn >= SAME_CURVE else (here, SHORTER)
        if ending is not None and ending[1] == SHORTER:
            # The further off a solution is, the longer each trial takes.
            length, failed, steady = length * (0.4 if failed < 2 else 0.1), failed + 1, _STEADY
            if length < _SHORTEST * max_step:
                return STALLED
            continue
        failed, steady = 0, max(0, steady - 1)
        if ending is not None:
            last, reason = ending
            if last is not here:
                steps.append(last)
            return reason
        steps.append(new)
        tell(1)
        if turn > 0.99 and int(new.iterations) <= 6 and not steady:
            length = min(1.4 * length, max_step)
        elif turn < 0.97:
            length *= 0.7
    return "max_points"


def array_of(tree: object) -> Any:
    """Host copies of a compiled call's results, so that what follows costs no dispatch."""
    return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, tree)
