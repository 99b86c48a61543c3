"""The variables of a scan's data: their names, sizes, types, units and descriptions."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..flow.results import REASON_NAMES
from ..machine.units import attributes, unit_of
from .grid import Blocks
from .program import START, ScanProgram
from .regime import flags
from .store import NOT_COMPUTED, Variable


def variables_of(program: ScanProgram, blocks: Blocks) -> dict[str, Variable]:
    """The variables that a program computes, by name, found without computing them."""
    values = {name: jnp.zeros(4) + x[0] for name, x in blocks.axes.items()}
    shapes = eqx.filter_eval_shape(program, values, jnp.ones(4, bool))
    known: dict[str, Mapping[str, Any]] = {
        "result": {
            "long_name": "how the lane ended",
            **flags({"not_computed": NOT_COMPUTED} | {n: i for i, n in enumerate(REASON_NAMES)}),
        }
    }
    machine, start = program.first(blocks)
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
    """The unit of an axis' values; "" where a function makes the machine, which has its own."""
    if program.build is not None and not name.startswith(START):
        return ""
    return unit_of(program.first(blocks)[0].units, name)
