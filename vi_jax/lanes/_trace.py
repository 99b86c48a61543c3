"""A lane's functions as jaxprs of flat arguments, traced once for all that is alike."""

import functools
import sys
from collections.abc import Callable, Sequence
from types import FunctionType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer, eval_jaxpr
from jax.extend.core import ClosedJaxpr

from ._program import LaneProgram
from ._recent import Recent


class Functions(NamedTuple):
    """What a lane does."""

    begin: Callable[..., Any]
    step: Callable[..., Any]
    end: Callable[..., Any]


class Traced(NamedTuple):
    """The program of a lane."""

    program: LaneProgram
    consts: list[Any]
    """Arrays that the functions close over: further inputs."""
    out: Any
    """The structure of the results."""
    row: Any
    """The structure of a row."""


_recent: "Recent[Any, Traced]" = Recent(64)


def traced(functions: Functions, treedef: Any, leaves: Sequence[Any], **options: int) -> Traced:
    """The program for inputs of this structure and of these leaves' shapes and types.

    **Arguments:** `options` of the `LaneProgram`.
    """
    shapes = [one(x) for x in leaves]
    try:
        jax.eval_shape(_forgets, jax.ShapeDtypeStruct((), jnp.int32))
        key = (
            *map(_name, functions),
            treedef,
            *((x.shape, x.dtype) for x in shapes),
            *options.items(),
            bool(jax.config.jax_enable_x64),  # pyright: ignore
        )
        found = _recent.get(key)
    except (TypeError, ValueError):  # no hash, or no telling whether two are equal
        return _traced(functions, treedef, shapes, options)
    if found is None:
        found = _traced(functions, treedef, shapes, options)
        if not any(isinstance(x, Tracer) for x in found.consts):
            _recent.put(key, found)
    return found


@jax.jit
def _forgets(x: Any) -> Any:
    # Traced again after `jax.clear_caches()`: what is forgotten there is forgotten here.
    _recent.clear()
    return x


def _name(function: Callable[..., Any]) -> tuple:
    """What is equal only for functions that do the same, as long as they are pure.

    **Raises:** `TypeError` where that is not to be known.
    """
    if isinstance(function, functools.partial):
        if function.keywords:
            raise TypeError("no place in an order")
        return (_name(function.func), *map(_bound, function.args))
    if not isinstance(function, FunctionType):
        raise TypeError("no function")
    if function.__closure__ is not None:
        # A decorated function closes over what it decorates: there is one of it in its module.
        module = sys.modules.get(function.__module__)
        if getattr(module, function.__qualname__, None) is not function:
            raise TypeError("made for this call, perhaps")
    return (function,)


def _bound(x: Any) -> tuple:
    if isinstance(x, FunctionType | functools.partial):
        return _name(x)
    leaves, treedef = jtu.tree_flatten(x)
    return (treedef, *map(_constant, leaves))


def _constant(x: Any) -> Any:
    """What is equal only for equal constants, which 1, 1.0 and True or 0.0 and -0.0 are not.

    **Raises:** `TypeError` for what varies.
    """
    if isinstance(x, jax.Array):
        raise TypeError("no constant")
    if isinstance(x, np.ndarray | np.generic):
        if x.dtype.hasobject:
            raise TypeError("no numbers")
        return np.ndarray, x.shape, x.dtype, x.tobytes()
    if isinstance(x, float | complex):
        return type(x), float.hex(x.real), float.hex(x.imag)
    return type(x), x


def _traced(functions: Functions, treedef: Any, leaves: list[Any], options: Any) -> Traced:
    n = len(leaves)
    told: dict[str, Any] = {}

    def begun(*args):
        carry, (active, complete, row) = functions.begin(jtu.tree_unflatten(treedef, args))
        found, told["carry"] = jtu.tree_flatten(carry)
        rows, told["row"] = jtu.tree_flatten(row)
        return [*found, _flag(active), _flag(complete), *rows]

    begin = jax.make_jaxpr(begun)(*leaves)
    size = told["carry"].num_leaves
    carried = begin.out_avals[:size]

    def stepped(*args):
        carry = jtu.tree_unflatten(told["carry"], args[n:])
        inputs = jtu.tree_unflatten(treedef, args[:n])
        carry, (active, complete, row) = functions.step(inputs, carry)
        found = _same("carry", told["carry"], carry, carried)
        rows = _same("row", told["row"], row, begin.out_avals[size + 2 :])
        return [*found, _flag(active), _flag(complete), *rows]

    def ended(*args):
        carry = jtu.tree_unflatten(told["carry"], args[n:])
        inputs = jtu.tree_unflatten(treedef, args[:n])
        out, told["out"] = jtu.tree_flatten(functions.end(inputs, carry))
        return out

    both = [*leaves, *map(one, carried)]
    jaxprs = [begin, jax.make_jaxpr(stepped)(*both), jax.make_jaxpr(ended)(*both)]
    (begin, step, end), consts = _without_consts(jaxprs, n)
    program = LaneProgram(begin=begin, step=step, end=end, **options)
    return Traced(program, consts, told["out"], told["row"])


def one(x: Any) -> jax.ShapeDtypeStruct:
    """Shape and type of it."""
    return jax.ShapeDtypeStruct(x.shape, x.dtype)


def _flag(x: Any) -> Any:
    return jnp.asarray(x, bool)


def _same(what: str, treedef: Any, tree: Any, avals: list) -> list:
    leaves, other = jtu.tree_flatten(tree)
    if other != treedef:
        raise TypeError(f"`step` must give a {what} of the structure {treedef}, but gave {other}.")
    for x, aval in zip(leaves, avals, strict=True):
        if jnp.shape(x) != aval.shape:
            raise TypeError(
                f"`step` must give a {what} with shape {aval.shape}, but gave {jnp.shape(x)}."
            )
    return [jnp.asarray(x, aval.dtype) for x, aval in zip(leaves, avals, strict=True)]


def _without_consts(jaxprs: list[ClosedJaxpr], n: int) -> tuple[list[ClosedJaxpr], list]:
    """The jaxprs with the arrays that they close over as further inputs, and these."""
    consts: list[Any] = []
    for jaxpr in jaxprs:
        for x in jaxpr.consts:
            if isinstance(x, jax.Array) and not any(x is y for y in consts):
                consts.append(x)
    if not consts:
        return jaxprs, consts

    def opened(jaxpr: ClosedJaxpr) -> ClosedJaxpr:
        rest = jaxpr.in_avals[n:]

        def function(*args):
            given = args[n : n + len(consts)]
            held = [
                next((g for g, y in zip(given, consts, strict=True) if y is x), x)
                for x in jaxpr.consts
            ]
            own = (*args[:n], *args[n + len(consts) :])
            return eval_jaxpr(jaxpr.jaxpr, held, *own)

        shapes = [*map(one, jaxpr.in_avals[:n]), *map(one, consts), *map(one, rest)]
        return jax.make_jaxpr(function)(*shapes)

    return [opened(jaxpr) for jaxpr in jaxprs], consts
