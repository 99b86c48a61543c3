"""`scan`: axes over parameters and starts give a labelled data set."""

import dataclasses
import functools
import json
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from .._checks import count, fits_memory, fits_records, flag, instance_of
from .._interrupted import Interrupted
from .._lazy import lazy
from .._renamed import renamed
from ..flow import AbstractMethod
from ..flow.methods import MethodLike, preset
from ..flow.results import REASON_NAMES
from ..machine import AbstractMachine
from ..machine.units import attributes as units_of
from ..machine.units import unit_of
from ._describe import attributes_of, description_of
from ._work import (
    ClusterLost,
    block_size,
    rounded,
    run_here,
    run_on_cluster,
    size_of,
    worker_count,
)
from .grid import Blocks, axes_of
from .program import START, ScanProgram, check_corners, make_program
from .regime import flags
from .store import (
    NOT_COMPUTED,
    MemoryStore,
    Variable,
    ZarrStore,
    check_writable,
    dataset,
    open_dataset,
)

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


@renamed(scene="machine")
def scan(
    machine: AbstractMachine | Callable[..., AbstractMachine],
    axes: Mapping[str, Any],
    *,
    measure: Any = ("extremes", "regime"),
    start: Any = None,
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

    The grid is computed in blocks of lanes, several at a time, all by one compiled program.
    Inside a block a lane that has ended makes room for the next. Other numbers on the axes, in the
    machine or in `settle` compile nothing again.

    **Arguments:**

    - `machine`: the machine, or a function of the axes' values by name that makes it (then define
      the function once: another one is another program).
    - `axes`: names of numbers of the machine (`"drive.frequency_ratio"`, `"stops.0.restitution"`)
      or of the start (`"start.Y"`), each with a row of values.
    - `measure`: what is kept: names out of `"extremes"`, `"regime"`, `"frequency_ratio"`,
      `"power"`, `"impact_rate"`, `"sections"`, `"exponent"`, `"steps"`; `AbstractMeasure`s;
      functions of a lane's machine and `Run` that return named numbers; or the name of one of the
      machine's own `averages` (one called `"power"` stands in place of ours).
    - `start`: the first state; by default the machine's own start at rest.
    - `settle`, `cycles`: drive cycles before observing (any number), and observed (static; by
      default as many as the measures need, at least 32).
    - `method`, `clock`, `max_impacts`, `max_steps`: as for `simulate`; by default the
      `"standard"` preset.
    - `derivatives`: names, as on the axes, by which all floating-point variables are
      differentiated, in forward mode: `d_y_min` and so on, with an axis `by`.
    - `paired`: take the axes' values together, one lane for each place in the rows (which must be
      of one length), along the dimension `sample`, instead of every combination.
    - `verify`: so many lanes, drawn at random, are run again by the `"reference"` preset (by a
      still tighter method if that is the method). `data.attrs` then says of each variable how many
      of them came out otherwise (`verified_changed_period`, for whole numbers) or what 95 of 100
      are off by at most (`verified_error_y_min`; infinite where one of both failed): whether the
      method is good enough for this scan.
    - `store`: folder of a Zarr store, written block by block. The same call resumes it after an
      interruption; a changed one is refused with the difference named, the code of your own
      functions included. Chunks that were lost or damaged are named and computed again.
    - `lanes`: lanes in a block (a multiple of 256); memory grows with it and with `cycles`.
    - `workers`: blocks at work at the same time on a CPU, by default as many as it has cores.
    - `devices`: local devices over which a block is spread; all by default.
    - `cluster`: a `dask.distributed.Client`, to compute the blocks there instead of here. If its
      scheduler is lost, a `ConnectionError` says what is kept and how to go on.
    - `progress`: show a bar with rate and time left (in a terminal or notebook).

    **Returns:** an `xarray.Dataset` over the axes, with units; `result` says of each lane how it
    ended (0: well; -1: not computed). With a `store` it is read lazily from there.

    **Raises:** `ValueError` or `TypeError` before any work for what cannot be run;
    `ScanInterrupted`, a `KeyboardInterrupt`, on Ctrl-C.
    """
    grid, verify = axes_of(axes), count("verify", verify)
    if store is not None:
        instance_of("store", store, (str, Path), "a path")
    paired, progress = flag("paired", paired), flag("progress", progress)
    if cluster is not None and not (hasattr(cluster, "submit") and hasattr(cluster, "cancel")):
        raise TypeError(
            f"Argument `cluster` must be a `dask.distributed.Client`, but got {cluster!r}."
        )
    if paired and len({x.size for x in grid.values()}) != 1:
        raise ValueError(
            "Argument `axes` must hold rows of one length if they are `paired`, but they have "
            f"{[x.size for x in grid.values()]}."
        )
    job = make_program(
        machine, tuple(grid), measure=measure, start=start, settle=settle, cycles=cycles,
        method=method, clock=clock, derivatives=derivatives, max_impacts=max_impacts,
        max_steps=max_steps,
    )  # fmt: skip
    workers = worker_count(workers)
    devices = len(jax.local_devices()) if devices is None else count("devices", devices, least=1)
    if devices > len(jax.local_devices()):
        raise ValueError(
            f"Argument `devices` must be at most {len(jax.local_devices())}, the local devices, "
            f"but got {devices}."
        )
    total = Blocks(grid, 1, paired=paired).total
    if store is not None and lanes is None:
        lanes = _lanes_in(Path(store))
    at_fault = "cycles" if lanes is None else "lanes"
    lanes = block_size(total, workers, devices) if lanes is None else rounded(lanes, total, devices)
    fits_records(at_fault, lanes * (job.cycles + 1), 12)
    if jax.default_backend() != "cpu":
        job = dataclasses.replace(job, places=lanes // devices)
    blocks = Blocks(grid, lanes, paired=paired)
    job = check_corners(job, blocks)
    variables = variables_of(job, blocks)
    per_lane = sum(math.prod(v.sizes) * v.dtype.itemsize for v in variables.values())
    fits_memory("axes", total * per_lane if store is None else total + 500 * len(blocks))
    description = description_of(job, blocks)
    attributes = attributes_of(description)
    if store is not None:
        check_writable(store)
        kept: MemoryStore | ZarrStore = ZarrStore(store, description, blocks, variables)
    else:
        kept = MemoryStore(blocks, variables)

    def collected() -> "xr.Dataset":
        if isinstance(kept, MemoryStore):
            data = dataset(kept.arrays, blocks, variables)
        else:
            data = open_dataset(kept.path)
        for name in grid:
            data[name].attrs |= units_of(_unit_on_axis(job, blocks, name))
        data.attrs = attributes
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
                run_on_cluster(job, blocks, open_blocks, cluster)
                if cluster is not None
                else run_here(job, blocks, open_blocks, workers, devices)
            )
            for where, numbers in done:
                kept.write(where, numbers)
                bar.update(size_of(where))
    except KeyboardInterrupt:
        raise ScanInterrupted(collected(), store) from None
    except ClusterLost as lost:
        raise ConnectionError(_how_to_go_on(kept)) from lost
    data = collected()
    if verify:
        again = functools.partial(
            scan, machine, measure=measure, start=start, settle=settle, cycles=cycles,
            method=_better(job), clock=clock, paired=True, max_impacts=max_impacts,
            max_steps=max_steps, workers=workers, devices=devices, cluster=cluster, progress=False,
        )  # fmt: skip
        try:
            data.attrs |= _verified(data, blocks, min(verify, total), again)
        except KeyboardInterrupt:
            raise ScanInterrupted(data, store) from None
    _tell_failures(data)
    return data


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


def _better(job: ScanProgram) -> AbstractMethod:
    """A method to verify the job's by."""
    best, mine = preset(job.machine, "reference"), job.method
    same = type(best) is type(mine) and best.steps_per_cycle <= mine.steps_per_cycle
    return mine.tighter() if same else best


def _verified(
    data: "xr.Dataset", blocks: Blocks, lanes: int, again: Callable[..., "xr.Dataset"]
) -> dict[str, Any]:
    """How some of the lanes come out by a better method."""
    total = data["result"].size
    drawn = np.sort(np.random.default_rng(0).choice(total, lanes, replace=False))
    places = np.unravel_index(drawn, data["result"].shape)
    if blocks.paired:
        places = (drawn,) * len(blocks.axes)
    axes = {name: x[place] for (name, x), place in zip(blocks.axes.items(), places, strict=True)}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "[0-9,]+ of [0-9,]+ lanes failed")
        better = again(axes)
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


def variables_of(job: ScanProgram, blocks: Blocks) -> dict[str, Variable]:
    """What the job computes, found without computing it."""
    values = {name: jnp.zeros(4) + x[0] for name, x in blocks.axes.items()}
    shapes = eqx.filter_eval_shape(job, values, jnp.ones(4, bool))
    known: dict[str, Mapping[str, Any]] = {
        "result": {
            "long_name": "how the lane ended",
            **flags({"not_computed": NOT_COMPUTED} | {n: i for i, n in enumerate(REASON_NAMES)}),
        }
    }
    machine, start = job.first(blocks)
    for measure in job.measures:
        known |= measure.described(start)
    found = {}
    for name, shape in shapes.items():
        by = name.startswith("d_") and name not in known and bool(job.derivatives)
        about = dict(known.get(name.removeprefix("d_") if by else name, {}))
        dims = tuple(about.pop("dims", ()))
        if "unit_of" in about:
            about |= units_of(unit_of(machine.units, about.pop("unit_of")))
        if by:
            dims = ("by", *dims)
            about = {
                "long_name": f"derivative of {name.removeprefix('d_')}",
                "by": list(job.derivatives),
            }
        sizes = shape.shape[1:]
        if len(dims) != len(sizes):
            dims = tuple(f"{name}_{i}" for i in range(len(sizes)))
        for taken in {name, *dims} & {*blocks.axes, *blocks.dims}:
            raise ValueError(
                f"Measure {name!r} must have another name than the axis {taken!r}, or one on "
                "other dimensions."
            )
        found[name] = Variable(dims, tuple(sizes), np.dtype(shape.dtype), about)
    return found


def _unit_on_axis(job: ScanProgram, blocks: Blocks, name: str) -> str:
    """What a function that makes the machine takes is in units of its own."""
    if job.build is not None and not name.startswith(START):
        return ""
    return unit_of(job.first(blocks)[0].units, name)


def _tell_failures(data: "xr.Dataset") -> None:
    codes, numbers = np.unique(np.asarray(data["result"]), return_counts=True)
    failed = {int(c): int(n) for c, n in zip(codes, numbers, strict=True) if c != 0}
    if not failed:
        return
    names = ["not_computed", *REASON_NAMES]
    why = ", ".join(f"{names[code + 1]}: {n:,}" for code, n in failed.items())
    warnings.warn(
        f"{sum(failed.values()):,} of {data['result'].size:,} lanes failed ({why}); see `result` "
        "and `RESULTS`.",
        stacklevel=3,
    )


def _lanes_in(path: Path) -> int | None:
    """The block size of a store that is there already."""
    try:
        attributes = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        return int(attributes["scan"]["lanes"])
    except (OSError, KeyError, ValueError, TypeError):
        return None
