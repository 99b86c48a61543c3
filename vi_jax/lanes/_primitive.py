"""The JAX primitive behind `run`: its batching, forward derivative and lowering for both backends.

Its transpose, used in reverse mode, is in `_backward.py`.
"""

import functools
import math
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Literal, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir, partial_eval

from .._loading import without_collection
from ._arrays import MOST_IN_REGISTERS
from ._derivative import forward, widened
from ._program import LaneProgram, batch_of, dependent_parts, shape_of
from ._shared import set_within
from ._vector import Unsupported
from .call import header, register_handler
from .elementary import run_outside_jit
from .runtime import AnyProgram, kernel_of

_vector_only: ContextVar[bool] = ContextVar("strict", default=False)


def vector_only() -> AbstractContextManager:
    """Raise `Unsupported` within this context for programs whose lanes cannot be vector code,
    instead of compiling them for XLA's backend."""
    return set_within(_vector_only, True)


def primitive_of_programs(name: str) -> Primitive:
    primitive = Primitive(name)
    primitive.multiple_results = True

    @primitive.def_abstract_eval
    def _(*args, program: AnyProgram, rows: int, **others):
        batch = batch_of(program, [a.shape for a in args])
        return [ShapedArray((*batch, *a.shape), a.dtype) for a in program.results(rows)]

    run_outside_jit(primitive)
    return primitive


lanes_p = primitive_of_programs("lanes")

# The most directions of a derivative within one lane. Six directions took 19 ms so, and 48 ms as
# separate lanes.
DIRECTIONS = 8


def _batched(args, dims, *, program: LaneProgram, rows: int, backend: str):
    """Make an axis of `jax.vmap` one of lanes, or of directions within a lane: the latter if only
    tangents have the axis and its length is at most `DIRECTIONS`."""
    args = [jnp.asarray(x) for x in args]
    (size, inner), batched = axes_of(program, args, dims), tuple(d is not None for d in dims)
    tangents = program.tangents or (False,) * len(batched)
    if all(t or not m for t, m in zip(tangents, batched, strict=True)) and 1 < size <= DIRECTIONS:
        return _batched_directions(args, dims, inner, batched, size, program, rows, backend)
    moved = with_lane_axis(args, dims, program.in_avals, inner, size)
    out = lanes_p.bind(*moved, program=program, rows=rows, backend=backend)
    depend = dependent_parts(program, batched, smooth=False)
    wide = [depend.control or w for w in (*depend.outs, *depend.rows)]
    # Results that are equal in all lanes get no axis, as in `vmap` itself.
    has_axis = [w or size == 0 for w in wide]
    return [x if w else x[0] for x, w in zip(out, has_axis, strict=True)], [
        0 if w else None for w in has_axis
    ]


def axes_of(program: AnyProgram, args, dims) -> tuple[int, tuple[int, ...]]:
    """Return the length of `jax.vmap`'s axis (at `dims`), and the lanes' other batch axes."""
    pairs = [(x.shape, d) for x, d in zip(args, dims, strict=True)]
    size = next(shape[d] for shape, d in pairs if d is not None)
    shapes = [shape if d is None else shape[:d] + shape[d + 1 :] for shape, d in pairs]
    return size, batch_of(program, shapes)


def with_lane_axis(args, dims, avals, inner: tuple, size: int) -> list[Any]:
    """Return arguments of a batch of lanes, with an axis of `jax.vmap`, at `dims`, before the other
    batch axes `inner`; `avals` have the numbers of axes in one lane."""
    moved = []
    for x, d, aval in zip(args, dims, avals, strict=True):
        is_single = x.ndim - (d is not None) == aval.ndim
        if d is None and is_single:
            moved.append(x)  # shared by all lanes
            continue
        x = x[None] if d is None else jnp.moveaxis(x, d, 0)
        shape = x.shape[x.ndim - aval.ndim :]
        if is_single:
            x = x.reshape(x.shape[0], *(1 for _ in inner), *shape)
        moved.append(jnp.broadcast_to(x, (size, *inner, *shape)))
    return moved


def _batched_directions(
    args, dims, inner: tuple, many, size: int, program: LaneProgram, rows: int, backend: str
):
    """Carry tangents in several directions along with one motion (`widened`)."""
    wide, depend = widened(program, many, size)
    axes, moved = len(inner), []
    for x, d, aval in zip(args, dims, program.in_avals, strict=True):
        # After the batch axes, before the axes of one lane's array.
        place = 0 if d is None or x.ndim - 1 == aval.ndim else axes
        moved.append(x if d is None else jnp.moveaxis(x, d, place))
    out = lanes_p.bind(*moved, program=wide, rows=rows, backend=backend)
    places = [axes if w else None for w in depend.outs]
    places += [axes + 1 if w else None for w in depend.rows]
    return out, places


batching.primitive_batchers[lanes_p] = _batched


def _jvp(primals, tangents, *, program: LaneProgram, rows: int, backend: str):
    varied = tuple(type(t) is not ad.Zero for t in tangents)
    derived = forward(program, varied)
    changes = [t for t in tangents if type(t) is not ad.Zero]
    out = lanes_p.bind(*primals, *changes, program=derived.program, rows=rows, backend=backend)
    values = [out[place] for place in derived.values]
    return values, [
        out[derived.slopes[k]] if flag else ad.Zero(jax.typeof(values[k]).to_tangent_aval())
        for k, flag in enumerate(derived.has)
    ]


def _partially_known(trace, *tracers, program: LaneProgram, rows: int, backend: str):
    """Evaluate partially for `jax.linearize` and `jax.grad`, where tangents are unknown: the
    program of the values runs at once, that of values and derivatives is postponed. The tracers are
    those of `JaxprTrace` in JAX's `interpreters/partial_eval.py` (0.10.2).
    `tests/lanes/test_jax.py` fails if they change."""
    unknown = [not t.is_known() for t in tracers]
    of_values = program.values_without(unknown, [t.aval.shape for t in tracers])
    others = {"rows": rows, "backend": backend}
    postponed = trace.default_process_primitive(lanes_p, tracers, {"program": program, **others})
    if of_values is None or not any(unknown):
        return postponed
    smaller, is_value = of_values
    given = [t.pval.get_known() for t in tracers[: len(smaller.in_avals)]]
    values = iter(lanes_p.bind(*given, program=smaller, **others))
    return [next(values) if known else x for known, x in zip(is_value, postponed, strict=True)]


def _partially_known_equation(saveable, unknown, instantiated, equation):
    """Do the same within `jax.checkpoint`: values are computed again along with their derivatives,
    unless the policy saves them. A rule of `partial_eval_jaxpr_custom_rules` returns the equations
    to compute now and later, flags of the unknown results of both, and the values to keep."""
    program, outs = equation.params["program"], len(equation.outvars)
    shapes = [x.aval.shape for x in equation.invars]
    of_values = program, [True] * outs
    if any(unknown):
        of_values = program.values_without(unknown, shapes)
    elif _saved(saveable(lanes_p, *(x.aval for x in equation.invars), **equation.params)):
        return equation, None, [False] * outs, [False] * outs, []
    kept = [
        x
        for x, flag in zip(equation.invars, instantiated, strict=True)
        if not flag and not isinstance(x, Literal)
    ]
    if of_values is None:
        return None, equation, [True] * outs, [True] * outs, kept
    smaller, is_value = of_values
    now = equation.replace(
        invars=equation.invars[: len(smaller.in_avals)],
        outvars=[x for x, known in zip(equation.outvars, is_value, strict=True) if known],
        params={**equation.params, "program": smaller},
    )
    return now, equation, [not known for known in is_value], [True] * outs, kept


def _saved(policy: object) -> bool:
    """Return whether a policy of `jax.checkpoint` saves a value. It returns `True`, or an instance
    of JAX's `SaveableType` (0.10.2), which no public module contains."""
    return policy is True or type(policy).__name__.startswith("Saveable")


ad.primitive_jvps[lanes_p] = _jvp
partial_eval.custom_partial_eval_rules[lanes_p] = _partially_known
partial_eval.partial_eval_jaxpr_custom_rules[lanes_p] = _partially_known_equation


# --- XLA's backend: the same loop for any device and any primitive. All lanes of a batch advance
# together, until the last has ended.

# Steps between two checks whether any lane continues. The result travels from a GPU to the
# processor; a check at each step took a sixth of the time of 10,000 lanes.
_STEPS_PER_CHECK = 8


def run_on_xla(program: LaneProgram, rows: int, *args: Any) -> list[Any]:
    """Return the results and rows of a batch of lanes, as the primitive does. Inputs have the batch
    axes first, or none if all lanes share them."""
    batch = batch_of(program, [x.shape for x in args])
    lanes = math.prod(batch)
    if lanes == 0:
        return [jnp.zeros((*batch, *a.shape), a.dtype) for a in program.results(rows)]
    axes = [
        None if batch and x.ndim == a.ndim else 0
        for x, a in zip(args, program.in_avals, strict=True)
    ]
    flat = [
        x if axis is None else x.reshape(lanes, *a.shape)
        for x, a, axis in zip(args, program.in_avals, axes, strict=True)
    ]
    out = _run_together(program, rows, flat, axes, lanes)
    return [x.reshape(*batch, *x.shape[1:]) for x in out]


def _run_together(
    program: LaneProgram, most_rows: int, inputs: list, axes: list[int | None], lanes: int
) -> list[Any]:
    """Return results and rows of lanes; `axes` is 0 for an input with a leading axis of lanes."""
    n, index = len(program.carry_avals), jnp.arange(lanes)
    carried = [0] * n
    begin = jax.vmap(jaxpr_as_fun(program.begin), in_axes=axes, axis_size=lanes)
    step = jax.vmap(jaxpr_as_fun(program.step), in_axes=(*axes, *carried), axis_size=lanes)
    end = jax.vmap(jaxpr_as_fun(program.end), in_axes=(*axes, *carried), axis_size=lanes)

    def store_rows(rows: list, filled: jax.Array, complete: jax.Array, row: list) -> list:
        # A lane without a new row writes beyond the end, which is dropped. So no two lanes write to
        # one place, and `rows` is not copied. `lax.cond` copied it at each step, which took two
        # thirds of the time on a GPU (JAX 0.11.2).
        place = jnp.where(complete, filled, most_rows)
        options = {"mode": "drop", "unique_indices": True, "indices_are_sorted": True}
        return [r.at[index, place].set(x, **options) for r, x in zip(rows, row, strict=True)]

    def iteration(_: Any, state: tuple) -> tuple:
        carry, active, filled, rows = state
        out = step(*inputs, *carry)
        # A lane that has ended keeps its carry.
        keep_ended = lambda a, b: jnp.where(active.reshape(lanes, *(1,) * (a.ndim - 1)), a, b)
        carry = [keep_ended(a, b) for a, b in zip(out[:n], carry, strict=True)]
        complete = active & out[n + 1]
        rows = store_rows(rows, filled, complete, out[n + 2 :])
        return carry, active & out[n], filled + complete, rows

    rows = [
        jnp.full((lanes, *a.shape), jnp.nan if jnp.issubdtype(a.dtype, jnp.inexact) else 0, a.dtype)
        for a in program.results(most_rows)[len(program.out_avals) :]
    ]
    filled = jnp.zeros(lanes, jnp.int32)
    out = begin(*inputs)
    carry, active, complete, row = list(out[:n]), out[n], out[n + 1], out[n + 2 :]
    state = (carry, active, filled + complete, store_rows(rows, filled, complete, row))
    carry, _, _, rows = jax.lax.while_loop(
        lambda state: jnp.any(state[1]),
        lambda state: jax.lax.fori_loop(0, _STEPS_PER_CHECK, iteration, state),
        state,
    )
    return [*end(*inputs, *carry), *rows]


# --- lowering


_on_xla = mlir.lower_fun(
    lambda *args, program, rows, backend: run_on_xla(program, rows, *args), multiple_results=True
)


def _lowered(ctx, *args, program: LaneProgram, rows: int, backend: str):
    """Lower to a call of the program's kernel on a CPU, else to XLA's loop."""
    otherwise = functools.partial(_on_xla, ctx, *args, program=program, rows=rows, backend=backend)
    if backend == "xla":
        if _vector_only.get():
            raise Unsupported("the other backend")
        return otherwise()
    return lower_to_kernel(ctx, args, program, rows, otherwise)


@without_collection()
def lower_to_kernel(ctx, args, program: AnyProgram, rows: int, otherwise: Callable[[], Any]):
    """Lower to a call of a program's kernel. Without a kernel, warn and return `otherwise()`;
    within `vector_only` raise `Unsupported` instead."""
    try:
        avals = list(zip(ctx.avals_in, program.in_avals, strict=True))
        one_for_all = tuple(a.size > MOST_IN_REGISTERS and x.ndim == a.ndim for x, a in avals)
        kernel = kernel_of(program, _lane_count(program, ctx.avals_in), one_for_all)
        target = register_handler()
    except Unsupported as reason:
        if _vector_only.get():
            raise
        _warn(str(reason))
        return otherwise()
    ctx.module_context.add_keepalive(kernel)  # kept as long as the compiled program
    call = functools.partial(kernel_call, target, kernel, program, rows, ctx.avals_out)
    return mlir.lower_fun(call, multiple_results=True)(ctx, *args)


def kernel_call(target: str, kernel, program: AnyProgram, rows: int, avals, *args):
    strides = [
        math.prod(x.shape[x.ndim - aval.ndim :]) if x.ndim > aval.ndim else 0
        for x, aval in zip(args, program.in_avals, strict=True)
    ]
    head = header(kernel.key, _lane_count(program, args), rows, strides)
    return jax.ffi.ffi_call(target, [*map(shape_of, avals)])(head, *args)


def _lane_count(program: AnyProgram, args) -> int:
    return math.prod(batch_of(program, [x.shape for x in args]))


@functools.cache
def _warn(reason: str) -> None:
    warnings.warn(
        f"Lanes run on XLA's slower backend, because this program needs {reason}.", stacklevel=2
    )


mlir.register_lowering(lanes_p, _lowered, platform="cpu")
mlir.register_lowering(lanes_p, _on_xla)
