"""`boundary`: curves of folds, period doublings, lost symmetries and grazings."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._at_work import at_work
from .._checks import flag, interval
from .._interrupted import Interrupted
from .._lazy import xr
from ..flow import tidy
from ..machine import check_leaf, leaf, with_units
from ._conditions import AbstractCondition
from ._fixed_step_method import steps_of
from ._problem import check_parameter
from ._shooting import Shooting
from ._sliding import SLIDING
from ._solution import orbit_of
from ._solve import Unknowns, jacobian_at, tangent_at
from ._solve import advance as solved
from ._symmetry import images, may_be_symmetric
from ._tables import stability_in_words
from .curve import INTERRUPTED, Step, check_walk, walk
from .results import InWords, Orbit
from .special import DOUBLING, FOLD, GRAZING, SYMMETRY, SpecialPoint

# What lies below zero by no more than this is zero to rounding: a choice, a hundred times the
# corrector's tolerance.
_NOISE = 1e-9

# Of the first and of the second parameter.
Intervals = tuple[tuple[float, float], tuple[float, float]]


@dataclasses.dataclass(frozen=True, repr=False)
class Boundary(InWords):
    """A curve in two parameters along which an orbit bifurcates: host arrays, a row a point, in the
    machine's units (see `AbstractMachine.units`)."""

    kind: str
    """"fold", "period-doubling", "symmetry-breaking" or "grazing"."""
    names: tuple[str, str]
    """Names of the two parameters."""
    parameters: np.ndarray
    """Their values; (points, 2)."""
    y_min: np.ndarray
    """Smallest position (of the first coordinate)."""
    multipliers: np.ndarray
    """Floquet multipliers over the period; (points, states)."""
    impact_speed: np.ndarray
    """V⁻ of each impact; (points, impacts)."""
    clearance: np.ndarray
    """Smallest distance to a stop at a turn that does not touch it."""
    ends: tuple[str, str]
    """Why the curve ends on each side: "bounds", "grazing" (an impact more or less), "stalled",
    "max_points", "interrupted"."""
    problem: Shooting = dataclasses.field(repr=False)
    steps: list[Step] = dataclasses.field(repr=False)
    condition: "Special" = dataclasses.field(repr=False)
    scale: np.ndarray = dataclasses.field(repr=False)

    def orbit(self, index: int) -> Orbit:
        """The motion at one point."""
        return orbit_of(self.problem, self.steps[index])

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """The curve as an `xarray.Dataset` over its points, the two parameters by their names.

        **Arguments:** `along`, to keep only what has one dimension: `"point"`, `"impact"` or
        `"state"` (the multipliers), which then makes a table without repetitions.

        **Raises:** `ValueError` if there is no such dimension.
        """
        data: dict[str, Any] = {
            name: ("point", x) for name, x in zip(self.names, self.parameters.T, strict=True)
        }
        data |= {name: ("point", getattr(self, name)) for name in ("y_min", "clearance")}
        data["impact_speed"] = ("point", "impact"), self.impact_speed
        data["multipliers"] = ("point", "state"), self.multipliers
        data["stability"] = "point", stability_in_words(self.multipliers)
        about = {"kind": self.kind, "ends": list(self.ends)}
        found = xr.Dataset(data, attrs={**about, "period_in_cycles": self.problem.cycles})
        found = with_units(found, self.problem.machine.units, {name: name for name in self.names})
        return tidy(found, along)

    def __str__(self) -> str:
        low, high = self.parameters.min(axis=0), self.parameters.max(axis=0)
        return (
            f"Curve of {len(self.parameters)} points of {self.kind}: {self.names[0]} in "
            f"[{low[0]:.6g}, {high[0]:.6g}], {self.names[1]} in [{low[1]:.6g}, {high[1]:.6g}]; "
            f"ends: {self.ends[0]}, {self.ends[1]}"
        )


def boundary(
    point: SpecialPoint,
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
    special: det(M - I) = 0 for a fold or a symmetry breaking, det(M + I) = 0 for a period doubling,
    V⁻ = 0 or a clearance of zero for a grazing. Host-side: not to be traced.

    **Arguments:**

    - `point`: from `Branch.special`; its parameter is the first of the two.
    - `parameter`: name of the second.
    - `bounds`: intervals of the first and of the second parameter.
    - `step`, `max_step`, `max_points`, `progress`: as for `continue_orbit`, parameters in half
      their intervals.

    **Returns:** a `Boundary`. It ends where the motion ceases to be one (another impact grazes).

    **Raises:** `ValueError` if the point is of another kind, outside the bounds, or the name
    unknown or the same; on Ctrl-C `Interrupted`, whose `partial` is the curve so far.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    progress = flag("progress", progress)
    _check_point(point)
    bounds = _checked_bounds(point, parameter, bounds)
    problem, condition, x = _special_motion(point, parameter, bounds)
    scale = np.ones(x.size)
    scale[-2:] = [0.5 * (high - low) for low, high in bounds]

    def advance(x: Unknowns, tangent: Unknowns, length: float) -> Step:
        return solved(problem, x, tangent, scale, length)

    start = advance(x, tangent_at(problem, x, scale), 0.0)
    if not bool(start.good):
        raise ValueError(
            "Argument `point` could not be refined in two parameters (last correction "
            f"{float(start.size):.2g})."
        )

    def stop(here: Step, new: Step) -> tuple[Step, str] | None:
        if not _inside(new, bounds):
            return _cut(advance, here, new, bounds, scale), "bounds"
        return (here, "grazing") if condition.another_grazes(new) else None

    forward, backward = [start], [start._replace(tangent=-start.tangent)]
    ends = [INTERRUPTED, INTERRUPTED]

    def curve() -> Boundary:
        path = [*reversed(backward[1:]), *forward]
        return _curve(problem, condition, path, (ends[0], ends[1]), scale)

    def kept() -> Interrupted:
        return Interrupted("walk along the boundary", curve())

    with at_work("boundary", kept, progress=progress, unit="point") as tell:
        ends[1] = walk(advance, forward, stop=stop, tell=tell, **settings)
        ends[0] = walk(advance, backward, stop=stop, tell=tell, **settings)
    return curve()


def _check_point(point: SpecialPoint) -> None:
    """**Raises:** `TypeError` or `ValueError` unless this is a bifurcation that can be followed."""
    if not isinstance(point, SpecialPoint):
        raise TypeError(
            f"Argument `point` must be a `SpecialPoint`, from `Branch.special`, but got {point!r}."
        )
    if point.kind not in (FOLD, DOUBLING, SYMMETRY, GRAZING, *SLIDING):
        raise ValueError(
            "Argument `point` must be a fold, a period doubling, a symmetry breaking or a grazing, "
            f"but is a {point.kind}."
        )
    if not point.problem.follows_events:
        raise ValueError(
            "Argument `point` must belong to motions without rest on a stop, but these rest, and "
            "are followed in one parameter only."
        )
    if point.kind in (GRAZING, *SLIDING) and not point.touches:
        raise ValueError(
            "Argument `point` must be a grazing at which something is touched, but there "
            f"{point.detail}."
        )


def _checked_bounds(point: SpecialPoint, parameter: str, bounds: Any) -> Intervals:
    """The intervals of both parameters. **Raises:** `ValueError` for what is none, or does not hold
    the point."""
    machine, name = point.problem.machine, point.problem.parameters[0]
    check_leaf(machine, parameter)
    if name == parameter:
        raise ValueError(f"Argument `parameter` must be another one than {name}.")
    try:
        first, second = bounds
    except (TypeError, ValueError):
        raise ValueError(
            "Argument `bounds` must be an interval for each of the two parameters, but got "
            f"{bounds!r}."
        ) from None
    first, second = interval("bounds", first), interval("bounds", second)
    check_parameter(machine, name, point.parameter, first, "point")
    check_parameter(machine, parameter, float(leaf(machine, parameter)), second, "point")
    return first, second


def _special_motion(
    point: SpecialPoint, parameter: str, bounds: Intervals
) -> tuple[Shooting, "Special", np.ndarray]:
    """The equations of the curve, the condition among them that makes its motions special, and
    their unknowns at the point where it begins."""
    old = point.problem
    two = dataclasses.replace(old, parameters=(*old.parameters, parameter))
    corners = [two.at(jnp.asarray([a, b])) for a in bounds[0] for b in bounds[1]]
    steps = max(old.steps, steps_of(old.method, corners, old.like, old.cycles))
    problem = dataclasses.replace(two, steps=steps)
    values = point.parameter, float(leaf(old.machine, parameter))
    x = np.append(np.asarray(point.step.x)[:-1], values)
    symmetry = None
    if point.kind == SYMMETRY:
        if not may_be_symmetric(problem, corners):
            raise ValueError(
                "Argument `parameter` must leave the machine its symmetry, but with another "
                f"{parameter} a motion is not its own image."
            )
        symmetry = _symmetry_condition(problem, x)
    condition = Special(point.kind, point.impact, symmetry)
    return dataclasses.replace(problem, conditions=(condition,)), condition, x


def _curve(
    problem: Shooting, condition: "Special", path: list[Step], ends: tuple[str, str],
    scale: np.ndarray,
) -> Boundary:  # fmt: skip
    seen = [step.seen for step in path]
    return Boundary(
        kind=condition.kind,
        names=(problem.parameters[0], problem.parameters[1]),
        parameters=np.stack([step.x[-2:] for step in path]),
        y_min=np.array([at.y_min for at in seen]),
        multipliers=np.stack([at.multipliers for at in seen]),
        impact_speed=np.stack([at.approach[list(problem.impacts)] for at in seen]),
        clearance=np.array([at.nearest.room for at in seen]),
        ends=ends,
        problem=problem,
        steps=path,
        condition=condition,
        scale=scale,
    )


class SymmetryCondition(eqx.Module):
    """The condition that a motion is its own image under the symmetry of its machine, in the place
    of one of its equations.

    The motions x of the equations F(x, p) = 0 from event to event are symmetric where D(x), their
    difference from their own image (`images`), vanishes. Where they lose their symmetry F cannot be
    solved for x: its Jacobian J = ∂F/∂x has a null vector r, along which the motion departs from
    its image, and a left null vector l, so that l·F = 0 is met by every symmetric motion close by
    to first order. That combination of the equations gives way to w·D = 0, where w picks out of D
    how far the motion has gone along r:

        F + l (w·D - l·F) = 0,   w = DD r/|DD r|²,   DD the derivative of D by x.

    These equations are regular, and the curve's own condition det(M - I) = 0 is added to them.
    """

    left: Float[Array, " equations"]
    """l, the left null vector of J where the symmetry is lost."""
    weight: Float[Array, " differences"]
    """w, which picks out of D how far the motion has gone along r."""

    def instead(self, problem: Shooting, missing: Array, x: Array) -> Array:
        """The equations' residual F, given as `missing`, with the combination l·F exchanged for
        w·D."""
        departs = self.weight @ images(problem, x)
        return missing + self.left * (departs - self.left @ missing)


def _symmetry_condition(problem: Shooting, x: np.ndarray) -> SymmetryCondition:
    """The condition at a motion that loses its symmetry, by the singular vectors of its Jacobian
    without the columns of the parameters."""
    count = len(problem.parameters)
    left, _, right = np.linalg.svd(np.asarray(jacobian_at(problem, jnp.asarray(x)))[:, :-count])
    direction = jnp.append(jnp.asarray(right[-1]), jnp.zeros(count))
    change = jax.jvp(lambda x: images(problem, x), (jnp.asarray(x),), (direction,))[1]
    return SymmetryCondition(jnp.asarray(left[:, -1]), change / (change @ change))


class Special(AbstractCondition):
    """The condition that a motion is special.

    With the monodromy matrix M that is det(M - I) = 0 at a fold or where a symmetry is lost,
    det(M + I) = 0 at a period doubling; at a grazing V⁻ = 0 of the impact that is lost, or a
    clearance of zero.
    """

    kind: str = eqx.field(static=True)
    impact: int | None = eqx.field(static=True)
    """The event that grazes; `None` at a touch, and where nothing grazes."""
    symmetry: SymmetryCondition | None = None

    def exchanged(self, problem, x, missing):
        """Where a symmetry is lost, one of the equations is exchanged (see `SymmetryCondition`)."""
        return missing if self.symmetry is None else self.symmetry.instead(problem, missing, x)

    def missing(self, problem, x, seen):
        """The determinant, V⁻ or the clearance."""
        identity = jnp.eye(seen.monodromy.shape[0], dtype=x.dtype)
        if self.kind in (GRAZING, *SLIDING):
            return seen.nearest.room if self.impact is None else seen.approach[self.impact]
        sign = 1 if self.kind == DOUBLING else -1
        return jnp.linalg.det(seen.monodromy + sign * identity)

    def another_grazes(self, step: Step) -> bool:
        """Whether an impact beside the one that grazes here is lost, or a stop is touched."""
        # In a symmetric motion another impact grazes as well, to rounding.
        others = [v + _NOISE for i, v in enumerate(step.seen.approach) if i != self.impact]
        # At a grazing the body turns on the stop, to rounding.
        touching = self.kind in (GRAZING, *SLIDING) and self.impact is None
        passed = not touching and step.seen.nearest.room < -_NOISE
        return bool(min(others, default=1.0) <= 0 or passed)


def _inside(step: Step, bounds: Intervals) -> bool:
    return all(low <= x <= high for x, (low, high) in zip(step.x[-2:], bounds, strict=True))


def _cut(
    advance: Callable[..., Step], here: Step, new: Step, bounds: Intervals, scale: np.ndarray
) -> Step:
    """The last point inside the bounds between two, found by halving the step.

    **Arguments:** `advance` as for `walk`; `here` and `new`, inside and outside; `scale`, the size
    of each unknown.
    """
    low, high = 0.0, float(np.dot(here.tangent, (new.x - here.x) / scale))
    last = here
    for _ in range(30):
        middle = 0.5 * (low + high)
        step = advance(here.x, here.tangent, middle)
        inside = bool(step.good) and _inside(step, bounds)
        low, high = (middle, high) if inside else (low, middle)
        last = step if inside else last
    return last
