"""Where a scan's numbers go: arrays in memory, or a Zarr store that survives interruption."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
import zarr

from .._checks import unwritable
from .grid import Blocks

_UNDONE = -1


class Variable(NamedTuple):
    """One array of a scan: axes beyond the grid's, their sizes, type and attributes."""

    dims: tuple[str, ...]
    sizes: tuple[int, ...]
    dtype: np.dtype
    attributes: Mapping[str, Any]

    @property
    def empty(self) -> Any:
        """What stands where nothing was computed."""
        return np.nan if np.issubdtype(self.dtype, np.floating) else _UNDONE


class MemoryStore:
    """Arrays in memory."""

    def __init__(self, shape: tuple[int, ...], variables: Mapping[str, Variable]):
        self.arrays = {
            name: np.full(shape + v.sizes, v.empty, v.dtype) for name, v in variables.items()
        }

    def done(self, where: tuple[slice, ...]) -> bool:
        """Whether the block was computed."""
        return _computed(self.arrays["result"], where)

    def write(self, where: tuple[slice, ...], numbers: Mapping[str, np.ndarray]) -> None:
        """Keep a block's numbers."""
        for name, x in numbers.items():
            array = self.arrays[name]
            array[where] = x.reshape(array[where].shape)


class ZarrStore:
    """A Zarr group on disk, one chunk for each block.

    `result` is written last, and a chunk appears whole or not at all, so that a block counts as
    done only if all its numbers are there.
    """

    def __init__(
        self,
        path: str | Path,
        description: Mapping[str, Any],
        blocks: Blocks,
        variables: Mapping[str, Variable],
    ):
        self.path = Path(path)
        description = json.loads(json.dumps(description))
        if not (self.path / "zarr.json").exists():
            if self.path.exists() and (self.path.is_file() or any(self.path.iterdir())):
                raise ValueError(
                    f"Argument `store` must be a new folder or the store of a scan, but {path} "
                    "is neither."
                )
            _make(self.path, description, blocks, variables)
        self.group = zarr.open_group(str(self.path), mode="r+", zarr_format=3)
        _compare(self.path, dict(self.group.attrs), description)

    def done(self, where: tuple[slice, ...]) -> bool:
        """Whether the block was computed."""
        return _computed(self._array("result"), where)

    def write(self, where: tuple[slice, ...], numbers: Mapping[str, np.ndarray]) -> None:
        """Keep a block's numbers."""
        for name in sorted(numbers, key=lambda name: name == "result"):
            array = self._array(name)
            shape = tuple(part.stop - part.start for part in where) + array.shape[len(where) :]
            array[where] = numbers[name].reshape(shape)

    def _array(self, name: str) -> Any:
        return self.group[name]


def _computed(results: Any, where: tuple[slice, ...]) -> bool:
    return bool((results[where] != _UNDONE).all())


def _make(
    path: Path, description: Mapping[str, Any], blocks: Blocks, variables: Mapping[str, Variable]
) -> None:
    """An empty store, made beside its place and then renamed: it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as beside:
        made = Path(beside) / "store"
        group = zarr.create_group(str(made), zarr_format=3, attributes={"scan": description})
        for name, x in blocks.axes.items():
            coordinate = group.create_array(
                name, shape=x.shape, dtype=x.dtype, dimension_names=blocks.dims_of(name)
            )
            coordinate[:] = x
        for name, v in variables.items():
            group.create_array(
                name,
                shape=blocks.shape + v.sizes,
                chunks=blocks.block + v.sizes,
                dtype=v.dtype,
                fill_value=v.empty,
                dimension_names=(*blocks.dims, *v.dims),
                attributes=dict(v.attributes),
            )
        try:
            made.rename(path)
        except OSError:
            if not (path / "zarr.json").exists():
                raise  # else another scan made it in the meantime


def check_writable(path: str | Path) -> None:
    """**Raises:** `ValueError` if no store can be written there; makes the folders above it."""
    problem = unwritable(Path(path).parent)
    if problem is not None:
        raise ValueError(
            f"Argument `store` must be a path that can be written to, but {path} is not: {problem}."
        )


def _compare(path: Path, attributes: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Refuse to mix two scans in one store."""
    there = attributes.get("scan")
    if there is None:
        raise ValueError(
            f"Argument `store` must be a new folder or the store of a scan, but {path} is another "
            "Zarr group."
        )
    for key in dict.fromkeys([*wanted, *there]):
        old, new = there.get(key), wanted.get(key)
        if old == new:
            continue
        if isinstance(old, dict) and isinstance(new, dict):
            inner = next(k for k in sorted({*old, *new}) if old.get(k) != new.get(k))
            key, old, new = f"{key} {inner}", old.get(inner), new.get(inner)
        raise ValueError(
            f"Argument `store` must be new or hold the same scan, but in {path} the {key} is "
            f"{old}, and now it is {new}."
        )


def open_dataset(path: Path) -> xr.Dataset:
    """The data of a store, read as they are looked at."""
    return xr.open_zarr(str(path), consolidated=False, chunks=None, mask_and_scale=False)


def dataset(
    arrays: Mapping[str, np.ndarray],
    blocks: Blocks,
    variables: Mapping[str, Variable],
) -> xr.Dataset:
    """Arrays with their axes and attributes."""
    return xr.Dataset(
        {
            name: ((*blocks.dims, *v.dims), arrays[name], dict(v.attributes))
            for name, v in variables.items()
        },
        coords={name: (blocks.dims_of(name), x) for name, x in blocks.axes.items()},
    )
