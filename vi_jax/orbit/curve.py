"""Curves of periodic motions, branches and boundaries, and tables of their numbers."""

import abc
import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._checks import count, given_number, one_of
from .._messages import count_of
from .._types import State, xr
from ..flow import average_names, in_names, quantities_on, quantity_names, tidy
from ..machine import (
    AbstractMachine,
    components,
    cycles_in_words,
    frequency_ratio,
    in_unit,
    phase_at,
    units_of,
    with_units,
)
from .codimension_two import cosine_of, points_of
from .conditions import Special, held_in_words
from .corrector import Hits, Step, energies_of, hits_of, orbit_of, sections_at
from .equations import Observed, Shooting
from .kinds import TORUS
from .locate import locate_zero
from .results import Orbit, stability_of
from .special import Point
from .tolerances import EXACT, ROUNDING

# Names of the numbers at each point of every curve.
COLUMNS = (
    "parameter", "y_min", "y_max", "clearance", "frequency_ratio", "duration", "impacts",
    "fastest_impact", "slowest_impact", "impact_energy", "multiplier", "stable",
)  # fmt: skip


def column_names(machine: AbstractMachine, like: State) -> tuple[str, ...]:
    inner = (*components(like), *quantity_names(machine, like))
    return (*COLUMNS, *average_names(machine, like), *(f"section_{name}" for name in inner))


def special_table(special: list[Point], names: tuple[str, ...]) -> dict[str, Any]:
    orbits = [point.orbit for point in special]
    # Arrays without words keep a string type that files can hold.
    found = {
        "kind": np.array([point.kind for point in special], str),
        "detail": np.array([point.detail for point in special], str),
        "parameter": np.array([point.parameter for point in special], float),
        "point": np.array([point.index for point in special], int),
        "cycles": np.array([int(orbit.cycles) for orbit in orbits], int),
        "y_min": np.array([float(orbit.y_min) for orbit in orbits], float),
        "y_max": np.array([float(orbit.y_max) for orbit in orbits], float),
    }
    for i, name in enumerate(names):
        found.setdefault(name, np.array([point.parameters[i] for point in special], float))
    return {f"special_{name}": ("special", x) for name, x in found.items()}


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Curve(abc.ABC):
    """A curve of periodic motions; its columns have one row for each point, in order."""

    problem: Shooting
    """The equations of the motions."""
    steps: list[Step]
    """The solution of the equations at each point."""
    ends: tuple[str, str]
    """The reason for which the curve ends, on each side."""
    special: list[Point] = dataclasses.field(init=False)
    """The special points, in the curve's order."""

    def _stack(self, get: Callable[[Observed], Any]) -> np.ndarray:
        return np.stack([np.asarray(get(step.observed)) for step in self.steps])

    @property
    def scale(self) -> np.ndarray:
        return self.problem.scale

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.problem.parameters[::-1]

    @cached_property
    def parameters(self) -> np.ndarray:
        """Values of the parameters; (points, parameters)."""
        return np.stack([step.x[: -len(self.names) - 1 : -1] for step in self.steps])

    @property
    def parameter(self) -> np.ndarray:
        """Values of the first parameter."""
        return self.parameters[:, 0]

    @property
    def free(self) -> dict[str, np.ndarray]:
        """Values of the additional parameters, by name."""
        return dict(zip(self.names[1:], self.parameters[:, 1:].T, strict=True))

    @cached_property
    def y_min(self) -> np.ndarray:
        """Smallest position of the first coordinate, in the machine's unit (for a `Scene` a)."""
        return self._stack(lambda observed: observed.y_min)

    @cached_property
    def y_max(self) -> np.ndarray:
        """Largest position over the period, in the same unit."""
        return self._stack(lambda observed: observed.y_max)

    @cached_property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers over the period, the largest modulus first; (points, states). NaN at
        an end of a boundary with a lost impact, where some of them have no limit."""
        return self._stack(lambda observed: observed.multipliers)

    @cached_property
    def impact_phase(self) -> np.ndarray:
        """Clock of each impact, as `Orbit.impact_phase`, possibly beyond the period of the motion;
        (points, impacts). Only the first impact of a chatter into rest: `orbit(i)` lists all."""
        problem, places = self.problem, list(self.problem.impacts)
        phases = (phase_at(problem.at(x.x), x.x[places]) for x in self.steps)
        return np.stack([np.asarray(phase) for phase in phases])

    @cached_property
    def impact_speed(self) -> np.ndarray:
        """V⁻ of each impact in `impact_phase`, in the machine's unit (for a `Scene` a ω)."""
        return self._stack(lambda observed: observed.approach[list(self.problem.impacts)])

    @cached_property
    def clearance(self) -> np.ndarray:
        """Smallest distance to a stop at a turn that does not touch it: of several stops as a share
        of the motion's size there."""
        return self._stack(lambda observed: observed.nearest.margin)

    @cached_property
    def duration(self) -> np.ndarray:
        """Least period in time."""
        return self._stack(lambda observed: observed.duration)

    @cached_property
    def frequency_ratio(self) -> np.ndarray:
        """ζ: mean speed of the drive, NaN for machines without a drive."""
        ratio = frequency_ratio(self.problem.machine, jnp.asarray(self.duration / self.cycles))
        if ratio is None:
            return np.full(len(self.steps), np.nan)
        given = dict(zip(self.names, self.parameters.T, strict=True))
        return np.asarray(given.get("drive.frequency_ratio", ratio))

    @cached_property
    def averages(self) -> dict[str, np.ndarray]:
        """The machine's own averages over the period, by name (see `AbstractMachine.averages`)."""
        names = self.steps[0].observed.averages
        return {
            name: self._stack(lambda observed, name=name: observed.averages[name]) for name in names
        }

    @property
    def cycles(self) -> int:
        """Period in drive cycles."""
        return self.problem.cycles

    @property
    def stable(self) -> np.ndarray:
        """True at each point if all multipliers lie inside the unit circle, by more than 1e-9."""
        return self.multiplier < 1 - ROUNDING

    @property
    def admissible(self) -> np.ndarray:
        """True at each point if the motion stays inside the gap and approaches each impact."""
        return np.array([step.observed.admissible(self.problem.impacts) for step in self.steps])

    @property
    def multiplier(self) -> np.ndarray:
        """The greatest modulus of a multiplier, at each point."""
        return np.abs(self.multipliers).max(axis=1)

    @property
    def fastest_impact(self) -> np.ndarray:
        """Largest V⁻ in the period, at each point; 0 without impacts."""
        return np.array([hits.speed.max(initial=0.0) for hits in self._hits])

    @property
    def slowest_impact(self) -> np.ndarray:
        """Smallest V⁻ in the period, at each point; infinite without impacts."""
        return np.array([hits.speed.min(initial=np.inf) for hits in self._hits])

    @cached_property
    def impact_energy(self) -> np.ndarray:
        """Energy that impacts take in a cycle, averaged over the period, at each point (see
        `Run.impact_energy`); simulated at the first access."""
        hit = bool(self.problem.impacts)
        return energies_of(self.problem, self.steps) if hit else np.zeros(len(self.steps))

    @cached_property
    def _hits(self) -> list[Hits]:
        return [hits_of(self.problem, step) for step in self.steps]

    @property
    def impacts(self) -> np.ndarray:
        """Number of impacts in the period, at each point."""
        return np.array([hits.number for hits in self._hits])

    @property
    def rests(self) -> np.ndarray:
        """Number of times that a body comes to rest on a stop in the period, at each point."""
        return np.full(len(self.steps), len(self.problem.landings))

    @cached_property
    def sections(self) -> dict[str, np.ndarray]:
        """The state on the section and the machine's quantities there, by name; computed on
        access."""
        rows = []
        for step in self.steps:
            first = jax.tree.map(lambda x: x[:1], sections_at(self.problem, step.x)[0])
            quantities = quantities_on(self.problem.at(step.x), first)
            rows.append(components(first, 1) | quantities)
        return {name: np.concatenate([np.asarray(row[name]) for row in rows]) for name in rows[0]}

    @property
    def column_names(self) -> tuple[str, ...]:
        """Names of all numbers at each point, for pictures and tables."""
        return (*column_names(self.problem.machine, self.problem.like), *self.names[1:])

    def column(self, name: str) -> np.ndarray:
        """Return a number at each point: an array of the curve, an average of the machine, a
        parameter, or a component of the state or a quantity on the section, as `section_Y`.

        **Raises:** `ValueError` with the known names.
        """
        if name == self.names[0] and name not in self.column_names:
            return self.parameter
        one_of("name", name, self.column_names)
        if name in self.averages or name in self.free:
            return (self.averages | self.free)[name]
        inner = name.removeprefix("section_")
        return getattr(self, name) if inner == name else self.sections[inner]

    def orbit(self, index: int) -> Orbit:
        """Return the motion at one point; a negative `index` counts from the end."""
        points = len(self.steps)
        index = count("index", index, least=-points, most=points - 1)
        return orbit_of(self.problem, self.steps[index])

    def at(self, value: float) -> list[Orbit]:
        """Solve for the curve's motions at a value of its first parameter; return them in order."""
        value = given_number("value", value)

        def difference(step: Step) -> float:
            # Points at a value, such as a bound, are at it to rounding.
            offset = float(step.x[-1]) - value
            return offset if abs(offset) > EXACT * float(self.scale[-1]) else 0.0

        solutions = []
        following: list[Step | None] = [*self.steps[1:], None]
        for i, (here, new) in enumerate(zip(self.steps, following, strict=True)):
            if not difference(here):
                # The last point of a closed branch is its first one.
                if i == 0 or new is not None or "closed" not in self.ends:
                    solutions.append(here)
            elif new is not None and difference(here) * difference(new) < 0:
                solutions.append(locate_zero(self.problem, here, new, difference))
        return [orbit_of(self.problem, step) for step in solutions if step is not None]

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """Return the curve as an `xarray.Dataset` over its points, with the `stability` at each in
        words, and its special points: `special_kind`, `special_detail`, `special_parameter`, the
        index `special_point` of the curve's point (-1 if none), and more. The parameters are also
        variables by their own names, unless another column has that name. The ends are in `attrs`.

        `.to_netcdf(path, engine="h5netcdf")` writes all of it, complex multipliers too. `along`, as
        in `Run.to_xarray`, is `"point"`, `"special"`, `"impact"` or `"state"` (the multipliers).
        """
        data: dict[str, Any] = {self.names[0]: ("point", self.parameter)}
        data |= {name: ("point", self.column(name)) for name in self.column_names}
        data |= {
            "impact_phase": (("point", "impact"), self.impact_phase),
            "impact_speed": (("point", "impact"), self.impact_speed),
            "multipliers": (("point", "state"), self.multipliers),
            "stability": ("point", in_names(stability_of(self.multipliers))),
        }
        data |= special_table(self.special, self.names)
        attributes = {"parameter": self.names[0], "period_in_cycles": self.cycles}
        attributes |= {"ends": list(self.ends)}
        if isinstance(self, Boundary):
            attributes["kind"] = self.kind
        found = xr.Dataset(data, attrs=attributes)
        quantities = {name: name for name in (*self.averages, *self.names)}
        quantities |= {f"special_{name}": name for name in self.names}
        quantities |= dict.fromkeys(("parameter", "special_parameter"), self.names[0])
        quantities |= dict.fromkeys(("special_y_min", "special_y_max"), "position")
        return tidy(with_units(found, units_of(self.problem.machine), quantities), along)


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Branch(Curve):
    """A branch of periodic motions in one parameter, and in additional free parameters if
    quantities are held. NumPy arrays with one row for each point, in order, in the machine's units
    (see `AbstractMachine.units`).

    It ends on each side at the "bounds"; by "grazing" (an impact is lost or a stop touched); by one
    of the four sliding bifurcations ("crossing-sliding", …; see `Point.kind`); by "period-doubling"
    (it begins at a motion of half its period); by "symmetry-breaking" (it begins at a symmetric
    motion); by "hopf" (it shrinks to an equilibrium); by "rest" (a rest on a stop is lost or
    divided); by "closed" (its last point is its first one: an isola); by "multiplier" (another
    multiplier becomes as large as a held one, or a held complex pair becomes real); by "jammed"
    (`level` or `load` of a dry friction becomes negative at a step of the motion); by "stalled" (no
    motion was found even with the smallest step); by "max_points"; by "interrupted"; or by "long"
    (the period of an autonomous motion is four times the first one, for which the steps were
    chosen: begin another branch there).
    """

    special: list[Point]

    @property
    def name(self) -> str:
        """Name of the parameter."""
        return self.names[0]

    def _freed_in_words(self) -> list[str]:
        if not self.free:
            return []
        units = units_of(self.problem.machine)
        ranges = (
            f"{name} in {in_unit(f'[{values.min():.6g}, {values.max():.6g}]', units, name)}"
            for name, values in self.free.items()
        )
        return [f"  held: {held_in_words(self.problem)}; by {', '.join(ranges)}"]

    def __repr__(self) -> str:
        low, high = self.parameter.min(), self.parameter.max()
        machine = self.problem.machine
        period = cycles_in_words(machine, self.cycles)
        span = in_unit(f"[{low:.6g}, {high:.6g}]", units_of(machine), self.name)
        lines = [
            f"Branch of {count_of(len(self.parameter), 'motion')} of period {period} with "
            f"{branch_hits_in_words(self)}, {self.name} in {span}, "
            f"{int(self.stable.sum())} of them stable; ends: {self.ends[0]}, {self.ends[1]}",
            *self._freed_in_words(),
            *(f"  {point}" for point in self.special),
        ]
        return "\n".join(lines)


@dataclasses.dataclass(frozen=True, repr=False, eq=False)
class Boundary(Curve):
    """A curve in two parameters along which an orbit bifurcates. NumPy arrays with one row for each
    point, in order, in the machine's units (see `AbstractMachine.units`).

    It ends as a `Branch` does. A curve of Neimark–Sacker points also ends by "resonance-1:1" and
    "resonance-1:2" (the two multipliers become real), a curve of motions without symmetry by
    "symmetry-breaking" (they become symmetric).
    """

    @property
    def condition(self) -> Special:
        """The condition that makes the motions special."""
        return self.problem.conditions[0]

    @property
    def kind(self) -> str:
        """The kind of its points: "fold", "period-doubling", "neimark-sacker", "symmetry-breaking",
        "branch-point", "grazing", "rest" or that of a sliding bifurcation."""
        return self.condition.kind

    @cached_property
    def special(self) -> list[Point]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The points of codimension two on the curve, in order; located to rounding if accessed."""
        return points_of(self.problem, self.steps, self.ends)

    @property
    def angle(self) -> np.ndarray:
        """The angle of the pair of multipliers that leaves the unit circle, in radians, at each
        point; NaN on curves of other kinds."""
        if self.kind != TORUS:
            return np.full(len(self.steps), np.nan)
        return np.arccos(np.clip([cosine_of(step) for step in self.steps], -1, 1))

    @property
    def column_names(self) -> tuple[str, ...]:
        """The columns of any curve; for Neimark–Sacker points also the `angle`."""
        return (*super().column_names, *(("angle",) if self.kind == TORUS else ()))

    def __repr__(self) -> str:
        low, high = self.parameters.min(axis=0), self.parameters.max(axis=0)
        lines = [
            f"Curve of {count_of(len(self.parameters), 'point')} of {self.kind}: {self.names[0]} "
            f"in [{low[0]:.6g}, {high[0]:.6g}], {self.names[1]} in [{low[1]:.6g}, {high[1]:.6g}]; "
            f"ends: {self.ends[0]}, {self.ends[1]}",
            *(f"  {point}" for point in self.special),
        ]
        return "\n".join(lines)


def branch_hits_in_words(branch: Branch) -> str:
    if branch.problem.rests:
        return "rest on a stop"
    return count_of(branch.impact_speed.shape[1], "impact")
