"""`basins`: which start goes to which motion, the motions found on the way."""

import math
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import count, fits_records, given_number
from .._lazy import lazy
from .._renamed import renamed
from .._types import State
from ..flow import MethodLike, chosen, machine_of, simulate, tidy
from ..machine import (
    AbstractMachine,
    attributes,
    by_name,
    state_in_words,
    summary_table,
    unit_of,
    with_leaf,
)
from ..orbit import impacts_in_words
from ._scan import LanesFailed, ScanInterrupted, scan
from .grid import axes_of
from .measures import AbstractMeasure, Regime
from .program import START
from .regime import CODES, REGIMES, flags

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = lazy("xarray")


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


class Basins(NamedTuple):
    """Basins of attraction."""

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
        many = "" if len(self.attractors) == 1 else "s"
        units = {} if self.machine is None else self.machine.units
        lines = [f"Basins of {len(self.attractors)} periodic motion{many}"]
        for a in self.attractors:
            where = state_in_words({name: x[0] for name, x in a.sections.items()}, 6, units)
            lines.append(
                f"  {a.label}: period {self.period_of(a.period)}, "
                f"{impacts_in_words(round(a.impacts))}, {where}: "
                f"{100 * a.fraction:.2f} ± {100 * a.error:.2f} %"
            )
        lines += [f"  {name}: {100 * x:.2f} %" for name, x in self.irregular.items() if x]
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return summary_table(str(self))


class _Mark(AbstractMeasure):
    """Of the last section states that of greatest position, the same for all lanes on a motion."""

    longest: int = eqx.field(static=True)

    def described(self, start):
        """Each component of the state."""
        return {name: {"unit_of": name} for name in by_name(start)}

    @property
    def cycles(self):
        """As many as are compared."""
        return self.longest

    def __call__(self, machine, run):
        """Of one lane."""
        states = {name: x[-self.longest :] for name, x in by_name(run.sections).items()}
        highest = jnp.argmax(jax.vmap(machine.position)(run.sections)[-self.longest :])
        return {name: x[highest] for name, x in states.items()}


@renamed(scene="machine")
def basins(
    machine: AbstractMachine,
    region: Mapping[str, tuple[float, float]],
    *,
    resolution: int | tuple[int, ...] = 128,
    samples: int | None = None,
    seed: int = 0,
    settle: int = 400,
    longest: int = 64,
    tolerance: float | None = None,
    apart: float = 1e-3,
    method: MethodLike = None,
    start: State = None,
    **options: Any,
) -> Basins:
    """Find the motions that starts in a region settle on, and which start goes to which.

    No motion has to be known before: where each lane has ended is compared with the motions found
    so far, phase shifts included, and a new motion is added where none is near. Starts beyond a
    stop count as failed.

    **Arguments:**

    - `machine`: the machine.
    - `region`: ranges of parts of the start, such as `{"start.Y": (-4, 2), "start.V": (-4, 4)}`.
    - `resolution`: starts along each of them, on a grid that fills the range (cell centres).
    - `samples`: instead of the grid so many random starts, uniform in the region (with `seed`),
      for fractions with a standard error.
    - `settle`: drive cycles before the motion is judged.
    - `longest`, `tolerance`: as in `Regime`.
    - `apart`: section states farther apart than this (relative to 1 + |state|) belong to different
      motions.
    - `method`, `start`, and further options: as for `scan` (`store` to interrupt and resume).

    **Returns:** `Basins`.

    **Raises:** as `scan`; on Ctrl-C `ScanInterrupted`, whose `data` says of each start that was
    followed where it ended (`period`, and a section state).
    """
    machine = machine_of(machine)
    for name in ("measure", "paired", "cycles", "derivatives"):
        if name in options:
            raise TypeError(f"Argument `{name}` is `scan`'s, and not to be given to `basins`.")
    given_number("apart", apart, low=0.0, open_low=True)
    axes = _starts_in(region, resolution, samples, count("seed", seed))
    method = chosen(machine, method)
    measure = (Regime(longest=longest, tolerance=tolerance), _Mark(longest))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LanesFailed)
        data = scan(
            machine, axes, measure=measure, start=start, settle=settle, method=method,
            paired=samples is not None, **options,
        )  # fmt: skip
    begin = machine.start() if start is None else start
    names = list(by_name(begin))

    def followed(state: np.ndarray, cycles: int) -> np.ndarray:
        here = begin
        for name, value in zip(names, state, strict=True):
            here = with_leaf(here, name, value)
        # Always as many cycles, so that another period is not another program.
        run = simulate(machine, here, longest, method=method)
        return np.stack(
            [np.asarray(x)[1 : cycles + 1] for x in by_name(run.sections).values()], axis=1
        )

    try:
        label, motions = _sorted_out(data, names, apart, followed)
    except KeyboardInterrupt:
        raise ScanInterrupted(data, options.get("store")) from None
    impacts = np.asarray(data["impacts"]).ravel()
    attractors = [_attractor(i, m, names, label, impacts) for i, m in enumerate(motions)]
    parts = {name: float(np.mean(label == number)) for name, number in CODES.items()}
    about = {"long_name": "motion that the start settles on", **flags(CODES)}
    period = data["period"]
    kind = np.min_scalar_type(-max(4, len(motions)))
    data = data.assign(label=(period.dims, label.astype(kind).reshape(period.shape), about))
    return Basins(data, attractors, parts, machine)


def _starts_in(
    region: Mapping[str, tuple[float, float]],
    resolution: int | tuple[int, ...],
    samples: int | None,
    seed: int,
) -> dict[str, np.ndarray]:
    """The starts in a region, as axes of a scan: those of a grid, or random ones in pairs.

    **Raises:** `ValueError` or `TypeError` that names the argument.
    """
    ranges = axes_of(region, "region")
    for name, row in ranges.items():
        if not name.startswith(START):
            raise ValueError(
                f'Argument `region` must name parts of the start, "start.Y" and such, but names '
                f"{name!r}."
            )
        if row.size != 2 or not row[0] < row[1]:
            raise ValueError(
                "Argument `region` must give ranges (low, high), low < high, of parts of the "
                f'start, "start.Y" and such, but got {region[name]!r} for {name!r}.'
            )
    if samples is not None:
        samples = count("samples", samples, least=1)
        fits_records("samples", samples, len(ranges))
        rng = np.random.default_rng(seed)
        return {name: rng.uniform(low, high, samples) for name, (low, high) in ranges.items()}
    sizes = resolution if isinstance(resolution, tuple) else (resolution,) * len(ranges)
    if len(sizes) != len(ranges):
        raise ValueError(
            f"Argument `resolution` must be one number or {len(ranges)}, but got {resolution!r}."
        )
    axes = {}
    for (name, (low, high)), size in zip(ranges.items(), sizes, strict=True):
        size = count("resolution", size, least=1)
        axes[name] = low + (high - low) * (np.arange(size) + 0.5) / size
    return axes


def _attractor(
    number: int, motion: np.ndarray, names: list[str], label: np.ndarray, impacts: np.ndarray
) -> Attractor:
    """A motion that starts came to, with its share of them.

    **Arguments:** `number`, its label; `motion`, its section states, (period, states); `names` of
    their components; `label` and `impacts`, of each start the motion it came to and its impacts.
    """
    here = label == number
    fraction = float(np.mean(here))
    return Attractor(
        label=number,
        period=len(motion),
        impacts=float(np.median(impacts[here])),
        sections=dict(zip(names, motion.T, strict=True)),
        starts=int(np.sum(here)),
        fraction=fraction,
        error=math.sqrt(fraction * (1 - fraction) / label.size),
    )


def _sorted_out(
    data: "xr.Dataset",
    names: list[str],
    apart: float,
    followed: Callable[[np.ndarray, int], np.ndarray],
) -> tuple[np.ndarray, list[np.ndarray]]:
    """A label for each lane, and the section states (period, components) of each motion, that of
    the most lanes first.

    **Arguments:** what the scan found; the names of a state's components; how far states of one
    motion may differ; what gives the section states of a motion from one of them and its period.
    """
    period = np.asarray(data["period"]).ravel()
    states = np.stack([np.asarray(data[name]).ravel() for name in names], axis=1)
    label = np.where(np.isin(period, list(REGIMES)), period, int(REGIMES.failed)).astype(int)
    settled = np.flatnonzero(period > 0)
    if not settled.size:
        return label, []
    # Lanes on one motion fall into few cells; what is found for one of them holds for all.
    cells = np.floor(states[settled] / apart).astype(np.int64)
    cells = np.column_stack([period[settled].astype(np.int64), cells])
    _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    motions: list[np.ndarray] = []
    of_cell = np.empty(first.size, int)
    for i, lane in enumerate(settled[first]):
        p, state = int(period[lane]), states[lane]
        for j, motion in enumerate(motions):
            distance = np.abs(motion - state) / (1 + np.abs(state))
            if len(motion) == p and np.min(np.max(distance, axis=1)) <= apart:
                of_cell[i] = j
                break
        else:
            of_cell[i] = len(motions)
            motions.append(followed(state, p))
    found = of_cell[inverse.ravel()]
    order = np.argsort(-np.bincount(found), kind="stable")
    label[settled] = np.argsort(order)[found]
    return label, [motions[i] for i in order]
