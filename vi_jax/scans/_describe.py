"""What a scan is, in words and numbers: by it a store knows its own scan, and data their origin
and their variables."""

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._messages import installed_version
from ..flow import REASON_NAMES
from ..machine import AbstractMachine, attributes, leaf, leaf_names, unit_of
from ._identity import Unverifiable, identity
from ._shaken import NOISE, START, part_of
from .grid import LANE, Blocks
from .measures import Regime
from .program import ScanProgram
from .regime import CODES, flags
from .store import NOT_COMPUTED, UNVERIFIABLE, Variable


def description_of(program: ScanProgram, blocks: Blocks) -> dict[str, Any]:
    """What makes two scans the same, in words and numbers that JSON can hold."""

    def described(tree: object) -> str:
        return _lasting(eqx.tree_pformat(tree, short_arrays=False, width=10**6))

    machine: dict[str, Any]
    if program.machine is not None:
        machine = {
            name: _described(leaf(program.machine, name)) for name in leaf_names(program.machine)
        }
        machine["structure"] = _lasting(str(jtu.tree_structure(program.machine)))
    else:  # a function is known by what it makes
        machine = {"made by": _lasting(getattr(program.build, "__qualname__", repr(program.build)))}
        for name, place in (("first", 0), ("last", -1)):
            made, _ = program.lane(_lane(blocks, place))
            machine |= {
                f"{name} {leaf_}": _described(leaf(made, leaf_)) for leaf_ in leaf_names(made)
            }
            machine[f"{name} structure"] = _lasting(str(jtu.tree_structure(made)))
    start: Any = "the machine's own"
    if program.start is not None:
        start = {name: _described(leaf(program.start, name)) for name in leaf_names(program.start)}
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
    if program.shaken is not None:
        about["noise"] = program.shaken.described()
    if any(isinstance(measure, Regime) for measure in program.measures):
        # A store of an earlier release has other numbers for them, not to be mixed with these.
        about["regimes"] = dict(CODES)
    return about


def _lasting(text: str) -> str:
    """Without addresses in memory, which are others in each process."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", text)


def _lane(blocks: Blocks, place: int) -> dict[str, Any]:
    return {name: jnp.asarray(x[place]) for name, x in blocks.axes.items()}


def _codes(program: ScanProgram) -> dict[str, str]:
    """What tells the user's own functions and classes from others of the same name."""
    parts: dict[str, Any] = {"machine": program.machine if program.build is None else program.build}
    parts |= {"start": program.start, "method": program.method}
    if program.shaken is not None and program.shaken.noise.functions:
        parts["noise"] = program.shaken.noise.functions
    for i, measure in enumerate(program.measures):
        parts[f"measure {i + 1}"] = measure
    found = {}
    for name, part in parts.items():
        try:
            found[name] = identity(part)
        except Unverifiable as error:
            found[name] = f"{UNVERIFIABLE}{error}"
    return found


def _described(x: object) -> Any:
    return np.asarray(x, float).tolist()


def attributes_of(about: dict[str, Any], machine: AbstractMachine) -> dict[str, Any]:
    """The attributes of a scan's data, from its description and one of its machines."""
    return {
        "vi_jax": installed_version(),
        "machine_class": type(machine).__name__,
        "method": about["method"],
        "settle": about["settle"],
        "cycles": about["cycles"],
        "machine": json.dumps(about["machine"]),
        "start": json.dumps(about["start"]),
        "precision": about["precision"],
    } | ({"noise": json.dumps(about["noise"])} if "noise" in about else {})


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
    machine, start = program.first(blocks)
    if machine.outcomes:
        outcomes = {name: i for i, name in enumerate(machine.outcomes)}
        known["outcome"] = {
            "long_name": "outcome with which an event ended the motion",
            **flags({"none": -1} | outcomes),
        }
    for measure in program.measures:
        known |= measure.described(start)
    found = {}
    for name, shape in shapes.items():
        by = name.startswith("d_") and name not in known and bool(program.derivatives)
        about = dict(known.get(name.removeprefix("d_") if by else name, {}))
        dims = tuple(about.pop("dims", ()))
        if "unit_of" in about:
            about |= attributes(unit_of(machine.units, about.pop("unit_of")))
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
    return unit_of(program.first(blocks)[0].units, name)
