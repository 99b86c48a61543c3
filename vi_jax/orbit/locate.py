"""The location of points on a curve: zeros of tests between two points, and crossings at which the
equations are singular.
"""

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np

from .corrector import Step, advance, distance_along, observe
from .equations import Shooting
from .tolerances import NEARBY, ROUGHLY

# Distances, as shares of the step, to retry before a place without a solution: choices.
_RETRIES = (1e-6, 1e-5, 1e-4, 1e-3)

# A test is zero below this share of its largest value. A place is accurate to that in scaled
# unknowns, or to the last correction. A choice: closer, rounding would be resolved.
_PLACED = 1e-13

# The search stops after this number of places without a solution: around a singularity of the
# equations only the corrector's rounding would be resolved. A choice.
_TRIALS = 5

# A search for a zero evaluates its function so often at most: a choice.
_MOST_STEPS = 80

# Distance of samples from a point where branches cross, in scaled unknowns: a choice.
SPACING = 1e-3

# At most so many times that distance on each side.
MOST_SAMPLES = 8

# A neighbour lies on the crossing curve if its tangent deviates from the median by more than this
# multiple of the median deviation. A choice: equal distances give 3 at most.
_OUTLIER = 10.0


class NoValueError(ArithmeticError):
    """A test has no value, because the corrector did not converge."""


class _TooCloseError(ArithmeticError):
    """The corrector has failed so often that no closer place can be reached."""


def passes_zero(before: float, after: float) -> bool:
    """Return whether a test changes its sign, or becomes exactly zero, from a point to the next."""
    return before * after < 0 or (after == 0 and abs(before) > 0)


def locate_zero(
    problem: Shooting, here: Step, new: Step, test: Callable[[Step], float],
    known: dict[float, Step] | None = None,
) -> Step | None:  # fmt: skip
    """Return the point between two, along the first one's tangent, at which a test that changes its
    sign between them is zero, or `None`. `new` may lie on either side of `here`. Points between
    them, by their distance from `here`, are taken from `known` and added to it."""
    length = distance_along(problem, here, new)
    points = {} if known is None else known
    points |= {0.0: here, length: new}
    failed: list[float] = []
    tested: dict[float, float] = {}
    bracket: dict[bool, float] = {}

    def solve_at(s: float) -> Step:
        """Return the solution there; if none, as at crossing branches, the one just before it."""
        step = advance(problem, here.x, here.tangent, s)
        for share in _RETRIES:
            if bool(step.good):
                break
            if share == _RETRIES[0]:
                failed.append(s)
            step = advance(problem, here.x, here.tangent, s - share * length)
        return step

    def value(s: float) -> float:
        if s not in points:
            if len(failed) >= _TRIALS:
                raise _TooCloseError
            points[s] = solve_at(s)
        if s not in tested:
            tested[s] = test(points[s])
        found = tested[s]
        if np.isnan(found):
            raise NoValueError
        bracket[found > 0] = s
        resolution = max(min(ROUGHLY, float(points[end].size)) for end in bracket.values())
        close = len(bracket) == 2 and abs(bracket[True] - bracket[False]) <= resolution
        # Of the largest value of either sign, since near a pole those of one are of any size.
        largest = (max(0.0, *(sign * x for x in (found, *tested.values()))) for sign in (1, -1))
        return 0.0 if close or abs(found) <= _PLACED * min(largest) else found

    # If the test jumps or has no value, use the closest point.
    try:
        if not value(0.0) * value(length) <= 0:
            return None
        ends = _known_bracket([s for s, step in points.items() if bool(step.good)], length, value)
        root = bracketed_zero(value, *ends, tolerance=_PLACED)
        value(root)
    except NoValueError:
        return None
    except _TooCloseError:
        root = failed[-1]
    # At crossing branches, or if a motion shrinks to rest, use a point just before it.
    for share in _RETRIES:
        if any(bool(points[s].good) for s in tested if abs(s - root) <= share * abs(length)):
            break
        with contextlib.suppress(NoValueError, _TooCloseError):
            value(root - share * length)

    def rank(s: float) -> tuple[float, bool, float]:
        """Rank a point by its distance from zero; if the test jumps, prefer the last one before."""
        return abs(tested[s]), bool(tested[s] * tested[0.0] < 0), abs(s - root)

    good = [s for s in tested if bool(points[s].good)]
    return points[min(good, key=rank)] if good else None


def bracketed_zero(
    function: Callable[[float], float], low: float, high: float, *, tolerance: float
) -> float:
    """Return a zero between two places where a function has different signs, by inverse quadratic
    interpolation where that is safe, else bisection (T. R. Chandrupatla, Adv. Eng. Softw. 28,
    1997). SciPy takes half a second to load. **Raises:** `ArithmeticError` for equal signs."""
    a, b, share = high, low, 0.5
    at_a, at_b = function(a), function(b)
    c, at_c = b, at_b
    if at_a * at_b > 0:
        raise ArithmeticError("no change of sign")
    for _ in range(_MOST_STEPS):
        best = a if abs(at_a) < abs(at_b) else b
        least = (tolerance + 1e-15 * abs(best)) / abs(b - a) if a != b else 1.0
        if least > 0.5 or 0.0 in (at_a, at_b):
            return best
        place = a + min(max(share, least), 1 - least) * (b - a)
        value = function(place)
        if (value > 0) == (at_a > 0):
            c, at_c = a, at_a
        else:
            b, c, at_b, at_c = a, b, at_a, at_b
        a, at_a, share = place, value, 0.5
        x, y = (a - b) / (c - b), float(at_a - at_b) / float(at_c - at_b)
        if y**2 < x and (1 - y) ** 2 < 1 - x:
            share = at_a / (at_b - at_a) * at_c / (at_b - at_c)
            share += (c - a) / (b - a) * at_a / (at_c - at_a) * at_b / (at_c - at_b)
    return a if abs(at_a) < abs(at_b) else b


def _known_bracket(
    places: list[float], length: float, value: Callable[[float], float]
) -> tuple[float, float]:
    places = sorted({0.0, *places, length}, key=abs)
    low, high, begin = 0, len(places) - 1, value(0.0)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if value(places[middle]) * begin > 0 else (low, middle)
    return places[low], places[high]


# A dip of a test within a step falls to this share of its values at the ends, by a parabola, or
# beyond zero: a choice.
_DIPS = 0.1


def dip_of(places: list[float], values: list[float]) -> float | None:
    """Return the place of the extremum of the parabola through three points, if their values have
    one sign and the parabola comes near zero, or beyond, between the last two; else `None`."""
    steps, heights = np.diff(places), np.sign(values[1]) * np.array(values)
    if not (np.isfinite(heights).all() and heights.min() > 0 and steps.min() > 0):
        return None
    before, after = np.diff(heights) / steps
    curvature = (after - before) / steps.sum()
    slope = before + curvature * steps[0]
    if not curvature > 0:
        return None
    shift = -0.5 * slope / curvature
    is_low = heights[1] + 0.5 * slope * shift < _DIPS * heights[1:].min()
    return float(places[1] + shift) if 0 < shift < steps[1] and is_low else None


def find_zero_near(problem: Shooting, x: np.ndarray, test: Callable[[Step], float]) -> Step | None:
    """Return the solution near one at which a test is zero, by the secant method, or `None`."""
    found: list[Step] = []

    def value(shift: float) -> float:
        step = advance(problem, x, np.eye(x.size)[-1], shift)
        found.append(step)
        if not bool(step.good):
            raise NoValueError  # else the secant method continues with NaN, fifty times
        return test(step)

    from scipy.optimize import newton  # slow to load

    try:
        shift, report = newton(  # pyright: ignore[reportAssignmentType]
            value, 0.0, x1=1e-6, tol=1e-12, full_output=True, disp=False
        )
        is_near = report.converged and abs(shift) < NEARBY and not np.isnan(value(float(shift)))
    except NoValueError:
        return None
    return found[-1] if is_near else None


def crossing(
    problem: Shooting, advance: Callable[[Any, Any, float], Step], here: Step, root: float,
    test: Callable[[Step], float], admits: Callable[[Step, float], bool] = lambda *_: True,
) -> Step | None:  # fmt: skip
    """Return the point of a curve at which a test is zero and the equations are singular: where
    branches cross, or where an impact grazes. `None` with too few points or without a zero.

    The equations cannot be solved close to it, but the curve passes through it smoothly. A
    polynomial through its neighbours gives the place and the motion there. If the curve is found on
    the near side only, more neighbours of that side are taken.

    **Arguments:** `root`, the approximate distance of the place along the tangent; `admits`, a
    function of a point and its distance that returns whether the point belongs to this curve.
    """
    found: dict[float, Step] = {}

    def solve_at(length: float) -> Step | None:
        step = advance(here.x, here.tangent, length)
        return step if bool(step.good) and admits(step, length) else None

    for side, wanted in ((-SPACING, 3), (SPACING, 6), (-SPACING, 6)):
        for n in range(1, MOST_SAMPLES + 1):
            if len(found) == wanted:
                break
            step = None if n * side in found else solve_at(root + n * side)
            if step is not None:
                found[n * side] = step
    if len(found) < 6:
        return None
    tangents = np.stack([step.tangent for step in found.values()])
    deviations = np.linalg.norm(tangents - np.median(tangents, axis=0), axis=1)
    on_curve = deviations <= _OUTLIER * np.median(deviations) + 1e-9
    found = {x: step for (x, step), keep in zip(found.items(), on_curve, strict=True) if keep}
    places, neighbours = np.array(list(found)), list(found.values())

    def polynomial(values: Any) -> np.polynomial.Polynomial:
        return np.polynomial.Polynomial.fit(places, values, len(places) - 1)

    zeros = polynomial([np.asarray(test(step)) for step in neighbours]).roots()
    zeros = zeros[np.abs(zeros.imag) < 1e-12].real
    if not zeros.size or np.abs(zeros).min() > SPACING:
        return None
    place = zeros[np.argmin(np.abs(zeros))]

    def interpolated(get: Callable[[Step], Any]) -> np.ndarray:
        return np.stack([polynomial(x)(place) for x in zip(*map(get, neighbours), strict=True)])

    x, tangent = interpolated(lambda step: step.x), interpolated(lambda step: step.tangent)
    return here._replace(
        x=x, tangent=tangent / np.linalg.norm(tangent), observed=observe(problem, x)
    )
