"""`basins`: which start goes to which motion, the motions found on the way."""

import difflib
import functools
import inspect
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._checks import count, fits_records, given_number
from .._messages import at_work, warning_once
from .._types import State, xr
from ..flow import AbstractMethod, MethodLike, check_start, chosen, machine_of, simulate
from ..machine import AbstractMachine, components, with_leaf
from ._computed import ScanInterrupted
from ._found import Attractor, Basins
from ._scan import LanesFailed, scan
from ._shaken import START
from .grid import axes_of
from .measures import AbstractMeasure, Regime
from .regime import CODES, REGIMES, flags

# Options of `scan` that verbs which scan starts set themselves.
_SET = {"measure", "paired", "cycles", "derivatives", "axes"}


class _Mark(AbstractMeasure):
    """Of the last section states that of greatest position, the same for all lanes on a motion."""

    longest: int = eqx.field(static=True)

    def described(self, start):
        """Each component of the state."""
        return {name: {"unit_of": name} for name in components(start)}

    @property
    def cycles(self):
        """As many as are compared."""
        return self.longest

    def __call__(self, machine, run):
        """The section with the highest position among the last of one lane."""
        states = {name: x[-self.longest :] for name, x in components(run.sections, 1).items()}
        highest = jnp.argmax(jax.vmap(machine.position)(run.sections)[-self.longest :])
        return {name: x[highest] for name, x in states.items()}


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
    - `method`, `start`, `progress`, and further options: as for `scan` (`store` to interrupt and
      resume).

    **Returns:** `Basins`.

    **Raises:** as `scan`; on Ctrl-C `ScanInterrupted`, whose `data` says of each start that was
    followed where it ended (`period`, and a section state).
    """
    machine = machine_of(machine)
    check_options(basins, options, ())
    given_number("apart", apart, low=0.0, open_low=True)
    axes = starts_in(region, resolution, samples, count("seed", seed))
    method = chosen(machine, method)
    data = followed(
        machine, axes, longest, tolerance, start=start, settle=settle, method=method,
        paired=samples is not None, progress=progress, **options,
    )  # fmt: skip
    begin = machine.start() if start is None else start
    kept = functools.partial(ScanInterrupted, data, options.get("store"))
    with at_work("sorting", kept, progress=False):
        return sorted_out(data, machine, begin, apart=apart, longest=longest, method=method)


def sorted_out(
    data: "xr.Dataset",
    machine: AbstractMachine,
    begin: object,
    *,
    apart: float,
    longest: int,
    method: AbstractMethod,
) -> Basins:
    """The basins in what a scan of starts found.

    **Arguments:** what `followed` found; the machine; a start, of which the region's
    parts are replaced; `apart`, `longest` and `method` as for `basins`.
    """
    names = list(components(begin))

    def sections(state: np.ndarray, cycles: int) -> np.ndarray:
        here = begin
        for name, value in zip(names, state, strict=True):
            here = with_leaf(here, name, value)
        # Always as many cycles, so that another period is not another program.
        run = simulate(machine, here, longest, method=method)
        return np.stack(
            [np.asarray(x)[1 : cycles + 1] for x in components(run.sections, 1).values()], axis=1
        )

    label, motions = _labelled(data, names, apart, sections)
    impacts = np.asarray(data["impacts"]).ravel()
    attractors = [_attractor(i, m, names, label, impacts) for i, m in enumerate(motions)]
    parts = {name: float(np.mean(label == number)) for name, number in CODES.items()}
    about = {"long_name": "motion that the start settles on", **flags(CODES)}
    about["at_stop"] = _at_stop(data, machine, begin)
    period = data["period"]
    kind = np.min_scalar_type(-max(4, len(motions)))
    data = data.assign(label=(period.dims, label.astype(kind).reshape(period.shape), about))
    return Basins(data, attractors, parts, machine)


def _at_stop(data: "xr.Dataset", machine: AbstractMachine, begin: object) -> list[str]:
    """Edges of the region beyond which no start can be, such as `"start.Y high"`, for a stop is
    there: in the middle of each edge a start inside of it is looked at, and one beyond."""
    rows = {str(name): np.asarray(data[name]) for name in data["period"].dims}
    found = []
    for name, row in rows.items():
        if not name.startswith(START) or row.size < 2:
            continue
        half = 0.5 * (row[1] - row[0])
        for side, edge, out in (("low", row[0] - half, -half), ("high", row[-1] + half, half)):
            middle = {other: 0.5 * (x[0] + x[-1]) for other, x in rows.items()}
            inside, beyond = ({**middle, name: edge + x * out} for x in (-1e-3, 1e-3))
            if _can_be(machine, begin, inside) and not _can_be(machine, begin, beyond):
                found.append(f"{name} {side}")
    return found


def _can_be(machine: AbstractMachine, begin: object, values: Mapping[str, float]) -> bool:
    """Whether a start with these parts can be simulated."""
    for name, value in values.items():
        begin = with_leaf(begin, name.removeprefix(START), value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            check_start(machine, begin)
        except ValueError:
            return False
    return True


def check_options(
    verb: Callable[..., Any], options: Mapping[str, Any], refused: Iterable[str]
) -> None:
    """**Raises:** `TypeError` for an option that is none of `scan`'s, or one that a verb which
    scans starts does not take.

    **Arguments:** `refused`, those that this verb alone does not take.
    """
    who = verb.__name__
    own, of_scan = ({*inspect.signature(x).parameters} - {"options"} for x in (verb, scan))
    for name in options:
        if name in {*_SET, *refused}:
            raise TypeError(f"Argument `{name}` is not to be given to `{who}`.")
        if name not in of_scan:
            near = difflib.get_close_matches(name, sorted(own | of_scan - _SET))
            hint = f"near names: {', '.join(near)}" if near else f"see `help(vi_jax.{who})`"
            raise TypeError(f"`{who}` has no argument `{name}`; {hint}.")


def followed(
    machine: AbstractMachine,
    axes: Mapping[str, Any],
    longest: int,
    tolerance: float | None,
    **options: Any,
) -> "xr.Dataset":
    """What a scan finds of starts, for `sorted_out`; those that fail are no news."""
    measure: tuple[AbstractMeasure, ...]
    measure = Regime(longest=longest, tolerance=tolerance), _Mark(longest)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", LanesFailed)
        return scan(machine, axes, measure=measure, **options)


def starts_in(
    region: Mapping[str, tuple[float, float]],
    resolution: int | tuple[int, ...],
    samples: int | None,
    seed: int | tuple[int, ...],
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


def _labelled(
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
