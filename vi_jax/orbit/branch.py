"""`continue_orbit`: a branch of periodic motions in one parameter, and why it changes."""

import dataclasses
import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from .._checks import interval
from .._lazy import lazy
from ..flow.methods import MethodLike
from ..scene.numbers import check_again, check_leaf, leaf, with_leaf
from ._follow import Follower
from ._shooting import Shooting
from ._solve import advance, located, orbit_of, problem_of, tangent_at
from .curve import Step, check_walk, walk
from .results import ORBIT_RESULTS, Orbit, impacts_in_words
from .special import SpecialPoint

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = lazy("xarray")

# An orbit found on the cycle map solves the equations from impact to impact closer than this; one
# that rests on a stop does not.
_SAME = 1e-3


@dataclasses.dataclass(frozen=True)
class Branch:
    """A branch of periodic motions: host arrays with one row for each point, in their order."""

    name: str
    """Name of the parameter."""
    parameter: np.ndarray
    y_min: np.ndarray
    """Smallest Y (unit: a)."""
    y_max: np.ndarray
    """Largest Y (unit: a)."""
    multipliers: np.ndarray
    """Floquet multipliers over the period, the largest modulus first; (points, states)."""
    impact_phase: np.ndarray
    """Clock of each impact since the section (radians of crank angle); (points, impacts)."""
    impact_speed: np.ndarray
    """V⁻ of each impact (unit: a ω); (points, impacts)."""
    clearance: np.ndarray
    """Smallest distance to a stop at a turn that does not touch it (unit: a)."""
    frequency_ratio: np.ndarray
    """ζ: mean crank speed (unit: ω), NaN for scenes that are not driven."""
    cycles: int
    """Period in drive cycles."""
    special: list[SpecialPoint]
    ends: tuple[str, str]
    """Why the branch ends on each side: "bounds", "grazing" (an impact is lost or a stop touched),
    "period-doubling" (it springs there from a motion of half its period), "symmetry-breaking" (from
    a symmetric one), "hopf" (it shrinks to rest), "closed", "stalled", "max_points"."""
    problem: Shooting = dataclasses.field(repr=False)
    steps: list[Step] = dataclasses.field(repr=False)
    scale: np.ndarray = dataclasses.field(repr=False)

    @property
    def stable(self) -> np.ndarray:
        """Whether all multipliers lie inside the unit circle, at each point."""
        return np.abs(self.multipliers).max(axis=1) < 1

    @property
    def admissible(self) -> np.ndarray:
        """Whether the motion stays inside the gap and approaches each impact, at each point."""
        slow = self.impact_speed.min(axis=1, initial=np.inf)
        return (self.clearance > -1e-9) & (slow > -1e-9)

    def orbit(self, index: int) -> Orbit:
        """The motion at one point."""
        return orbit_of(self.problem, self.steps[index])

    def at(self, value: float) -> list[Orbit]:
        """The branch's motions at a value of the parameter, solved for; in the branch's order."""
        found = []
        for here, new in itertools.pairwise(self.steps):
            # Steps follow the branch's sense, except in its backward half, which is turned.
            if (here.x[-1] - value) * (new.x[-1] - value) > 0 or new.x[-1] == value:
                continue
            if float(np.dot(here.tangent, (new.x - here.x) / self.scale)) < 0:
                here, new = new, here
            step = located(
                self.problem, here, new, self.scale, lambda step: float(step.x[-1]) - value
            )
            if step is not None:
                found.append(orbit_of(self.problem, step))
        return found

    def to_xarray(self) -> "xr.Dataset":
        """The branch as an `xarray.Dataset` over its points."""
        units = {"y_min": "a", "y_max": "a", "clearance": "a", "impact_speed": "a ω"}
        data = {
            name: ("point", getattr(self, name))
            for name in ("parameter", "y_min", "y_max", "clearance", "frequency_ratio", "stable")
        }
        data |= {
            "impact_phase": (("point", "impact"), self.impact_phase),
            "impact_speed": (("point", "impact"), self.impact_speed),
            "multipliers": (("point", "state"), self.multipliers),
        }
        found = xr.Dataset(data, attrs={"parameter": self.name, "period_in_cycles": self.cycles})
        for name, unit in units.items():
            found[name].attrs["units"] = unit
        return found

    def __str__(self) -> str:
        low, high = self.parameter.min(), self.parameter.max()
        period = self.problem.scene.period_of(self.cycles)
        lines = [
            f"Branch of {len(self.parameter)} motions of period {period} with "
            f"{impacts_in_words(self.impact_speed.shape[1])}, "
            f"{self.name} in [{low:.6g}, {high:.6g}], "
            f"{int(self.stable.sum())} of them stable; ends: {self.ends[0]}, {self.ends[1]}",
            *(f"  {point}" for point in self.special),
        ]
        return "\n".join(lines)


def continue_orbit(
    orbit: Orbit,
    *,
    parameter: str,
    bounds: tuple[float, float],
    step: float = 0.01,
    max_step: float = 0.1,
    max_points: int = 1000,
    method: MethodLike = None,
) -> Branch:
    """Follow a periodic motion in one number of its scene, both ways, through folds.

    Pseudo-arclength on the equations from impact to impact, which stay smooth at a grazing. Folds,
    period doublings, Neimark–Sacker bifurcations, crossings of branches and grazings are located
    to rounding. Where an impact is lost or a stop is touched, the motion ceases to be one: there
    the branch ends (`special[i].switch()` goes on with the other impacts). Host-side: not to be
    traced; one compiled program for each number of cycles and impacts.

    **Arguments:**

    - `orbit`: from `find_orbit`, or from another branch.
    - `parameter`: name of a number of the scene: `"drive.frequency_ratio"`, `"stops.0.gap"`,
      `"oscillator.damping_ratio"`, …
    - `bounds`: the interval of the parameter.
    - `step`, `max_step`: first and longest step along the branch, in the norm of the unknowns
      (positions in a, velocities in a ω, clocks in radians, the parameter in half its interval).
    - `max_points`: points in each direction at most.
    - `method`: how the scene is carried, of fixed steps: by default `ExactFlight()` where it
      applies, else 20 steps of `Verner9` a cycle.

    **Returns:** a `Branch`.

    **Raises:** `ValueError` if the orbit is none, lies outside the bounds, or the name is unknown.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    if not isinstance(orbit, Orbit) or orbit.residual.ndim:
        raise ValueError("Argument `orbit` must be one `Orbit`, not a batch or a state.")
    if not bool(orbit.successful):
        reason = ORBIT_RESULTS[orbit.result]
        raise ValueError(f"Argument `orbit` must be an orbit, but is: {reason}")
    check_leaf(orbit.scene, parameter)
    low, high = interval("bounds", bounds)
    value = float(leaf(orbit.scene, parameter))
    if not low <= value <= high:
        raise ValueError(
            f"Argument `bounds` must hold the orbit's {parameter} = {value:g}, but is "
            f"({low:g}, {high:g})."
        )
    for bound in (low, high):
        check_again(with_leaf(orbit.scene, parameter, bound))
    problem, x = problem_of(orbit, parameter, (low, high), method)
    scale = np.ones(problem.size)
    scale[-1] = 0.5 * (high - low)
    # At a fixed parameter, unless the orbit lies at a fold: then across the branch, which takes a
    # program of its own.
    start, moved = _refined(problem, x, np.eye(problem.size)[-1], scale)
    if moved > _SAME:
        start, moved = _refined(problem, x, tangent_at(problem, x, scale), scale)
    if moved > _SAME:
        raise ValueError(
            "Argument `orbit` could not be refined from impact to impact (last correction "
            f"{max(moved, float(start.size)):.2g}): branches cross there, it is no orbit of this "
            "scene, or its body comes to rest on a stop, which cannot be followed from impact to "
            "impact."
        )
    ahead = Follower(problem, scale, (low, high))
    forward = walk(ahead.advance, start, stop=ahead.stop, **settings)
    back = Follower(problem, scale, (low, high))
    turned = start._replace(tangent=-start.tangent)
    if forward.end == "closed":
        backward_steps, ends = [], ("closed", "closed")
    else:
        backward = walk(back.advance, turned, stop=back.stop, **settings)
        backward_steps, ends = back.path(backward.steps[1:]), (backward.end, forward.end)
    special = [*reversed(back.special), *ahead.special]
    steps = [*reversed(backward_steps), *ahead.path(forward.steps)]
    return _branch(problem, parameter, steps, special, ends, scale)


def _refined(problem: Shooting, x, tangent, scale) -> tuple[Step, float]:
    """The solution in the plane across a tangent at `x`, and how far (scaled) it is from there."""
    start = advance(problem, x, tangent, scale, 0.0)
    return start, float(np.max(np.abs(start.x - x) / scale)) if bool(start.good) else np.inf


def _branch(problem, name, steps, special, ends, scale) -> Branch:
    xs = np.stack([step.x for step in steps])
    impacts = np.asarray(problem.impacts, int)

    def column(get: Callable[[Any], Any]) -> np.ndarray:
        return np.stack([np.asarray(get(step.seen)) for step in steps])

    duration = column(lambda seen: seen.duration)
    ratio = problem.scene.frequency_ratio(jnp.asarray(duration / problem.cycles))
    if ratio is not None and name == "drive.frequency_ratio":
        ratio = xs[:, -1]
    return Branch(
        name=name,
        parameter=xs[:, -1],
        y_min=column(lambda seen: seen.y_min),
        y_max=column(lambda seen: seen.y_max),
        multipliers=column(lambda seen: seen.multipliers),
        impact_phase=xs[:, impacts],
        impact_speed=column(lambda seen: np.asarray(seen.approach)[impacts]),
        clearance=column(lambda seen: seen.clearance),
        frequency_ratio=np.full(len(xs), np.nan) if ratio is None else np.asarray(ratio),
        cycles=problem.cycles,
        special=special,
        ends=ends,
        problem=problem,
        steps=steps,
        scale=scale,
    )
