"""`basins`: the motion that each start settles on; `integrity_profile`: the erosion of basins."""

import dataclasses
import difflib
import inspect
import itertools
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._checks import axes_of, count, fits_records, given_number, host_side, on_host
from .._messages import at_work, count_of, warning_once
from .._types import State, xr
from ..flow import (
    REASON_NAMES,
    AbstractMethod,
    MethodLike,
    check_start,
    chosen,
    machine_of,
    simulate,
    sizes_on_host,
    tidy,
)
from ..machine import (
    AbstractMachine,
    angles_in,
    attributes,
    begun,
    check_leaf,
    components,
    cycles_in_words,
    has_delays,
    in_rows,
    in_words,
    is_angle,
    machine_of_chain,
    modes_of,
    near_names,
    nearest_images,
    state_in_words,
    unit_of,
    units_of,
    with_leaf,
    with_leaves,
    with_modes,
    without_modes,
)
from ..orbit import MotionSections, index_of
from . import _geometry as geometry
from ._scan import LanesFailed, place_in_words, scan
from .measures import CODES, REGIMES, Regime, Sections, flags, legends
from .program import START, check_leaf_name, start_with

_BEYOND = REASON_NAMES.index("bad_start")


class Attractor(NamedTuple):
    """A motion on which starts settle."""

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
    """Share of all starts."""
    error: float
    """Standard error of `fraction` for random starts, √(p(1 - p)/N); on a grid it is an upper
    estimate."""
    modes: tuple[np.ndarray, ...] = ()
    """The machine's own modes on its sections, arrays of shape (period,)."""

    def __repr__(self) -> str:
        return in_words(self)


class Integrity(NamedTuple):
    """Measures of the basin of a motion, after Soliman and Thompson (1989), and Lenci and Rega
    (2003). Distances are in the given `scales`."""

    label: int
    """The index of the motion in `attractors`."""
    local: float
    """Local integrity measure: radius of the largest ball of starts around the motion that all
    settle on it, the least over its sections; NaN if none of them lies in the region."""
    sections: np.ndarray
    """The radius for each section state; shape (period,), NaN outside of the region."""
    factor: float
    """Integrity factor: radius of the largest ball of such starts anywhere in the region."""
    centre: dict[str, float]
    """Its centre, by the names of the region."""
    local_at_edge: bool
    """True if the edge of the region limits the ball of `local`: it may be larger."""
    factor_at_edge: bool
    """True if the edge of the region limits the ball of `factor`."""
    resolution: float
    """The uncertainty of the radii: half a diagonal of the grid's cells."""

    def __repr__(self) -> str:
        return in_words(self)


class Basins(NamedTuple):
    """Basins of attraction: the motion that each start settles on, and these motions."""

    data: "xr.Dataset"
    """`label` over the region (or over `sample`): an index into `attractors`, or negative for
    starts that settle on no periodic motion (`label.attrs` has the reasons); `period`, `impacts`,
    `result`, and a section state at the end of the lane."""
    attractors: list[Attractor]
    """The periodic motions, the largest basin first: label i is `attractors[i]`."""
    irregular: dict[str, float]
    """Shares of the starts that settle on no periodic motion: chaotic, unsettled, failed, transient
    (transiently chaotic, see `Regime`)."""
    machine: AbstractMachine
    """The machine with these basins, for names of periods."""

    def period_of(self, cycles: int) -> str:
        """Return the duration of a number of cycles, in the words of the machine."""
        return cycles_in_words(self.machine, cycles)

    def integrity(self, *, scales: Mapping[str, float] | None = None) -> list[Integrity]:
        """Return the largest ball of starts of each motion, around the motion and anywhere.

        A ball ends at a cell whose start settles elsewhere, or on no motion, and at the edge of the
        region. A stop does not limit a ball, since no start lies beyond it. The range of an angle
        of `wrap_angles` has no edge if it is a whole turn. Balls lie within the region's
        components: if other components of a motion differ from those of the starts, its sections
        are projected into the region.

        **Arguments:** `scales`, the unit of distance along components of the start, such as
        `{"start.V": 2.0}`; 1 by default.

        **Returns:** an `Integrity` for each of `attractors`.

        **Raises:** `ValueError` if the starts lie on no grid, or for scales of other components.
        """
        label, is_start, names = self._grid()
        scale = _scales_along(names, scales)
        at_stop = self.data["label"].attrs.get("at_stop", ())
        ends = [[f"{name} {side}" not in at_stop for side in ("low", "high")] for name in names]
        centres = [np.asarray(self.data[name], float) for name in names]
        angles = [is_angle(self.machine, name.removeprefix(START)) for name in names]
        cells = geometry.Cells(centres, scale, np.array(ends), np.array(angles))
        cells = cells._replace(ends=cells.ends & ~cells.round[:, None])
        resolution = 0.5 * float(np.linalg.norm(cells.widths / scale))
        found = []
        for a in self.attractors:
            foreign = is_start & (label != a.label)
            points = np.stack([a.sections[name.removeprefix(START)] for name in names], axis=1)
            balls = [geometry.ball_around(cells.inside(x), foreign, cells) for x in points]
            around = np.array([x.radius for x in balls])
            local, at_edge = np.nan, False
            if not np.isnan(around).all():
                least = int(np.nanargmin(around))
                local, at_edge = float(around[least]), balls[least].at_edge
            ball = geometry.largest_ball(is_start & (label == a.label), foreign, cells)
            centre = dict(zip(names, ball.centre.tolist(), strict=True))
            parts = (a.label, local, around, ball.radius, centre, at_edge, ball.at_edge, resolution)
            found.append(Integrity(*parts))
        return found

    def entropy(self, *, box: int = 5) -> geometry.BasinEntropy:
        """Return basin entropy and boundary basin entropy: the uncertainty of the outcome in a box
        of starts. Chaotic, unsettled and failed are outcomes; starts beyond a stop are left out.

        **Arguments:** `box`, starts along each side of a box.

        **Raises:** `ValueError` if the starts lie on no grid, or on fewer than `box` along an axis.
        """
        label, is_start, _ = self._grid()
        box = count("box", box, least=2, most=min(label.shape))
        return geometry.entropy_of(label, box=box, is_start=is_start)

    def uncertainty(self) -> geometry.Uncertainty:
        """Return the uncertainty exponent of the basins' boundaries: the power of the error of the
        starts with which the share of uncertain starts decreases. It is 1 for smooth boundaries.

        It is measured between 1 cell and a sixteenth of the grid, 3 cells at least. Its error
        due to the grid is about 0.05 at 512 starts along each of two axes.

        **Raises:** `ValueError` if the starts lie on no grid, or on fewer than 16 along an axis.
        """
        label, is_start, _ = self._grid()
        if min(label.shape) < 16:
            raise ValueError(
                "An uncertainty exponent needs 16 starts at least along each axis, but there are "
                f"{min(label.shape)}."
            )
        return geometry.uncertainty_of(label, is_start=is_start)

    def _grid(self) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Return labels on the grid, flags of starts not beyond a stop, and names of the axes."""
        label = self.data["label"]
        names = [str(name) for name in label.dims]
        if names == ["sample"] or min(label.shape) < 2:
            raise ValueError(
                "The geometry of basins needs starts on a grid, two at least along each axis, but "
                f"there are {dict(label.sizes)}. Pass `resolution` to `basins`."
            )
        return np.asarray(label), np.asarray(self.data["result"]) != _BEYOND, names

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """Return the basins as an `xarray.Dataset`: `data`, and for each motion `motion_period`,
        `motion_impacts`, `motion_starts`, `motion_fraction`, `motion_error` and its section states
        (`motion_Y`, NaN beyond its period). A nonnegative `label` is an index along `motion`.
        `along`, as in `Run.to_xarray`, is `"motion"`, `"cycle"` (section states), or the last axis
        of the starts."""
        variables = {}
        for name in ("period", "impacts", "starts", "fraction", "error"):
            values = [getattr(a, name) for a in self.attractors]
            variables[f"motion_{name}"] = "motion", np.asarray(values)
        for name in self.attractors[0].sections if self.attractors else ():
            rows = in_one_array([a.sections[name] for a in self.attractors])
            about = attributes(unit_of(units_of(self.machine), name))
            variables[f"motion_{name}"] = ("motion", "cycle"), rows, about
        return tidy(self.data.assign(variables), along)

    def __repr__(self) -> str:
        lines = [f"Basins of {count_of(len(self.attractors), 'periodic motion')}"]
        is_chain = machine_of_chain(self.machine) is not None
        for a in self.attractors:
            parts = a.sections.items()
            first = {x: y[0] for x, y in parts if not (is_chain and x.startswith("history"))}
            where = state_in_words(first, 6, units_of(self.machine))
            lines.append(
                f"  {a.label}: period {self.period_of(a.period)}, "
                f"{count_of(round(a.impacts), 'impact')}, {where}: "
                f"{100 * a.fraction:.2f} ± {100 * a.error:.2f} %"
            )
        for name, share in self.irregular.items():
            if share:
                why = f" ({self._reasons()})" if name == "failed" else ""
                lines.append(f"  {name}: {100 * share:.2f} %{why}")
        return "\n".join(lines)

    def _reasons(self) -> str:
        failed = np.asarray(self.data["label"]) == int(REGIMES.failed)
        numbers = np.unique(np.asarray(self.data["result"])[failed]).astype(int)
        return ", ".join(REASON_NAMES[i] for i in numbers)


def in_one_array(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Return rows of several lengths as one array, shorter ones filled with NaN."""
    return np.array([*itertools.zip_longest(*rows, fillvalue=np.nan)], float).T


def _scales_along(names: Sequence[str], scales: Mapping[str, float] | None) -> np.ndarray:
    """Return the units of distance along these axes. **Raises:** as `Basins.integrity`."""
    given = {} if scales is None else dict(scales)
    for name, scale in given.items():
        if name not in names:
            raise ValueError(f"Argument `scales` must name {list(names)}, but names {name!r}.")
        given_number("scales", scale, low=0.0, open_low=True)
    return np.array([float(given.get(name, 1.0)) for name in names])


# Options of `scan` that the functions of this file set themselves, or that leave no period to find.
_RESERVED = {"measure", "paired", "cycles", "derivatives", "axes", "noise", "key"}


class _Mark(Sections):
    """The one of the last section states with the greatest position, equal on each motion, and the
    machine's own modes there."""

    def described(self, start):
        return {name: {"unit_of": name} for name in components(start)}

    def __call__(self, machine, run):
        highest = jnp.argmax(jax.vmap(machine.position)(run.sections)[-self.number :])
        modes = {f"mode_{i}": x[-self.number :] for i, x in enumerate(run.modes)}
        return {name: x[highest] for name, x in (super().__call__(machine, run) | modes).items()}


@dataclasses.dataclass(frozen=True)
class _Mapper:
    """A mapper from starts to the motions on which they settle, with the arguments of `basins`."""

    start: State
    """The components of the starts that do not vary; by default those of the machine's own."""
    settle: int
    longest: int
    tolerance: float | None
    apart: float
    method: AbstractMethod

    def __post_init__(self):
        given_number("apart", self.apart, low=0.0, open_low=True)

    def begin_of(self, machine: AbstractMachine) -> State:
        return machine.start() if self.start is None else self.start

    def scan(
        self, machine: AbstractMachine, axes: Mapping[str, Any], **options: Any
    ) -> "xr.Dataset":
        """Simulate from starts on axes until their motions have settled."""
        measures = Regime(longest=self.longest, tolerance=self.tolerance), _Mark(self.longest)
        given: Any = {"start": self.start, "settle": self.settle, "method": self.method}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LanesFailed)
            return scan(machine, axes, measure=measures, **given, **options)

    def basins_in(self, data: "xr.Dataset", machine: AbstractMachine) -> Basins:
        """Return the basins in the result of `scan`."""
        begin = self.begin_of(machine)
        label, motions = self._sorted(data, machine)
        impacts = np.asarray(data["impacts"]).ravel()
        attractors = []
        for number, motion in enumerate(motions):
            on_motion = label == number
            share = float(np.mean(on_motion))
            attractors.append(Attractor(
                label=number,
                period=len(motion.states),
                impacts=float(np.median(impacts[on_motion])),
                sections=dict(zip(components(begin), motion.states.T, strict=True)),
                modes=tuple(motion.modes.T),
                starts=int(np.sum(on_motion)),
                fraction=share,
                error=math.sqrt(share * (1 - share) / label.size),
            ))  # fmt: skip
        parts = {name: float(np.mean(label == number)) for name, number in CODES.items()}
        about = {"long_name": "motion that the start settles on", **flags(CODES)}
        about["at_stop"] = _edges_at_stop(data, machine, begin)
        period = data["period"]
        kind = np.min_scalar_type(-max(4, len(motions)))
        data = data.assign(label=(period.dims, label.astype(kind).reshape(period.shape), about))
        data.attrs |= legends(data)
        return Basins(data, attractors, parts, machine)

    def _sorted(
        self, data: "xr.Dataset", machine: AbstractMachine
    ) -> tuple[np.ndarray, list[MotionSections]]:
        """Return the label of each lane, and each motion's sections, most lanes first."""
        begin, period = self.begin_of(machine), np.asarray(data["period"]).ravel()
        states, modes = _last_sections(data, machine, begin)
        label = np.where(np.isin(period, list(REGIMES)), period, int(REGIMES.failed)).astype(int)
        settled = np.flatnonzero(period > 0)
        if not settled.size:
            return label, []
        axes = [START + name for name in components(begin)]
        starts = [float(np.abs(data[x]).max()) if x in data.coords else 0.0 for x in axes]
        unit = sizes_on_host(machine, begin, np.vstack([states[settled], starts]))
        # Lanes on one motion lie in few cells. A result for one of them holds for all.
        cells = np.floor(states[settled] / (unit * self.apart)).astype(np.int64)
        cells = np.column_stack([period[settled].astype(np.int64), modes[settled], cells])
        _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
        motions: list[MotionSections] = []
        motion_of_cell, angles = np.empty(first.size, int), angles_in(machine, begin)
        for i, lane in enumerate(settled[first]):
            cycles, here = int(period[lane]), (states[lane], modes[lane])
            motion_of_cell[i] = index_of(motions, cycles, *here, self.apart)
            if motion_of_cell[i] == len(motions):
                sections = self._sections_from(data, machine, int(lane), cycles, *here)
                motions.append(MotionSections(*sections, unit, angles))
        found = motion_of_cell[inverse.ravel()]
        order = np.argsort(-np.bincount(found), kind="stable")
        label[settled] = np.argsort(order)[found]
        return label, [motions[i] for i in order]

    def _sections_from(
        self, data: "xr.Dataset", machine: AbstractMachine, lane: int, cycles: int,
        state: np.ndarray, modes: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Return states and modes on the sections of a lane's motion from its last state on."""
        begin, settle = self.begin_of(machine), 0
        values = dict(zip(components(begin), state, strict=True))
        start = with_modes(with_leaves(without_modes(begin), values), tuple(modes))
        if has_delays(machine):  # the state alone is not a point of the motion
            start, settle = _start_of_lane(data, begin, lane), self.settle
        # The same number of cycles for all periods, for one compiled program.
        run = simulate(machine, start, self.longest, settle=settle, method=self.method)
        modes_there = np.reshape(run.modes, (-1, self.longest + 1)).T
        return in_rows(on_host(run.sections))[1 : cycles + 1], modes_there[1 : cycles + 1]


def _last_sections(
    data: "xr.Dataset", machine: AbstractMachine, begin: State
) -> tuple[np.ndarray, np.ndarray]:
    """Return the last section state of each lane and the machine's modes there, in rows."""
    row = lambda name: np.asarray(data[name]).ravel()
    states = np.stack([row(name) for name in components(begin)], axis=1)
    modes = [row(f"mode_{i}") for i in range(len(modes_of(begun(machine, begin)) or ()))]
    return states, np.reshape(modes, (-1, len(states))).T


@host_side
@warning_once
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
    progress: bool = True,
    **options: Any,
) -> Basins:
    """Find the motions that starts in a region settle on, and the motion of each start.

    No motion must be known in advance. The final motion of each start is compared with those found
    so far, including phase shifts, and a new one is added if needed. Starts beyond a stop count as
    failed.

    **Arguments:**

    - `machine`: the machine.
    - `region`: ranges of components of the start, such as
      `{"start.Y": (-4, 2), "start.V": (-4, 4)}`.
    - `resolution`: starts along each of them, on a grid that fills the range (cell centres).
    - `samples`: the number of random starts instead of the grid, uniform in the region (with
      `seed`), for fractions with a standard error.
    - `settle`: drive cycles before the motion is classified.
    - `longest`, `tolerance`: as in `Regime`.
    - `apart`: section states farther apart than this belong to different motions; relative to the
      size of each number, as in `Regime`.
    - `method`, `start`, `progress`, and further options: as for `scan` (`store` to resume).

    **Returns:** `Basins`.

    **Raises:** as `scan`; on Ctrl-C `Interrupted`, whose `partial` has the final period and
    section state of each start that was simulated.
    """
    machine = machine_of(machine)
    _check_options(basins, options, ())
    mapper = _Mapper(start, settle, longest, tolerance, apart, chosen(machine, method))
    begin = mapper.begin_of(machine)
    axes = starts_in(region, machine, begin, resolution, samples, count("seed", seed))
    data = mapper.scan(machine, axes, paired=samples is not None, progress=progress, **options)
    where = place_in_words(options.get("store"))
    with at_work("sorting", lambda: data, progress=False, where=where):
        return mapper.basins_in(data, machine)


def _edges_at_stop(data: "xr.Dataset", machine: AbstractMachine, begin: object) -> list[str]:
    """Return edges of the region at a stop, such as `"start.Y high"`: in the middle of each edge, a
    start just inside is possible, and one just beyond is not."""
    rows = {str(name): np.asarray(data[name]) for name in data["period"].dims}
    found = []
    for name, row in rows.items():
        if not name.startswith(START) or row.size < 2:
            continue
        half = 0.5 * (row[1] - row[0])
        for side, edge, outward in (("low", row[0] - half, -half), ("high", row[-1] + half, half)):
            middle = {other: 0.5 * (x[0] + x[-1]) for other, x in rows.items()}
            inside, beyond = ({**middle, name: edge + x * outward} for x in (-1e-3, 1e-3))
            if _may_start(machine, begin, inside) and not _may_start(machine, begin, beyond):
                found.append(f"{name} {side}")
    return found


def _may_start(machine: AbstractMachine, begin: object, values: Mapping[str, float]) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            check_start(machine, start_with(begin, values))
        except ValueError:
            return False
    return True


def _check_options(
    verb: Callable[..., Any], options: Mapping[str, Any], refused: Iterable[str]
) -> None:
    function = verb.__name__
    parameters, of_scan = ({*inspect.signature(x).parameters} - {"options"} for x in (verb, scan))
    for name in options:
        if name in {*_RESERVED, *refused}:
            raise TypeError(f"Argument `{name}` must not be given to `{function}`.")
        if name not in of_scan:
            near = difflib.get_close_matches(name, sorted(parameters | of_scan - _RESERVED))
            hint = f"near names: {', '.join(near)}" if near else f"see `help(vi_jax.{function})`"
            raise TypeError(f"`{function}` has no argument `{name}`; {hint}.")


def starts_in(
    region: Mapping[str, tuple[float, float]],
    machine: AbstractMachine,
    begin: State,
    resolution: int | tuple[int, ...],
    samples: int | None,
    seed: int | tuple[int, ...],
) -> dict[str, np.ndarray]:
    """Return the starts in a region as axes of a scan: those of a grid, or random ones in pairs."""
    ranges = axes_of(region, "region")
    names = [START + name for name in components(without_modes(begin))]
    for name, row in ranges.items():
        if not name.startswith(START):
            raise ValueError(
                f"Argument `region` must name numbers of the start, but names {name!r}; "
                f"{near_names(name, names)}."
            )
        if row.size != 2 or not row[0] < row[1]:
            raise ValueError(
                "Argument `region` must give ranges (low, high), low < high, but got "
                f"{region[name]!r} for {name!r}."
            )
        check_leaf_name(machine, begin, name, "region", None)
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


def _start_of_lane(data: "xr.Dataset", begin: State, lane: int) -> State:
    names = [START + name for name in components(begin)]
    period, axes = data["period"], [name for name in names if name in data.coords]
    rows = {name: data[name].broadcast_like(period).transpose(*period.dims) for name in axes}
    return start_with(begin, {name: float(x.values.ravel()[lane]) for name, x in rows.items()})


# Sections of a motion move less than this share of the region between two values. A choice.
_LARGEST_MOVE = 0.25

# The variables of each motion at each value, with their values if it does not exist.
_NUMBERS = {
    "share": 0.0, "error": 0.0, "local": np.nan, "factor": np.nan,
    "local_at_edge": False, "factor_at_edge": False,
}  # fmt: skip


class IntegrityProfile(NamedTuple):
    """Basins over one parameter of a machine: the share and the integrity of each motion, also
    called an erosion profile. The steep decrease is Thompson's Dover cliff.

    A motion is the same as one at an earlier value if its period and number of impacts are equal.
    Its sections must differ from the last ones by less than a quarter of the region.
    """

    parameter: str
    values: np.ndarray
    """The values in rising order; shape (values,)."""
    period: np.ndarray
    """The period of each motion in drive cycles; shape (motions,), most starts first."""
    impacts: np.ndarray
    """The number of impacts in a period; shape (motions,)."""
    label: np.ndarray
    """The index of the motion in `attractors` at each value, -1 if no start settles on it; shape
    (motions, values), as for all below."""
    share: np.ndarray
    """The share of starts that settle on it."""
    error: np.ndarray
    """The standard error of `share`, as in `Attractor`."""
    local: np.ndarray
    """The local integrity measure, as in `Integrity`; NaN if no start settles on the motion, or its
    sections lie outside of the region."""
    factor: np.ndarray
    """The integrity factor; NaN if no start settles on the motion."""
    local_at_edge: np.ndarray
    """True if the edge of the region limits the ball of `local`: it may be larger."""
    factor_at_edge: np.ndarray
    """True if the edge of the region limits the ball of `factor`."""
    resolution: float
    """The uncertainty of the radii; NaN without motions."""
    basins: list[Basins]
    """The basins at each value."""

    @property
    def irregular(self) -> dict[str, np.ndarray]:
        """The shares of starts on no periodic motion, by names of `REGIMES`; shape (values,)."""
        return {name: np.array([x.irregular[name] for x in self.basins])
                for name in self.basins[0].irregular}  # fmt: skip

    def name_of(self, motion: int) -> str:
        """Return a motion in words: its period and its impacts."""
        period = self.basins[0].period_of(int(self.period[motion]))
        return f"{period}, {count_of(round(float(self.impacts[motion])), 'impact')}"

    def to_xarray(self, *, along: str | None = None) -> "xr.Dataset":
        """Return the profile as an `xarray.Dataset` over `motion` and the parameter; `along` is one
        of these, as in `Run.to_xarray`."""
        both = "motion", self.parameter
        unit = unit_of(units_of(self.basins[0].machine), self.parameter)
        variables: dict[str, Any] = {
            name: (both, getattr(self, name)) for name in ("label", *_NUMBERS)
        }
        variables |= {name: (self.parameter, x) for name, x in self.irregular.items()}
        variables |= {"period": ("motion", self.period), "impacts": ("motion", self.impacts)}
        coords = {self.parameter: (self.parameter, self.values, attributes(unit))}
        return tidy(xr.Dataset(variables, coords), along)

    def __repr__(self) -> str:
        low, high = self.values[[0, -1]]
        lines = [
            f"Integrity over {self.parameter}, {self.values.size} values from {low:.6g} to "
            f"{high:.6g}: {count_of(len(self.period), 'motion')}"
        ]
        for i in range(min(len(self.period), 8)):
            present = self.values[self.share[i] > 0]
            best = int(np.argmax(self.share[i]))
            text = (
                f"  {i}: {self.name_of(i)}, {present[0]:.6g} to {present[-1]:.6g}: at most "
                f"{100 * self.share[i, best]:.1f} % at {self.values[best]:.6g}"
            )
            if not np.isnan(self.local[i]).all():
                best = int(np.nanargmax(self.local[i]))
                text += f", local integrity {self.local[i, best]:.4g} at {self.values[best]:.6g}"
            lines.append(text)
        if len(self.period) > 8:
            lines.append(f"  {len(self.period) - 8} further motions")
        return "\n".join(lines)


@host_side
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
    """Compute basins, their shares and their integrity over one parameter (an erosion profile), as
    one scan by one compiled program.

    **Arguments:** `machine`; `parameter`, the name of the number that varies, such as
    `"drive.frequency_ratio"`; its `values`, which are sorted; `scales`, as for `Basins.integrity`;
    all others and further options as for `basins`, with the same starts at each value (`start`: by
    default the machine's own at each value).

    **Returns:** an `IntegrityProfile`.

    **Raises:** as `basins`; `ValueError` for values that are not a row of numbers, or scales of
    names outside of the region.
    """
    machine = machine_of(machine)
    check_leaf(machine, parameter)
    _check_options(integrity_profile, options, ("samples", "seed"))
    row = np.unique(axes_of({parameter: values}, "values")[parameter])
    mapper = _Mapper(start, settle, longest, tolerance, apart, chosen(machine, method))
    axes = starts_in(region, machine, mapper.begin_of(machine), resolution, None, 0)
    for x in axes.values():
        count("resolution", x.size, least=2)
    _scales_along([*axes], scales)
    data = mapper.scan(machine, {parameter: row, **axes}, progress=progress, **options)
    found, integrity = [], []
    with at_work(
        "sorting of basins", lambda: data, progress=progress, unit="value", total=row.size,
        where=place_in_words(options.get("store")),
    ) as report:  # fmt: skip
        for i, value in enumerate(row):
            part = data.isel({parameter: i}).load()
            found.append(mapper.basins_in(part, with_leaf(machine, parameter, value)))
            integrity.append(found[-1].integrity(scales=scales))
            report(1)
    return _profile(parameter, row, axes, found, integrity)


def _profile(
    parameter: str,
    values: np.ndarray,
    axes: Mapping[str, np.ndarray],
    found: list[Basins],
    integrity: list[list[Integrity]],
) -> IntegrityProfile:
    label = _matched(found, axes)
    shape = label.shape
    numbers = {name: np.full(shape, absent) for name, absent in _NUMBERS.items()}
    period, impacts, resolution = np.zeros(shape[0], int), np.zeros(shape[0]), math.nan
    for motion, i in np.argwhere(label >= 0):
        a, measures = found[i].attractors[label[motion, i]], integrity[i][label[motion, i]]
        period[motion], impacts[motion], resolution = a.period, a.impacts, measures.resolution
        numbers["share"][motion, i], numbers["error"][motion, i] = a.fraction, a.error
        for name in ("local", "factor", "local_at_edge", "factor_at_edge"):
            numbers[name][motion, i] = getattr(measures, name)
    order = np.argsort(-numbers["share"].sum(axis=1), kind="stable")
    numbers = {name: x[order] for name, x in numbers.items()}
    return IntegrityProfile(
        parameter, values, period[order], impacts[order], label[order], **numbers,
        resolution=resolution, basins=found,
    )  # fmt: skip


def _matched(found: list[Basins], axes: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the label of each motion at each value, -1 without the motion: (motions, values).
    Attractors of a kind are matched with the last of each motion, the nearest pair first."""
    names = [name.removeprefix(START) for name in axes]
    angles = np.array([is_angle(found[0].machine, name) for name in names])
    widths = np.array([np.ptp(x) * x.size / (x.size - 1) for x in axes.values()])
    last: list[Attractor] = []
    rows: list[np.ndarray] = []
    for i, basins_here in enumerate(found):
        pairs = sorted(
            (_distance(a, b, names, angles, widths), motion, b.label)
            for motion, a in enumerate(last)
            for b in basins_here.attractors
            if a.period == b.period and round(a.impacts) == round(b.impacts)
        )
        free = {b.label for b in basins_here.attractors}
        for step, motion, label in pairs:
            if label in free and rows[motion][i] < 0 and step < _LARGEST_MOVE:
                rows[motion][i] = label
                last[motion] = basins_here.attractors[label]
                free.remove(label)
        for label in sorted(free):
            last.append(basins_here.attractors[label])
            rows.append(np.full(len(found), -1))
            rows[-1][i] = label
    return np.array(rows, int).reshape(len(rows), len(found))


def _distance(
    a: Attractor, b: Attractor, names: list[str], angles: np.ndarray, widths: np.ndarray
) -> float:
    """Return the distance of sections, relative to the widths, at the best shift in phase."""
    x, y = (np.stack([m.sections[name] for name in names], axis=1) for m in (a, b))
    modes = list(zip(a.modes, b.modes, strict=True))
    shifts = (n for n in range(len(y)) if all((c == np.roll(d, n)).all() for c, d in modes))
    shifted = (np.roll(y, n, axis=0) for n in shifts)
    moves = ((np.abs(nearest_images(angles, x, z) - z) / widths).max() for z in shifted)
    return float(min(moves, default=np.inf))
