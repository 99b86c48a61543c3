"""`boundary`: curves of folds, period doublings, lost symmetries and grazings."""

import dataclasses
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import interval
from .._interrupted import Interrupted
from .._lazy import lazy
from ..flow.labelled import tidy
from ..machine.numbers import check_again, check_leaf, leaf, with_leaf
from ..machine.shown import summary_table
from ..machine.units import with_units
from ._fixed_step_method import steps_of
from ._shooting import Shooting
from ._solution import orbit_of
from ._solve import advance as solved
from ._solve import jacobian_at, tangent_at
from ._symmetry import images, may_be_symmetric
from .curve import INTERRUPTED, Step, Walk, check_walk, walk
from .results import Orbit
from .special import DOUBLING, FOLD, GRAZING, SYMMETRY, SpecialPoint

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = lazy("xarray")

# What lies below zero by no more than this is zero to rounding.
_NOISE = 1e-9


@dataclasses.dataclass(frozen=True)
class Boundary:
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

    def orbit(self, index: int) -> Orbit:
        """The motion at one point."""
        return orbit_of(self.problem, self.steps[index])

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """The curve as an `xarray.Dataset` over its points, the two parameters by their names.

        **Arguments:** `along`, to keep only what is told along one dimension: `"point"`, `"impact"`
        or `"state"` (the multipliers), which then makes a table without repetitions.

        **Raises:** `ValueError` if there is no such dimension.
        """
        data: dict[str, Any] = {
            name: ("point", x) for name, x in zip(self.names, self.parameters.T, strict=True)
        }
        data |= {name: ("point", getattr(self, name)) for name in ("y_min", "clearance")}
        data["impact_speed"] = ("point", "impact"), self.impact_speed
        data["multipliers"] = ("point", "state"), self.multipliers
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

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return summary_table(str(self), self.y_min)


def boundary(
    point: SpecialPoint,
    *,
    parameter: str,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    step: float = 0.01,
    max_step: float = 0.05,
    max_points: int = 1000,
) -> Boundary:
    """Follow a bifurcation of a branch in a second parameter, both ways.

    Pseudo-arclength on the orbit's equations together with the condition that makes the point
    special: det(M - I) = 0 for a fold or a symmetry breaking, det(M + I) = 0 for a period doubling,
    V⁻ = 0 or a clearance of zero for a grazing. Host-side: not to be traced.

    **Arguments:**

    - `point`: from `Branch.special`; its parameter is the first of the two.
    - `parameter`: name of the second.
    - `bounds`: intervals of the first and of the second parameter.
    - `step`, `max_step`, `max_points`: as for `continue_orbit`, parameters in half their intervals.

    **Returns:** a `Boundary`. It ends where the motion ceases to be one (another impact grazes).

    **Raises:** `ValueError` if the point is of another kind, outside the bounds, or the name
    unknown or the same; on Ctrl-C `Interrupted`, whose `partial` is the curve so far.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    if not isinstance(point, SpecialPoint):
        raise TypeError(
            f"Argument `point` must be a `SpecialPoint`, from `Branch.special`, but got {point!r}."
        )
    if point.kind not in (FOLD, DOUBLING, SYMMETRY, GRAZING):
        raise ValueError(
            "Argument `point` must be a fold, a period doubling, a symmetry breaking or a grazing, "
            f"but is a {point.kind}."
        )
    if point.kind == GRAZING and not point.touches:
        raise ValueError(
            "Argument `point` must be a grazing at which something is touched, but there "
            f"{point.detail}."
        )
    old = point.problem
    check_leaf(old.machine, parameter)
    names = (old.parameters[0], parameter)
    if names[0] == names[1]:
        raise ValueError(f"Argument `parameter` must be another one than {names[0]}.")
    try:
        first, second = bounds
    except (TypeError, ValueError):
        raise ValueError(
            "Argument `bounds` must be an interval for each of the two parameters, but got "
            f"{bounds!r}."
        ) from None
    bounds = (interval("bounds", first), interval("bounds", second))
    values = (point.parameter, float(leaf(old.machine, parameter)))
    for name, value, (low, high) in zip(names, values, bounds, strict=True):
        if not low <= value <= high:
            raise ValueError(
                f"Argument `bounds` must hold the point's {name} = {value:g}, but is "
                f"({low:g}, {high:g})."
            )
        for bound in (low, high):
            check_again(with_leaf(old.machine, name, bound))
    corners = []
    for a in bounds[0]:
        for b in bounds[1]:
            probe = dataclasses.replace(old, parameters=names)
            corners.append(probe.at(jnp.asarray([a, b])))
    steps = max(old.steps, steps_of(old.method, corners, old.like, old.cycles))
    problem = dataclasses.replace(old, parameters=names, steps=steps)
    x = np.append(np.asarray(point.step.x)[:-1], values)
    scale = np.ones(problem.size)
    scale[-2:] = [0.5 * (high - low) for low, high in bounds]
    lone = None
    if point.kind == SYMMETRY:
        if not may_be_symmetric(problem, corners):
            raise ValueError(
                "Argument `parameter` must leave the machine its symmetry, but with another "
                f"{parameter} a motion is not its own image."
            )
        lone = _lone(problem, x)
    condition = _Condition(problem, point.kind, point.impact, lone)
    tangent = tangent_at(condition, x, scale)

    def advance(x: Any, tangent: Any, length: float) -> Step:
        return solved(condition, x, tangent, scale, length)

    start = advance(x, tangent, 0.0)
    if not bool(start.good):
        raise ValueError(
            "Argument `point` could not be refined in two parameters (last correction "
            f"{float(start.size):.2g})."
        )

    def stop(here: Step, new: Step) -> tuple[Step, str] | None:
        inside = all(
            low <= value <= high for value, (low, high) in zip(new.x[-2:], bounds, strict=True)
        )
        if not inside:
            return _cut(advance, here, new, bounds, scale), "bounds"
        # In a symmetric motion another impact grazes as well, to rounding.
        others = [v + _NOISE for i, v in enumerate(new.seen.approach) if i != condition.impact]
        # At a grazing the body turns on the stop, to rounding.
        touching = point.kind == GRAZING and condition.impact is None
        if min(others, default=1.0) <= 0 or (not touching and new.seen.clearance < -_NOISE):
            return here, "grazing"
        return None

    forward = walk(advance, start, stop=stop, **settings)
    backward = Walk([start], INTERRUPTED)
    if forward.end != INTERRUPTED:
        backward = walk(advance, start._replace(tangent=-start.tangent), stop=stop, **settings)
    path = [*reversed(backward.steps[1:]), *forward.steps]
    curve = Boundary(
        kind=point.kind,
        names=names,
        parameters=np.stack([step.x[-2:] for step in path]),
        y_min=np.array([step.seen.y_min for step in path]),
        multipliers=np.stack([step.seen.multipliers for step in path]),
        impact_speed=np.stack([step.seen.approach[list(problem.impacts)] for step in path]),
        clearance=np.array([step.seen.clearance for step in path]),
        ends=(backward.end, forward.end),
        problem=problem,
        steps=path,
    )
    if INTERRUPTED in curve.ends:
        raise Interrupted("walk along the boundary", curve)
    return curve


class SymmetryCondition(eqx.Module):
    """What keeps a symmetric motion symmetric.

    Where it loses its symmetry the equations cannot be solved for it: a departure along the
    direction in which it does so is missed by none of them, and one combination of them is met by
    every symmetric motion. That one gives way to the condition to be symmetric.
    """

    left: Float[Array, " equations"]
    """That combination."""
    weight: Float[Array, " differences"]
    """Of what tells the motion from its image, as that direction does."""

    def instead(self, problem: Shooting, missing: Array, x: Array) -> Array:
        """What the equations lack, that one exchanged."""
        departs = self.weight @ images(problem, x)
        return missing + self.left * (departs - self.left @ missing)


def _lone(problem: Shooting, x: np.ndarray) -> SymmetryCondition:
    count = len(problem.parameters)
    left, _, right = np.linalg.svd(np.asarray(jacobian_at(problem, jnp.asarray(x)))[:, :-count])
    direction = jnp.append(jnp.asarray(right[-1]), jnp.zeros(count))
    told = jax.jvp(lambda x: images(problem, x), (jnp.asarray(x),), (direction,))[1]
    return SymmetryCondition(jnp.asarray(left[:, -1]), told / (told @ told))


class _Condition(eqx.Module):
    """The equations of an orbit and what makes it special."""

    problem: Shooting
    kind: str = eqx.field(static=True)
    impact: int | None = eqx.field(static=True)
    lone: "SymmetryCondition | None" = None

    def residual(self, x):
        missing, seen = self.problem.residual(x), self.problem.observe(x)
        if self.lone is not None:
            missing = self.lone.instead(self.problem, missing, x)
        identity = jnp.eye(seen.monodromy.shape[0], dtype=x.dtype)
        if self.kind == GRAZING:
            extra = seen.clearance if self.impact is None else seen.approach[self.impact]
        elif self.kind == DOUBLING:
            extra = jnp.linalg.det(seen.monodromy + identity)
        else:
            extra = jnp.linalg.det(seen.monodromy - identity)
        return jnp.append(missing, extra)

    def observe(self, x):
        return self.problem.observe(x)


def _cut(advance: Any, here: Step, new: Step, bounds: Any, scale: np.ndarray) -> Step:
    """The last point inside the bounds, by halving the step."""
    low, high = 0.0, float(np.dot(here.tangent, (new.x - here.x) / scale))
    last = here
    for _ in range(30):
        middle = 0.5 * (low + high)
        step = advance(here.x, here.tangent, middle)
        inside = bool(step.good) and all(
            a <= value <= b for value, (a, b) in zip(step.x[-2:], bounds, strict=True)
        )
        low, high = (middle, high) if inside else (low, middle)
        last = step if inside else last
    return last
