"""`all_orbits`: the periodic motions found by searches from a region of starts."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from .._checks import count, given_number, host_side
from .._messages import count_of, in_parts, warning_once
from .._types import State, xr
from ..flow import MethodLike, in_names, machine_of, tidy
from ..machine import AbstractMachine, components, cycles_in_words, units_of, with_units
from ..orbit import (
    ORBIT_RESULTS,
    AbstractRootFinder,
    Orbit,
    Orbits,
    distinct_among,
    find_orbit,
    in_one_line,
)
from ._basins import in_one_array, starts_in
from .program import start_with


@dataclasses.dataclass(frozen=True)
class Searched:
    """Statistics of the search for motions of one period, for estimates of motions not found."""

    cycles: int
    """The period in drive cycles; motions whose periods divide it solve its equations too."""
    starts: int
    """Number of random starts."""
    simulated: int
    """Number of starts that could be simulated, for example not beyond a stop."""
    converged: int
    """Number of searches that found a motion."""
    motions: int
    """Number of different motions among them."""
    once: int
    """Number of motions that only one search found."""
    still: int = 0
    """Number of searches that ended at an equilibrium, which is not a motion."""

    @property
    def unseen(self) -> float:
        """Good and Turing's estimate of the probability that the next converging search finds a new
        motion: `once / converged`, NaN if none converged. It counts searches, not motions: many
        motions with small sets of starts may be missing."""
        return self.once / self.converged if self.converged else np.nan

    @property
    def detectable(self) -> float:
        """The share of the converging searches above which a motion is found by this number of
        searches in 95 of 100 cases; NaN if none converged."""
        return 1 - 0.05 ** (1 / self.converged) if self.converged else np.nan


@dataclasses.dataclass(frozen=True, repr=False)
class AllOrbits:
    """Periodic motions from a region of starts, stable and unstable, and search statistics."""

    orbits: Orbits
    """The motions, by period and then by least position; each with its multipliers."""
    found: np.ndarray
    """Number of searches that found each; (motions, periods), in the order of `searched`."""
    searched: tuple[Searched, ...]
    """The statistics of each period."""
    region: dict[str, tuple[float, float]]
    """Ranges of the components of the start."""
    machine: AbstractMachine

    @property
    def stable(self) -> np.ndarray:
        """True for each stable motion."""
        return np.array([bool(orbit.stable) for orbit in self.orbits], bool)

    @property
    def periods(self) -> np.ndarray:
        """The least period of each motion, in drive cycles."""
        return np.array([int(orbit.cycles) for orbit in self.orbits], int)

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """Return the motions as an `xarray.Dataset`: for each its period, extremes, impacts,
        stability, multipliers, section states (NaN beyond its period), and the number of searches
        that `found` it; for each period the statistics of its search. `along`, as in
        `Run.to_xarray`, is `"motion"`, `"search"` (the periods), `"cycle"` or `"multiplier"`."""
        data: dict[str, Any] = {"period": ("motion", self.periods)}
        for name in ("impacts", "duration", "y_min", "y_max", "clearance", "slowest_impact"):
            values = [np.asarray(getattr(orbit, name)) for orbit in self.orbits]
            data[name] = "motion", np.array(values, int if name == "impacts" else float)
        words = [str(in_names(o.stability)) for o in self.orbits]
        data["stability"] = "motion", np.array(words, str)
        states = [components(orbit.sections, 1) for orbit in self.orbits]
        for name in states[0] if states else ():
            rows = zip(states, self.periods, strict=True)
            rows = in_one_array([np.asarray(state[name])[:period] for state, period in rows])
            data[f"section_{name}"] = ("motion", "cycle"), rows
        if states:
            multipliers = np.stack([np.asarray(orbit.multipliers) for orbit in self.orbits])
            data["multipliers"] = ("motion", "multiplier"), multipliers
            data["total_found"] = "motion", self.found.sum(axis=1)
            data["found"] = ("motion", "search"), self.found
        for name in ("cycles", "starts", "simulated", "converged", "motions", "once", "unseen",
                     "detectable", "still"):  # fmt: skip
            values = [getattr(searched, name) for searched in self.searched]
            data[f"search_{name}"] = "search", np.array(values)
        return tidy(with_units(xr.Dataset(data), units_of(self.machine), {}), along)

    def __repr__(self) -> str:
        count, stable = len(self.orbits), int(self.stable.sum())
        longest = max(searched.cycles for searched in self.searched)
        lines = [
            f"{count_of(count, 'periodic motion')} of at most "
            f"{cycles_in_words(self.machine, longest)}, {stable} of them stable"
        ]
        for orbit, found in zip(self.orbits, self.found, strict=True):
            lines.append(f"{in_one_line(orbit)}; found {count_of(found.sum(), 'time')}")
        where = ", ".join(f"{name} in [{a:g}, {b:g}]" for name, (a, b) in self.region.items())
        lines.append(f"searched from random starts, {where}:")
        for s in self.searched:
            invalid = s.starts - s.simulated
            note = f" ({invalid:,} could not be simulated)" if invalid else ""
            line = (
                f"  {cycles_in_words(self.machine, s.cycles)}: {s.converged:,} of {s.starts:,} "
                f"searches converged{note}, on {s.motions}"
            )
            if s.still:
                line += f", {s.still:,} ended at an equilibrium"
            if s.converged:
                line += (
                    f"; of further such searches about {100 * s.unseen:.2g} % find others (none "
                    f"likely gets more than {100 * s.detectable:.2g} %)"
                )
            lines.append(line)
        return "\n".join(lines)


@host_side
@warning_once
def all_orbits(
    machine: AbstractMachine,
    cycles: int = 6,
    *,
    region: Mapping[str, tuple[float, float]],
    starts: int = 1024,
    seed: int = 0,
    tolerance: float = 1e-6,
    start: State = None,
    root_finder: AbstractRootFinder | None = None,
    method: MethodLike = None,
) -> AllOrbits:
    """Find the periodic motions up to a number of cycles, stable and unstable.

    For each period of 1 to `cycles` drive cycles `find_orbit` searches from random starts, all in
    one compiled call. The results are sorted into different motions with their least periods. A
    random search may miss orbits. The result has the number of searches, of those that converged,
    and the probability that the next one finds a new orbit (Good–Turing estimate). Host-side: not
    to be traced; one compiled program for each period.

    **Arguments:**

    - `machine`: the machine.
    - `cycles`: the longest period.
    - `region`: ranges of components of the start, such as
      `{"start.Y": (-4, 2), "start.V": (-4, 4)}`, on the machine's section.
    - `starts`: the number of random starts for each period, uniform in the region (with `seed`).
    - `tolerance`: as for `distinct_orbits`.
    - `start`: a state on the section with the components that are not in the region; by default
      `machine.start()`.
    - `root_finder`, `method`: as for `find_orbit`.

    **Returns:** `AllOrbits`.

    **Raises:** `ValueError` or `TypeError` for unusable arguments; on Ctrl-C `Interrupted`, whose
    `partial` has the finished periods, if there are any.
    """
    machine, cycles = machine_of(machine), count("cycles", cycles, least=1)
    starts, seed = count("starts", starts, least=1), count("seed", seed)
    tolerance = given_number("tolerance", tolerance, low=0.0)
    begin = machine.start() if start is None else start
    # Each period has its own random starts, so that those of shorter periods stay the same.
    rows = [starts_in(region, machine, begin, 1, starts, (seed, n)) for n in range(1, cycles + 1)]
    ranges = {name: (float(low), float(high)) for name, (low, high) in region.items()}

    def step(_, piece):
        n, row = piece
        guesses = jax.vmap(functools.partial(start_with, begin))(row)
        return None, find_orbit(machine, guesses, n, root_finder=root_finder, method=method)

    def joined(_, batches: list[Orbit]) -> AllOrbits:
        return _combined(machine, batches, tolerance, ranges)

    pieces = ((1, piece) for piece in enumerate(rows, 1))
    return in_parts("search for periodic motions", step, None, pieces, joined, progress=False)


def _combined(
    machine: AbstractMachine, batches: list[Orbit], tolerance: float,
    region: dict[str, tuple[float, float]],
) -> AllOrbits:  # fmt: skip
    """Return the different motions in the results of searches for 1, 2, … cycles."""
    orbits, found = distinct_among(batches, tolerance)
    searched = tuple(
        Searched(
            cycles=n,
            starts=int(batch.residual.size),
            simulated=int(np.isfinite(np.asarray(batch.residual)).sum()),
            converged=int(column.sum()),
            motions=int((column > 0).sum()),
            once=int((column == 1).sum()),
            still=int((np.asarray(batch.result == ORBIT_RESULTS.equilibrium)).sum()),
        )
        for n, (batch, column) in enumerate(zip(batches, found.T, strict=True), 1)
    )
    return AllOrbits(orbits, found, searched, region, machine)
