"""Reverse mode: the transpose of `lanes`, and the primitive `lanes_backward`, which uses a tape.

`lanes_backward` computes Jᵀc, with the Jacobian J of a program's results and rows with respect to
some of its inputs, and their cotangents c. On a CPU it is a kernel with a forward and a reverse
pass (`_tape.py`), else it goes by columns. Its derivatives use the same code. D is the program of
the values y and the derivatives Jv. Run backward with the cotangents dc of y and c of Jv, it gives

    d(Jᵀc) = Jᵀ dc + ∂(cᵀJv)/∂x.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir

from ._derivative import forward
from ._primitive import (
    DIRECTIONS,
    axes_of,
    lanes_p,
    lower_to_kernel,
    primitive_of_programs,
    with_lane_axis,
)
from ._program import LaneProgram, batch_of, size_of
from ._reverse import ReverseProgram, reverse


def by_columns(
    program: LaneProgram,
    rows: int,
    backend: str,
    args: Sequence[Any],
    weights: Mapping[int, Any],
    batch: tuple[int, ...],
) -> dict[int, Any]:
    """Run the program forward along each number, and weight the derivatives with the cotangents. Up
    to `DIRECTIONS` numbers share one motion. Inputs in which the program is linear are `None` in
    `args`; the result has their cotangents by place, with the batch axes. `weights` has the
    cotangents of the results by place."""
    places: dict[int, slice] = {}  # the range of each such input among the numbers of all
    number = 0
    for i, (x, aval) in enumerate(zip(args, program.in_avals, strict=True)):
        if x is None:
            places[i] = slice(number, number + aval.size)
            number += aval.size
    if not number:  # only empty arrays
        avals = {i: program.in_avals[i] for i in places}
        return {i: jnp.zeros((*batch, *x.shape), x.dtype) for i, x in avals.items()}
    size = min(number, DIRECTIONS)
    units = jnp.eye(-(-number // size) * size, number)  # padded, so that one program serves all
    run_many = jax.vmap(
        functools.partial(lanes_p.bind, program=program, rows=rows, backend=backend),
        [0 if i in places else None for i in range(len(args))],
        axis_size=size,
    )
    weighted = []
    for first in range(0, number, size):
        inputs = list(args)
        for i, place in places.items():
            aval = program.in_avals[i]
            unit = units[first : first + size, place].astype(aval.dtype)
            inputs[i] = unit.reshape(size, *aval.shape)
        columns = run_many(*inputs)
        weighted.append(sum(_weighted(columns[k], x, 1 + len(batch)) for k, x in weights.items()))
    numbers = jnp.concatenate(weighted)[:number]  # (numbers, *batch)
    out = {}
    for i, place in places.items():
        aval = program.in_avals[i]
        x = jnp.moveaxis(numbers[place], 0, -1)
        out[i] = x.reshape(*batch, *aval.shape).astype(aval.dtype)
    return out


def _weighted(column, weight, kept: int):
    """Return the weighted sum over all but the first `kept` axes; values of weight 0 may be NaN."""
    product = jnp.where(weight == 0, 0.0, column * weight)
    return jnp.sum(product, axis=tuple(range(kept, product.ndim)))


# Up to so many numbers go by columns. Measured: a gradient through 64 motors for 50 cycles on one
# thread, with respect to 1, 2, 4, 8, 11 numbers. In units of one simulation, columns took 2.1, 2.5,
# 3.3, 6.7, 9.7; a tape took 3.2, 3.3, 3.5, 4.5, 4.5. Both compile in about the same time.
_BY_COLUMNS = 4

# For steps longer than so many equations the limit grows with the square of the step's length. A
# tape takes some 1.5 ms per equation to trace, columns a third of that. A motor's step has 3,600.
_SHORT = 4_000

# The cost of one cotangent by a tape, in columns (from the measurement of `_BY_COLUMNS`).
_COLUMNS_EACH = 4

# A tape keeps and goes through all numbers of the carry in each iteration. With many of them, as in
# the history of a machine with delays, it is as fast as one column for so many numbers. Measured:
# 970 numbers, 61 simulations.
_CARRIED_EACH, _MANY = 16, 256

lanes_backward_p = primitive_of_programs("lanes_backward")


# --- the transpose of `lanes`


def _transposed(cotangents, *args, program: LaneProgram, rows: int, backend: str):
    """Transpose a program: by a tape for many numbers, if possible, else by columns."""
    linear = [ad.is_undefined_primal(x) for x in args]
    shapes = [x.aval.shape if u else jnp.shape(x) for x, u in zip(args, linear, strict=True)]
    batch = batch_of(program, shapes)
    weights = {k: ct for k, ct in enumerate(cotangents) if type(ct) is not ad.Zero}
    number = sum(a.size for a, u in zip(program.in_avals, linear, strict=True) if u)
    found = None
    if backend != "xla" and number > _most_columns(program):
        found = _by_tape(program, rows, args, linear, weights)
    if found is None:
        inputs = [None if u else jnp.asarray(x) for x, u in zip(args, linear, strict=True)]
        found = by_columns(program, rows, backend, inputs, weights, batch)
    out: list[Any] = [None] * len(args)
    for i, x in found.items():
        out[i] = _for_argument(x, program.in_avals[i], args[i].aval)
    return out


@functools.lru_cache(maxsize=64)
def _most_columns(program: LaneProgram) -> float:
    """Return the greatest number of numbers for which columns are used."""
    base = program.base or program
    length, carried = size_of(base.step.jaxpr), sum(a.size for a in base.carry_avals)
    limit = _BY_COLUMNS * max(1.0, length / _SHORT) ** 2
    return limit if carried < _MANY else max(limit, carried / _CARRIED_EACH)


def _for_argument(x, lane_aval, aval):
    """Return the cotangent of an argument: the sum over lanes, if all share it."""
    if aval.ndim == lane_aval.ndim:
        x = jnp.sum(x, axis=tuple(range(x.ndim - lane_aval.ndim)))
    return x.reshape(aval.shape).astype(aval.dtype)


def _by_tape(
    program: LaneProgram, rows: int, args, linear: list[bool], weights
) -> dict[int, Any] | None:
    """Return cotangents by the places of their tangents, which are flagged in `linear`. Return
    `None` if it is no program of values and derivatives, or if a part of it has no transpose."""
    base = program.base
    if base is None or not program.varied or any(linear[: len(base.in_avals)]):
        return None
    places = _tangent_places(program)
    wanted = tuple(i in places and linear[places[i]] for i in range(len(base.in_avals)))
    slopes = forward(base, program.varied).slopes
    if set(weights) - set(slopes.values()):
        return None
    given = tuple(slopes.get(k, -1) in weights for k in range(base.result_count))
    back = reverse(base, wanted, given)
    if back is None:
        return None
    inputs = [jnp.asarray(x) for x in args[: len(base.in_avals)]]
    cotangents = [weights[slopes[k]] for k, flag in enumerate(given) if flag]
    found = lanes_backward_p.bind(*inputs, *cotangents, program=back, rows=rows)
    targets = [places[i] for i, flag in enumerate(wanted) if flag]
    return dict(zip(targets, found, strict=True))


def _tangent_places(program: LaneProgram) -> dict[int, int]:
    """Return a dictionary from inputs of a program's base to the places of their tangents."""
    assert program.base is not None
    varied = [i for i, flag in enumerate(program.varied) if flag]
    return {i: len(program.base.in_avals) + n for n, i in enumerate(varied)}


ad.primitive_transposes[lanes_p] = _transposed


# --- `lanes_backward`


def _columns(*args, program: ReverseProgram, rows: int) -> list[Any]:
    base, varied = program.program, program.varied
    n, batch = len(base.in_avals), batch_of(program, [x.shape for x in args])
    inputs, weights_given = list(args[:n]), args[n:]
    inputs[0] = jnp.broadcast_to(inputs[0], (*batch, *base.in_avals[0].shape))
    derived = forward(base, varied)
    slopes = derived.slopes
    cotangents = iter(weights_given)
    weights = {slopes[k]: next(cotangents) for k, flag in enumerate(program.given) if flag}
    tangents = [None for flag in varied if flag]
    found = by_columns(derived.program, rows, "auto", [*inputs, *tangents], weights, batch)
    return [found[n + k] for k in range(len(tangents))]


def _batched(args, dims, *, program: ReverseProgram, rows: int):
    """Make an axis of `jax.vmap` one of lanes. But many cotangents of the same motions, as in
    `jax.jacrev`, go by columns, which share the motions."""
    args = [jnp.asarray(x) for x in args]
    n, (size, inner) = len(program.program.in_avals), axes_of(program, args, dims)
    number = sum(a.size for a in program.results())
    same_motions = all(d is None for d in dims[:n])
    if same_motions and size * _COLUMNS_EACH > number:
        columns = jax.vmap(functools.partial(_columns, program=program, rows=rows), dims)
        return columns(*args), [0] * len(program.results())
    moved = with_lane_axis(args, dims, program.in_avals, inner, size)
    out = lanes_backward_p.bind(*moved, program=program, rows=rows)
    return out, [0] * len(out)


def _jvp(primals, tangents, *, program: ReverseProgram, rows: int):
    """Return Jᵀc and its derivative (see the module's docstring)."""
    values = lanes_backward_p.bind(*primals, program=program, rows=rows)
    base, n = program.program, len(program.program.in_avals)
    moved = tuple(type(x) is not ad.Zero for x in tangents[:n])
    changed = [None if type(x) is ad.Zero else x for x in tangents[n:]]
    inputs, cotangents = primals[:n], primals[n:]
    dc = _by_result(program, changed)
    if any(moved):
        derived, _, places, slopes = forward(base, moved)
        c = _by_result(program, cotangents)
        weights = {slopes[k]: x for k, x in c.items() if k in slopes}
        weights |= {places[k]: x for k, x in dc.items()}
        inputs = [*inputs, *(x for x, flag in zip(tangents[:n], moved, strict=True) if flag)]
    else:
        derived, weights = base, dc
    wanted = (*program.varied, *(False for _ in inputs[n:]))
    given = tuple(k in weights for k in range(derived.result_count))
    if not weights:
        return values, [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in values]
    back = reverse(derived, wanted, given)
    if back is None:
        columns = functools.partial(_columns, program=program, rows=rows)
        return values, jax.jvp(columns, primals, [*map(ad.instantiate_zeros, tangents)])[1]
    ordered = [weights[k] for k in sorted(weights)]
    return values, lanes_backward_p.bind(*inputs, *ordered, program=back, rows=rows)


def _by_result(program: ReverseProgram, cotangents: Sequence[Any]) -> dict[int, Any]:
    """Return the cotangents that exist by the places of their results or row parts."""
    places = [k for k, flag in enumerate(program.given) if flag]
    return {k: x for k, x in zip(places, cotangents, strict=True) if x is not None}


def _transposed_back(*_, **__):
    raise NotImplementedError(
        "A gradient that uses a tape has no derivative in reverse mode. Use forward mode for all "
        "derivatives after the first: `jax.jacfwd(jax.grad(f))` or `jax.jvp(jax.grad(f), x, v)`."
    )


batching.primitive_batchers[lanes_backward_p] = _batched
ad.primitive_transposes[lanes_backward_p] = _transposed_back
ad.primitive_jvps[lanes_backward_p] = _jvp


_columns_lowered = mlir.lower_fun(_columns, multiple_results=True)


def _lowered(ctx, *args, program: ReverseProgram, rows: int):
    otherwise = functools.partial(_columns_lowered, ctx, *args, program=program, rows=rows)
    return lower_to_kernel(ctx, args, program, rows, otherwise)


mlir.register_lowering(lanes_backward_p, _lowered, platform="cpu")
mlir.register_lowering(lanes_backward_p, _columns_lowered)
