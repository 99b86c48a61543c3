"""What is checked of a scan before any work: its machines at the corners of the grid."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..flow import check_noise, check_reals, check_values
from ..machine import check_again, with_leaf
from ._shaken import MACHINE, part_of
from .grid import Blocks
from .program import ScanProgram, check_leaf_name


def _corners(blocks: Blocks) -> np.ndarray:
    """The lanes in which the axes have their least and greatest values, one in a row."""
    rows = list(blocks.axes.values())
    if blocks.paired:
        ends = {int(place) for x in rows for place in (x.argmin(), x.argmax())}
        return np.stack([x[sorted(ends)] for x in rows], axis=-1)
    corners: Any = [np.unique([x.min(), x.max()]) for x in rows]
    return np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, len(rows))


def check_corners(program: ScanProgram, blocks: Blocks) -> ScanProgram:
    """The program, once machine, start and method are checked at the corners of the grid.

    What the gaps are at the corners says whether a body can come to rest anywhere on the grid; if
    none can, the program leaves that out. (Where a function makes the machines, the program knows
    it already.) Axes that are paired have no corners: machines are checked at all their lanes.

    **Raises:** `ValueError` or `TypeError` for what cannot be run.
    """
    rests = False
    if blocks.paired and program.machine is not None:
        lanes = {
            name: jnp.asarray(x) for name, x in blocks.axes.items() if part_of(name) == MACHINE
        }
        machine = program.machine
        for name, x in lanes.items():
            machine = with_leaf(machine, name, x)
        check_again(machine)  # all lanes at a time
    for values in _corners(blocks):
        lane = {name: jnp.asarray(x) for name, x in zip(blocks.axes, values, strict=True)}
        machine, start = program.lane(lane)
        check_again(machine)
        rests = rests or machine.may_rest()
        for name in program.derivatives:
            check_leaf_name(machine, start, name, "derivatives", program.shaken)
        program.method.check(machine)
        start = machine.adopt(start)
        check_reals("start", start)
        check_values(machine, start)
        if program.shaken is not None:
            check_noise(machine, start, program.shaken.noise_of(lane))
    if program.build is not None:
        return program
    return dataclasses.replace(program, options=dataclasses.replace(program.options, rests=rests))
