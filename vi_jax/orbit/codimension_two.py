"""Points of codimension two, located on a finished curve of special motions in two parameters."""

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._messages import count_of
from .conditions import Special, bifurcation_tests, is_defective, sum_of_minors
from .corrector import Step, advance, distance_along, host_program, jacobian_and_rows, jacobian_at
from .edit_events import half_difference, may_be_symmetric, over_periods, repeated
from .equations import Shooting
from .kinds import (
    CROSSING,
    CUSP,
    DEGENERATE,
    DEGENERATE_SYMMETRY,
    DOUBLING,
    FLIP,
    FOLD,
    GRAZING,
    KINDS,
    RESONANCE_1,
    RESONANCE_2,
    RESONANCE_3,
    RESONANCE_4,
    RESONANT,
    SYMMETRY,
    TORUS,
    TOUCHING,
)
from .local_map import LocalMap, graze_at
from .locate import crossing, dip_of, locate_zero, passes_zero
from .special import Point, point_at
from .tolerances import ALIKE, FAINT, LOCATED
from .touch import NoLocalMapError
from .walk import SAME_CURVE

# The thresholds here are choices.

# An impact slower than so many roots of a clearance is its turn, for accelerations of up to 50.
_SAME_TURN = 10.0

# Local maps of grazing motions are examined over so many periods.
PERIODS = 3


def cosine_of(step: Step) -> float:
    """Return the cosine of the angle of the pair with product nearest to 1; beyond ±1 if real."""
    values = step.observed.multipliers
    first, second = np.triu_indices(len(values), 1)
    pair = int(np.argmin(np.abs(values[first] * values[second] - 1)))
    return float(0.5 * (values[first[pair]] + values[second[pair]]).real)


class Vectors(NamedTuple):
    """Left and right null vector of the Jacobian in all unknowns but the parameters."""

    left: np.ndarray
    right: np.ndarray


# A function of a step along a curve, and of the vectors of a nearby step. It returns a value, which
# is zero at a point of codimension two, and its own vectors with the same signs, or `None`.
Test = Callable[[Step, Vectors | None], tuple[float, Vectors | None]]


def points_of(problem: Shooting, steps: list[Step], ends: tuple[str, str]) -> list[Point]:
    """Return the points of codimension two on a curve, in its order."""
    condition: Special = problem.conditions[0]

    def point(kind: str, step: Step, detail: str | None = None, **fields: Any) -> Point:
        detail = detail or KINDS[kind].on_curve or None
        return point_at(problem, step, kind, detail, curve=condition.kind, **fields)

    found: list[tuple[float, Point]] = []
    for place, end in ((0, ends[0]), (len(steps) - 1, ends[1])):
        if end == GRAZING and condition.kind not in TOUCHING:
            impact = _grazing_impact(steps[place])
            found.append((place, point(GRAZING, steps[place], impact=impact, index=place)))
        if end in (RESONANCE_1, RESONANCE_2, SYMMETRY):
            found.append((place, point(end, steps[place], index=place)))
    for kind, test in _tests_of(problem, condition).items():
        for place, step in _zeros(problem, steps, test):
            is_resonance = kind in (RESONANCE_1, RESONANCE_2)
            if is_resonance and not is_defective(problem, step, KINDS[kind].multiplier):
                continue
            symmetric = kind == FOLD and condition.kind in TOUCHING and _is_symmetric(problem, step)
            found.append((place, point(SYMMETRY if symmetric else kind, step)))
    if condition.kind == GRAZING:
        for place, step, detail_here in _resonant_grazings(problem, condition.impact, steps):
            found.append((place, point(RESONANT, step, detail_here, impact=condition.impact)))
    return [point for _, point in sorted(found, key=lambda f: f[0])]


def _is_symmetric(problem: Shooting, step: Step) -> bool:
    if not may_be_symmetric(problem, [problem.machine, problem.at(step.x)]):
        return False
    return bool(np.linalg.norm(half_difference(problem, step, mirrored=True)) < ALIKE)


def _grazing_impact(step: Step) -> int | None:
    """Return the impact that grazes at the end of a curve; `None` at a touch."""
    approach = np.asarray(step.observed.approach / step.observed.units)
    # A lost impact comes with a turn near the stop: at a distance of about v² for a speed v. At a
    # touched stop the impacts keep their speed.
    touches = max(_SAME_TURN * np.sqrt(abs(step.observed.relative_clearance)), LOCATED)
    if approach.size and approach.min() < touches:
        return int(np.argmin(approach))
    return None


def _resonant_grazings(
    problem: Shooting, impact: int | None, steps: list[Step]
) -> Iterator[tuple[float, Step, str]]:
    """Yield the resonant grazings of a curve: the position in steps with a fraction, the point, and
    a description of the curve that begins there."""

    usually_lost = steps[len(steps) // 2].observed.lost

    def local(step: Step) -> LocalMap | None:
        # If another impact is lost as well, at an end, the map has a pole: its sign is rounding.
        if (step.observed.lost & ~usually_lost).any():
            return None
        with contextlib.suppress(NoLocalMapError):
            return graze_at(point_at(problem, step, GRAZING, "", impact)).map

    maps = [local(step) for step in steps]
    is_planar = problem.states == 2  # folds and doublings begin at the same point
    for n, sign in itertools.product(range(1, PERIODS + 1), (1,) if is_planar else (1, -1)):
        begins = f"a curve of {'folds' if sign > 0 else 'period doublings'} begins"
        begins = KINDS[RESONANT].on_curve if is_planar else begins
        description = f"{begins} of the motion with one impact in {count_of(n, 'period')}"
        resonance = lambda each, n=n, sign=sign: each.resonance(n, sign) if each else np.nan
        test = lambda step, resonance=resonance: resonance(local(step))
        values = [resonance(each) for each in maps]
        for i, (before, after) in enumerate(itertools.pairwise(values)):
            if not passes_zero(before, after):
                continue
            step = locate_zero(problem, steps[i], steps[i + 1], test)
            if step is None or not bool(step.good):
                continue
            small = FAINT * max(abs(before), abs(after))
            at = local(step)
            if at and abs(resonance(at)) <= small and (at.passages(n) >= small).all():
                yield _place(problem, i, steps, step), step, description


def _place(problem: Shooting, i: int, steps: list[Step], at: Step) -> float:
    """Return the position of a point on a curve: the step before it plus a fraction."""
    along, from_start = ((step.x - steps[i].x) / problem.scale for step in (steps[i + 1], at))
    return i + float(along @ from_start / (along @ along))


def _tests_of(problem: Shooting, condition: Special) -> dict[str, Test]:
    def scalar(function: Callable[[Step], float]) -> Test:
        return lambda step, like: (function(step), None)

    fold, doubling = (
        scalar(lambda s, kind=kind: bifurcation_tests(s)[kind]) for kind in (CROSSING, DOUBLING)
    )
    motion = dataclasses.replace(problem, conditions=())
    if condition.kind == TORUS:
        return {RESONANCE_3: scalar(lambda s: cosine_of(s) + 0.5), RESONANCE_4: scalar(cosine_of)}
    # The product of all eigenvalues of M ± I but one, if that one is zero.
    sign = 1 if condition.kind == DOUBLING else -1
    shifted = lambda s: s.observed.monodromy + sign * np.eye(len(s.observed.monodromy))
    double = scalar(lambda s: float(sum_of_minors(shifted(s))))
    if condition.kind == FOLD:
        return {CUSP: _cusp_test(motion), FLIP: doubling, RESONANCE_1: double}
    if condition.kind == DOUBLING:
        return {DEGENERATE: _cubic_test(motion, twice=True), FLIP: fold, RESONANCE_2: double}
    if condition.kind == CROSSING:
        return {RESONANCE_1: double}
    if condition.kind == SYMMETRY:
        return {DEGENERATE_SYMMETRY: _cubic_test(motion, twice=False), RESONANCE_1: double}
    # M has a pole at a grazing impact, but not at a touched stop.
    return {} if condition.impact is not None else {FOLD: fold, DOUBLING: doubling}


def _null_vectors(matrix: np.ndarray, like: Vectors | None = None) -> Vectors:
    """Return the null vectors l and r of a square matrix. Their signs are coupled: the adjugate is
    r lᵀ times det U · det V and a positive number, and it is continuous. The vectors `like` of a
    point close by determine the common sign."""
    left, _, right = np.linalg.svd(matrix)
    found = Vectors(left[:, -1] * np.linalg.det(left) * np.linalg.det(right), right[-1])
    if like is None:
        return found
    overlap = max((float(a @ b) for a, b in zip(found, like, strict=True)), key=abs)
    return Vectors(*(np.sign(overlap) * a for a in found))


def _cusp_test(motion: Shooting) -> Test:
    """Return a test for cusps: the signed rate of the parameters along a curve of folds. With the
    left null vector l of F_x they change so that l·F_p dp = 0, along a line that turns slowly,
    while their direction reverses at a cusp."""

    def test(step: Step, like: Vectors | None) -> tuple[float, Vectors]:
        jacobian = jacobian_at(motion, step.x)
        nulls = _null_vectors(jacobian[:, :-2], like)
        first, second = nulls.left @ jacobian[:, -2:]
        moves = np.asarray(step.tangent)[-2:]
        return float(moves @ [-second, first] / np.hypot(first, second)), nulls

    return test


@host_program
def _derivatives_along(problem: Shooting, x, right, bend):
    """Return the equations' second and third derivatives d/dt along x + t right + t² bend/2."""

    def along(t):
        return problem.motion_residual(x + t * right + 0.5 * t * t * bend)

    def derivative(function):
        return lambda t: jax.jvp(function, (t,), (jnp.ones_like(t),))[1]

    second = derivative(derivative(along))
    zero = jnp.zeros((), x.dtype)
    return jax.jvp(second, (zero,), (jnp.ones_like(zero),))


def _cubic_test(motion: Shooting, *, twice: bool) -> Test:
    """Return the cubic coefficient of the motions that begin at a doubling or a symmetry breaking.
    Let F be the equations of the motion gone through twice, or of the symmetric motion, with null
    vectors l and r, and second and third derivatives B and C. The coefficient is l·(C(r, r, r) + 3
    B(r, w))/6, F_x w = -B(r, r) (Kuznetsov, Elements of Applied Bifurcation Theory, 2004, section
    5.4). The quadratic coefficient l·B(r, r)/2 is zero by the symmetry of both halves."""
    whole = over_periods(motion, 2) if twice else motion

    def test(step: Step, like: Vectors | None) -> tuple[float, None]:
        x = repeated(motion, step.x, whole) if twice else np.asarray(step.x)
        (jacobian, rows), scale = jacobian_and_rows(whole, x), whole.scale
        matrix = jacobian[:, :-2]
        nulls = _null_vectors(matrix)
        right = scale * np.append(nulls.right, [0.0, 0.0])
        second, _ = _derivatives_along(whole, x, right, np.zeros_like(x))
        bend = np.linalg.lstsq(matrix, -second / rows)[0]
        _, third = _derivatives_along(whole, x, right, scale * np.append(bend, [0.0, 0.0]))
        return float(nulls.left @ (third / rows)) / 6, None

    return test


def _zeros(problem: Shooting, steps: list[Step], test: Test) -> Iterator[tuple[float, Step]]:
    """Yield the zeros of a test along a curve: position in steps with a fraction, and point."""
    tested: list[tuple[float, Vectors | None]] = []
    for step in steps:
        like = tested[-1][1] if tested else None
        # At an end with a lost impact the tests have poles.
        regular = np.isfinite(step.observed.monodromy).all()
        tested.append(test(step, like) if regular else (np.nan, like))
    for i, (here, new) in enumerate(itertools.pairwise(steps)):
        (before, like), (after, _) = tested[i], tested[i + 1]
        value = lambda s, like=like: test(s, like)[0]
        scale, ends = max(abs(before), abs(after)), [(here, new)]
        near, known = steps[i - 1 : i + 2], [x for x, _ in tested[i - 1 : i + 2]]
        if i and (middle := _dip(problem, near, known, value)) is not None:
            ends = [(here, middle), (new, middle)]
        elif not passes_zero(before, after):
            continue
        for pair in ends:
            at = _zero(problem, *pair, value, scale)
            if at is not None:
                yield _place(problem, i, steps, at), at


def _dip(
    problem: Shooting, steps: list[Step], values: list[float], test: Callable[[Step], float]
) -> Step | None:
    """Return a point between the last two of three at which a test has another sign than there."""
    before, here, new = steps
    back, ahead = distance_along(problem, before, here), distance_along(problem, here, new)
    place = dip_of([-back, 0.0, ahead], values)
    step = None if place is None else advance(problem, here.x, here.tangent, place)
    return step if step is not None and bool(step.good) and test(step) * values[1] < 0 else None


def _zero(
    problem: Shooting, here: Step, new: Step, test: Callable[[Step], float], scale: float
) -> Step | None:
    """Return the point between two where a test, of size `scale` there, is zero without a pole."""
    at = locate_zero(problem, here, new, test)
    if at is None or abs(test(at)) <= LOCATED * scale:
        return at
    # At a crossing with another curve the corrector fails.

    def admits(step: Step, length: float) -> bool:
        return float(step.tangent @ here.tangent) >= SAME_CURVE and abs(test(step)) < scale

    advance_here = partial(advance, problem)
    return crossing(problem, advance_here, here, distance_along(problem, here, at), test, admits)
