"""`integrity_profile`: how basins erode as one number of the machine changes."""

import functools
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .._checks import count, given_number
from .._messages import at_work, so_many, warning_once
from .._types import State, xr
from ..flow import MethodLike, chosen, machine_of, tidy
from ..machine import (
    AbstractMachine,
    attributes,
    check_leaf,
    is_angle,
    nearest_images,
    summary_table,
    unit_of,
    units_of,
    with_leaf,
)
from ._basins import (
    Attractor,
    Basins,
    Integrity,
    check_options,
    followed,
    scales_along,
    sorted_out,
    starts_in,
)
from ._computed import ScanInterrupted
from ._lane_noise import START
from .grid import axes_of

# From one value to the next a section of one motion moves by less than this part of the region.
# A choice.
_MOVES = 0.25

# What is said of each motion at each value, and where there is none.
_NUMBERS = {
    "share": 0.0, "error": 0.0, "local": np.nan, "factor": np.nan,
    "local_at_edge": False, "factor_at_edge": False,
}  # fmt: skip


class IntegrityProfile(NamedTuple):
    """Basins over one number of a machine: the share and the integrity of each motion, also called
    an erosion profile. Thompson's Dover cliff is where they fall off.

    Motions at two neighbouring values count as the same if they have the same period and number of
    impacts, and their sections differ by less than a quarter of the region.
    """

    parameter: str
    values: np.ndarray
    """The values, rising; shape (values,)."""
    period: np.ndarray
    """Period of each motion in drive cycles; shape (motions,), the one of most starts first."""
    impacts: np.ndarray
    """Impacts in a period; shape (motions,)."""
    label: np.ndarray
    """Number of the motion among the `attractors` at each value, -1 where no start settles on it;
    shape (motions, values), as of all below."""
    share: np.ndarray
    """Part of the starts that settle on it, 0 where none does."""
    error: np.ndarray
    """Standard error of `share`, as in `Attractor`."""
    local: np.ndarray
    """Local integrity measure, as in `Integrity`; NaN where no start settles on the motion, or its
    sections lie outside of the region."""
    factor: np.ndarray
    """Integrity factor; NaN where no start settles on the motion."""
    local_at_edge: np.ndarray
    """Whether the edge of the region limits the ball, so that a larger region might give a larger
    one."""
    factor_at_edge: np.ndarray
    """Whether the edge of the region limits the ball of `factor`."""
    resolution: float
    """The uncertainty of the radii; NaN if there is no motion."""
    basins: list[Basins]
    """The basins at each value."""

    @property
    def irregular(self) -> dict[str, np.ndarray]:
        """Parts of the starts that end on no periodic motion, by the names of `REGIMES`; each of
        shape (values,)."""
        return {name: np.array([x.irregular[name] for x in self.basins])
                for name in self.basins[0].irregular}  # fmt: skip

    def name_of(self, motion: int) -> str:
        """A motion in words: its period and its impacts."""
        period = self.basins[0].period_of(int(self.period[motion]))
        return f"{period}, {so_many(round(float(self.impacts[motion])), 'impact')}"

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """This profile as an `xarray.Dataset` over `motion` and the parameter.

        **Arguments:** `along`, to keep only what lies along one of these.

        **Raises:** `ValueError` if there is no such dimension.
        """
        both = "motion", self.parameter
        unit = unit_of(units_of(self.basins[0].machine), self.parameter)
        variables: dict[str, Any] = {
            name: (both, getattr(self, name)) for name in ("label", *_NUMBERS)
        }
        variables |= {name: (self.parameter, x) for name, x in self.irregular.items()}
        variables |= {"period": ("motion", self.period), "impacts": ("motion", self.impacts)}
        coords = {self.parameter: (self.parameter, self.values, attributes(unit))}
        return tidy(xr.Dataset(variables, coords), along)

    def __str__(self) -> str:
        low, high = self.values[[0, -1]]
        lines = [
            f"Integrity over {self.parameter}, {self.values.size} values from {low:.6g} to "
            f"{high:.6g}: {so_many(len(self.period), 'motion')}"
        ]
        for i in range(min(len(self.period), 8)):
            here = self.values[self.share[i] > 0]
            best = int(np.argmax(self.share[i]))
            text = (
                f"  {i}: {self.name_of(i)}, {here[0]:.6g} to {here[-1]:.6g}: at most "
                f"{100 * self.share[i, best]:.1f} % at {self.values[best]:.6g}"
            )
            if not np.isnan(self.local[i]).all():
                best = int(np.nanargmax(self.local[i]))
                text += f", local integrity {self.local[i, best]:.4g} at {self.values[best]:.6g}"
            lines.append(text)
        if len(self.period) > 8:
            lines.append(f"  {len(self.period) - 8} further motions")
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return summary_table(str(self))


@warning_once
def integrity_profile(
    machine: AbstractMachine,
    parameter: str,
    values: object,
    region: Mapping[str, tuple[float, float]],
    *,
    resolution: int | tuple[int, ...] = 64,
    scales: Mapping[str, float] | None = None,
    settle: int = 400,
    longest: int = 64,
    tolerance: float | None = None,
    apart: float = 1e-3,
    method: MethodLike = None,
    start: State = None,
    progress: bool = True,
    **options: Any,
) -> IntegrityProfile:
    """Compute basins, their shares and their integrity over one parameter (an erosion profile).

    All values are one scan, by one compiled program.

    **Arguments:**

    - `machine`, `parameter`: the machine and the name of the number that is changed, such as
      `"drive.frequency_ratio"`.
    - `values`: its values; they are taken in rising order.
    - `region`, `resolution`: as for `basins`; the same starts at each value.
    - `scales`: as for `Basins.integrity`.
    - `settle`, `longest`, `tolerance`, `apart`, `method`, `start`, `progress`, and further options:
      as for `basins` (`start`: by default the machine's own at each value).

    **Returns:** an `IntegrityProfile`.

    **Raises:** as `basins`; `ValueError` for values that are no rising row of numbers, or scales
    of what is not in the region.
    """
    machine = machine_of(machine)
    check_leaf(machine, parameter)
    check_options(integrity_profile, options, ("samples", "seed"))
    given_number("apart", apart, low=0.0, open_low=True)
    row = np.unique(axes_of({parameter: values}, "values")[parameter])
    begin = machine.start() if start is None else start
    axes = starts_in(region, machine, begin, resolution, None, 0)
    for x in axes.values():
        count("resolution", x.size, least=2)
    scales_along([*axes], scales)
    method = chosen(machine, method)
    data = followed(
        machine, {parameter: row, **axes}, longest, tolerance, start=start, settle=settle,
        method=method, progress=progress, **options,
    )  # fmt: skip
    found, integrity = [], []
    kept = functools.partial(ScanInterrupted, data, options.get("store"))
    with at_work("basins", kept, progress=progress, unit="value", total=row.size) as tell:
        for i, value in enumerate(row):
            here = with_leaf(machine, parameter, value)
            begin = here.start() if start is None else start
            part = data.isel({parameter: i}).load()
            one = sorted_out(part, here, begin, apart=apart, longest=longest, method=method)
            found.append(one)
            integrity.append(one.integrity(scales=scales))
            tell(1)
    return _profile(parameter, row, axes, found, integrity)


def _profile(
    parameter: str,
    values: np.ndarray,
    axes: Mapping[str, np.ndarray],
    found: list[Basins],
    integrity: list[list[Integrity]],
) -> IntegrityProfile:
    """The basins at each value sorted by motion."""
    label = _followed(found, axes)
    shape = label.shape
    numbers = {name: np.full(shape, absent) for name, absent in _NUMBERS.items()}
    period, impacts, resolution = np.zeros(shape[0], int), np.zeros(shape[0]), math.nan
    for motion, i in np.argwhere(label >= 0):
        a, reach = found[i].attractors[label[motion, i]], integrity[i][label[motion, i]]
        period[motion], impacts[motion], resolution = a.period, a.impacts, reach.resolution
        numbers["share"][motion, i], numbers["error"][motion, i] = a.fraction, a.error
        for name in ("local", "factor", "local_at_edge", "factor_at_edge"):
            numbers[name][motion, i] = getattr(reach, name)
    order = np.argsort(-numbers["share"].sum(axis=1), kind="stable")
    numbers = {name: x[order] for name, x in numbers.items()}
    return IntegrityProfile(
        parameter, values, period[order], impacts[order], label[order], **numbers,
        resolution=resolution, basins=found,
    )  # fmt: skip


def _followed(found: list[Basins], axes: Mapping[str, np.ndarray]) -> np.ndarray:
    """Which attractor at each value is which motion, -1 for none: (motions, values).

    Of the motions of a kind those nearest to each other are one, the nearest pair first.
    """
    names = [name.removeprefix(START) for name in axes]
    angles = np.array([is_angle(found[0].machine, name) for name in names])
    widths = np.array([np.ptp(x) * x.size / (x.size - 1) for x in axes.values()])
    last: list[Attractor] = []
    rows: list[np.ndarray] = []
    for i, one in enumerate(found):
        pairs = sorted(
            (_distance(a, b, names, angles, widths), motion, b.label)
            for motion, a in enumerate(last)
            for b in one.attractors
            if a.period == b.period and round(a.impacts) == round(b.impacts)
        )
        free = {b.label for b in one.attractors}
        for distance, motion, label in pairs:
            if label in free and rows[motion][i] < 0 and distance < _MOVES:
                rows[motion][i] = label
                last[motion] = one.attractors[label]
                free.remove(label)
        for label in sorted(free):
            last.append(one.attractors[label])
            rows.append(np.full(len(found), -1))
            rows[-1][i] = label
    return np.array(rows, int).reshape(len(rows), len(found))


def _distance(
    a: Attractor, b: Attractor, names: list[str], angles: np.ndarray, widths: np.ndarray
) -> float:
    """How far sections of two motions of one period are apart, as a part of the region's widths,
    by the best shift in phase."""
    x, y = (np.stack([m.sections[name] for name in names], axis=1) for m in (a, b))
    shifted = (np.roll(y, shift, axis=0) for shift in range(len(y)))
    return float(min((np.abs(nearest_images(angles, x, z) - z) / widths).max() for z in shifted))
