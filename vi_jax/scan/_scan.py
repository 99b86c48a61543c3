"""`scan`: axes over parameters and starts give a labelled data set."""

import dataclasses
import functools
import json
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from tqdm import tqdm

from .._checks import count, fits_memory, fits_records, flag, instance_of
from .._interrupted import Interrupted
from .._lazy import lazy
from .._renamed import renamed
from .._types import State
from ..flow import REASON_NAMES, AbstractMethod, MethodLike, RunOptions, preset
from ..machine import AbstractMachine
from ..machine import attributes as units_of
from ._describe import attributes_of, description_of, unit_on_axis, variables_of
from ._work import ClusterLost, block_size, rounded, run_here, run_on_cluster, size_of, worker_count
from .corners import check_corners
from .grid import Blocks, axes_of
from .program import ScanProgram, make_program
from .store import MemoryStore, ZarrStore, check_writable

if TYPE_CHECKING:
    import xarray as xr
else:
    xr = lazy("xarray")


class ScanInterrupted(Interrupted):
    """Raised when a scan is interrupted: what was computed is not lost, but in `data`."""

    def __init__(self, data: "xr.Dataset", store: str | Path | None):
        kept = "what was computed is in `.data`"
        if store is not None:
            kept = f"what was computed is in {store}, and the same call goes on from there"
        super().__init__("scan", data, kept)
        self.data = data


class LanesFailed(UserWarning):
    """Said of a scan of which some lanes failed."""


class _Workplace(NamedTuple):
    """Where blocks are computed: by threads on local devices, or by a Dask cluster."""

    workers: int
    devices: int
    cluster: Any


@renamed(scene="machine")
def scan(
    machine: AbstractMachine | Callable[..., AbstractMachine],
    axes: Mapping[str, Any],
    *,
    measure: Any = ("extremes", "regime"),
    start: State = None,
    settle: int = 200,
    cycles: int | None = None,
    method: MethodLike = None,
    clock: str | None = None,
    derivatives: Iterable[str] = (),
    paired: bool = False,
    verify: int = 0,
    max_impacts: int = 1000,
    max_steps: int | None = None,
    store: str | Path | None = None,
    lanes: int | None = None,
    workers: int | None = None,
    devices: int | None = None,
    cluster: Any = None,
    progress: bool = True,
) -> "xr.Dataset":
    """Simulate every combination of the axes' values and keep what is measured.

    The grid is computed in blocks of lanes, several at a time, all by one compiled program. Other
    numbers on the axes, in the machine or in `settle` compile nothing again.

    **Arguments:**

    - `machine`: the machine, or a function of the axes' values by name that makes it (define the
      function once: another one is another program).
    - `axes`: names of numbers of the machine (`"drive.frequency_ratio"`, `"stops.0.restitution"`)
      or of the start (`"start.Y"`), each with a row of values.
    - `measure`: what is kept: names out of `"extremes"`, `"regime"`, `"frequency_ratio"`,
      `"power"`, `"impact_rate"`, `"sections"`, `"exponent"`, `"steps"`; `AbstractMeasure`s;
      functions of a lane's machine and `Run` that return named numbers; or the name of one of the
      machine's own `averages` (one called `"power"` takes the place of ours).
    - `start`: the first state; by default the machine's own start at rest.
    - `settle`, `cycles`: drive cycles before observing (any number), and observed (static; by
      default as many as the measures need, at least 32).
    - `method`, `clock`, `max_impacts`, `max_steps`: as for `simulate`; by default `"standard"`.
    - `derivatives`: names, as on the axes, by which all floating-point variables are
      differentiated, in forward mode: `d_y_min` and so on, with an axis `by`.
    - `paired`: take the axes' values together, one lane for each place in the rows (of one
      length), along the dimension `sample`, instead of every combination.
    - `verify`: so many lanes, drawn at random, are run again by the `"reference"` preset (a still
      tighter method if that is the method). `data.attrs` then says of each variable how many of
      them came out otherwise (`verified_changed_period`, for whole numbers) or what 95 of 100 are
      off by at most (`verified_error_y_min`; infinite where one of both failed).
    - `store`: folder of a Zarr store, written block by block. The same call resumes it after an
      interruption; a changed one is refused with the difference named, the code of your own
      functions included. Chunks that were lost or damaged are named and computed again.
    - `lanes`: lanes in a block (a multiple of 256); memory grows with it and with `cycles`.
    - `workers`: blocks at work at the same time on a CPU, by default as many as it has cores.
    - `devices`: local devices over which a block is spread; all by default.
    - `cluster`: a `dask.distributed.Client`, to compute the blocks there. If its scheduler is
      lost, a `ConnectionError` says what is kept and how to go on.
    - `progress`: show a bar with rate and time left (in a terminal or notebook).

    **Returns:** an `xarray.Dataset` over the axes, with units; `result` says of each lane how it
    ended (0: well; -1: not computed). With a `store` it is read lazily from there.

    **Raises:** `ValueError` or `TypeError` before any work for what cannot be run;
    `ScanInterrupted`, a `KeyboardInterrupt`, on Ctrl-C.
    """
    grid, verify = axes_of(axes), count("verify", verify)
    paired, progress = flag("paired", paired), flag("progress", progress)
    _check_call(grid, paired, store, cluster)
    options = RunOptions(
        settle=settle, method=method, clock=clock, max_impacts=max_impacts, max_steps=max_steps
    )
    make = functools.partial(
        make_program, machine, tuple(grid), measure=measure, start=start, cycles=cycles
    )
    program = make(options, derivatives=derivatives)
    place = _workplace(workers, devices, cluster)
    blocks = _blocks(program, grid, place, paired, store, lanes)
    data = _computed(program, blocks, place, store, progress)
    if verify:
        better = make(dataclasses.replace(options, method=_better(program)))
        try:
            data.attrs |= _verified(data, blocks, verify, better, place)
        except KeyboardInterrupt:
            raise ScanInterrupted(data, store) from None
    _warn_of_failures(data)
    return data


def _check_call(grid: Mapping[str, np.ndarray], paired: bool, store: Any, cluster: Any) -> None:
    """**Raises:** `TypeError` or `ValueError` for arguments of `scan` that are none."""
    if store is not None:
        instance_of("store", store, (str, Path), "a path")
    if cluster is not None and not (hasattr(cluster, "submit") and hasattr(cluster, "cancel")):
        raise TypeError(
            f"Argument `cluster` must be a `dask.distributed.Client`, but got {cluster!r}."
        )
    if paired and len({x.size for x in grid.values()}) != 1:
        raise ValueError(
            "Argument `axes` must hold rows of one length if they are `paired`, but they have "
            f"{[x.size for x in grid.values()]}."
        )


def _workplace(workers: int | None, devices: int | None, cluster: Any) -> _Workplace:
    """As many threads and devices as are asked for, or as there are.

    **Raises:** `ValueError` for more devices than there are.
    """
    workers, there = worker_count(workers), len(jax.local_devices())
    devices = there if devices is None else count("devices", devices, least=1)
    if devices > there:
        raise ValueError(
            f"Argument `devices` must be at most {there}, the local devices, but got {devices}."
        )
    return _Workplace(workers, devices, cluster)


def _computed(
    program: ScanProgram, blocks: Blocks, place: _Workplace, store: Any = None, progress=False
) -> "xr.Dataset":
    """What a program finds on a grid, checked before any work.

    **Arguments:** `blocks`, the grid; `place`, where it is computed; `store`, a path to keep it at,
    `None` for the memory; `progress`, whether a bar is shown.

    **Raises:** as `scan`.
    """
    program = check_corners(program, blocks)
    variables = variables_of(program, blocks)
    per_lane = sum(math.prod(v.sizes) * v.dtype.itemsize for v in variables.values())
    total = blocks.total
    fits_memory("axes", total * per_lane if store is None else total + 500 * len(blocks))
    description = description_of(program, blocks)
    if store is not None:
        check_writable(store)
        kept: MemoryStore | ZarrStore = ZarrStore(store, description, blocks, variables)
    else:
        kept = MemoryStore(blocks, variables)

    def collected() -> "xr.Dataset":
        data = kept.data()
        for name in blocks.axes:
            data[name].attrs |= units_of(unit_on_axis(program, blocks, name))
        data.attrs = attributes_of(description, program.first(blocks)[0])
        return data

    open_blocks = kept.open_blocks()
    _ = xr.Dataset  # loaded now: after an interrupt nobody waits for that
    try:
        with tqdm(
            total=total,
            initial=total - sum(size_of(where) for where in open_blocks),
            unit="lane",
            unit_scale=True,
            disable=None if progress else True,
        ) as bar:
            done = (
                run_on_cluster(program, blocks, open_blocks, place.cluster)
                if place.cluster is not None
                else run_here(program, blocks, open_blocks, place.workers, place.devices)
            )
            for where, numbers in done:
                kept.write(where, numbers)
                bar.update(size_of(where))
    except KeyboardInterrupt:
        raise ScanInterrupted(collected(), store) from None
    except ClusterLost as lost:
        raise ConnectionError(_how_to_go_on(kept)) from lost
    return collected()


def _blocks(
    program: ScanProgram,
    grid: Mapping[str, np.ndarray],
    place: _Workplace,
    paired: bool,
    store: str | Path | None = None,
    lanes: int | None = None,
) -> Blocks:
    """The grid in blocks of `lanes`: as in the store if there is one, or as suits the workplace.

    **Arguments:** `grid`, values by axis; `place`, where it is computed; `paired`, whether the axes
    have one length and are gone along together; `store`, a path or `None`; `lanes`, `None` to
    choose.

    **Raises:** `ValueError` if a block would not fit into the memory.
    """
    total = Blocks(grid, 1, paired=paired).total
    if store is not None and lanes is None:
        lanes = _lanes_in(Path(store))
    at_fault = "cycles" if lanes is None else "lanes"
    if lanes is None:
        lanes = block_size(total, place.workers, place.devices)
    else:
        lanes = rounded(lanes, total, place.devices)
    fits_records(at_fault, lanes * (program.cycles + 1), 12)
    return Blocks(grid, lanes, paired=paired)


def _how_to_go_on(kept: MemoryStore | ZarrStore) -> str:
    """What is left of a scan whose cluster is lost."""
    how = "Nothing is kept: give the scan a `store`, from which the same call goes on."
    if isinstance(kept, ZarrStore):
        number = len(kept.blocks)
        done = number - len(kept.open_blocks())
        how = (
            f"{done:,} of {number:,} blocks are computed and kept in {kept.path}: the same call "
            "goes on from there, with a new client or without `cluster`."
        )
    return f"The scheduler of the Dask cluster was lost. {how}"


def _better(program: ScanProgram) -> AbstractMethod:
    """A method to verify the program's by."""
    best, mine = preset(program.machine, "reference"), program.method
    same = type(best) is type(mine) and best.steps_per_cycle <= mine.steps_per_cycle
    return mine.tighter() if same else best


def _verified(
    data: "xr.Dataset", blocks: Blocks, lanes: int, program: ScanProgram, place: _Workplace
) -> dict[str, Any]:
    """How some of the lanes, drawn by chance, come out by a better program; attributes by their
    names.

    **Arguments:** `data`, what was found; `lanes`, how many (at most all); `program`, the better
    one; `place`, where it is computed.
    """
    total = data["result"].size
    lanes = min(lanes, total)
    drawn = np.sort(np.random.default_rng(0).choice(total, lanes, replace=False))
    places = np.unravel_index(drawn, data["result"].shape)
    if blocks.paired:
        places = (drawn,) * len(blocks.axes)
    axes = {name: x[i] for (name, x), i in zip(blocks.axes.items(), places, strict=True)}
    better = _computed(program, _blocks(program, axes, place, paired=True), place)
    found: dict[str, Any] = {"verified_lanes": lanes}
    for name in better:
        mine = np.asarray(data[name]).reshape(total, -1)[drawn]
        other = np.asarray(better[name]).reshape(lanes, -1)
        if mine.dtype.kind == "f":
            same = (mine == other) | (np.isnan(mine) & np.isnan(other))
            apart = np.where(same, 0.0, np.abs(mine - other))
            worst = np.where(np.isfinite(apart), apart, np.inf).max(axis=1)
            found[f"verified_error_{name}"] = float(np.quantile(worst, 0.95, method="higher"))
        else:
            found[f"verified_changed_{name}"] = int((mine != other).any(axis=1).sum())
    return found


def _warn_of_failures(data: "xr.Dataset") -> None:
    codes, numbers = np.unique(np.asarray(data["result"]), return_counts=True)
    failed = {int(c): int(n) for c, n in zip(codes, numbers, strict=True) if c != 0}
    if not failed:
        return
    names = ["not_computed", *REASON_NAMES]
    why = ", ".join(f"{names[code + 1]}: {n:,}" for code, n in failed.items())
    warnings.warn(
        f"{sum(failed.values()):,} of {data['result'].size:,} lanes failed ({why}); see `result` "
        "and `RESULTS`.",
        LanesFailed,
        stacklevel=4,
    )


def _lanes_in(path: Path) -> int | None:
    """The block size of a store that is there already."""
    try:
        attributes = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        return int(attributes["scan"]["lanes"])
    except (OSError, KeyError, ValueError, TypeError):
        return None
