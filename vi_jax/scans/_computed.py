"""A grid computed by a scan's program, block by block, wherever that is done."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from .._checks import count, fits_memory, fits_records
from .._messages import Interrupted, at_work
from .._types import xr
from ..machine import attributes as units_of
from ._describe import attributes_of, description_of, unit_on_axis, variables_of
from ._shaken import lane_numbers
from ._work import ClusterLost, block_size, rounded, run_here, run_on_cluster, size_of, worker_count
from .corners import check_corners
from .grid import Blocks
from .program import ScanProgram
from .store import MemoryStore, ZarrStore, check_writable


class ScanInterrupted(Interrupted):
    """Raised when a scan is interrupted: what was computed is not lost, but in `data`."""

    def __init__(self, data: "xr.Dataset", store: str | Path | None):
        kept = "what was computed is in `.data`"
        if store is not None:
            kept = f"what was computed is in {store}, and the same call goes on from there"
        super().__init__("scan", data, kept)
        self.data = data


class Workplace(NamedTuple):
    """Where blocks are computed: by threads on local devices, or by a Dask cluster."""

    workers: int
    devices: int
    cluster: Any


def workplace(workers: int | None, devices: int | None, cluster: object) -> Workplace:
    """As many threads and devices as are asked for, or as there are.

    **Raises:** `ValueError` for more devices than there are.
    """
    workers, there = worker_count(workers), len(jax.local_devices())
    devices = there if devices is None else count("devices", devices, least=1)
    if devices > there:
        raise ValueError(
            f"Argument `devices` must be at most {there}, the local devices, but got {devices}."
        )
    return Workplace(workers, devices, cluster)


def computed(
    program: ScanProgram, blocks: Blocks, place: Workplace, store: Any = None, progress=False
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
    done = total - sum(size_of(where) for where in open_blocks)
    try:
        with at_work(
            "scan", lambda: ScanInterrupted(collected(), store),
            progress=progress, unit="lane", total=total, done=done,
        ) as tell:  # fmt: skip
            found = (
                run_on_cluster(program, blocks, open_blocks, place.cluster)
                if place.cluster is not None
                else run_here(program, blocks, open_blocks, place.workers, place.devices)
            )
            for where, numbers in found:
                kept.write(where, numbers)
                tell(size_of(where))
    except ClusterLost as lost:
        raise ConnectionError(_how_to_go_on(kept)) from lost
    return collected()


def in_blocks(
    program: ScanProgram,
    grid: Mapping[str, np.ndarray],
    place: Workplace,
    paired: bool,
    store: str | Path | None = None,
    lanes: int | None = None,
    numbers: np.ndarray | None = None,
) -> Blocks:
    """The grid in blocks of `lanes`: as in the store if there is one, or as suits the workplace.

    **Arguments:** `grid`, values by axis; `place`, where it is computed; `paired`, whether the axes
    have one length and are gone along together; `store`, a path or `None`; `lanes`, `None` to
    choose; `numbers` of the lanes, by which noise tells them apart, by default their places.

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
    points = program.cycles * max(1, program.options.samples) + 1
    fits_records(at_fault, lanes * points, 12)
    if program.shaken is not None and numbers is None:
        numbers = lane_numbers(total)
    return Blocks(grid, lanes, paired=paired, numbers=numbers)


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


def _lanes_in(path: Path) -> int | None:
    """The block size of a store that is there already."""
    try:
        attributes = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        return int(attributes["scan"]["lanes"])
    except (OSError, KeyError, ValueError, TypeError):
        return None
