"""`continue_orbit`: a branch of periodic motions in one parameter, and why it changes."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from .._checks import interval, one_of
from .._interrupted import Interrupted
from .._lazy import lazy
from ..flow import MethodLike, tidy
from ..machine import check_leaf, in_unit, leaf, with_units
from ._monitor import BranchMonitor
from ._observed import Observed
from ._rest import rests
from ._shooting import Shooting
from ._solution import orbit_of
from ._solve import advance, check_parameter, located, problem_of, tangent_at
from ._tables import COLUMNS, on_sections, table_of
from ._tables import column_names as column_names
from .curve import INTERRUPTED, Step, check_walk, walk
from .floquet import NEUTRAL
from .results import ORBIT_RESULTS, InWords, Orbit, impacts_in_words
from .special import SpecialPoint

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = lazy("xarray")

# An orbit found on the cycle map solves the equations from impact to impact closer than this; one
# that rests on a stop does not. A choice.
_SAME = 1e-3

# A point lies at a value of the parameter if it is no further from it (in the parameter's scale).
_ROUNDING = 1e-12


@dataclasses.dataclass(frozen=True, repr=False)
class Branch(InWords):
    """A branch of periodic motions: host arrays with one row for each point, in their order, in
    the machine's units (see `AbstractMachine.units`)."""

    name: str
    """Name of the parameter."""
    parameter: np.ndarray
    y_min: np.ndarray
    """Smallest position (of the first coordinate), in the machine's unit (of a `Scene` a)."""
    y_max: np.ndarray
    """Largest position over the period, in the same unit."""
    multipliers: np.ndarray
    """Floquet multipliers over the period, the largest modulus first; (points, states)."""
    impact_phase: np.ndarray
    """Clock of each impact since the section, in the machine's units (of a `Scene` the crank angle
    in radians); (points, impacts)."""
    impact_speed: np.ndarray
    """V⁻ of each impact, in the machine's unit (of a `Scene` a ω); (points, impacts)."""
    clearance: np.ndarray
    """Smallest distance to a stop at a turn that does not touch it, in the unit of positions."""
    frequency_ratio: np.ndarray
    """ζ: mean speed of the drive, NaN for machines that are not driven."""
    duration: np.ndarray
    """Least period in time."""
    averages: dict[str, np.ndarray]
    """The machine's own averages over the period, by name (see `AbstractMachine.averages`)."""
    cycles: int
    """Period in drive cycles."""
    special: list[SpecialPoint]
    ends: tuple[str, str]
    """Why the branch ends on each side: "bounds", "grazing" (an impact is lost or a stop touched),
    "period-doubling" (it springs there from a motion of half its period), "symmetry-breaking" (from
    a symmetric one), "hopf" (it shrinks to rest), "closed", "stalled", "max_points",
    "interrupted", "long" (an autonomous motion takes four times as long as that from which the
    branch began, for which its steps are: begin another one there)."""
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

    @property
    def impacts(self) -> np.ndarray:
        """Number of impacts in the period, at each point."""
        return np.full(len(self.parameter), self.impact_speed.shape[1])

    @cached_property
    def sections(self) -> dict[str, np.ndarray]:
        """The state on the section and the machine's own quantities there, by name; solved for
        when it is first asked for."""
        return on_sections(self.problem, self.steps)

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of all that is a number at each point, as pictures and tables take them."""
        return column_names(self.problem.machine, self.problem.like)

    def column(self, name: str) -> np.ndarray:
        """A number at each point: one of the branch's arrays, one of the machine's averages, or a
        part of the state or a quantity on the section, as `section_Y`.

        **Raises:** `ValueError` that lists the names there are.
        """
        one_of("name", name, self.column_names)
        if name in self.averages:
            return self.averages[name]
        if name in COLUMNS:
            return getattr(self, name)
        return self.sections[name.removeprefix("section_")]

    def table(self, function: Callable[[Orbit], Any]) -> "xr.Dataset":
        """What a function makes of the orbit at each point, as an `xarray.Dataset` over the points
        beside the parameter; `.to_dataframe()` makes it a table.

        **Arguments:** a function of an `Orbit` that returns numbers by name; or one number or
        array, which is called `value` then. An array has axes of its own.

        **Raises:** `TypeError` for a function that returns no numbers, or others at another point.
        """
        orbits = (self.orbit(i) for i in range(len(self.steps)))
        return table_of(function, orbits, self.name, self.parameter, self.problem.machine.units)

    def orbit(self, index: int) -> Orbit:
        """The motion at one point."""
        return orbit_of(self.problem, self.steps[index])

    def at(self, value: float) -> list[Orbit]:
        """The branch's motions at a value of the parameter, solved for; in the branch's order."""

        def apart(step: Step) -> float:
            # Points are put on a value, such as a bound, to rounding.
            by = float(step.x[-1]) - value
            return by if abs(by) > _ROUNDING * float(self.scale[-1]) else 0.0

        found = []
        following: list[Step | None] = [*self.steps[1:], None]
        if "closed" in self.ends:
            following[-1] = self.steps[0]
        for here, new in zip(self.steps, following, strict=True):
            if not apart(here):
                found.append(here)
            elif new is not None and apart(here) * apart(new) < 0:
                found.append(self._between(here, new, apart))
        return [orbit_of(self.problem, step) for step in found if step is not None]

    def _between(self, here: Step, new: Step, test: Callable[[Step], float]) -> Step | None:
        """The point at which a test is zero, between two that follow each other."""
        # Steps follow the branch's sense, except in its backward half, which is turned.
        if float(np.dot(here.tangent, (new.x - here.x) / self.scale)) < 0:
            here, new = new, here
        return located(self.problem, here, new, self.scale, test)

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """The branch as an `xarray.Dataset` over its points.

        **Arguments:** `along`, to keep only what has one dimension: `"point"`, `"impact"` or
        `"state"` (the multipliers), which then makes a table without repetitions.

        **Raises:** `ValueError` if there is no such dimension.
        """
        data = {name: ("point", self.column(name)) for name in self.column_names}
        data |= {
            "impact_phase": (("point", "impact"), self.impact_phase),
            "impact_speed": (("point", "impact"), self.impact_speed),
            "multipliers": (("point", "state"), self.multipliers),
        }
        found = xr.Dataset(data, attrs={"parameter": self.name, "period_in_cycles": self.cycles})
        own = {name: name for name in self.averages} | {"parameter": self.name}
        found = with_units(found, self.problem.machine.units, own)
        return tidy(found, along)

    def __str__(self) -> str:
        low, high = self.parameter.min(), self.parameter.max()
        machine = self.problem.machine
        period = machine.period_of(self.cycles)
        span = in_unit(f"[{low:.6g}, {high:.6g}]", machine.units, self.name)
        lines = [
            f"Branch of {len(self.parameter)} motions of period {period} with "
            f"{impacts_in_words(self.impact_speed.shape[1])}, {self.name} in {span}, "
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
    """Follow a periodic motion in one number of its machine, both ways, through folds.

    Pseudo-arclength on the equations from impact to impact, which stay smooth at a grazing. Folds,
    period doublings, Neimark–Sacker bifurcations, crossings of branches and grazings are located
    to rounding. Where an impact is lost or a stop is touched, the motion ceases to be one: there
    the branch ends (`special[i].switch()` goes on with the other impacts). Host-side: not to be
    traced; one compiled program for each number of cycles and impacts.

    **Arguments:**

    - `orbit`: from `find_orbit`, or from another branch.
    - `parameter`: name of a number of the machine: `"drive.frequency_ratio"`, `"stops.0.gap"`,
      `"oscillator.damping_ratio"`, …
    - `bounds`: the interval of the parameter.
    - `step`, `max_step`: first and longest step along the branch, in the norm of the unknowns: the
      state and the clock of each impact in the machine's own units (of a `Scene`: positions in a,
      velocities in a ω, crank angles in radians), the parameter in half its interval.
    - `max_points`: points in each direction at most.
    - `method`: how the machine is carried, of fixed steps: by default that of the orbit if its
      steps are, else `ExactFlight()` where it applies, else 20 steps of `Verner9` a cycle.

    **Returns:** a `Branch`.

    **Raises:** `ValueError` if the orbit is none, rests on a stop, does not list all its impacts,
    or lies outside the bounds, or if the name is unknown; on Ctrl-C `Interrupted`, whose `partial`
    is the branch so far.
    """
    settings = check_walk(step=step, max_step=max_step, max_points=max_points)
    _check_orbit(orbit)
    check_leaf(orbit.machine, parameter)
    bounds = interval("bounds", bounds)
    value = float(leaf(orbit.machine, parameter))
    check_parameter(orbit.machine, parameter, value, bounds, "orbit")
    problem, x = problem_of(orbit, parameter, bounds, method)
    scale = np.ones(problem.size)
    scale[-1] = 0.5 * (bounds[1] - bounds[0])
    start = _first_point(problem, x, scale, orbit)
    ahead = BranchMonitor(problem, scale, bounds)
    forward = walk(ahead.advance, start, stop=ahead.stop, **settings)
    back = BranchMonitor(problem, scale, bounds)
    turned = start._replace(tangent=-start.tangent)
    if forward.end in ("closed", INTERRUPTED):
        backward_steps, ends = [], (forward.end, forward.end)
    else:
        backward = walk(back.advance, turned, stop=back.stop, **settings)
        backward_steps, ends = back.path(backward.steps[1:]), (backward.end, forward.end)
    special = [*reversed(back.special), *ahead.special]
    steps = [*reversed(backward_steps), *ahead.path(forward.steps)]
    branch = _branch(problem, parameter, steps, special, ends, scale)
    if INTERRUPTED in ends:
        raise Interrupted("walk along the branch", branch)
    return branch


def _check_orbit(orbit: Orbit) -> None:
    """**Raises:** `ValueError` unless this is one orbit that does not rest on a stop."""
    if not isinstance(orbit, Orbit) or orbit.residual.ndim:
        raise ValueError("Argument `orbit` must be one `Orbit`, not a batch or a state.")
    if not bool(orbit.successful):
        reason = ORBIT_RESULTS[orbit.result]
        raise ValueError(f"Argument `orbit` must be an orbit, but is: {reason}")
    if rests(orbit):
        raise ValueError(
            "Argument `orbit` must not rest on a stop, but does: such a motion can be simulated, "
            "swept and found, but not followed as a branch."
        )


def _first_point(problem: Shooting, x: np.ndarray, scale: np.ndarray, orbit: Orbit) -> Step:
    """The orbit as a solution of its equations from event to event.

    It is refined at its parameter, unless it lies at a fold: then across the branch, which takes a
    program of its own.

    **Raises:** `ValueError` where there is no solution close to it, or many.
    """
    start, moved = _refined(problem, x, np.eye(problem.size)[-1], scale)
    if moved > _SAME:
        start, moved = _refined(problem, x, tangent_at(problem, x, scale), scale)
    if moved > _SAME and float(np.abs(np.asarray(orbit.multipliers) - 1).min()) < NEUTRAL:
        raise ValueError(
            "Argument `orbit` must be alone at its parameter, but one of its multipliers is 1: "
            "branches cross there, or something in its state is neutral, as a place that is free "
            "or a number carried along. Leave that out of the state to follow it."
        )
    if moved > _SAME:
        raise ValueError(
            "Argument `orbit` could not be refined from impact to impact (last correction "
            f"{max(moved, float(start.size)):.2g}): branches cross there, or it is no orbit of "
            "this machine."
        )
    return start


def _refined(
    problem: Shooting, x: np.ndarray, tangent: np.ndarray, scale: np.ndarray
) -> tuple[Step, float]:
    """The solution in the plane across a tangent at `x`, and how far (scaled) it is from there."""
    start = advance(problem, x, tangent, scale, 0.0)
    return start, float(np.max(np.abs(start.x - x) / scale)) if bool(start.good) else np.inf


def _branch(
    problem: Shooting, name: str, steps: list[Step], special: list[SpecialPoint],
    ends: tuple[str, str], scale: np.ndarray,
) -> Branch:  # fmt: skip
    """The branch as arrays, from its points.

    **Arguments:** `name`, the parameter's; `steps`, the points in their order; `special` and `ends`
    as in `Branch`; `scale`, the size of each unknown.
    """
    xs = np.stack([step.x for step in steps])
    impacts = np.asarray(problem.impacts, int)

    def column(get: Callable[[Observed], Any]) -> np.ndarray:
        return np.stack([np.asarray(get(step.seen)) for step in steps])

    duration = column(lambda seen: seen.duration)
    ratio = problem.machine.frequency_ratio(jnp.asarray(duration / problem.cycles))
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
        clearance=column(lambda seen: seen.nearest.room),
        frequency_ratio=np.full(len(xs), np.nan) if ratio is None else np.asarray(ratio),
        duration=duration,
        averages={
            name: column(lambda seen, name=name: seen.averages[name])
            for name in steps[0].seen.averages
        },
        cycles=problem.cycles,
        special=special,
        ends=ends,
        problem=problem,
        steps=steps,
        scale=scale,
    )
