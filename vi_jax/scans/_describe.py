"""What a scan is, in words and numbers: by it a store knows its own scan, and data their origin
and their variables."""

import functools
import hashlib
import inspect
import json
import re
import sys
import types
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._messages import installed_version
from ..flow import REASON_NAMES
from ..machine import AbstractMachine, attributes, leaf, leaf_names, outcomes_of, unit_of, units_of
from ._lane_noise import NOISE, START, part_of
from .grid import LANE, Blocks
from .program import ScanProgram
from .regime import flags
from .store import NOT_COMPUTED, UNVERIFIABLE, Variable


def description_of(program: ScanProgram, blocks: Blocks) -> dict[str, Any]:
    """What makes two scans the same, in words and numbers that JSON can hold."""

    def described(tree: object) -> str:
        return _lasting(eqx.tree_pformat(tree, short_arrays=False, width=10**6))

    machine: dict[str, Any] = {}
    parts = {"": program.machine}
    if program.machine is None:  # a function is known by what it makes
        machine = {"made by": _lasting(getattr(program.build, "__qualname__", repr(program.build)))}
        parts = {"first ": program.at(blocks, 0)[0], "last ": program.at(blocks, -1)[0]}
    for which, part in parts.items():
        machine |= {which + name: x for name, x in _numbers(part).items()}
        machine[f"{which}structure"] = _lasting(str(jtu.tree_structure(part)))
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


def _lasting(text: str) -> str:
    """Without addresses in memory, which are others in each process."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _codes(program: ScanProgram) -> dict[str, str]:
    """What tells the user's own functions and classes from others of the same name."""
    parts: dict[str, Any] = {"machine": program.machine if program.build is None else program.build}
    parts |= {"start": program.start, "method": program.method}
    if program.lane_noise is not None and program.lane_noise.noise.functions:
        parts["noise"] = program.lane_noise.noise.functions
    for i, measure in enumerate(program.measures):
        parts[f"measure {i + 1}"] = measure
    return {name: identity(part) for name, part in parts.items()}


# Code that does not change while a study goes on, and is known by its name.
_LIBRARIES = {
    "vi_jax", "jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "optax", "optimistix",
    "lineax", "jaxtyping", "beartype", "xarray", "matplotlib", *sys.stdlib_module_names,
}  # fmt: skip

# What a class holds besides what its author wrote.
_MADE = (types.GetSetDescriptorType, types.MemberDescriptorType, types.WrapperDescriptorType)


def identity(thing: object) -> str:
    """Return a digest of a function, or of an object: the source of its code, and its content.

    A function refers to its defaults, to the variables that it closes over and to the globals that
    it names; functions and classes among them are part of the digest, unless they are a library's.
    Of an object count its class and its attributes. If something has neither source nor content,
    the answer begins with `UNVERIFIABLE` and names it.
    """
    digest = hashlib.sha256()
    try:
        for word in _words(thing, {}):
            digest.update(word.encode("utf-8", "backslashreplace") + b"\0")
    except (OSError, TypeError, RecursionError) as error:
        return f"{UNVERIFIABLE}{error}"
    return digest.hexdigest()[:16]


def _words(thing: Any, seen: dict[int, Any]) -> Iterator[str]:
    """The words that `thing` is made of. `seen` holds what was begun: things refer in rings."""
    if thing is None or isinstance(thing, int | float | complex | str | bytes | np.dtype):
        yield repr(thing)
    elif isinstance(thing, np.ndarray | np.generic | jax.Array):
        array = np.asarray(thing)
        yield f"{array.dtype} {array.shape} {hashlib.sha256(array.tobytes()).hexdigest()}"
    elif isinstance(thing, types.ModuleType):
        yield thing.__name__
    elif id(thing) in seen:
        yield str(list(seen).index(id(thing)))
    else:
        seen[id(thing)] = thing
        yield type(thing).__qualname__
        for part in _parts(inspect.unwrap(thing) if callable(thing) else thing):
            yield from _words(part, seen)


def _parts(thing: Any) -> list[Any]:
    """What `thing` consists of.

    **Raises:** `OSError` or `TypeError` for what has neither source nor content.
    """
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
        name = [thing.__module__, thing.__qualname__]
        own = (thing.__module__ or "").partition(".")[0] not in _LIBRARIES
        if isinstance(thing, type):
            return [*name, *thing.__bases__, *_members(thing)] if own else name
        used = inspect.getclosurevars(thing)
        if not own:
            return [*name, used.nonlocals]
        if inspect.getfile(thing) == "<string>":  # Python 3.13 has that of `python -c` for all
            raise OSError("it was made by `exec`")
        source = inspect.getsource(thing)
        return [source, thing.__defaults__, thing.__kwdefaults__, used.nonlocals, used.globals]
    return [type(thing), *thing.__reduce_ex__(2)[1:3]]


def _members(kind: type) -> Iterator[Any]:
    """What the author of a class wrote in it: methods and plain values, with their names."""
    for name, value in sorted(vars(kind).items()):
        code = getattr(inspect.unwrap(value) if callable(value) else value, "__code__", None)
        is_made = isinstance(value, _MADE) or (code and code.co_filename == "<string>")
        is_plain = isinstance(value, int | float | complex | str | bytes) and name[:2] != "__"
        if (hasattr(value, "__get__") and not is_made) or is_plain:
            yield from (name, value)


def _numbers(tree: Any) -> dict[str, Any]:
    return {name: np.asarray(leaf(tree, name), float).tolist() for name in leaf_names(tree)}


def attributes_of(about: dict[str, Any], machine: AbstractMachine) -> dict[str, Any]:
    """The attributes of a scan's data, from its description and one of its machines."""
    found = {"vi_jax": installed_version(), "machine_class": type(machine).__name__}
    found |= {name: about[name] for name in ("method", "settle", "cycles", "precision")}
    tables = [name for name in ("machine", "start", "noise") if name in about]
    return found | {name: json.dumps(about[name]) for name in tables}


def variables_of(program: ScanProgram, blocks: Blocks) -> dict[str, Variable]:
    """The variables that a program computes, by name, found without computing them."""
    values = {name: jnp.zeros(4) + x[0] for name, x in blocks.axes.items()}
    if blocks.numbers is not None:
        values[LANE] = jnp.zeros(4, jnp.uint32)
    shapes = eqx.filter_eval_shape(program, values, jnp.ones(4, bool))
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
    for measure in program.measures:
        known |= measure.described(start)
    found, units = {}, units_of(machine)
    for name, shape in shapes.items():
        by = name.startswith("d_") and name not in known and bool(program.derivatives)
        about = dict(known.get(name.removeprefix("d_") if by else name, {}))
        dims = tuple(about.pop("dims", ()))
        if "unit_of" in about:
            about |= attributes(unit_of(units, about.pop("unit_of")))
        if by:
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


def unit_on_axis(program: ScanProgram, blocks: Blocks, name: str) -> str:
    """The unit of an axis' values; "" where a function makes the machine, which has its own, and of
    an amplitude of noise."""
    if part_of(name) == NOISE:
        return ""
    if program.build is not None and not name.startswith(START):
        return ""
    return unit_of(units_of(program.at(blocks, 0)[0]), name)
