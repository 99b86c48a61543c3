"""`continue_orbit` and `boundary`: a motion followed in one parameter, a bifurcation in two."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._checks import (
    flag,
    given_number,
    host_side,
    instance_of,
    interval,
    one_of,
    short,
    tuple_of_names,
)  # fmt: skip
from ..flow import MethodLike
from ..machine import check_leaf, leaf, may_rest
from .boundary_events import Intervals, SpecialTable
from .branch_events import MotionTable
from .conditions import Special, hold_values, is_defective, known_names, rates_at, replacement_at
from .corrector import Step, advance, tangent_at
from .curve import Boundary, Branch
from .equations import Shooting
from .from_orbit import (
    ADVICE,
    check_parameter,
    problem_of,
    resting_problem_of,
    with_parameters,
    with_sizes,
    with_widths,
)
from .kinds import CROSSING, FOLD, FOLLOWED, SLIDING, SYMMETRY, TOUCHING, with_article
from .results import ORBIT_RESULTS, Orbit, check_multipliers, lies_on_a_stop
from .sliding import change_at, without_part
from .special import Point
from .tolerances import ALIKE, FAINT, ROUNDING
from .walk import check_walk, follow_both_ways, rescaled

_NONE: Mapping[str, Any] = MappingProxyType({})


@host_side
def continue_orbit(
    orbit: Orbit,
    *,
    parameter: str,
    bounds: tuple[float, float],
    step: float = 0.01,
    max_step: float = 0.1,
    max_points: int = 1000,
    extrema: str | Sequence[str] = (),
    watch: Mapping[str, Callable[[Orbit], float]] = _NONE,
    free: Mapping[str, tuple[float, float]] = _NONE,
    fixed: Mapping[str, float | None] = _NONE,
    method: MethodLike = None,
    progress: bool = True,
) -> Branch:
    """Follow a periodic motion in one parameter of its machine, both ways, through folds.

    Pseudo-arclength on the equations from impact to impact, which stay smooth at a grazing. Special
    points are located to rounding. A branch of motions that rest on a stop ends if the chatter
    would take until the release, or if the force on the body vanishes. Each branch also ends at a
    lost impact or a touched stop (`special[i].switch()` continues with the other impacts).
    Host-side: not to be traced; one compiled program for each number of impacts.

    **Arguments:**

    - `orbit`: from `find_orbit`, or from another branch.
    - `parameter`, `bounds`: a parameter of the machine, such as `"drive.frequency_ratio"` or
      `"stops.0.gap"`, and its interval.
    - `step`, `max_step`: first and longest step along the branch, in the norm of the scaled
      unknowns. Scales: half the largest modulus of each component of the state along the motion,
      1/2π of a cycle for the clock of each impact, half its interval for the parameter.
    - `max_points`: maximum number of points in each direction.
    - `extrema`: names of quantities whose largest and least values along the branch are located, as
      special points: `"y_min"`, `"y_max"`, `"clearance"`, `"duration"`, `"frequency_ratio"`,
      `"fastest_impact"`, `"slowest_impact"`, `"multiplier"` (the greatest modulus), the machine's
      own averages, and quantities on the section such as `"section_Y"`. They need one more compiled
      program.
    - `watch`: functions of the orbit, by name. Their zeros along the branch are located as special
      points of kind `"watched"`: `{"limit": lambda orbit: orbit.impact_speed.max() - 2.0}`.
    - `free`: additional parameters that vary, with the interval of each: `{"stops.0.gap": (1.0,
      3.0)}`.
    - `fixed`: for each of them a quantity of the motion, one of the names above, that is held:
      `{"y_min": -3.0}`; `None` holds the orbit's own value. A given value must be near the orbit's.
      The free parameters must change the quantity: `"y_max"` of a motion that hits its right stop
      can only be held if the gap is free. The parameter turns back at special points of kind
      `turn`; at a `fold` a multiplier passes 1. Hopf points are not sought.
    - `method`: a method of fixed steps: by default that of the orbit if its steps are fixed, else
      `ExactFlight()` if it applies, else 20 steps of `Verner9` a cycle. An implicit solver, such as
      `Adaptive(diffrax.Kvaerno5())`, then takes equal steps.
    - `progress`: whether to count the points found, in a terminal or a notebook.

    **Returns:** a `Branch`.

    **Raises:** `ValueError` for an unknown name; for an orbit that was not found, does not list all
    its impacts, lies outside the bounds, or rests on a stop of a machine with `renewed`, friction
    on a stop, or cycles that another event than a turn ends. On Ctrl-C `Interrupted`, whose
    `partial` is the branch so far.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    progress = flag("progress", progress)
    _check_orbit(orbit)
    _check_held(orbit, free, fixed)
    check_leaf(orbit.machine, parameter)
    bounds = interval("bounds", bounds)
    value = float(leaf(orbit.machine, parameter))
    check_parameter(orbit.machine, parameter, value, bounds, "orbit")
    rests = int(orbit.rests) > 0 or (may_rest(orbit.machine) and lies_on_a_stop(orbit))
    equations = resting_problem_of if rests else problem_of
    problem, x = equations(orbit, parameter, bounds, method)
    sought, watched = _check_names("extrema", extrema, problem), _check_watched(watch, orbit)
    problem, x, ranges = _extend(problem, x, free, fixed, bounds, np.asarray(orbit.multipliers))
    problem, start = _first_point(problem, x, orbit)
    return follow_both_ways(
        lambda: MotionTable(problem, ranges, sought, watched),
        start,
        Branch,
        what="branch", progress=progress, settings=settings,
    )  # fmt: skip


def _check_orbit(orbit: Orbit) -> None:
    if not isinstance(orbit, Orbit) or orbit.residual.ndim:
        raise ValueError(
            f"Argument `orbit` must be one `Orbit`, not a batch or a state, but got {short(orbit)}."
        )
    if orbit.residual.dtype != jnp.float64:
        raise ValueError(
            "Argument `orbit` must be of double precision to be followed: call "
            '`jax.config.update("jax_enable_x64", True)` first and find it again.'
        )
    if not bool(orbit.successful):
        reason = ORBIT_RESULTS[orbit.result]
        raise ValueError(
            f"Argument `orbit` is an orbit whose search failed: {reason} Pass a converged orbit."
        )


def _check_held(orbit: Orbit, free: object, fixed: object) -> None:
    for argument, mapping in (("free", free), ("fixed", fixed)):
        if not isinstance(mapping, Mapping):
            example = '{"stops.0.gap": (1.0, 3.0)}' if argument == "free" else '{"y_min": None}'
            raise TypeError(
                f"Argument `{argument}` must map names, as {example}, but got {mapping!r}."
            )
    assert isinstance(free, Mapping) and isinstance(fixed, Mapping)
    if len(free) != len(fixed):
        raise ValueError(
            f"Argument `fixed` must hold as many numbers as `free` frees, {len(free)}, but holds "
            f"{len(fixed)}."
        )
    if "multiplier" in fixed:
        check_multipliers("orbit", orbit)


def _extend(
    problem: Shooting, x: np.ndarray, free: Mapping[str, tuple[float, float]],
    fixed: Mapping[str, float | None], bounds: tuple[float, float], multipliers: np.ndarray,
) -> tuple[Shooting, np.ndarray, list[tuple[float, float]]]:  # fmt: skip
    """Add parameters and as many conditions; return equations, unknowns and intervals."""
    if not free:
        return with_widths(problem, [bounds]), x, [bounds]
    machine, parameter_values, ranges = problem.machine, [], []
    for name, given in free.items():
        check_leaf(machine, name, argument="free")
        if name == problem.parameters[0]:
            raise ValueError(f"Argument `free` must name others than the parameter, {name}.")
        ranges.append(interval(f"free[{name!r}]", given))
        parameter_values.append(float(leaf(machine, name)))
        check_parameter(machine, name, parameter_values[-1], ranges[-1], "orbit", "free")
    names = _check_names("fixed", tuple(fixed), problem)
    given = {k: v if v is None else given_number(f"fixed[{k!r}]", v) for k, v in fixed.items()}
    here, _ = rates_at(problem, names, jnp.asarray(x), jnp.zeros(x.size))
    targets = {name: float(here[name]) if v is None else v for name, v in given.items()}
    for name, target in targets.items():
        if not np.isfinite(target):
            raise ValueError(
                f"Argument `fixed` must name what the orbit has, but its {name} is {target:g}."
            )
    new = dataclasses.replace(problem, conditions=hold_values(targets, multipliers))
    new = with_parameters(new, x, tuple(free), ranges := [*ranges, bounds])
    return new, np.concatenate([x[:-1], parameter_values, x[-1:]]), ranges


def _check_names(argument: str, names: str | Sequence[str], problem: Shooting) -> tuple[str, ...]:
    known = known_names(problem)
    return tuple(one_of(argument, name, known) for name in tuple_of_names(argument, names))


def _check_watched(
    watch: Mapping[str, Callable[[Orbit], float]], orbit: Orbit
) -> Mapping[str, Callable[[Orbit], float]]:
    if not isinstance(watch, Mapping) or not all(callable(f) for f in watch.values()):
        raise TypeError(
            "Argument `watch` must map names to functions of an `Orbit`, as "
            f'{{"limit": lambda orbit: orbit.y_max - 2.0}}, but got {watch!r}.'
        )
    for name, function in watch.items():
        value = np.asarray(function(orbit))
        if value.ndim or value.dtype.kind not in "fiu":
            raise TypeError(f"Argument `watch` must give numbers, but {name!r} gives {value!r}.")
    return watch


def _first_point(problem: Shooting, x: np.ndarray, orbit: Orbit) -> tuple[Shooting, Step]:
    """Return the equations with the sizes of the orbit's motion, and their solution there."""
    start, old_scale = _refined_point(problem, x, orbit), problem.scale
    problem = with_sizes(problem, start.x, start.observed.largest)
    (start,) = rescaled([start], old_scale, problem.scale)
    return problem, advance(problem, start.x, start.tangent, 0.0)


def _refined_point(problem: Shooting, x: np.ndarray, orbit: Orbit) -> Step:
    """Refine the orbit as a solution of its equations from event to event, at its parameter. At a
    fold it is refined across the branch instead, which needs another compiled program."""
    start, distance = _refine(problem, x, np.eye(problem.size)[-1])
    if problem.conditions:
        if bool(start.good):
            return start
        raise ValueError(
            "No motion with the values in `fixed` was found by varying `free` (last correction "
            f"{float(start.size):.2g}). Choose values closer to the orbit's, or other free "
            "parameters: an extreme on a stop, say, does not depend on any."
        )
    if distance > ALIKE:
        start, distance = _refine(problem, x, tangent_at(problem, x))
    if distance > ALIKE and float(np.abs(np.asarray(orbit.multipliers) - 1).min()) < ROUNDING:
        raise ValueError(
            "Argument `orbit` has a multiplier of exactly 1: branches cross there, or a component "
            "of its state is neutral, such as a free position, a counter, or the place at which "
            "dry friction holds a body. Leave such a component out of the state to follow the "
            "orbit."
        )
    if distance > ALIKE:
        raise ValueError(
            "Argument `orbit` could not be refined from impact to impact (last correction "
            f"{max(distance, float(start.size)):.2g}): branches cross there, its section lies on "
            "an impact or another event, or it is no orbit of this machine."
        )
    return start


def _refine(problem: Shooting, x: np.ndarray, tangent: np.ndarray) -> tuple[Step, float]:
    """Return the solution in the plane across a tangent at `x`, and its scaled distance from it."""
    start = advance(problem, x, tangent, 0.0)
    distance = float(np.max(np.abs(start.x - x) / problem.scale))
    return start, distance if bool(start.good) else np.inf


@host_side
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

    Pseudo-arclength on the orbit's equations, with the condition of the bifurcation: det(M - I) = 0
    of a fold or branch point, det(M + I) = 0 of a period doubling, product 1 of two multipliers at
    a Neimark–Sacker bifurcation. At a grazing it is V⁻ = 0 or a clearance of zero, at a lost rest a
    chatter that ends at the release or a least force of zero. Host-side: not to be traced.

    **Arguments:**

    - `point`: from `Branch.special`, or by `switch` from a point of codimension two; its parameter
      is the first of the two.
    - `parameter`: name of the second.
    - `bounds`: intervals of the first and of the second parameter.
    - `step`, `max_step`, `max_points`, `progress`: as for `continue_orbit`; the scale of a
      parameter is half its interval.

    **Returns:** a `Boundary`, whose `special` are its points of codimension two. It ends where the
    motion changes (another impact grazes, another rest is lost).

    **Raises:** `ValueError` if the point is of another kind or outside the bounds, or the name is
    unknown or that of the first parameter. On Ctrl-C `Interrupted` with the curve so far,
    `partial`.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    progress = flag("progress", progress)
    _check_point(point)
    ranges = _checked_bounds(point, parameter, bounds)
    problem, x = _special_motion(point, parameter, ranges)

    # The second parameter rises ahead. If it hardly does, the tangent needs another program.
    start = advance(problem, x, np.eye(x.size)[-2], 0.0)
    if not bool(start.good) or start.tangent[-2] < FAINT:
        tangent = tangent_at(problem, x)
        start = advance(problem, x, tangent * np.copysign(1.0, tangent[-2]), 0.0)
    if not bool(start.good):
        several = ""
        if point.kind in TOUCHING and sum(point.step.observed.lost) > 1:
            several = (
                " Several of its events vanish at once, as in a symmetric motion, or in one that "
                "repeats within its period. Break the symmetry, or begin with fewer cycles."
            )
        raise ValueError(
            "Argument `point` could not be refined in two parameters (last correction "
            f"{float(start.size):.2g}).{several}"
        )

    return follow_both_ways(
        lambda: SpecialTable(problem, ranges),
        start,
        lambda special, **fields: Boundary(**fields),
        what="boundary", progress=progress, settings=settings,
    )  # fmt: skip


def _check_point(point: Point) -> None:
    instance_of("point", point, Point, "a `Point`, from `Branch.special`")
    if point.kind not in FOLLOWED:
        raise ValueError(
            "Argument `point` must be a fold, a period doubling, a Neimark–Sacker bifurcation, a "
            "symmetry breaking, a branch point, a rest that is lost, or a grazing or sliding "
            "bifurcation at which something is touched, but is "
            f"{with_article(point.kind)}. {ADVICE}"
        )
    if point.kind == FOLD and not is_defective(point.problem, point.step, 1.0):
        raise ValueError(
            "Argument `point` must not be a fold of two motions at once, as of equal machines "
            "without coupling, but two multipliers are 1. Follow the fold of one of them."
        )
    vanishes = point.kind in SLIDING and change_at(point.problem, point.step) is not None
    if point.kind in TOUCHING and not (point.touches or vanishes):
        raise ValueError(
            "Argument `point` must be a grazing or a sliding bifurcation at which something is "
            f"touched, but is {with_article(point.kind)}: {point.detail}. {ADVICE}"
        )


def _checked_bounds(point: Point, parameter: str, bounds: Any) -> Intervals:
    """Return the intervals of the second parameter and of the point's own, in the order of the
    unknowns; raise `ValueError` unless both are intervals that contain the point."""
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


def _special_motion(point: Point, parameter: str, bounds: Intervals) -> tuple[Shooting, np.ndarray]:
    old, start, impact = point.problem, np.asarray(point.step.x), point.impact
    change = change_at(old, point.step) if point.kind in SLIDING else None
    if change is not None:  # with the vanishing part it could not be solved beyond the point
        old, start, impact = without_part(old, point.step, change)
    problem = with_parameters(old, start, (parameter,), bounds)
    values = float(leaf(old.machine, parameter)), point.parameter
    x = np.append(start[:-1], values)
    replacement = None
    if point.kind in (SYMMETRY, CROSSING):
        replacement = replacement_at(problem, x)
        if replacement is None:
            raise ValueError(
                "Argument `parameter` must keep the symmetry, or other property, by which the "
                f"branches cross, but they separate when {parameter} changes."
            )
    condition = Special(point.kind, impact, replacement)
    return dataclasses.replace(problem, conditions=(condition,)), x
