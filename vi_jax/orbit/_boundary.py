"""`boundary`: curves of folds, period doublings, lost symmetries and grazings."""

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np

from .._checks import flag, instance_of, interval
from .._messages import so_many
from .._types import xr
from ..flow import tidy
from ..machine import check_leaf, leaf, with_units
from ._conditions import Special, symmetry_condition
from ._corrector import Step, advance, tangent_at
from ._follow import Followed, both_ways, check_walk
from ._problem import check_parameter, steps_of
from ._shooting import Shooting
from ._sliding import ADDING_SLIDING, GRAZING_SLIDING
from ._solution import orbit_at
from ._special_table import Intervals, SpecialTable, cosine_of, points_of
from ._symmetry import may_be_symmetric
from ._words import DOUBLING, FOLD, SYMMETRY, TORUS, TOUCHING, one
from .branch import stability_in_words
from .results import InWords, Orbit
from .special import CodimensionTwo, SpecialPoint

# What to do instead at a point that is not followed: at others, and at one that is seen from the
# side on which its motion has the part that vanishes.
_INSTEAD = (
    "Such a point is found value by value of the second parameter: `find_orbit` with another one, "
    "from this motion, and `continue_orbit` from there locates it again."
)
_OTHER_SIDE = (
    "It is followed from the side without that part: `continue_orbit(point.switch(), ...)` ends at "
    "it too, and its special point there can be given."
)


@dataclasses.dataclass(frozen=True, repr=False)
class Boundary(InWords):
    """A curve in two parameters along which an orbit bifurcates: host arrays, a row a point, in the
    machine's units (see `AbstractMachine.units`)."""

    kind: str
    """"fold", "period-doubling", "neimark-sacker", "symmetry-breaking" or "grazing"."""
    names: tuple[str, str]
    """Names of the two parameters."""
    parameters: np.ndarray
    """Their values; (points, 2)."""
    y_min: np.ndarray
    """Smallest position (of the first coordinate)."""
    multipliers: np.ndarray
    """Floquet multipliers over the period; (points, states). NaN at an end where an impact is lost,
    where some of them have no limit."""
    impact_speed: np.ndarray
    """V⁻ of each impact; (points, impacts)."""
    clearance: np.ndarray
    """Smallest distance to a stop at a turn that does not touch it."""
    ends: tuple[str, str]
    """Why the curve ends on each side: "bounds", "grazing" (an impact more or less), "closed" (it
    has come back to its first point, which is its last one as well), of a curve of Neimark–Sacker
    points "resonance-1:1" and "resonance-1:2" (the two multipliers become real), of a curve of
    motions without symmetry "symmetry-breaking" (they become symmetric), "stalled", "max_points",
    "interrupted"."""
    problem: Shooting = dataclasses.field(repr=False)
    steps: list[Step] = dataclasses.field(repr=False)
    condition: Special = dataclasses.field(repr=False)
    scale: np.ndarray = dataclasses.field(repr=False)

    @cached_property
    def special(self) -> tuple[CodimensionTwo, ...]:
        """The points of codimension two on the curve, in its order, each located to rounding; they
        are looked for when they are first asked for."""
        return points_of(self.problem, self.condition, self.steps, self.ends, self.scale)

    @property
    def angle(self) -> np.ndarray:
        """The angle of the pair of multipliers that leaves the unit circle, in radians, at each
        point; NaN on curves of other kinds."""
        if self.kind != TORUS:
            return np.full(len(self.steps), np.nan)
        return np.arccos(np.clip([cosine_of(step) for step in self.steps], -1, 1))

    def orbit(self, index: int) -> Orbit:
        """The motion at one point; a negative `index` counts from the end."""
        return orbit_at(self.problem, self.steps, index)

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """The curve as an `xarray.Dataset` over its points, the two parameters by their names, and
        its points of codimension two: `special_kind`, `special_detail` and, by `special_` and
        their names, the parameters.

        **Arguments:** `along`, to keep only what has one dimension: `"point"`, `"special"`,
        `"impact"` or `"state"` (the multipliers), which then makes a table without repetitions.

        **Raises:** `ValueError` if there is no such dimension.
        """
        data: dict[str, Any] = {
            name: ("point", x) for name, x in zip(self.names, self.parameters.T, strict=True)
        }
        data |= {name: ("point", getattr(self, name)) for name in ("y_min", "clearance")}
        data["impact_speed"] = ("point", "impact"), self.impact_speed
        data["multipliers"] = ("point", "state"), self.multipliers
        data["stability"] = "point", stability_in_words(self.multipliers)
        if self.kind == TORUS:
            data["angle"] = "point", self.angle
        places = np.array([point.parameters for point in self.special], float).reshape(-1, 2)
        named = {f"special_{name}": name for name in self.names}
        data |= {name: ("special", x) for name, x in zip(named, places.T, strict=True)}
        for word in ("kind", "detail"):
            words = [getattr(point, word) for point in self.special]
            data[f"special_{word}"] = "special", np.array(words, str)
        about = {"kind": self.kind, "ends": list(self.ends)}
        found = xr.Dataset(data, attrs={**about, "period_in_cycles": self.problem.cycles})
        named |= {name: name for name in self.names}
        found = with_units(found, self.problem.machine.units, named)
        return tidy(found, along)

    def __str__(self) -> str:
        low, high = self.parameters.min(axis=0), self.parameters.max(axis=0)
        lines = [
            f"Curve of {so_many(len(self.parameters), 'point')} of {self.kind}: {self.names[0]} in "
            f"[{low[0]:.6g}, {high[0]:.6g}], {self.names[1]} in [{low[1]:.6g}, {high[1]:.6g}]; "
            f"ends: {self.ends[0]}, {self.ends[1]}",
            *(f"  {point}" for point in self.special),
        ]
        return "\n".join(lines)


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
    two multipliers whose product is 1 for a Neimark–Sacker bifurcation, V⁻ = 0 or a clearance of
    zero for a grazing. Host-side: not to be traced.

    **Arguments:**

    - `point`: from `Branch.special`, or by `switch` from a point of codimension two; its parameter
      is the first of the two.
    - `parameter`: name of the second.
    - `bounds`: intervals of the first and of the second parameter.
    - `step`, `max_step`, `max_points`, `progress`: as for `continue_orbit`, parameters in half
      their intervals.

    **Returns:** a `Boundary`, whose `special` are its points of codimension two. It ends where the
    motion ceases to be one (another impact grazes).

    **Raises:** `ValueError` if the point is of another kind, outside the bounds, or the name
    unknown or the same; on Ctrl-C `Interrupted`, whose `partial` is the curve so far.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    progress = flag("progress", progress)
    _check_point(point)
    ranges = _checked_bounds(point, parameter, bounds)
    problem, condition, x = _special_motion(point, parameter, ranges)
    scale = problem.scale([0.5 * (high - low) for low, high in ranges])

    tangent = tangent_at(problem, x, scale)
    tangent = tangent * np.copysign(1.0, tangent[-2])  # ahead the second parameter rises
    start = advance(problem, x, tangent, scale, 0.0)
    if not bool(start.good):
        raise ValueError(
            "Argument `point` could not be refined in two parameters (last correction "
            f"{float(start.size):.2g})."
        )

    return both_ways(
        lambda: SpecialTable(problem, condition, scale, ranges),
        start,
        lambda found: _curve(found, condition),
        what="boundary", progress=progress, settings=settings,
    )  # fmt: skip


def _check_point(point: SpecialPoint) -> None:
    """**Raises:** `TypeError` or `ValueError` unless this is a bifurcation that can be followed."""
    instance_of("point", point, SpecialPoint, "a `SpecialPoint`, from `Branch.special`")
    if point.kind not in (FOLD, DOUBLING, TORUS, SYMMETRY, *TOUCHING):
        raise ValueError(
            "Argument `point` must be a fold, a period doubling, a Neimark–Sacker bifurcation, a "
            "symmetry breaking, or a grazing or sliding bifurcation at which something is touched, "
            f"but is {one(point.kind)}. {_INSTEAD}"
        )
    if not point.problem.follows_events:
        raise ValueError(
            "Argument `point` must belong to motions without rest on a stop, but these rest, and "
            "are followed in one parameter only."
        )
    if point.kind in TOUCHING and not point.touches:
        touched = point.kind in (ADDING_SLIDING, GRAZING_SLIDING)
        raise ValueError(
            "Argument `point` must be a grazing or a sliding bifurcation at which something is "
            f"touched, but is {one(point.kind)}: {point.detail}. "
            f"{_OTHER_SIDE if touched else _INSTEAD}"
        )


def _checked_bounds(point: SpecialPoint, parameter: str, bounds: Any) -> Intervals:
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
    point: SpecialPoint, parameter: str, bounds: Intervals
) -> tuple[Shooting, Special, np.ndarray]:
    """The equations of the curve, the condition among them that makes its motions special, and
    their unknowns at the point where it begins."""
    old = point.problem
    two = dataclasses.replace(old, parameters=(parameter, *old.parameters))
    corners = two.corners(bounds)
    steps = max(old.steps, steps_of(old.method, corners, old.like, old.cycles))
    problem = dataclasses.replace(two, steps=steps)
    values = float(leaf(old.machine, parameter)), point.parameter
    x = np.append(np.asarray(point.step.x)[:-1], values)
    symmetry = None
    if point.kind == SYMMETRY:
        if not may_be_symmetric(problem, corners):
            raise ValueError(
                "Argument `parameter` must leave the machine its symmetry, but with another "
                f"{parameter} a motion is not its own image."
            )
        symmetry = symmetry_condition(problem, x)
    condition = Special(point.kind, point.impact, symmetry)
    return dataclasses.replace(problem, conditions=(condition,)), condition, x


def _curve(found: Followed, condition: Special) -> Boundary:
    problem, seen = found.problem, [step.seen for step in found.steps]
    return Boundary(
        kind=condition.kind,
        names=(problem.parameters[1], problem.parameters[0]),
        parameters=np.stack([step.x[:-3:-1] for step in found.steps]),
        y_min=np.array([at.y_min for at in seen]),
        multipliers=np.stack([at.multipliers for at in seen]),
        impact_speed=np.stack([at.approach[list(problem.impacts)] for at in seen]),
        clearance=np.array([at.nearest.room for at in seen]),
        ends=found.ends,
        problem=problem,
        steps=found.steps,
        condition=condition,
        scale=found.scale,
    )
