"""Reverse mode by columns: forward along every number, the derivatives weighted by cotangents."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from ._primitive import DIRECTIONS, lanes_p
from ._program import LaneProgram


def by_columns(
    program: LaneProgram,
    backend: str,
    args: Sequence[Any],
    weights: Mapping[int, Any],
    batch: tuple[int, ...],
) -> dict[int, Any]:
    """The program is run forward along every number that is differentiated, `DIRECTIONS` of them
    with one motion, and each derivative is weighted with the cotangents.

    **Arguments:** a program that is linear in some inputs; its backend; its arguments, `None` for
    these inputs; the cotangents of its results, by their places; the axes of the batch.

    **Returns:** the cotangents of these inputs, by their places, each with the axes of the batch.
    """
    places: dict[int, slice] = {}  # of each such input among the numbers of all
    number = 0
    for i, (x, aval) in enumerate(zip(args, program.in_avals, strict=True)):
        if x is None:
            places[i] = slice(number, number + aval.size)
            number += aval.size
    size = min(number, DIRECTIONS)
    units = jnp.eye(-(-number // size) * size, number)  # filled up: one program for all
    along = jax.vmap(
        functools.partial(lanes_p.bind, program=program, backend=backend),
        [0 if i in places else None for i in range(len(args))],
        axis_size=size,
    )
    found = []
    for first in range(0, number, size):
        given = list(args)
        for i, place in places.items():
            aval = program.in_avals[i]
            some = units[first : first + size, place].astype(aval.dtype)
            given[i] = some.reshape(size, *aval.shape)
        columns = along(*given)
        found.append(sum(_weighted(columns[k], x, 1 + len(batch)) for k, x in weights.items()))
    each = jnp.concatenate(found)[:number]  # (numbers, *batch)
    out = {}
    for i, place in places.items():
        aval = program.in_avals[i]
        x = jnp.moveaxis(each[place], 0, -1)
        out[i] = x.reshape(*batch, *aval.shape).astype(aval.dtype)
    return out


def _weighted(column, weight, kept: int):
    """The weighted sum over all but the first `kept` axes. A value of weight 0 may be NaN, as
    after a failure."""
    product = jnp.where(weight == 0, 0.0, column * weight)
    return jnp.sum(product, axis=tuple(range(kept, product.ndim)))
