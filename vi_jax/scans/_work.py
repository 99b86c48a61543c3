"""How the blocks of a scan are computed: threads and devices here, or a Dask cluster."""

import functools
import math
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array

from .. import lanes
from .._checks import count
from .._programs import PLAIN, CompiledFunction
from ..flow import compiling
from .grid import Blocks
from .program import ScanProgram

# Lanes of a block on a CPU and on an accelerator: choices. A block is what an interrupt loses.
_MOST, _ON_ACCELERATOR = 4096, 65536

# A block has so many lanes on each device, or so many doubled again and again: few sizes, for few
# programs. A choice.
_LEAST = 256


# A block: where it lies on each axis of the grid.
Where = tuple[slice, ...]


def size_of(where: Where) -> int:
    """Number of lanes in a block."""
    return math.prod(part.stop - part.start for part in where)


def worker_count(workers: int | None) -> int:
    """So many threads, or one for each core.

    **Raises:** `TypeError` or `ValueError` for what is no count.
    """
    if workers is not None:
        return count("workers", workers, least=1)
    return lanes.cores()


def block_size(total: int, workers: int, devices: int) -> int:
    """Lanes in a block of a grid of `total` lanes where the user names no number.

    Few sizes, because each is a program of its own; small enough to occupy every core.
    """
    if jax.default_backend() != "cpu":
        most, share = _ON_ACCELERATOR * devices, total
    else:
        most, share = _MOST * devices, math.ceil(total / workers)
    size = _LEAST * devices
    while size < min(share, most):
        size *= 2
    return size


def rounded(lanes: int, total: int, devices: int) -> int:
    """So many lanes in a block, but no more than the grid has, made a multiple of what it must be.

    **Raises:** `TypeError` or `ValueError` for what is no count.
    """
    lanes = min(count("lanes", lanes, least=1), total)
    step = _LEAST * devices
    return math.ceil(lanes / step) * step


@functools.cache
def _compiled(devices: int) -> Callable[..., dict[str, Array]]:
    """A program of a block of lanes, compiled for so many devices."""
    mesh = Mesh(np.asarray(jax.local_devices()[:devices]), ("lanes",))
    whole, split = PartitionSpec(), PartitionSpec("lanes")

    def here(program, values, wanted):
        return program(values, wanted)

    def over_devices(program, values, wanted):
        numbers, rest = eqx.partition(program, eqx.is_array)
        return jax.shard_map(
            lambda numbers, *lanes: here(eqx.combine(numbers, rest), *lanes),
            mesh=mesh, in_specs=(whole, split, split), out_specs=split, check_vma=False,
        )(numbers, values, wanted)  # fmt: skip

    return CompiledFunction(here if devices == 1 else over_devices, PLAIN, **compiling())


def compute(
    program: ScanProgram,
    values: dict[str, np.ndarray],
    lanes: int,
    devices: int = 1,
    *,
    dry: bool = False,
) -> dict[str, np.ndarray]:
    """The numbers of a block of lanes, by name, as the program finds them.

    A block is filled up to `lanes`, so that all blocks are one program. With several devices the
    lanes are dealt to them in turn, since neighbours take alike long. `dry` only compiles: none of
    the lanes is run.

    **Arguments:** the program; the axes' values of each lane; the size of a full block; over how
    many local devices it is spread; whether to compile only.
    """
    size = next(iter(values.values())).size
    deal = np.arange(lanes).reshape(-1, devices).T.ravel()
    place = np.minimum(deal, size - 1)
    filled = {name: jnp.asarray(x[place]) for name, x in values.items()}
    out = _compiled(devices)(program, filled, jnp.asarray((deal < size) & (not dry)))
    back = np.argsort(deal)[:size]
    return {name: np.asarray(x)[back] for name, x in out.items()}


def run_here(
    program: ScanProgram, blocks: Blocks, todo: list[Where], workers: int, devices: int
) -> Iterator[tuple[Where, dict[str, np.ndarray]]]:
    """The blocks `todo` with their numbers, as they are done, each on one core, several at a time.

    On an accelerator, or over several devices, one at a time.

    **Arguments:** `blocks`, the whole grid; `todo`, which of its blocks; `workers`, threads;
    `devices`, on how many a block is spread.
    """
    if devices > 1 or jax.default_backend() != "cpu":
        workers = 1
    if todo and workers > 1:
        # Compiled here, once and not in several threads at a time, by a block without lanes.
        compute(program, blocks.values(todo[0]), blocks.lanes, devices, dry=True)

    x64 = _x64()

    def work(where):
        with jax.enable_x64(x64), lanes.threads(1):  # a thread has its own
            return where, compute(program, blocks.values(where), blocks.lanes, devices)

    waiting = iter(todo)
    pool = ThreadPoolExecutor(workers)
    running: set[Future] = set()
    try:
        while True:
            while len(running) < workers:
                where = next(waiting, None)
                if where is None:
                    break
                running.add(pool.submit(work, where))
            if not running:
                return
            ended, running = wait(running, return_when=FIRST_COMPLETED)
            for future in ended:
                yield future.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


class ClusterLost(Exception):
    """The scheduler of a cluster does not answer."""


def run_on_cluster(
    program: ScanProgram, blocks: Blocks, todo: list[Where], client: Any
) -> Iterator[tuple[Where, dict[str, np.ndarray]]]:
    """Blocks as Dask tasks, as they are done. **Raises:** `ClusterLost`; what a task raises."""
    from dask.distributed import as_completed

    if client.status != "running":
        raise ClusterLost
    x64 = _x64()
    # Small enough to go with every task: data that are shared would die with their worker.
    parcel = PicklableProgram(program)
    where_of = {
        client.submit(
            _remote, parcel, blocks.values(where), blocks.lanes, x64, pure=False, retries=3
        ): where
        for where in todo
    }
    try:
        for future in as_completed(list(where_of)):
            try:
                found = future.result()
            except (CancelledError, OSError) as error:
                if future.status == "error":  # a task's own
                    raise
                raise ClusterLost from error
            yield where_of.pop(future), found
    finally:
        if client.status == "running":  # else it would wait for an answer
            client.cancel(list(where_of))


def _x64() -> bool:
    return jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]


class PicklableProgram:
    """A scan's program on its way to another process, with NumPy's arrays in place of JAX's."""

    def __init__(self, program: ScanProgram):
        self.inner = jtu.tree_map(lambda x: np.asarray(x) if eqx.is_array(x) else x, program)


def _remote(
    parcel: PicklableProgram, values: dict[str, np.ndarray], lanes: int, x64: bool
) -> dict[str, np.ndarray]:
    with jax.enable_x64(x64):
        program = jtu.tree_map(
            lambda x: jnp.asarray(x) if eqx.is_array_like(x) else x, parcel.inner
        )
        return compute(program, values, lanes)
