"""The JAX primitive behind `run`: batched, differentiated forward, lowered for either backend."""

import functools
import math
import warnings
from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Literal, Primitive
from jax.interpreters import ad, batching, mlir, partial_eval

from . import _xla as xla
from ._context import within
from ._derivative import forward, widened
from ._program import LaneProgram, spread
from ._vector import Unsupported
from .call import header, registered
from .runtime import kernel_of

_strict: ContextVar[bool] = ContextVar("strict", default=False)


def vector_only() -> AbstractContextManager:
    """Within this context a program with lanes that cannot be vector code is not compiled: it
    raises `Unsupported`."""
    return within(_strict, True)


lanes_p = Primitive("lanes")
lanes_p.multiple_results = True


@lanes_p.def_abstract_eval
def _(*args, program: LaneProgram, backend: str):
    batch = program.batch([a.shape for a in args])
    rows = [(*batch, program.rows, *a.shape) for a in program.row_avals]
    outs = [(*batch, *a.shape) for a in program.out_avals]
    avals = [*program.out_avals, *program.row_avals]
    return [ShapedArray(shape, a.dtype) for shape, a in zip([*outs, *rows], avals, strict=True)]


@lanes_p.def_impl
def _(*args, program: LaneProgram, backend: str):
    return jax.jit(functools.partial(lanes_p.bind, program=program, backend=backend))(*args)


# Directions of a derivative that one lane carries along.
_DIRECTIONS = 8


def _batched(args, dims, *, program: LaneProgram, backend: str):
    args = [jnp.asarray(x) for x in args]
    size = next(x.shape[d] for x, d in zip(args, dims, strict=True) if d is not None)
    many = tuple(d is not None for d in dims)
    shapes = [
        x.shape if d is None else x.shape[:d] + x.shape[d + 1 :]
        for x, d in zip(args, dims, strict=True)
    ]
    inner = program.batch(shapes)
    slopes = program.slopes or (False,) * len(many)
    if all(s or not m for s, m in zip(slopes, many, strict=True)) and 1 < size <= _DIRECTIONS:
        return _directions(args, dims, inner, many, size, program, backend)
    moved = []
    for x, d, shape, aval in zip(args, dims, shapes, program.in_avals, strict=True):
        if d is None and len(shape) == aval.ndim:
            moved.append(x)  # one for all lanes
            continue
        x = x[None] if d is None else jnp.moveaxis(x, d, 0)
        if len(shape) == aval.ndim:
            x = x.reshape(x.shape[0], *(1 for _ in inner), *aval.shape)
        moved.append(jnp.broadcast_to(x, (size, *inner, *aval.shape)))
    out = lanes_p.bind(*moved, program=program, backend=backend)
    there = spread(program, many, smooth=False)
    wide = [there.control or w for w in (*there.outs, *there.rows)]
    # What is the same in all lanes is one, as `vmap` has it for what does not depend on its axis.
    return [x if w else x[0] for x, w in zip(out, wide, strict=True)], [
        0 if w else None for w in wide
    ]


def _directions(args, dims, inner: tuple, many, size: int, program: LaneProgram, backend: str):
    """Tangents in several directions go along with one motion."""
    wide, there = widened(program, many, size)
    axes, moved = len(inner), []
    for x, d, aval in zip(args, dims, program.in_avals, strict=True):
        # Behind the axes of the lanes, before those of the number itself.
        own = 0 if d is None or x.ndim - 1 == aval.ndim else axes
        moved.append(x if d is None else jnp.moveaxis(x, d, own))
    out = lanes_p.bind(*moved, program=wide, backend=backend)
    places = [axes if w else None for w in there.outs]
    places += [axes + 1 if w else None for w in there.rows]
    return out, places


batching.primitive_batchers[lanes_p] = _batched


def _jvp(primals, tangents, *, program: LaneProgram, backend: str):
    moving = tuple(type(t) is not ad.Zero for t in tangents)
    derived, has = forward(program, moving)
    changes = [t for t in tangents if type(t) is not ad.Zero]
    out = iter(lanes_p.bind(*primals, *changes, program=derived, backend=backend))
    values, slopes = [], []
    # The results and their derivatives, then the rows and theirs.
    for part in (has[: _outs(program)], has[_outs(program) :]):
        values += [next(out) for _ in part]
        slopes += [next(out) if there else None for there in part]
    return values, [
        ad.Zero(jax.typeof(v).to_tangent_aval()) if s is None else s
        for v, s in zip(values, slopes, strict=True)
    ]


def _partial(trace, *tracers, program: LaneProgram, backend: str):
    """Where tangents are not known yet, as in `jax.linearize` and `jax.grad`, the values are: what
    is computed along with such tangents is not known either, and the values are computed alone."""
    unknown = [not t.is_known() for t in tracers]
    alone = program.values_without(unknown, [t.aval.shape for t in tracers])
    later = trace.default_process_primitive(
        lanes_p, tracers, {"program": program, "backend": backend}
    )
    if alone is None or not any(unknown):
        return later
    smaller, there = alone
    given = [t.pval.get_known() for t in tracers[: len(smaller.in_avals)]]
    values = iter(lanes_p.bind(*given, program=smaller, backend=backend))
    return [next(values) if known else x for known, x in zip(there, later, strict=True)]


def _partial_equation(saveable, unknown, instantiated, equation):
    """The same of an equation, for `jax.checkpoint`: what is computed now, and what later, when the
    values are computed again along with their derivatives."""
    program, outs = equation.params["program"], len(equation.outvars)
    shapes = [x.aval.shape for x in equation.invars]
    alone = program, [True] * outs
    if any(unknown):
        alone = program.values_without(unknown, shapes)
    elif _saved(saveable(lanes_p, *(x.aval for x in equation.invars), **equation.params)):
        return equation, None, [False] * outs, [False] * outs, []
    kept = [
        x
        for x, there in zip(equation.invars, instantiated, strict=True)
        if not there and not isinstance(x, Literal)
    ]
    if alone is None:
        return None, equation, [True] * outs, [True] * outs, kept
    smaller, there = alone
    now = equation.replace(
        invars=equation.invars[: len(smaller.in_avals)],
        outvars=[x for x, known in zip(equation.outvars, there, strict=True) if known],
        params={**equation.params, "program": smaller},
    )
    return now, equation, [not known for known in there], [True] * outs, kept


def _saved(policy: Any) -> bool:
    """Whether a policy of `jax.checkpoint` says so, by a truth value or by a word of JAX's."""
    return policy is True or type(policy).__name__.startswith("Saveable")


def _transposed(cotangents, *args, program: LaneProgram, backend: str):
    """By columns: the program is run along every number of the tangents asked for, several of them
    with one motion, and what comes of each is weighed.

    A reverse pass would have to take the steps again, and rounding may have them decide otherwise
    about an event than the first time.
    """
    places: dict[int, slice] = {}  # of each tangent asked for, among all their numbers
    number = 0
    for i, (x, aval) in enumerate(zip(args, program.in_avals, strict=True)):
        if ad.is_undefined_primal(x):
            places[i] = slice(number, number + aval.size)
            number += aval.size
    args = [x if i in places else jnp.asarray(x) for i, x in enumerate(args)]
    batch = program.batch([x.aval.shape if i in places else x.shape for i, x in enumerate(args)])
    weights = [(k, ct) for k, ct in enumerate(cotangents) if type(ct) is not ad.Zero]
    size = min(number, _DIRECTIONS)
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
        found.append(sum(_weighed(columns[k], ct, 1 + len(batch)) for k, ct in weights))
    each = jnp.concatenate(found)  # (numbers, *batch)
    out: list[Any] = [None] * len(args)
    for i, place in places.items():
        aval, x = args[i].aval, each[place]
        if aval.ndim == program.in_avals[i].ndim:  # one for all lanes
            x = jnp.sum(x, axis=tuple(range(1, x.ndim)))
        out[i] = jnp.moveaxis(x, 0, -1).reshape(aval.shape).astype(aval.dtype)
    return out


def _weighed(column, weight, kept: int):
    """Summed but for the first axes. What has no weight may be no number, as after a failure."""
    product = jnp.where(weight == 0, 0.0, column * weight)
    return jnp.sum(product, axis=tuple(range(kept, product.ndim)))


def _outs(program: LaneProgram) -> int:
    return len(program.out_avals)


ad.primitive_jvps[lanes_p] = _jvp
partial_eval.custom_partial_eval_rules[lanes_p] = _partial
partial_eval.partial_eval_jaxpr_custom_rules[lanes_p] = _partial_equation
ad.primitive_transposes[lanes_p] = _transposed


_on_xla = mlir.lower_fun(
    lambda *args, program, backend: xla.run(program, *args), multiple_results=True
)


def _lowered(ctx, *args, program: LaneProgram, backend: str):
    if backend == "xla":
        if _strict.get():
            raise Unsupported("the other backend")
        return _on_xla(ctx, *args, program=program, backend=backend)
    try:
        kernel = kernel_of(program, _count(program, ctx.avals_in))
    except Unsupported as reason:
        if _strict.get():
            raise
        _tell(str(reason))
        return _on_xla(ctx, *args, program=program, backend=backend)
    ctx.module_context.add_keepalive(kernel)
    call = functools.partial(_called, kernel, program, ctx.avals_out)
    return mlir.lower_fun(call, multiple_results=True)(ctx, *args)


def _called(kernel, program: LaneProgram, avals, *args):
    strides = [
        aval.size if x.ndim > aval.ndim else 0
        for x, aval in zip(args, program.in_avals, strict=True)
    ]
    head = header(kernel.key, _count(program, args), strides)
    results = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in avals]
    return jax.ffi.ffi_call(registered(), results)(head, *args)


def _count(program: LaneProgram, args) -> int:
    return math.prod(program.batch([x.shape for x in args]))


@functools.cache
def _tell(reason: str) -> None:
    warnings.warn(
        f"Lanes run on XLA's slower backend, because this program needs {reason}.", stacklevel=2
    )


mlir.register_lowering(lanes_p, _lowered, platform="cpu")
mlir.register_lowering(lanes_p, _on_xla)
