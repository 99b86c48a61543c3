"""Tests for bifurcations along a branch, and the place where branches cross."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ._shooting import Shooting
from ._solve import observe
from .curve import Step
from .floquet import NEUTRAL
from .special import CROSSING, DOUBLING, FOLD, TORUS

# How far beside a point where branches cross (in the norm of the scaled unknowns) it is looked at:
# a choice.
BESIDE = 1e-3

# At most so many times as far on each side.
MOST = 8

Advance = Callable[[Any, Any, float], Step]


def tests_of(step: Step) -> dict[str, float]:
    """Functions that change sign at the bifurcations."""
    M, identity = step.seen.monodromy, np.eye(step.seen.monodromy.shape[0])
    values = step.seen.multipliers
    with np.errstate(invalid="ignore"):  # a step without an answer has none here either
        doubling, crosses = np.linalg.det(M + identity), np.linalg.det(M - identity)
    pairs = [
        1 - values[i] * values[j] for i in range(len(values)) for j in range(i + 1, len(values))
    ]
    return {
        FOLD: float(step.tangent[-1]),
        DOUBLING: float(doubling),
        CROSSING: float(crosses),
        TORUS: float(np.real(np.prod(pairs))),
    }


def changed_between(before: dict[str, float], after: dict[str, float]) -> list[str]:
    """Which tests change their sign from one step to another."""
    changed = [kind for kind in before if before[kind] * after[kind] < 0]
    # Without damping a pair stays on the unit circle, to rounding of either sign.
    if TORUS in changed and max(abs(before[TORUS]), abs(after[TORUS])) < NEUTRAL:
        changed.remove(TORUS)
    return changed


def crossing(
    problem: Shooting, advance: Advance, here: Step, root: float, test: Callable[[Step], float],
    admits: Callable[[Step, float], bool] = lambda step, length: True,
) -> Step | None:  # fmt: skip
    """The point of a curve at which a test is zero, where its equations are singular: where
    branches cross, or where an impact grazes.

    Close to it the equations cannot be solved, but the curve passes through it smoothly, so that a
    polynomial through its neighbours tells where it is, and what the motion is there.

    **Arguments:** the equations; `advance`, of unknowns, tangent and length, the curve's point; a
    point of it, and about how far along its tangent the place is; the test; `admits`, of a point
    and its length, whether it belongs to this curve.

    Where the curve is found on the near side only, there are more neighbours of that one.

    **Returns:** `None` if too few points were found, or no zero.
    """
    found: dict[float, Step] = {}

    def along(length: float) -> Step | None:
        step = advance(here.x, here.tangent, length)
        return step if bool(step.good) and admits(step, length) else None

    for side, wanted in ((-BESIDE, 3), (BESIDE, 6), (-BESIDE, 6)):
        for n in range(1, MOST + 1):
            if len(found) == wanted:
                break
            step = None if n * side in found else along(root + n * side)
            if step is not None:
                found[n * side] = step
    if len(found) < 6:
        return None
    places, beside = np.array(list(found)), list(found.values())

    def through(values: Any) -> np.polynomial.Polynomial:
        return np.polynomial.Polynomial.fit(places, values, len(places) - 1)

    zeros = through([np.asarray(test(step)) for step in beside]).roots()
    zeros = zeros[np.abs(zeros.imag) < 1e-12].real
    if not zeros.size or np.abs(zeros).min() > BESIDE:
        return None
    place = zeros[np.argmin(np.abs(zeros))]

    def there(get: Callable[[Step], Any]) -> np.ndarray:
        return np.stack([through(x)(place) for x in zip(*map(get, beside), strict=True)])

    x, tangent = there(lambda step: step.x), there(lambda step: step.tangent)
    return here._replace(x=x, tangent=tangent / np.linalg.norm(tangent), seen=observe(problem, x))


def turns_back(here: Step, at: Step, last: Step, scale: np.ndarray) -> bool:
    """Whether the parameter at a point between two lies beyond that at both, by more than
    rounding."""
    sides = [(float(at.x[-1]) - float(step.x[-1])) / scale[-1] for step in (here, last)]
    return bool(sides[0] * sides[1] > 0 and min(map(abs, sides)) > 1e-12)
