"""`run`: the loop of one lane, written in JAX. Batched by `vmap` it runs as vector code.

The functions are traced as jaxprs of flat arguments, once for equal functions and inputs.
"""

import functools
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from contextvars import ContextVar
from types import FunctionType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer, eval_jaxpr
from jax.extend.core import ClosedJaxpr

from . import _backward as _backward  # registers the reverse mode of `lanes_p`
from ._merge import merged
from ._primitive import lanes_p
from ._program import LaneProgram, Part, shape_of
from ._shared import Recent, set_within

BACKENDS = ("auto", "xla")

_backend: ContextVar[str] = ContextVar("backend", default="auto")


class Emitted(NamedTuple):
    """The results of `begin` and `step` besides the carry."""

    active: Any
    """True while the lane continues."""
    complete: Any
    """True if a row is complete."""
    row: Any
    """The row, a pytree."""


def backend(name: str) -> AbstractContextManager:
    """Trace lanes for XLA (`"xla"`) within this context, or for the best backend here (`"auto"`).

    Compiled programs keep their backend.
    """
    if name not in BACKENDS:
        raise ValueError(f"Argument `name` must be one of {BACKENDS}, but got {name!r}.")
    return set_within(_backend, name)


def current_backend() -> str:
    return _backend.get()


def run(
    begin: Callable[[Any], tuple[Any, Emitted]],
    step: Callable[[Any, Any], tuple[Any, Emitted]],
    end: Callable[[Any, Any], Any],
    inputs: object,
    *,
    rows: int,
    backend: str | None = None,
) -> tuple[Any, Any]:
    """Run the loop of one lane: `begin`, then `step` while it is active, then `end`.

    `vmap` batches it, and all lanes run together. On a CPU they run as vector code in groups, on
    all cores that the process may use. A slot of a group takes the next lane when its lane has
    ended. Differentiable forward and in reverse, to any order; in reverse by a tape of the steps,
    or by running forward along each number. The functions get scalars and small arrays of one lane.
    All lanes share the values over which they close. Functions without closures are traced once for
    inputs of equal shapes and types; constants may be bound by `functools.partial`.

    **Arguments:**

    - `begin(inputs)`, `step(inputs, carry)`: functions that return the next carry and an `Emitted`;
    - `end(inputs, carry)`: a function that returns the results;
    - `inputs`: a pytree of arrays;
    - `rows`: the greatest number of rows. They are stored in the order of completion. Rows that a
      lane does not reach are NaN (0 for integers);
    - `backend`: `"xla"` or `"auto"`; by default that of the context.

    **Returns:** the results, and the rows with a leading axis of length `rows`.
    """
    leaves, treedef = jtu.tree_flatten(inputs)
    leaves = [jnp.asarray(x) for x in leaves]
    program, consts, *structures = traced(Functions(begin, step, end), treedef, leaves)
    backend = current_backend() if backend is None else backend
    out = lanes_p.bind(*leaves, *consts, program=program, rows=rows, backend=backend)
    n = len(program.out_avals)
    results, row = map(jtu.tree_unflatten, structures, (out[:n], out[n:]))
    return results, row


def once(function: Callable[[Any], Any], inputs: object, *, backend: str | None = None) -> Any:
    """Run `function(inputs)` as vector code without a loop, on a pytree of scalars and small
    arrays. `vmap` batches it like `run`."""
    end = functools.partial(_end_with, function)
    return run(_begin_ended, _no_step, end, inputs, rows=0, backend=backend)[0]


def once_with(
    module: Any, function: Callable[[Any, Any], Any], inputs: object, *, backend: str | None = None
) -> Any:
    """Run `function(module, inputs)` by `once`. Modules that differ in their arrays only share a
    kernel."""
    numbers, rest = eqx.partition(module, eqx.is_array)
    return once(functools.partial(_with_module, rest, function), (numbers, inputs), backend=backend)


def _with_module(rest: Any, function: Callable[[Any, Any], Any], given: tuple[Any, Any]) -> Any:
    numbers, inputs = given
    return function(eqx.combine(numbers, rest), inputs)


def _begin_ended(inputs: object) -> tuple[Any, Emitted]:
    return (), Emitted(False, False, ())


def _no_step(inputs: object, carry: object) -> tuple[Any, Emitted]:
    return carry, Emitted(False, False, ())


def _end_with(function: Callable[[Any], Any], inputs: object, carry: object) -> Any:
    return function(inputs)


# --- tracing


class Functions(NamedTuple):
    begin: Callable[..., Any]
    step: Callable[..., Any]
    end: Callable[..., Any]


class Traced(NamedTuple):
    program: LaneProgram
    consts: list[Any]
    """Arrays over which the functions close; they are further inputs."""
    out: Any
    """The structure of the results."""
    row: Any
    """The structure of a row."""


_recent: "Recent[Any, Traced]" = Recent(64)


def traced(functions: Functions, treedef: object, leaves: Sequence[Any]) -> Traced:
    """Return the program for inputs of this structure, and of these shapes and types."""
    shapes = [shape_of(x) for x in leaves]
    try:
        jax.eval_shape(_clear_with_jax, jax.ShapeDtypeStruct((), jnp.int32))
        key = (
            *map(_function_key, functions),
            treedef,
            *((x.shape, x.dtype) for x in shapes),
            bool(jax.config.jax_enable_x64),  # pyright: ignore
        )
        found = _recent.get(key)
    except (TypeError, ValueError):  # without a hash, or equality is not defined
        return _traced(functions, treedef, shapes)
    if found is None:
        found = _traced(functions, treedef, shapes)
        if not any(isinstance(x, Tracer) for x in found.consts):
            _recent.put(key, found)
    return found


@jax.jit
def _clear_with_jax(x: object) -> Any:
    # Traced again only after `jax.clear_caches()`, which has no public hook (JAX 0.10.2).
    _recent.clear()
    return x


def _function_key(function: Callable[..., Any]) -> tuple:
    """Return a key that is equal only for functions that compute the same if they are pure; raise
    `TypeError` if this cannot be decided."""
    if isinstance(function, functools.partial):
        if function.keywords:
            raise TypeError("no place in an order")
        return (_function_key(function.func), *map(_argument_key, function.args))
    if not isinstance(function, FunctionType) or function.__closure__ is not None:
        # A decorated function closes over the original one, and a jitted one hides its closure. A
        # function that its module holds by its name exists only once.
        module = sys.modules.get(getattr(function, "__module__", ""))
        if getattr(module, getattr(function, "__qualname__", ""), None) is not function:
            raise TypeError("perhaps made for this call")
    return (function,)


def _argument_key(x: object) -> tuple:
    """Return such a key for an argument bound by `functools.partial`: a function or a pytree."""
    if isinstance(x, FunctionType | functools.partial):
        return _function_key(x)
    leaves, treedef = jtu.tree_flatten(x)
    return (treedef, *map(_constant_key, leaves))


def _constant_key(x: object) -> Any:
    """Return a key that is equal only for equal constants: 1, 1.0, True differ, 0.0 and -0.0 too.
    Raise `TypeError` for values that may change."""
    if isinstance(x, jax.Array):
        raise TypeError("no constant")
    if isinstance(x, np.ndarray | np.generic):
        if x.dtype.hasobject:
            raise TypeError("no numbers")
        return np.ndarray, x.shape, x.dtype, x.tobytes()
    if isinstance(x, float | complex):
        return type(x), float.hex(x.real), float.hex(x.imag)
    return type(x), x


def _traced(functions: Functions, treedef: Any, leaves: list[Any]) -> Traced:
    n = len(leaves)
    structures: dict[str, Any] = {}

    def begun(*args):
        carry, (active, complete, row) = functions.begin(jtu.tree_unflatten(treedef, args))
        found, structures["carry"] = jtu.tree_flatten(carry)
        first, structures["row"] = jtu.tree_flatten(row)
        return [*found, _flag(active), _flag(complete), *first]

    begin = jax.make_jaxpr(begun)(*leaves)
    size = structures["carry"].num_leaves
    carried = begin.out_avals[:size]

    def stepped(*args):
        carry = jtu.tree_unflatten(structures["carry"], args[n:])
        inputs = jtu.tree_unflatten(treedef, args[:n])
        carry, (active, complete, row) = functions.step(inputs, carry)
        found = _checked("carry", structures["carry"], carry, carried)
        next_row = _checked("row", structures["row"], row, begin.out_avals[size + 2 :])
        return [*found, _flag(active), _flag(complete), *next_row]

    def ended(*args):
        carry = jtu.tree_unflatten(structures["carry"], args[n:])
        inputs = jtu.tree_unflatten(treedef, args[:n])
        out, structures["out"] = jtu.tree_flatten(functions.end(inputs, carry))
        return out

    both = [*leaves, *map(shape_of, carried)]
    jaxprs = [begin, jax.make_jaxpr(stepped)(*both), jax.make_jaxpr(ended)(*both)]
    jaxprs, consts = _consts_as_inputs(jaxprs, n)
    begin, step, end = map(Part.of, merged(*jaxprs))
    program = LaneProgram(parts=(begin, step, end))
    return Traced(program, consts, structures["out"], structures["row"])


def _flag(x: object) -> Any:
    return jnp.asarray(x, bool)


def _checked(what: str, treedef: object, tree: object, avals: list) -> list:
    """Return the leaves that `step` returned, converted to the types from `begin`; raise
    `TypeError` if the structure or a shape differs."""
    leaves, other = jtu.tree_flatten(tree)
    if other != treedef:
        raise TypeError(f"`step` must give a {what} of the structure {treedef}, but gave {other}.")
    for x, aval in zip(leaves, avals, strict=True):
        if jnp.shape(x) != aval.shape:
            raise TypeError(
                f"`step` must give a {what} with shape {aval.shape}, but gave {jnp.shape(x)}."
            )
    return [jnp.asarray(x, aval.dtype) for x, aval in zip(leaves, avals, strict=True)]


def _plain(x: Any) -> Any:
    """Return a known number as one of NumPy."""
    is_known = isinstance(x, jax.Array) and not isinstance(x, Tracer)
    return np.asarray(x) if is_known and x.ndim == 0 else x


def _consts_as_inputs(jaxprs: list[ClosedJaxpr], n: int) -> tuple[list[ClosedJaxpr], list]:
    """Return the jaxprs with their constant arrays as inputs after the first `n`, and these.
    Single numbers stay constants."""
    jaxprs = [jaxpr.replace(consts=[*map(_plain, jaxpr.consts)]) for jaxpr in jaxprs]
    consts: list[Any] = []
    for jaxpr in jaxprs:
        for x in jaxpr.consts:
            if isinstance(x, jax.Array) and not any(x is y for y in consts):
                consts.append(x)
    if not consts:
        return jaxprs, consts

    def with_inputs(jaxpr: ClosedJaxpr) -> ClosedJaxpr:
        rest = jaxpr.in_avals[n:]

        def function(*args):
            values = args[n : n + len(consts)]
            consts_in = [
                next((g for g, y in zip(values, consts, strict=True) if y is x), x)
                for x in jaxpr.consts
            ]
            arguments = (*args[:n], *args[n + len(consts) :])
            return eval_jaxpr(jaxpr.jaxpr, consts_in, *arguments)

        shapes = [*map(shape_of, jaxpr.in_avals[:n]), *map(shape_of, consts), *map(shape_of, rest)]
        return jax.make_jaxpr(function)(*shapes)

    return [with_inputs(jaxpr) for jaxpr in jaxprs], consts
