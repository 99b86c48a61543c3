"""Storage of a scan's results, as arrays in memory or as a Zarr store that survives interruption;
and the description of a scan, by which a store recognizes it."""

import dis
import functools
import hashlib
import inspect
import json
import math
import os
import re
import sys
import tempfile
import types
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import fits_memory, unwritable
from .._messages import installed_version, warn
from .._types import xr, zarr
from ..flow import REASON_NAMES
from ..machine import attributes, leaf, leaf_names, outcomes_of, unit_of, units_of
from .measures import flags, legends
from .program import LANE, NOISE, START, Blocks, ScanProgram, part_of

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

# The value of integers, `result` among them, in lanes that were not computed.
NOT_COMPUTED = -1

# The attribute with the release that began a store.
_RELEASE = "vi_jax"

# The beginning of the digest of code that cannot be compared.
UNVERIFIABLE = "it has no source: "

Where = tuple[slice, ...]
"""A block: its slice on each axis of the grid."""


class Variable(NamedTuple):
    """An array of a scan: axes beyond the grid's, their sizes, type and attributes."""

    dims: tuple[str, ...]
    sizes: tuple[int, ...]
    dtype: np.dtype
    attributes: Mapping[str, Any]

    @property
    def empty(self) -> Any:
        """The value in lanes that were not computed."""
        return np.nan if np.issubdtype(self.dtype, np.floating) else NOT_COMPUTED


class MemoryStore:
    def __init__(self, program: ScanProgram, blocks: Blocks, variables: Mapping[str, Variable]):
        self.program, self.blocks, self.variables = program, blocks, variables
        # In the form read from a file.
        self.about = json.loads(json.dumps(_description_of(program, blocks)))
        self.arrays: Mapping[str, Any] = self._opened()

    def _opened(self) -> Mapping[str, Any]:
        shape, variables = self.blocks.shape, self.variables.items()
        return {name: np.full(shape + v.sizes, v.empty, v.dtype) for name, v in variables}

    def open_blocks(self) -> list[Where]:
        return list(self.blocks)

    def write(self, where: Where, numbers: Mapping[str, np.ndarray]) -> None:
        """Write a block's numbers. Once its `result` is written, the block counts as computed."""
        for name in sorted(self.variables, key=lambda name: name == "result"):
            array = self.arrays[name]
            lanes = tuple(part.stop - part.start for part in where)
            array[where] = numbers[name].reshape(lanes + array.shape[len(where) :])

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def data(self) -> "xr.Dataset":
        data, (machine, _) = self._labelled(), self.program.at(self.blocks, 0)
        for name in self.blocks.axes:
            # Machines from a function have no numbers with these names, and noise has no units.
            known = name.startswith(START) or self.program.build is None
            if known and part_of(name) != NOISE:
                data[name].attrs |= attributes(unit_of(units_of(machine), name))
        data.attrs = legends(data)
        data.attrs |= {"vi_jax": installed_version(), "machine_class": type(machine).__name__}
        data.attrs |= {x: self.about[x] for x in ("method", "settle", "cycles", "precision")}
        tables = [name for name in ("machine", "start", "noise") if name in self.about]
        data.attrs |= {name: json.dumps(self.about[name]) for name in tables}
        return data

    def _labelled(self) -> "xr.Dataset":
        return xr.Dataset(
            {
                name: ((*self.blocks.dims, *v.dims), self.arrays[name], dict(v.attributes))
                for name, v in self.variables.items()
            },
            coords={name: (self.blocks.dims_of(name), x) for name, x in self.blocks.axes.items()},
        )


class ZarrStore(MemoryStore):
    """A Zarr group on disk with a chunk for each block, with Zarr's checksum of each (CRC-32C).
    Chunks of NaN are written too, so that a missing chunk of a computed block is a lost one. No
    other process, and no other scan of this one, may write to the store until it is closed."""

    def __init__(self, path: str | Path, *scan: Any):
        self.path, self.lost = Path(path), list[str]()
        super().__init__(*scan)

    def _opened(self) -> Mapping[str, Any]:
        new = not (self.path / "zarr.json").exists()
        if new:
            if self.path.exists() and (self.path.is_file() or any(self.path.iterdir())):
                raise ValueError(
                    f"Argument `store` must be a new folder or the store of a scan, but "
                    f"{self.path} is neither."
                )
            _create_store(self.path, self.about, self.blocks, self.variables)
        self._lock = _locked(self.path)
        try:
            return self._checked(new=new)
        except BaseException:
            self.close()
            raise

    def _checked(self, *, new: bool) -> Mapping[str, Any]:
        with zarr.config.set({"array.write_empty_chunks": True}):
            try:
                group = zarr.open_group(str(self.path), mode="r+", zarr_format=3)
            except Exception as error:
                raise ValueError(
                    f"Argument `store` must be the store of a scan, but {self.path / 'zarr.json'} "
                    f"cannot be read: {error}."
                ) from None
            _refuse_another_scan(self.path, dict(group.attrs), self.about, new=new)
            arrays: Any = {name: group[name] for name in (*self.variables, *self.blocks.axes)}
        begun, now = group.attrs.get(_RELEASE), installed_version()
        if begun is not None and begun != now:
            warn(
                f"{self.path} was begun by vi_jax {begun}, and this is {now}: the blocks that are "
                "still missing come from another release than those that are there."
            )
        for name, x in self.blocks.axes.items():
            found = _read(arrays[name], ...)
            if found is None or not np.array_equal(found, x):
                self.lost.append(name)
                arrays[name][:] = x
        return arrays

    def close(self) -> None:
        """Release the lock, so that others may write."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def open_blocks(self) -> list[Where]:
        """Return the blocks still to be computed. Warn of damaged ones, which are among them."""
        found = [where for where in self.blocks if not self._is_done(where)]
        if self.lost:
            more = f" and {len(self.lost) - 5:,} more" if len(self.lost) > 5 else ""
            warn(
                f"Blocks in {self.path} are lost or damaged, and are computed again: "
                f"{', '.join(self.lost[:5])}{more}."
            )
        return found

    def _is_done(self, where: Where) -> bool:
        chunks = {name: self._chunk_file(name, where) for name in self.variables}
        if not (self.path / chunks["result"]).exists():
            return False
        lost = [
            chunk
            for name, chunk in chunks.items()
            if not (self.path / chunk).exists() or _read(self.arrays[name], where) is None
        ]
        self.lost += lost
        return not lost

    def _chunk_file(self, name: str, where: Where) -> str:
        corner = [part.start // n for part, n in zip(where, self.blocks.block, strict=True)]
        corner += [0] * len(self.variables[name].sizes)
        return "/".join([name, "c", *map(str, corner)])

    def _labelled(self) -> "xr.Dataset":
        """Return the data of the store, which are read at their first use."""
        data = xr.open_zarr(str(self.path), chunks=None, mask_and_scale=False)
        return data[[*data["result"].dims, *sorted(map(str, data.data_vars))]]


def _read(array: Any, where: Any) -> np.ndarray | None:
    """Return the numbers there, or `None`: a file may be truncated or corrupt."""
    try:
        return np.asarray(array[where])
    except Exception:
        return None


def _locked(folder: Path) -> int | None:
    """Return a descriptor that holds a lock until it is closed; `None` without locks."""
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


def _create_store(
    path: Path, description: Mapping[str, Any], blocks: Blocks, variables: Mapping[str, Variable]
) -> None:
    """Create an empty store under another name and rename it: it exists as a whole or not."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        new_store = Path(folder) / "store"
        about = {"scan": description, _RELEASE: installed_version()}
        group = zarr.create_group(str(new_store), zarr_format=3, attributes=about)
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
            # One file then describes all arrays, and others open the store without a warning.
            warnings.filterwarnings("ignore", "Consolidated metadata")
            zarr.consolidate_metadata(str(new_store), zarr_format=3)
        try:
            new_store.rename(path)
        except OSError:
            if not (path / "zarr.json").exists():
                raise  # else another scan made it in the meantime


def opened(program: ScanProgram, blocks: Blocks, path: str | Path | None) -> MemoryStore:
    """Return the storage of a scan: a Zarr store, or memory without a path."""
    variables = _variables_of(program, blocks)
    per_lane = sum(math.prod(v.sizes) * v.dtype.itemsize for v in variables.values())
    in_memory = blocks.total * per_lane if path is None else blocks.total + 500 * len(blocks)
    fits_memory("axes", in_memory)
    if path is None:
        return MemoryStore(program, blocks, variables)
    _check_writable(path)
    return ZarrStore(path, program, blocks, variables)


def _check_writable(path: str | Path) -> None:
    """Raise `ValueError` if no store can be written there; create the folders above it."""
    problem = "it is empty" if path == "" else unwritable(Path(path).parent)
    if problem is None and "\0" in str(path):
        problem = "it holds a null character"
    elif problem is None and Path(path).is_dir():
        problem = unwritable(path)
    if problem is not None:
        raise ValueError(
            f"Argument `store` must be a path that can be written to, but {path} is not: {problem}."
        )


def _refuse_another_scan(
    path: Path, attributes: Mapping[str, Any], wanted: Mapping[str, Any], *, new: bool
) -> None:
    stored = attributes.get("scan")
    if stored is None:
        raise ValueError(
            f"Argument `store` must be a new folder or the store of a scan, but {path} is another "
            "Zarr group."
        )
    for key in dict.fromkeys([*wanted, *stored]):
        old, now = stored.get(key), wanted.get(key)
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


def _description_of(program: ScanProgram, blocks: Blocks) -> dict[str, Any]:
    """Return a description for comparison with other scans, in types of JSON."""

    def described(tree: object) -> str:
        return _cleaned(eqx.tree_pformat(tree, short_arrays=False, width=10**6))

    machine: dict[str, Any] = {}
    parts = {"": program.machine}
    if program.machine is None:  # a function is described by the machines that it makes
        machine = {"made by": _cleaned(getattr(program.build, "__qualname__", repr(program.build)))}
        parts = {"first ": program.at(blocks, 0)[0], "last ": program.at(blocks, -1)[0]}
    for which, part in parts.items():
        machine |= {which + name: x for name, x in _numbers(part).items()}
        machine[f"{which}structure"] = _cleaned(str(jtu.tree_structure(part)))
    start = "the machine's own" if program.start is None else _numbers(program.start)
    about: dict[str, Any] = {
        "machine": machine,
        "start": start,
        "paired": blocks.paired,
        "axis": {
            name: {
                "values": x.size,
                "from": float(x[0]),
                "to": float(x[-1]),
                "digest": hashlib.sha256(x.tobytes()).hexdigest()[:16],
            }
            for name, x in blocks.axes.items()
        },
        "measure": [described(m) for m in program.measures],
        "method": described(program.method),
        "clock": program.options.clock,
        "settle": int(program.options.settle),
        "cycles": program.cycles,
        "derivatives": list(program.derivatives),
        "max_impacts": program.options.max_impacts,
        "max_steps": program.options.max_steps,
        "lanes": blocks.lanes,
        "precision": str(jnp.result_type(float)),
        "code of": _codes(program),
    }
    if program.lane_noise is not None:
        about["noise"] = program.lane_noise.described()
    return about


def _cleaned(text: str) -> str:
    """Return a text without addresses in memory, which differ in each process."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _codes(program: ScanProgram) -> dict[str, str]:
    """Return digests of the user's own functions and classes."""
    parts: dict[str, Any] = {"machine": program.machine if program.build is None else program.build}
    parts |= {"start": program.start, "method": program.method}
    if program.lane_noise is not None and program.lane_noise.noise.functions:
        parts["noise"] = program.lane_noise.noise.functions
    for i, measure in enumerate(program.measures):
        parts[f"measure {i + 1}"] = measure
    return {name: identity(part) for name, part in parts.items()}


# Packages whose code does not change during a study; it is identified by name.
_LIBRARIES = {
    "vi_jax", "jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "optax", "optimistix",
    "lineax", "jaxtyping", "beartype", "xarray", "matplotlib", *sys.stdlib_module_names,
}  # fmt: skip

# Instructions that read a global: within a class body, names may be globals, too.
_LOADS = {"LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"}

# Members of a class that its author did not write.
_GENERATED = (types.GetSetDescriptorType, types.MemberDescriptorType, types.WrapperDescriptorType)


def identity(thing: object) -> str:
    """Return a digest of a function or an object, from its source code and its content: defaults,
    variables that it closes over, globals and members of modules that it names, class and
    attributes. Functions and classes among them count too, unless they are a library's. If
    something has neither source nor content, the result begins with `UNVERIFIABLE` and names it."""
    digest = hashlib.sha256()
    try:
        for word in _words(thing, {}):
            digest.update(word.encode("utf-8", "backslashreplace") + b"\0")
    except (OSError, TypeError, RecursionError) as error:
        return f"{UNVERIFIABLE}{error}"
    return digest.hexdigest()[:16]


def _words(thing: Any, visited: dict[int, Any]) -> Iterator[str]:
    """Yield the words that describe `thing`; `visited` objects may form cycles."""
    if thing is None or isinstance(thing, int | float | complex | str | bytes | np.dtype):
        yield repr(thing)
    elif isinstance(thing, np.ndarray | np.generic | jax.Array):
        array = np.asarray(thing)
        yield f"{array.dtype} {array.shape} {hashlib.sha256(array.tobytes()).hexdigest()}"
    elif isinstance(thing, types.ModuleType):
        yield thing.__name__
    elif id(thing) in visited:
        yield str(list(visited).index(id(thing)))
    else:
        visited[id(thing)] = thing
        yield type(thing).__qualname__
        for part in _parts(inspect.unwrap(thing) if callable(thing) else thing):
            yield from _words(part, visited)


def _parts(thing: Any) -> list[Any]:
    """Return the parts of an object. **Raises:** `OSError` or `TypeError` for one without any."""
    if isinstance(thing, set | frozenset):
        return sorted(map(identity, thing))
    if isinstance(thing, list | tuple):
        return list(thing)
    if isinstance(thing, Mapping):
        return [x for pair in thing.items() for x in pair]
    if isinstance(thing, functools.partial):
        return [thing.func, thing.args, thing.keywords]
    if isinstance(thing, types.MethodType):
        return [thing.__func__, thing.__self__]
    if isinstance(thing, types.BuiltinFunctionType | np.ufunc):
        return [thing.__name__]
    if isinstance(thing, property):
        return [thing.fget]
    if isinstance(thing, type | types.FunctionType):
        name, is_users = [thing.__module__, thing.__qualname__], _is_users(thing.__module__)
        if isinstance(thing, type):
            return [*name, *thing.__bases__, *_members(thing)] if is_users else name
        nonlocals = inspect.getclosurevars(thing).nonlocals
        if not is_users:
            return [*name, nonlocals]
        if inspect.getfile(thing) == "<string>":  # Python 3.13 names the source of `python -c` so
            raise OSError("it was made by `exec`")
        source = inspect.getsource(thing)
        if thing.__name__ == "<lambda>":  # a line may have several
            columns = [x[2] for x in thing.__code__.co_positions() if x[2]]
            source += str(min(columns, default=0))
        named = _named(thing.__code__)
        loaded = sorted(_globals_of(thing.__code__) & {*thing.__globals__})
        known = {n: thing.__globals__[n] for n in loaded}
        known |= {n: sys.modules[n] for n in sorted(named - {*known}) if n in sys.modules}
        modules = [
            x for x in (*known.values(), *nonlocals.values()) if isinstance(x, types.ModuleType)
        ]
        inside = list(_members_of_modules(modules, named))
        return [source, thing.__defaults__, thing.__kwdefaults__, nonlocals, known, inside]
    return [type(thing), *thing.__reduce_ex__(2)[1:3]]


def _is_users(module: str | None) -> bool:
    return (module or "").partition(".")[0] not in _LIBRARIES


def _named(code: types.CodeType) -> set[str]:
    """Return the names that a function reads, also within the functions that it defines."""
    return {name for each in _with_inner(code) for name in each.co_names}


def _globals_of(code: types.CodeType) -> set[str]:
    """Return the names of the globals that a function reads. The names of attributes are others."""
    instructions = (x for each in _with_inner(code) for x in dis.get_instructions(each))
    return {x.argval for x in instructions if x.opname in _LOADS}


def _with_inner(code: types.CodeType) -> Iterator[types.CodeType]:
    """Yield the code of a function and of those that it defines."""
    yield code
    for x in code.co_consts:
        if isinstance(x, types.CodeType):
            yield from _with_inner(x)


def _members_of_modules(modules: list[types.ModuleType], named: set[str]) -> Iterator[Any]:
    """Yield the members that a function may read from a user's modules, with their names."""
    modules, visited = list(modules), set[int]()
    for module in modules:  # grows
        if not _is_users(module.__name__) or id(module) in visited:
            continue
        visited.add(id(module))
        for name in sorted(named & {*vars(module)}):
            member = getattr(module, name)
            if isinstance(member, types.ModuleType):
                modules.append(member)
            yield from (f"{module.__name__}.{name}", member)


def _members(kind: type) -> Iterator[Any]:
    """Yield the methods and values that the author of a class wrote, with their names."""
    for name, value in sorted(vars(kind).items()):
        code = getattr(inspect.unwrap(value) if callable(value) else value, "__code__", None)
        is_generated = isinstance(value, _GENERATED) or (code and code.co_filename == "<string>")
        is_value = not hasattr(value, "__get__") and name[:2] != "__" and name != "_abc_impl"
        if (hasattr(value, "__get__") and not is_generated) or is_value:
            yield from (name, value)


def _numbers(tree: Any) -> dict[str, Any]:
    return {name: np.asarray(leaf(tree, name), float).tolist() for name in leaf_names(tree)}


def _variables_of(program: ScanProgram, blocks: Blocks) -> dict[str, Variable]:
    values = {name: np.zeros(4) + x[0] for name, x in blocks.axes.items()}
    if blocks.numbers is not None:
        values[LANE] = np.zeros(4, np.uint32)
    shapes = eqx.filter_eval_shape(program, values, np.ones(4, bool))
    known: dict[str, Mapping[str, Any]] = {
        "result": {
            "long_name": "how the lane ended",
            **flags({"not_computed": NOT_COMPUTED} | {n: i for i, n in enumerate(REASON_NAMES)}),
        }
    }
    machine, start = program.at(blocks, 0)
    if outcomes_of(machine):
        names = [name.replace(" ", "_") for name in outcomes_of(machine)]
        outcomes = {name: i for i, name in enumerate(names)}
        known["outcome"] = {
            "long_name": "outcome with which an event ended the motion",
            **flags({"none": -1} | outcomes),
        }
        known["outcome_cycle"] = {"long_name": "cycles before that event; -1 without one"}
        known["outcome_phase"] = {"long_name": "clock at it since their end", "unit_of": "phase"}
    for measure in program.measures:
        known |= measure.described(start)
    found, units = {}, units_of(machine)
    for name, shape in shapes.items():
        is_derivative = name.startswith("d_") and name not in known and bool(program.derivatives)
        about = dict(known.get(name.removeprefix("d_") if is_derivative else name, {}))
        dims = tuple(about.pop("dims", ()))
        if "unit_of" in about:
            about |= attributes(unit_of(units, about.pop("unit_of")))
        if is_derivative:
            dims = ("by", *dims)
            about = {
                "long_name": f"derivative of {name.removeprefix('d_')}",
                "by": list(program.derivatives),
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
