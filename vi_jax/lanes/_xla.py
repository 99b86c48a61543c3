"""XLA's backend: the same loop for any device and any primitive. All lanes of a batch advance
together, until the last has ended."""

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import jaxpr_as_fun

from ._program import LaneProgram

# Steps between two questions whether any lane goes on: the answer travels from a GPU to the
# processor, and asked at each step it took a sixth of the time of 10,000 lanes.
_UNASKED = 8


def run(program: LaneProgram, *args: Any) -> list[Any]:
    """Results and rows of a batch of lanes: what the primitive gives.

    **Arguments:** the program; its inputs, each with the axes of the batch before its own, or
    without them where all lanes share it.
    """
    batch = program.batch([x.shape for x in args])
    lanes = math.prod(batch)
    if lanes == 0:
        avals = [(a, a.shape) for a in program.out_avals]
        avals += [(a, (program.rows, *a.shape)) for a in program.row_avals]
        return [jnp.zeros((*batch, *shape), a.dtype) for a, shape in avals]
    axes = [
        None if batch and x.ndim == a.ndim else 0
        for x, a in zip(args, program.in_avals, strict=True)
    ]
    flat = [
        x if axis is None else x.reshape(lanes, *a.shape)
        for x, a, axis in zip(args, program.in_avals, axes, strict=True)
    ]
    out = _run_together(program, flat, axes, lanes)
    return [x.reshape(*batch, *x.shape[1:]) for x in out]


def _run_together(
    program: LaneProgram, inputs: list, axes: list[int | None], lanes: int
) -> list[Any]:
    """Results and rows of lanes with one leading axis.

    **Arguments:** `axes`, 0 for an input that has a value for each lane, else `None`.
    """
    n, index = len(program.carry_avals), jnp.arange(lanes)
    carried = [0] * n
    begin = jax.vmap(jaxpr_as_fun(program.begin), in_axes=axes, axis_size=lanes)
    step = jax.vmap(jaxpr_as_fun(program.step), in_axes=(*axes, *carried), axis_size=lanes)
    end = jax.vmap(jaxpr_as_fun(program.end), in_axes=(*axes, *carried), axis_size=lanes)

    def stored(rows: list, filled: jax.Array, complete: jax.Array, row: list) -> list:
        # A lane without a new row writes beyond the end, which is dropped; so no two lanes write to
        # one place, and `rows` is not copied. Within `lax.cond` it was, at each step: two thirds of
        # the time on a GPU (JAX 0.11.2).
        at = jnp.where(complete, filled, program.rows)
        own = {"mode": "drop", "unique_indices": True, "indices_are_sorted": True}
        return [r.at[index, at].set(x, **own) for r, x in zip(rows, row, strict=True)]

    def iteration(_: Any, state: tuple) -> tuple:
        carry, active, filled, rows = state
        out = step(*inputs, *carry)
        # A lane that has ended keeps what it had.
        carry = [_where(active, a, b) for a, b in zip(out[:n], carry, strict=True)]
        complete = active & out[n + 1]
        rows = stored(rows, filled, complete, out[n + 2 :])
        return carry, active & out[n], filled + complete, rows

    rows = [
        jnp.full((lanes, program.rows, *a.shape), _empty(a.dtype), a.dtype)
        for a in program.row_avals
    ]
    filled = jnp.zeros(lanes, jnp.int32)
    out = begin(*inputs)
    carry, active, complete, row = list(out[:n]), out[n], out[n + 1], out[n + 2 :]
    state = (carry, active, filled + complete, stored(rows, filled, complete, row))
    carry, _, _, rows = jax.lax.while_loop(
        lambda state: jnp.any(state[1]),
        lambda state: jax.lax.fori_loop(0, _UNASKED, iteration, state),
        state,
    )
    return [*end(*inputs, *carry), *rows]


def _empty(dtype):
    return jnp.nan if jnp.issubdtype(dtype, jnp.inexact) else 0


def _where(flag, a, b):
    return jnp.where(flag.reshape(flag.shape + (1,) * (a.ndim - 1)), a, b)
