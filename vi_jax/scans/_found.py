"""What a search for basins found: the motions, which start goes to which, how the basins lie."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from .._checks import count, given_number, require
from .._messages import so_many
from .._types import xr
from ..flow import REASON_NAMES, tidy
from ..machine import AbstractMachine, attributes, state_in_words, summary_table, unit_of
from ._geometry import (
    BasinEntropy,
    Cells,
    Uncertainty,
    ball_around,
    entropy_of,
    largest_ball,
    uncertainty_of,
)
from ._shaken import START

_BEYOND = REASON_NAMES.index("bad_start")


class Attractor(NamedTuple):
    """A motion on which starts have ended."""

    label: int
    period: int
    """Period in drive cycles."""
    impacts: float
    """Impacts in a period."""
    sections: dict[str, np.ndarray]
    """Its section states, arrays of shape (period,)."""
    starts: int
    """Number of starts that ended on it."""
    fraction: float
    """Part of all starts."""
    error: float
    """Standard error of `fraction` for random starts, √(p(1 - p)/N); on a grid it is an upper
    estimate."""


class Integrity(NamedTuple):
    """Measures of the basin of a motion, after Soliman and Thompson (1989), and Lenci and Rega
    (2003). Distances are in the given `scales`."""

    label: int
    """Which motion: `attractors[label]`."""
    local: float
    """Local integrity measure: radius of the largest ball of starts around the motion that all
    settle on it, the least over its sections; NaN if none of them lies in the region."""
    sections: np.ndarray
    """The same of each section state; shape (period,), NaN outside of the region."""
    factor: float
    """Integrity factor: radius of the largest ball of such starts anywhere in the region."""
    centre: dict[str, float]
    """Its centre, by the names of the region."""
    local_at_edge: bool
    """Whether the edge of the region is what ends the ball of `local`: a larger region might give a
    larger one."""
    factor_at_edge: bool
    """Whether the edge of the region ends the ball of `factor`."""
    resolution: float
    """What the radii may be off by: half a diagonal of the grid's cells."""


class Basins(NamedTuple):
    """Basins of attraction: which motion each start settles on, and the motions themselves."""

    data: "xr.Dataset"
    """`label` over the region (or over `sample`): a number in `attractors`, or below 0 for
    what is on none (`label.attrs` says which); `period`, `impacts`, `result`, and a section state
    on which the lane ended."""
    attractors: list[Attractor]
    """The periodic motions, the largest basin first: label i is `attractors[i]`."""
    irregular: dict[str, float]
    """Fractions of the starts that ended on no periodic motion: chaotic, unsettled, failed,
    transient (transiently chaotic, see `Regime`)."""
    machine: AbstractMachine | None = None
    """What moves; its words name the periods."""

    def period_of(self, cycles: int) -> str:
        """A duration of so many cycles, in the words of the machine."""
        return f"{2 * cycles}π" if self.machine is None else self.machine.period_of(cycles)

    def integrity(self, *, scales: Mapping[str, float] | None = None) -> list[Integrity]:
        """How far the starts of each motion reach: the largest ball of them around the motion, and
        anywhere.

        A ball ends at a cell whose start settles elsewhere, or nowhere, and at the edge of the
        region. A stop ends no ball, since no start lies beyond it: neither a start that would, nor
        an edge that lies on a stop. Balls lie within the region's components: if other states of a
        motion differ from those of the starts, sections count by their place in the region.

        **Arguments:** `scales`, what counts as distance 1 along parts of the start, such as
        `{"start.V": 2.0}`; 1 where left out.

        **Returns:** an `Integrity` for each of `attractors`.

        **Raises:** `ValueError` if the starts lie on no grid, or for scales of other components.
        """
        label, there, names = self._grid()
        given = {} if scales is None else dict(scales)
        for name, scale in given.items():
            if name not in names:
                raise ValueError(f"Argument `scales` must name {names}, but names {name!r}.")
            given_number("scales", scale, low=0.0, open_low=True)
        scale = np.array([float(given.get(name, 1.0)) for name in names])
        at_stop = self.data["label"].attrs.get("at_stop", ())
        ends = [[f"{name} {side}" not in at_stop for side in ("low", "high")] for name in names]
        centres = [np.asarray(self.data[name], float) for name in names]
        cells = Cells(centres, scale, np.array(ends))
        resolution = 0.5 * float(np.linalg.norm(cells.widths / scale))
        found = []
        for a in self.attractors:
            foreign = there & (label != a.label)
            points = np.stack([a.sections[name.removeprefix(START)] for name in names], axis=1)
            balls = [ball_around(x, foreign, cells) for x in points]
            around = np.array([x.radius for x in balls])
            local, cut = np.nan, False
            if not np.isnan(around).all():
                least = int(np.nanargmin(around))
                local, cut = float(around[least]), balls[least].at_edge
            ball = largest_ball(there & (label == a.label), foreign, cells)
            centre = dict(zip(names, ball.centre.tolist(), strict=True))
            parts = (a.label, local, around, ball.radius, centre, cut, ball.at_edge, resolution)
            found.append(Integrity(*parts))
        return found

    def entropy(self, *, box: int = 5) -> BasinEntropy:
        """Basin entropy and boundary basin entropy: how uncertain the outcome is in a small box of
        starts. Chaotic, unsettled and failed count as outcomes; starts beyond a stop are left out.

        **Arguments:** `box`, starts along each side of a box.

        **Raises:** `ValueError` if the starts lie on no grid, or on fewer than `box` along an axis.
        """
        label, there, _ = self._grid()
        box = count("box", box, least=2, most=min(label.shape))
        return entropy_of(label, box=box, there=there)

    def uncertainty(self, *, confidence: float = 0.95) -> Uncertainty:
        """Uncertainty exponent of the basins' boundaries: how slowly the part of uncertain starts
        shrinks as starts are known better. It is 1 for smooth boundaries.

        It is measured between 1 cell and a sixteenth of the grid, 3 cells at least. Its interval is
        the uncertainty by the grid: some ±0.05 at 512 starts along each of two axes.

        **Arguments:** `confidence` of the intervals.

        **Raises:** `ValueError` if the starts lie on no grid, or on fewer than 16 along an axis.
        """
        require("confidence", confidence, low=0.0, high=1.0, open_low=True, open_high=True)
        label, there, _ = self._grid()
        if min(label.shape) < 16:
            raise ValueError(
                "An uncertainty exponent needs 16 starts at least along each axis, but there are "
                f"{min(label.shape)}."
            )
        return uncertainty_of(label, confidence=float(confidence), there=there)

    def _grid(self) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Labels on the grid of the starts, which of these can be at all, the names of its axes."""
        label = self.data["label"]
        names = [str(name) for name in label.dims]
        if names == ["sample"] or min(label.shape) < 2:
            raise ValueError(
                "The geometry of basins needs starts on a grid, two at least along each axis, but "
                f"there are {dict(label.sizes)}: ask `basins` for a `resolution`."
            )
        return np.asarray(label), np.asarray(self.data["result"]) != _BEYOND, names

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """These basins as an `xarray.Dataset`: `data`, and of each motion `motion_period`,
        `motion_impacts`, `motion_starts`, `motion_fraction`, `motion_error` and its section states
        (`motion_Y`, NaN beyond its period). A `label` from 0 on is a place along `motion`.

        **Arguments:** `along`, to keep only what lies along one dimension: `"motion"`, `"cycle"`
        (their section states), or the last axis of the starts for `data`.

        **Raises:** `ValueError` if there is no such dimension.
        """
        variables = {}
        for name in ("period", "impacts", "starts", "fraction", "error"):
            values = [getattr(a, name) for a in self.attractors]
            variables[f"motion_{name}"] = "motion", np.asarray(values)
        longest = max((a.period for a in self.attractors), default=0)
        units = {} if self.machine is None else self.machine.units
        for name in self.attractors[0].sections if self.attractors else ():
            rows = np.full((len(self.attractors), longest), np.nan)
            for row, a in zip(rows, self.attractors, strict=True):
                row[: a.period] = a.sections[name]
            about = attributes(unit_of(units, name))
            variables[f"motion_{name}"] = ("motion", "cycle"), rows, about
        return tidy(self.data.assign(variables), along)

    def __str__(self) -> str:
        units = {} if self.machine is None else self.machine.units
        lines = [f"Basins of {so_many(len(self.attractors), 'periodic motion')}"]
        for a in self.attractors:
            where = state_in_words({name: x[0] for name, x in a.sections.items()}, 6, units)
            lines.append(
                f"  {a.label}: period {self.period_of(a.period)}, "
                f"{so_many(round(a.impacts), 'impact')}, {where}: "
                f"{100 * a.fraction:.2f} ± {100 * a.error:.2f} %"
            )
        lines += [f"  {name}: {100 * x:.2f} %" for name, x in self.irregular.items() if x]
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return summary_table(str(self))
