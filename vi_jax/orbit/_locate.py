"""The place on a curve at which a test is zero: where the curve is smooth, where the test jumps,
and where the equations are singular."""

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np

from ._corrector import Step, advance, observe, way
from ._shooting import Shooting

# How far short of a place that has no solution (as a share of the step) one is looked for: choices.
_SHORT_OF = (1e-6, 1e-5, 1e-4, 1e-3)

# Places without a solution after which none closer is looked for: around a place at which the
# equations are singular, what is left to be told is the rounding of the corrector. A choice.
_TRIALS = 5

# How far beside a point where branches cross (in the norm of the scaled unknowns) it is looked at:
# a choice.
BESIDE = 1e-3

# At most so many times as far on each side.
MOST = 8

# A neighbour whose tangent is so many times as far from the middle one as half of them are lies on
# the curve that crosses: a choice, where equal distances leave 3 at most.
_ASTRAY = 10.0

# A zero beside a solution is not further from it (in the parameter's scale): a choice.
_CLOSE = 1e-2

Advance = Callable[[Any, Any, float], Step]


class NoValueError(ArithmeticError):
    """A test has no value, because the corrector has no answer there."""


class _CloseError(ArithmeticError):
    """The corrector has had no answer so often that no closer place is to be had."""


def located(
    problem: Shooting, here: Step, new: Step, scale: np.ndarray, test: Callable[[Step], float]
) -> Step | None:
    """The point between two, along the first one's tangent, at which a test is zero; `None` if
    there is none.

    **Arguments:** `here` and `new`, the points, which may lie against that tangent; `scale`, the
    size of each unknown; `test`, a function of a point that changes its sign between them.
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


def zero_near(
    problem: Shooting, x: np.ndarray, scale: np.ndarray, test: Callable[[Step], float]
) -> Step | None:
    """The solution close to one at which a test is zero, by the secant method on the parameter;
    `None` if there is none.

    **Arguments:** the equations; about their solution; the size of each unknown; the test.
    """
    found: list[Step] = []

    def value(shift: float) -> float:
        step = advance(problem, x, np.eye(x.size)[-1], scale, shift)
        found.append(step)
        if not bool(step.good):
            raise NoValueError  # else the secant goes on with NaN, fifty times
        return test(step)

    from scipy.optimize import newton  # slow to load

    try:
        shift, report = newton(  # pyright: ignore[reportAssignmentType]
            value, 0.0, x1=1e-6, tol=1e-12, full_output=True, disp=False
        )
        near = report.converged and abs(shift) < _CLOSE and not np.isnan(value(float(shift)))
    except NoValueError:
        return None
    return found[-1] if near else None


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
    tangents = np.stack([step.tangent for step in found.values()])
    aside = np.linalg.norm(tangents - np.median(tangents, axis=0), axis=1)
    along_it = aside <= _ASTRAY * np.median(aside) + 1e-9
    found = {x: step for (x, step), keep in zip(found.items(), along_it, strict=True) if keep}
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
