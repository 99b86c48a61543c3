"""The equations of an orbit solved: their programs, and what they say."""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._programs import compiled
from .._types import Vector
from ._observed import Observed
from ._shooting import Shooting
from ._symmetry import images
from .curve import Step, array_of, corrected, first_tangent, way

# How far short of a place that has no solution (as a share of the step) one is looked for: choices.
_SHORT_OF = (1e-6, 1e-5, 1e-4, 1e-3)

# Places without a solution after which none closer is looked for: around a place at which the
# equations are singular, what is left to be told is the rounding of the corrector. A choice.
_TRIALS = 5


# Of an orbit, as numbers of the host or of a compiled call.
Unknowns = np.ndarray | Array


class NoValueError(ArithmeticError):
    """A test has no value, because the corrector has no answer there."""


class _CloseError(ArithmeticError):
    """The corrector has had no answer so often that no closer place is to be had."""


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
    return jnp.max(jnp.abs(finer.lacks(x) - problem.lacks(x)))


def off_by(problem: Shooting, x: Unknowns) -> float:
    """How much twice the steps change the states where each flight ends."""
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
def images_at(problem: Shooting, x):
    """How far a motion is from being its own image under the symmetry of its machine."""
    return images(problem, x)


def located(
    problem: Shooting, here: Step, new: Step, scale: np.ndarray, test: Callable[[Step], float]
) -> Step | None:
    """The point between two, along the first one's tangent, at which a test is zero; `None` if
    there is none.

    **Arguments:** `here` and `new`, the points; `scale`, the size of each unknown; `test`, a
    function of a point that changes its sign between them.
    """
    length = way(here, new, scale)
    at: dict[float, Step] = {0.0: here, length: new}
    silent: list[float] = []

    def reached(s: float) -> Step:
        """There, or where there is no answer, as close to where branches cross, right beside."""
        step = advance(problem, here.x, here.tangent, scale, s)
        for short in _SHORT_OF:
            if bool(step.good):
                break
            if short == _SHORT_OF[0]:
                silent.append(s)
            step = advance(problem, here.x, here.tangent, scale, s - short * length)
        return step

    def value(s: float) -> float:
        if s not in at:
            if len(silent) >= _TRIALS:
                raise _CloseError
            at[s] = reached(s)
        found = test(at[s])
        if np.isnan(found):
            raise NoValueError
        return found

    from scipy.optimize import brentq  # slow to load

    # Where the test jumps, or has no value, the closest point to it has to do.
    options: Any = {"xtol": 1e-14, "rtol": 1e-14, "maxiter": 80}
    try:
        if not value(0.0) * value(length) <= 0:
            return None
        root = float(brentq(value, 0.0, length, full_output=True, disp=False, **options)[0])
        value(root)
    except NoValueError:
        return None
    except _CloseError:
        root = silent[-1]
    # Where branches cross, or a motion shrinks to rest, the corrector has no answer; a point short
    # of it will do.
    for short in _SHORT_OF:
        if any(bool(at[s].good) for s in at if abs(s - root) <= short * abs(length)):
            break
        with contextlib.suppress(NoValueError, _CloseError):
            value(root - short * length)
    begin, good = test(here), [(s, step) for s, step in at.items() if bool(step.good)]

    def off(place: tuple[float, Step]) -> tuple[float, bool, float]:
        """How far a point is from it; of a test that only jumps, the last one before the jump is
        closest."""
        left = test(place[1])
        return abs(left), bool(left * begin < 0), abs(place[0] - root)

    return min(good, key=off)[1] if good else None


def between(
    problem: Shooting, here: Step, new: Step, scale: np.ndarray, test: Callable[[Step], float]
) -> Step | None:
    """As `located`, between two points that follow each other in a finished curve: its steps
    follow its sense, except in its backward half, which is turned."""
    if way(here, new, scale) < 0:
        here, new = new, here
    return located(problem, here, new, scale, test)
