"""Where a scan's numbers go: arrays in memory, or a Zarr store that survives interruption."""

import json
import os
import tempfile
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._checks import unwritable
from .._messages import installed_version, warn
from .._types import xr, zarr
from .grid import Blocks

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

# What stands in whole numbers of lanes that were not computed, `result` among them.
NOT_COMPUTED = -1

# The attribute that says which release began a store.
_RELEASE = "vi_jax"

# What begins the digest of code that cannot be compared.
UNVERIFIABLE = "it has no source: "

Where = tuple[slice, ...]
"""A block: where it lies on each axis of the grid."""


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
    """Arrays in memory, for a scan without a store."""

    def __init__(self, blocks: Blocks, variables: Mapping[str, Variable]):
        self.arrays: Mapping[str, Any] = {
            name: np.full(blocks.shape + v.sizes, v.empty, v.dtype) for name, v in variables.items()
        }
        self.blocks, self.variables = blocks, variables

    def open_blocks(self) -> list[Where]:
        """Return the blocks still to be computed."""
        return list(self.blocks)

    def write(self, where: Where, numbers: Mapping[str, np.ndarray]) -> None:
        """Write a block's numbers. Once its `result` is written, the block counts as computed."""
        for name in sorted(self.variables, key=lambda name: name == "result"):
            array = self.arrays[name]
            lanes = tuple(part.stop - part.start for part in where)
            array[where] = numbers[name].reshape(lanes + array.shape[len(where) :])

    def close(self) -> None:
        """Nothing is held."""

    def data(self) -> "xr.Dataset":
        """Return the arrays with their axes and attributes."""
        return xr.Dataset(
            {
                name: ((*self.blocks.dims, *v.dims), self.arrays[name], dict(v.attributes))
                for name, v in self.variables.items()
            },
            coords={name: (self.blocks.dims_of(name), x) for name, x in self.blocks.axes.items()},
        )


class ZarrStore(MemoryStore):
    """A Zarr group on disk, one chunk for each block, with Zarr's check sum of each (CRC-32C).

    Chunks of NaN are written too, so that a missing chunk of a computed block is a lost one. No
    other process, and no other scan of this one, may write to the store until it is closed.

    **Raises:** `ValueError` for a folder that is not the store of this scan, or is in use.
    """

    def __init__(
        self,
        path: str | Path,
        description: Mapping[str, Any],
        blocks: Blocks,
        variables: Mapping[str, Variable],
    ):
        self.path, self.blocks, self.variables = Path(path), blocks, variables
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
        self._lock = _locked(self.path)
        try:
            self._open(description, new=new)
        except BaseException:
            self.close()
            raise

    def _open(self, description: Mapping[str, Any], *, new: bool) -> None:
        with zarr.config.set({"array.write_empty_chunks": True}):
            try:
                group = zarr.open_group(str(self.path), mode="r+", zarr_format=3)
            except Exception as error:
                raise ValueError(
                    f"Argument `store` must be the store of a scan, but {self.path / 'zarr.json'} "
                    f"cannot be read: {error}."
                ) from None
            _compare(self.path, dict(group.attrs), description, new=new)
            self.arrays = {name: group[name] for name in (*self.variables, *self.blocks.axes)}
        begun, now = group.attrs.get(_RELEASE), installed_version()
        if begun is not None and begun != now:
            warn(
                f"{self.path} was begun by vi_jax {begun}, and this is {now}: the blocks that are "
                "still missing come from another release than those that are there."
            )
        for name, x in self.blocks.axes.items():
            found = _read(self.arrays[name], ...)
            if found is None or not np.array_equal(found, x):
                self.lost.append(name)
                self.arrays[name][:] = x

    def close(self) -> None:
        """Let others write."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def open_blocks(self) -> list[Where]:
        """Return the blocks still to be computed. Warns of damaged ones, which are among them."""
        found = [where for where in self.blocks if not self._is_done(where)]
        if self.lost:
            more = f" and {len(self.lost) - 5:,} more" if len(self.lost) > 5 else ""
            warn(
                f"Blocks in {self.path} are lost or damaged, and are computed again: "
                f"{', '.join(self.lost[:5])}{more}."
            )
        return found

    def _is_done(self, where: Where) -> bool:
        chunks = {name: self._chunk(name, where) for name in self.variables}
        if not (self.path / chunks["result"]).exists():
            return False
        lost = [
            chunk
            for name, chunk in chunks.items()
            if not (self.path / chunk).exists() or _read(self.arrays[name], where) is None
        ]
        self.lost += lost
        return not lost

    def _chunk(self, name: str, where: Where) -> str:
        """The file of a block's numbers."""
        corner = [part.start // n for part, n in zip(where, self.blocks.block, strict=True)]
        corner += [0] * len(self.variables[name].sizes)
        return "/".join([name, "c", *map(str, corner)])

    def data(self) -> "xr.Dataset":
        """Return the data of the store, which are read when they are used."""
        data = xr.open_zarr(str(self.path), chunks=None, mask_and_scale=False)
        return data[[*data["result"].dims, *sorted(map(str, data.data_vars))]]


def _read(array: Any, where: Any) -> np.ndarray | None:
    """The numbers there, or `None`: a file may be cut short or hold anything."""
    try:
        return np.asarray(array[where])
    except Exception:
        return None


def _locked(folder: Path) -> int | None:
    """A descriptor that holds a lock until it is closed; `None` where there are no locks."""
    if fcntl is None:
        return None
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return lock
    except BlockingIOError:
        os.close(lock)
        raise ValueError(
            f"Argument `store` must not be in use, but another scan writes to {folder}. Wait for "
            "its end, or give another folder."
        ) from None
    except OSError:  # a file system without locks
        os.close(lock)
        return None


def _make(
    path: Path, description: Mapping[str, Any], blocks: Blocks, variables: Mapping[str, Variable]
) -> None:
    """An empty store, made beside its place and then renamed: it is there whole or not at all."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as beside:
        made = Path(beside) / "store"
        about = {"scan": description, _RELEASE: installed_version()}
        group = zarr.create_group(str(made), zarr_format=3, attributes=about)
        compressors = [ZstdCodec(), Crc32cCodec()]
        for name, x in blocks.axes.items():
            group.create_array(
                name, data=x, dimension_names=blocks.dims_of(name), compressors=compressors
            )
        for name, v in variables.items():
            group.create_array(
                name,
                shape=blocks.shape + v.sizes,
                chunks=blocks.block + v.sizes,
                dtype=v.dtype,
                fill_value=v.empty,
                dimension_names=(*blocks.dims, *v.dims),
                attributes=dict(v.attributes),
                compressors=compressors,
            )
        with warnings.catch_warnings():
            # With it one file describes all arrays, and others open the store without a warning.
            warnings.filterwarnings("ignore", "Consolidated metadata")
            zarr.consolidate_metadata(str(made), zarr_format=3)
        try:
            made.rename(path)
        except OSError:
            if not (path / "zarr.json").exists():
                raise  # else another scan made it in the meantime


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
                f"same as that in {path}: {code}. Define its functions and classes in a file."
            )
