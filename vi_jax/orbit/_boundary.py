"""`boundary`: curves of folds, period doublings, lost symmetries and grazings."""

import dataclasses
from typing import Any

import numpy as np

from .._checks import flag, instance_of, interval
from ..machine import check_leaf, leaf
from ._conditions import Special, exchange_at, is_defective
from ._corrector import advance, tangent_at
from ._follow import both_ways, check_walk
from ._problem import check_parameter, flown, steps_of
from ._shooting import Shooting
from ._sliding import SLIDING, change_at, without_part
from ._special_table import Intervals, SpecialTable
from ._words import CROSSING, DOUBLING, FOLD, SYMMETRY, TORUS, TOUCHING, one
from .curve import Boundary
from .special import Point

# A unit tangent (scaled) of a curve has this component along its second parameter at least, if the
# curve is begun with that kept: a choice.
_STEEP = 1e-3

_INSTEAD = (
    "Such a point is found value by value of the second parameter: `find_orbit` with another one, "
    "from this motion, and `continue_orbit` from there locates it again."
)


def boundary(
    point: Point,
    *,
    parameter: str,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    step: float = 0.01,
    max_step: float = 0.05,
    max_points: int = 1000,
    progress: bool = True,
) -> Boundary:
    """Follow a bifurcation of a branch in a second parameter, both ways.

    Pseudo-arclength on the orbit's equations together with the condition that makes the point
    special: det(M - I) = 0 for a fold or where branches cross, det(M + I) = 0 for a period
    doubling, two multipliers whose product is 1 for a Neimark–Sacker bifurcation, V⁻ = 0 or a
    clearance of zero for a grazing, a chatter that ends at the release or a least force of zero for
    a rest. Host-side: not to be traced.

    **Arguments:**

    - `point`: from `Branch.special`, or by `switch` from a point of codimension two; its parameter
      is the first of the two.
    - `parameter`: name of the second.
    - `bounds`: intervals of the first and of the second parameter.
    - `step`, `max_step`, `max_points`, `progress`: as for `continue_orbit`, parameters in half
      their intervals.

    **Returns:** a `Boundary`, whose `special` are its points of codimension two. It ends where the
    motion changes (another impact grazes, another rest is lost).

    **Raises:** `ValueError` if the point is of another kind, outside the bounds, or the name
    unknown or the same; on Ctrl-C `Interrupted`, whose `partial` is the curve so far.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    progress = flag("progress", progress)
    _check_point(point)
    ranges = _checked_bounds(point, parameter, bounds)
    problem, condition, x = _special_motion(point, parameter, ranges)
    scale = problem.scale([0.5 * (high - low) for low, high in ranges])

    # Ahead the second parameter rises. Where it hardly does, the tangent takes its own program.
    start = advance(problem, x, np.eye(x.size)[-2], scale, 0.0)
    if not bool(start.good) or start.tangent[-2] < _STEEP:
        tangent = tangent_at(problem, x, scale)
        start = advance(problem, x, tangent * np.copysign(1.0, tangent[-2]), scale, 0.0)
    if not bool(start.good):
        raise ValueError(
            "Argument `point` could not be refined in two parameters (last correction "
            f"{float(start.size):.2g})."
        )

    return both_ways(
        lambda: SpecialTable(problem, condition, scale, ranges),
        start,
        lambda special, **found: Boundary(**found),
        what="boundary", progress=progress, settings=settings,
    )  # fmt: skip


def _check_point(point: Point) -> None:
    """**Raises:** `TypeError` or `ValueError` unless this is a bifurcation that can be followed."""
    instance_of("point", point, Point, "a `Point`, from `Branch.special`")
    if point.kind not in (FOLD, DOUBLING, TORUS, SYMMETRY, CROSSING, *TOUCHING):
        raise ValueError(
            "Argument `point` must be a fold, a period doubling, a Neimark–Sacker bifurcation, a "
            "symmetry breaking, a branch point, a rest that is lost, or a grazing or sliding "
            f"bifurcation at which something is touched, but is {one(point.kind)}. {_INSTEAD}"
        )
    vanishes = point.kind in SLIDING and change_at(point.problem, point.step) is not None
    if point.kind in TOUCHING and not (point.touches or vanishes):
        raise ValueError(
            "Argument `point` must be a grazing or a sliding bifurcation at which something is "
            f"touched, but is {one(point.kind)}: {point.detail}. {_INSTEAD}"
        )


def _checked_bounds(point: Point, parameter: str, bounds: Any) -> Intervals:
    """The intervals of the second parameter and of the point's own, in the order of the unknowns.
    **Raises:** `ValueError` unless both are intervals that hold the point."""
    machine, name = point.problem.machine, point.problem.parameters[0]
    check_leaf(machine, parameter)
    if name == parameter:
        raise ValueError(f"Argument `parameter` must be another one than {name}.")
    try:
        (_, _), (_, _) = first, second = bounds
    except (TypeError, ValueError):
        raise ValueError(
            "Argument `bounds` must be two intervals, ((low, high), (low, high)), that of "
            f"{name} and that of {parameter}, but got {bounds!r}."
        ) from None
    first, second = interval("bounds", first), interval("bounds", second)
    check_parameter(machine, name, point.parameter, first, "point")
    check_parameter(machine, parameter, float(leaf(machine, parameter)), second, "point")
    return second, first


def _special_motion(
    point: Point, parameter: str, bounds: Intervals
) -> tuple[Shooting, Special, np.ndarray]:
    """The equations of the curve, the condition among them that makes its motions special, and
    their unknowns at the point where it begins."""
    old, start, impact = point.problem, np.asarray(point.step.x), point.impact
    change = change_at(old, point.step) if point.kind in SLIDING else None
    if change is not None:  # with the part that vanishes it could not be solved for beyond
        old, start, impact = without_part(old, point.step, change)
    two = dataclasses.replace(old, parameters=(parameter, *old.parameters))
    corners = two.corners(bounds)
    steps = max(old.steps, steps_of(old.method, corners, old.like, flown(old, start)))
    problem = dataclasses.replace(two, steps=steps)
    values = float(leaf(old.machine, parameter)), point.parameter
    x = np.append(start[:-1], values)
    exchange = None
    if point.kind in (SYMMETRY, CROSSING):
        exchange = exchange_at(problem, x, problem.scale([0.5 * (b - a) for a, b in bounds]))
        if exchange is None:
            raise ValueError(
                "Argument `parameter` must keep the symmetry, or other property, by which the "
                f"branches cross, but they separate when {parameter} changes."
            )
    double = point.kind == FOLD and not is_defective(point.problem, point.step, 1.0)
    condition = Special(point.kind, impact, exchange, double=double)
    return dataclasses.replace(problem, conditions=(condition,)), condition, x
