"""`scan`: a labelled data set of motions over axes of parameters and starts."""

import contextlib
import functools
import itertools
import json
import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from concurrent import futures
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from .. import lanes
from .._checks import axes_of, count, fits_records, flag, host_side, instance_of
from .._messages import IN_PARTIAL, at_work, warn, warning_once
from .._programs import PLAIN, CompiledFunction
from .._types import State, xr
from ..flow import REASON_NAMES, MethodLike, RunOptions, compiling
from ..machine import AbstractMachine
from .program import Blocks, ScanProgram, check_corners, make_program
from .store import MemoryStore, Where, ZarrStore, opened

# Lanes of a block on a CPU and on an accelerator: choices. An interrupt loses one block.
_MOST, _ON_ACCELERATOR = 4096, 65536

# A block has this number of lanes times a power of two on each device: few sizes, few programs.
_LEAST = 256

# Blocks that a cluster has at a time: a choice, more than its cores.
_ON_CLUSTER = 4096

# Seconds without a new block before a cluster's workers are counted. A choice.
_PATIENCE = 10.0


def place_in_words(store: str | Path | None) -> str:
    """Return the place of the results of an interrupted scan."""
    if store is None:
        return IN_PARTIAL
    return f"what was computed is in {store}, and the same call continues from there"


class Workplace(NamedTuple):
    """The place where blocks are computed: threads on local devices, or a cluster."""

    workers: int
    devices: int
    cluster: Any


def workplace(workers: int | None, devices: int | None, cluster: object) -> Workplace:
    """Return the given numbers of threads and devices, or those available."""
    if not (
        cluster is None or isinstance(cluster, futures.Executor) or hasattr(cluster, "get_executor")
    ):
        raise TypeError(
            "Argument `cluster` must be a `dask.distributed.Client` or a "
            f"`concurrent.futures.Executor`, but got {cluster!r}."
        )
    workers = lanes.cores() if workers is None else count("workers", workers, least=1)
    local = len(jax.local_devices())
    devices = local if devices is None else count("devices", devices, least=1)
    if devices > local:
        raise ValueError(
            f"Argument `devices` must be at most {local}, the local devices, but got {devices}."
        )
    return Workplace(workers, devices, cluster)


def computed(
    program: ScanProgram, blocks: Blocks, place: Workplace, store: Any = None, progress=False
) -> "xr.Dataset":
    """Return the data of a program on a grid, checked before any work."""
    program = check_corners(program, blocks)
    with contextlib.closing(opened(program, blocks, store)) as storage:
        todo = storage.open_blocks()
        _ = xr.Dataset  # loaded now: an interrupt should not wait for that
        done = blocks.total - sum(map(_size_of, todo))
        with at_work(
            "scan", storage.data, progress=progress, unit="lane", total=blocks.total, done=done,
            where=place_in_words(store),
        ) as report:  # fmt: skip

            def write(where: Where, numbers: dict[str, np.ndarray]) -> None:
                storage.write(where, numbers)
                report(_size_of(where))

            try:
                run_blocks(program, blocks, todo, place, write)
            except ClusterLost as error:
                raise ConnectionError(_advice_after_loss(storage)) from error
        return storage.data()


def _size_of(where: Where) -> int:
    return math.prod(part.stop - part.start for part in where)


def in_blocks(
    program: ScanProgram,
    grid: Mapping[str, np.ndarray],
    place: Workplace,
    paired: bool,
    store: str | Path | None = None,
    lanes: int | None = None,
) -> Blocks:
    """Return the grid in blocks of `lanes`, by default those of the store or suitable for the
    workplace. The lanes' indices determine their noise."""
    total = Blocks(grid, 1, paired=paired).total
    if store is not None and lanes is None:
        lanes = _lanes_in(Path(store))
    argument = "cycles" if lanes is None else "lanes"
    if lanes is None:
        lanes = _block_size(total, place)
    else:  # a multiple of the step, but no larger than the grid needs
        step = _LEAST * place.devices
        lanes = math.ceil(min(count("lanes", lanes, least=1), total) / step) * step
    points = program.cycles * max(1, program.options.samples) + 1
    fits_records(argument, lanes * points, 12)
    if program.lane_noise is not None and total > 2**32:  # lanes have 32-bit numbers
        raise ValueError(
            f"Argument `axes` must have at most {2**32:,} lanes where there is noise, but has "
            f"{total:,}."
        )
    return Blocks(grid, lanes, paired=paired, numbered=program.lane_noise is not None)


def _lanes_in(path: Path) -> int | None:
    """Return the block size of an existing store, or `None`."""
    try:
        attributes = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        return int(attributes["scan"]["lanes"])
    except (OSError, KeyError, ValueError, TypeError):
        return None


def _block_size(total: int, place: Workplace) -> int:
    """Return the lanes in a block: few sizes, since each is a program, for blocks on every core."""
    if jax.default_backend() != "cpu":
        largest, share = _ON_ACCELERATOR * place.devices, total
    else:
        largest, share = _MOST * place.devices, math.ceil(total / place.workers)
    size = _LEAST * place.devices
    while size < min(share, largest):
        size *= 2
    return size


class ClusterLost(Exception):
    """A cluster, or an executor, does not respond."""


def run_blocks(
    program: ScanProgram,
    blocks: Blocks,
    todo: list[Where],
    place: Workplace,
    write: Callable[[Where, dict[str, np.ndarray]], None],
) -> None:
    """Compute the blocks `todo` in an executor, and write each when it is done.

    Local threads have one core and one block each; on an accelerator, or over several devices,
    there is one thread. On Ctrl-C all blocks are written that have ended by then. Dask itself sends
    the blocks of a lost worker to another one.
    """
    # As NumPy arrays it is sent with every task: shared data would be lost with their worker.
    packed = jtu.tree_map(lambda x: np.asarray(x) if eqx.is_array(x) else x, program)
    with contextlib.ExitStack() as stack:
        if place.cluster is not None:
            pool, at_once = _executor_of(place.cluster), _ON_CLUSTER
            devices, one_core = 1, False
        else:
            at_once = place.workers
            if place.devices > 1 or jax.default_backend() != "cpu":
                at_once = 1
            elif len(todo) > 1 and at_once > 1:
                # Compiled here once, not in several threads.
                compute(program, blocks.values(todo[0]), blocks.lanes, dry=True)
            pool = stack.enter_context(futures.ThreadPoolExecutor(at_once))
            devices, one_core = place.devices, True
        x64 = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
        task = functools.partial(
            _task, packed, lanes_of_block=blocks.lanes, devices=devices, x64=x64, one_core=one_core
        )
        waiting, running = iter(todo), dict[futures.Future, Where]()

        def begin(where: Where) -> None:
            try:
                running[pool.submit(task, blocks.values(where))] = where
            except RuntimeError as error:
                raise ClusterLost from error

        def finish(future: futures.Future) -> None:
            try:
                write(running[future], future.result())
            except (futures.CancelledError, futures.BrokenExecutor) as error:
                raise ClusterLost from error
            del running[future]

        try:
            while True:
                for where in itertools.islice(waiting, at_once - len(running)):
                    begin(where)
                if not running:
                    return
                done, _ = futures.wait(
                    running, timeout=_PATIENCE, return_when=futures.FIRST_COMPLETED
                )
                if not done:
                    _warn_without_workers(place.cluster)
                for future in done:
                    finish(future)
        finally:
            futures.wait([future for future in running if not future.cancel()])
            for future in list(running):
                if not future.cancelled() and future.exception() is None:
                    finish(future)


def _executor_of(cluster: Any) -> futures.Executor:
    if isinstance(cluster, futures.Executor):
        return cluster
    if cluster.status != "running":
        raise ClusterLost
    return cluster.get_executor(pure=False, retries=3)


def _warn_without_workers(cluster: Any) -> None:
    if hasattr(cluster, "scheduler_info") and not cluster.scheduler_info()["workers"]:
        warn("The Dask cluster has no workers. The scan waits for new ones, until Ctrl-C.")


def _task(
    packed: ScanProgram,
    values: dict[str, np.ndarray],
    lanes_of_block: int,
    devices: int,
    x64: bool,
    one_core: bool,
) -> dict[str, np.ndarray]:
    threads = lanes.threads(1) if one_core else contextlib.nullcontext()
    with jax.enable_x64(x64), threads:  # each thread has its own setting
        program = jtu.tree_map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, packed)
        return compute(program, values, lanes_of_block, devices)


def _advice_after_loss(storage: MemoryStore) -> str:
    advice = "Nothing was stored. Pass a `store`, from which the same call can continue."
    if isinstance(storage, ZarrStore):
        number = len(storage.blocks)
        done = number - len(storage.open_blocks())
        advice = (
            f"{done:,} of {number:,} blocks are computed and stored in {storage.path}. The same "
            "call continues from there, with a new client or without `cluster`."
        )
    return f"The cluster was lost, or its scheduler. {advice}"


@functools.cache
def _compiled(devices: int) -> Callable[..., dict[str, Array]]:
    mesh = Mesh(np.asarray(jax.local_devices()[:devices]), ("lanes",))
    replicated, split = PartitionSpec(), PartitionSpec("lanes")

    def over_devices(program, values, wanted):
        numbers, rest = eqx.partition(program, eqx.is_array)
        return jax.shard_map(
            lambda numbers, *lanes: eqx.combine(numbers, rest)(*lanes),
            mesh=mesh, in_specs=(replicated, split, split), out_specs=split, check_vma=False,
        )(numbers, values, wanted)  # fmt: skip

    function = ScanProgram.__call__ if devices == 1 else over_devices
    return CompiledFunction(function, PLAIN, **compiling())


def compute(
    program: ScanProgram,
    values: dict[str, np.ndarray],
    lanes: int,
    devices: int = 1,
    *,
    dry: bool = False,
) -> dict[str, np.ndarray]:
    """Return the numbers of a block of lanes, by name. A block is padded to `lanes`, so that all
    blocks are one program. Lanes are given to several devices in turn, since neighbours take
    similar times. With `dry`, the program is only compiled."""
    size = next(iter(values.values())).size
    order = np.arange(lanes).reshape(-1, devices).T.ravel()
    lanes_here = np.minimum(order, size - 1)
    filled = {name: jnp.asarray(x[lanes_here]) for name, x in values.items()}
    out = _compiled(devices)(program, filled, jnp.asarray((order < size) & (not dry)))
    inverse = np.argsort(order)[:size]
    return {name: np.asarray(x)[inverse] for name, x in out.items()}


class LanesFailed(UserWarning):
    """The warning that some lanes of a scan failed."""


@host_side
@warning_once
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
    derivatives: str | Iterable[str] = (),
    noise: Any = None,
    key: Any = None,
    paired: bool = False,
    max_impacts: int = 1000,
    max_steps: int | None = None,
    store: str | Path | None = None,
    lanes: int | None = None,
    workers: int | None = None,
    devices: int | None = None,
    cluster: Any = None,
    progress: bool = True,
) -> "xr.Dataset":
    """Simulate every combination of the axes' values and keep measures of each motion.

    Other values on the axes, in the machine or in `settle` do not compile again.

    **Arguments:**

    - `machine`: the machine, or a function that makes it from the axes' values by name (define it
      once, since another function compiles again).
    - `axes`: names of numbers of the machine (`"drive.frequency_ratio"`, `"stops.0.restitution"`)
      or of the start (`"start.Y"`), each with a row of values.
    - `measure`: the results: names among `"extremes"`, `"regime"`, `"frequency_ratio"`, `"power"`,
      `"impact_rate"`, `"sections"`, `"exponent"`, `"steps"`, or of the machine's own `averages`,
      which replace ours of the same name; `AbstractMeasure`s; functions of a lane's machine and
      `Run` that return named numbers. `()` for outcomes alone.
    - `start`: the initial state; by default the machine's own start.
    - `settle`, `cycles`: the numbers of drive cycles before observation, and observed (static; by
      default 32 or as many as the measures need).
    - `method`, `clock`, `max_impacts`, `max_steps`: as for `simulate`.
    - `derivatives`: names, as on the axes, with respect to which every real variable is
      differentiated: `d_y_min` and so on, with an axis `by`.
    - `noise`, `key`: a `WhiteNoise`, by default none, and with it one JAX key. Lane n of the grid
      (the last axis varies fastest) has the key `jax.random.fold_in(key, n)`. `"noise.V"` is an
      axis of amplitudes, `"noise.path"` of paths. Measures that need a period are refused.
    - `paired`: a lane for each index in the rows (of one length), along `sample`, and no grid.
    - `store`: the folder of a Zarr store, written block by block. The same call resumes it and
      computes lost blocks again. A changed call (or code of yours) is refused, with the difference.
    - `lanes`: lanes in a block (a multiple of 256); memory grows with it and with `cycles`.
    - `workers`, `devices`: blocks computed at once on a CPU (by default one per core), and local
      devices over which a block is spread (all by default).
    - `cluster`: a `dask.distributed.Client`, or an `Executor` of `concurrent.futures`, which
      computes the blocks.
    - `progress`: show a bar, in a terminal or a notebook.

    **Returns:** an `xarray.Dataset` over the axes, with units; `result` is the reason why each lane
    ended (0: completed; -1: not computed). With a `store` it is read lazily from there.

    **Raises:** `ValueError` or `TypeError` before any work for unusable arguments; on Ctrl-C
    `Interrupted`; `ConnectionError`, with the number of stored blocks, if the cluster is lost.
    """
    grid = axes_of(axes)
    progress, paired = flag("progress", progress), flag("paired", paired)
    if store is not None:
        instance_of("store", store, (str, Path), "a path")
    sizes = [x.size for x in grid.values()]
    if paired and len({*sizes}) != 1:
        raise ValueError(
            "Argument `axes` must hold rows of one length if they are `paired`, but they have "
            f"{sizes}."
        )
    options = RunOptions(
        settle=settle, method=method, clock=clock, max_impacts=max_impacts, max_steps=max_steps
    )
    program = make_program(
        machine, tuple(grid), options, measure=measure, start=start, cycles=cycles, noise=noise,
        key=key, derivatives=derivatives,
    )  # fmt: skip
    place = workplace(workers, devices, cluster)
    blocks = in_blocks(program, grid, place, paired, store, lanes)
    data = computed(program, blocks, place, store, progress)
    _warn_of_failures(data)
    return data


def _warn_of_failures(data: "xr.Dataset") -> None:
    codes, numbers = np.unique(np.asarray(data["result"]), return_counts=True)
    good = REASON_NAMES.index("successful"), REASON_NAMES.index("ended")  # an outcome is no failure
    failed = {int(c): int(n) for c, n in zip(codes, numbers, strict=True) if c not in good}
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
