"""Where a scan's numbers go: arrays in memory, or a Zarr store that survives interruption."""

import json
import tempfile
import warnings
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._checks import unwritable
from .._messages import installed_version, warn
from .._types import xr, zarr
from .grid import Blocks

# What stands in whole numbers of lanes that were not computed, `result` among them.
NOT_COMPUTED = -1

UNVERIFIABLE = "it cannot be looked at: "

# What lies in the store, not what it was made with: a file may have been lost since.
_AS_IT_IS: dict[str, Any] = {"use_consolidated": False}

# The attribute that says which release began a store.
_RELEASE = "vi_jax"

# Where the check sums lie: a row for each block, a column for each variable. They are written last,
# and are in a group of their own, so that they are no variable of the data set.
_CHECK = "check"
_SUMS = f"{_CHECK}/sums"


class Variable(NamedTuple):
    """One array of a scan: axes beyond the grid's, their sizes, type and attributes."""

    dims: tuple[str, ...]
    sizes: tuple[int, ...]
    dtype: np.dtype
    attributes: Mapping[str, Any]

    @property
    def empty(self) -> Any:
        """What stands where nothing was computed."""
        return np.nan if np.issubdtype(self.dtype, np.floating) else NOT_COMPUTED


class MemoryStore:
    """Arrays in memory, for a scan that nothing is to be kept of."""

    def __init__(self, blocks: Blocks, variables: Mapping[str, Variable]):
        self.arrays = {
            name: np.full(blocks.shape + v.sizes, v.empty, v.dtype) for name, v in variables.items()
        }
        self.blocks, self.variables = blocks, dict(variables)

    def open_blocks(self) -> list[tuple[slice, ...]]:
        """The blocks still to be computed: all."""
        return list(self.blocks)

    def write(self, where: tuple[slice, ...], numbers: Mapping[str, np.ndarray]) -> None:
        """Put a block's numbers in their place in the arrays."""
        for name, x in numbers.items():
            array = self.arrays[name]
            array[where] = x.reshape(array[where].shape)

    def data(self) -> "xr.Dataset":
        """The arrays with their axes and attributes."""
        return xr.Dataset(
            {
                name: ((*self.blocks.dims, *v.dims), self.arrays[name], dict(v.attributes))
                for name, v in self.variables.items()
            },
            coords={name: (self.blocks.dims_of(name), x) for name, x in self.blocks.axes.items()},
        )


class ZarrStore:
    """A Zarr group on disk, one chunk for each block, with a check sum of each chunk.

    The check sums of a block are written last, so that it counts as done only if all its numbers
    are there, and are those that were computed. What was lost since is named and computed again.
    """

    def __init__(
        self,
        path: str | Path,
        description: Mapping[str, Any],
        blocks: Blocks,
        variables: Mapping[str, Variable],
    ):
        self.path, self.blocks, self.variables = Path(path), blocks, dict(variables)
        self.names = sorted(variables)
        self.lost: list[str] = []
        description = json.loads(json.dumps(description))
        new = not (self.path / "zarr.json").exists()
        if new:
            if self.path.exists() and (self.path.is_file() or any(self.path.iterdir())):
                raise ValueError(
                    f"Argument `store` must be a new folder or the store of a scan, but {path} "
                    "is neither."
                )
            _make(self.path, description, blocks, variables)
        try:
            self.group = zarr.open_group(str(self.path), mode="r+", zarr_format=3, **_AS_IT_IS)
        except Exception as error:
            raise ValueError(
                f"Argument `store` must be the store of a scan, but {self.path / 'zarr.json'} "
                f"cannot be read: {error}."
            ) from None
        _compare(self.path, dict(self.group.attrs), description, new=new)
        self._warn_of_release()
        self._complete()

    def _warn_of_release(self) -> None:
        begun, now = self.group.attrs.get(_RELEASE), installed_version()
        if begun is not None and begun != now:
            warn(
                f"{self.path} was begun by vi_jax {begun}, and this is {now}: the blocks that are "
                "still missing come from another release than those that are there."
            )

    def _complete(self) -> None:
        """Make again what arrays are missing, or are not those of this scan."""
        for name, v in self.variables.items():
            array = _tried(lambda name=name: self.group[name])
            if not isinstance(array, zarr.Array) or array.chunks != self.blocks.block + v.sizes:
                self.lost.append(name)
                _add_variable(self.group, name, v, self.blocks)
        for name, x in self.blocks.axes.items():
            there = _tried(lambda name=name: np.asarray(self.group[name]))
            if not isinstance(there, np.ndarray) or not np.array_equal(there, x):
                self.lost.append(name)
                _add_axis(self.group, name, x, self.blocks)
        if not isinstance(_tried(lambda: self.group[_CHECK]), zarr.Group):
            # Only its head is made again: the sums below it may be whole.
            self.lost.append(f"{_CHECK}/zarr.json")
            (self.path / _CHECK / "zarr.json").unlink(missing_ok=True)
            self.group.require_group(_CHECK)
        shape = (len(self.blocks), len(self.names))
        if getattr(_tried(lambda: self.group[_SUMS]), "shape", None) != shape:
            self.lost.append(_SUMS)
            _add_sums(self.group, shape)

    def open_blocks(self) -> list[tuple[slice, ...]]:
        """The blocks still to be computed. Warns of those that were, and are not as they were."""
        found = [where for i, where in enumerate(self.blocks) if not self._done(i, where)]
        if self.lost:
            more = f" and {len(self.lost) - 5:,} more" if len(self.lost) > 5 else ""
            warn(
                f"In {self.path} what was computed is lost or damaged, and is computed again: "
                f"{', '.join(self.lost[:5])}{more}."
            )
        return found

    def _done(self, index: int, where: tuple[slice, ...]) -> bool:
        sums = _tried(lambda: self._array(_SUMS)[index])
        if not isinstance(sums, np.ndarray):
            self.lost.append(f"{_SUMS}/c/{index}/0")
            return False
        if not sums.any():
            return False  # not yet computed, or not to its end
        lost = []
        for name, wanted in zip(self.names, sums.tolist(), strict=True):
            array = self._array(name)
            numbers = _tried(lambda array=array: np.asarray(array[where]))
            if not isinstance(numbers, np.ndarray) or _sum(numbers, array.dtype) != wanted:
                corner = [part.start // n for part, n in zip(where, self.blocks.block, strict=True)]
                corner += [0] * (array.ndim - len(corner))
                lost.append("/".join([name, "c", *map(str, corner)]))
        self.lost += lost
        return not lost

    def write(self, where: tuple[slice, ...], numbers: Mapping[str, np.ndarray]) -> None:
        """Write a block's numbers to its chunks, and then their check sums."""
        sums = []
        for name in self.names:
            array = self._array(name)
            shape = tuple(part.stop - part.start for part in where) + array.shape[len(where) :]
            array[where] = numbers[name].reshape(shape)
            sums.append(_sum(numbers[name], array.dtype))
        self._array(_SUMS)[self.blocks.index(where)] = sums

    def data(self) -> "xr.Dataset":
        """The data of the store, read as they are looked at."""
        data = xr.open_zarr(str(self.path), consolidated=False, chunks=None, mask_and_scale=False)
        # Not in the order in which a file system lists them.
        return data[[*data["result"].dims, *sorted(map(str, data.data_vars))]]

    def _array(self, name: str) -> Any:
        return self.group[name]


def _tried(read: Callable[[], Any]) -> Any:
    """What is read, or `None`: a file may be missing, cut short or hold anything."""
    try:
        return read()
    except Exception:
        return None


def _sum(numbers: np.ndarray, dtype: np.dtype) -> int:
    """A check sum, never 0, of numbers of any shape; Zarr stores every NaN as the same one."""
    numbers = np.ascontiguousarray(numbers, dtype)
    if dtype.kind == "f":
        numbers = np.where(np.isnan(numbers), dtype.type(np.nan), numbers)
    return zlib.crc32(numbers.tobytes()) or 1


def _make(
    path: Path, description: Mapping[str, Any], blocks: Blocks, variables: Mapping[str, Variable]
) -> None:
    """An empty store, made beside its place and then renamed: it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as beside:
        made = Path(beside) / "store"
        about = {"scan": description, _RELEASE: installed_version()}
        group = zarr.create_group(str(made), zarr_format=3, attributes=about)
        for name, x in blocks.axes.items():
            _add_axis(group, name, x, blocks)
        for name, v in variables.items():
            _add_variable(group, name, v, blocks)
        _add_sums(group, (len(blocks), len(variables)))
        with warnings.catch_warnings():
            # By it others open the store at once, and without a warning that it is not there.
            warnings.filterwarnings("ignore", "Consolidated metadata")
            zarr.consolidate_metadata(str(made), zarr_format=3)
        try:
            made.rename(path)
        except OSError:
            if not (path / "zarr.json").exists():
                raise  # else another scan made it in the meantime


def _add_axis(group: Any, name: str, x: np.ndarray, blocks: Blocks) -> None:
    coordinate = group.create_array(
        name, shape=x.shape, dtype=x.dtype, dimension_names=blocks.dims_of(name), overwrite=True
    )
    coordinate[:] = x


def _add_variable(group: Any, name: str, v: Variable, blocks: Blocks) -> None:
    group.create_array(
        name,
        shape=blocks.shape + v.sizes,
        chunks=blocks.block + v.sizes,
        dtype=v.dtype,
        fill_value=v.empty,
        dimension_names=(*blocks.dims, *v.dims),
        attributes=dict(v.attributes),
        overwrite=True,
    )


def _add_sums(group: Any, shape: tuple[int, int]) -> None:
    group.create_array(
        _SUMS, shape=shape, chunks=(1, shape[1]), dtype="uint32", fill_value=0, overwrite=True
    )


def check_writable(path: str | Path) -> None:
    """**Raises:** `ValueError` if no store can be written there; makes the folders above it."""
    problem = "it is empty" if path == "" else unwritable(Path(path).parent)
    if problem is None and "\0" in str(path):
        problem = "it holds a null character"
    elif problem is None and Path(path).is_dir():
        problem = unwritable(path)
    if problem is not None:
        raise ValueError(
            f"Argument `store` must be a path that can be written to, but {path} is not: {problem}."
        )


def _compare(
    path: Path, attributes: Mapping[str, Any], wanted: Mapping[str, Any], *, new: bool
) -> None:
    """Refuse to mix two scans in one store."""
    there = attributes.get("scan")
    if there is None:
        raise ValueError(
            f"Argument `store` must be a new folder or the store of a scan, but {path} is another "
            "Zarr group."
        )
    for key in dict.fromkeys([*wanted, *there]):
        old, now = there.get(key), wanted.get(key)
        if old == now:
            continue
        if isinstance(old, dict) and isinstance(now, dict):
            inner = next(k for k in sorted({*old, *now}) if old.get(k) != now.get(k))
            key, old, now = f"{key} {inner}", old.get(inner), now.get(inner)
        raise ValueError(
            f"Argument `store` must be new or hold the same scan, but in {path} the {key} is "
            f"{old}, and now it is {now}."
        )
    for what, code in wanted["code of"].items():
        if not new and code.startswith(UNVERIFIABLE):
            raise ValueError(
                f"Argument `store` must be new, since it is unknown whether the {what} is the "
                f"same as that in {path}: {code}."
            )
