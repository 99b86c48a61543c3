"""`run`: one lane's loop, written as JAX; batched by `vmap` it runs as vector code."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import eval_jaxpr
from jax.extend.core import ClosedJaxpr

from ._context import within
from ._primitive import lanes_p
from ._program import Program

ROADS = ("auto", "xla")

_road: ContextVar[str] = ContextVar("road", default="auto")


class Emitted(NamedTuple):
    """What `begin` and `step` say besides the carry."""

    active: Any
    """Whether the lane goes on."""
    complete: Any
    """Whether a row is complete."""
    row: Any
    """The row, a pytree."""


def road(name: str) -> AbstractContextManager:
    """Trace lanes for `"xla"` within this context, or for what suits the machine (`"auto"`).

    What is compiled already keeps its road.
    """
    if name not in ROADS:
        raise ValueError(f"Argument `name` must be one of {ROADS}, but got {name!r}.")
    return within(_road, name)


def current_road() -> str:
    """The road that this context asks for."""
    return _road.get()


def run(
    begin: Callable[[Any], tuple[Any, Emitted]],
    step: Callable[[Any, Any], tuple[Any, Emitted]],
    end: Callable[[Any, Any], Any],
    inputs: Any,
    *,
    rows: int,
    block: int = 1,
    road: str | None = None,
) -> tuple[Any, Any]:
    """One lane's loop to its end: begin, step while it is active, end.

    Batched by `vmap`, all lanes run together: on a CPU as vector code for groups of them, on all
    cores that the process may use, each place of a group taking up the next lane when its own has
    ended. Differentiable in forward mode. The functions see scalars (and small arrays) of one lane;
    what they close over is shared.

    **Arguments:**

    - `begin(inputs)`, `step(inputs, carry)`: the next carry, and what they `Emitted`;
    - `end(inputs, carry)`: the results;
    - `inputs`: a pytree of arrays;
    - `rows`: room for rows; they are stored in the order in which they are completed, and what a
      lane does not come to is not a number (0 for integers);
    - `block`: steps in which a lane is sure to complete at most one row (for XLA);
    - `road`: `"xla"` or `"auto"`; by default what the context says.

    **Returns:** the results, and the rows with a leading axis of length `rows`.
    """
    leaves, treedef = jtu.tree_flatten(inputs)
    leaves = [jnp.asarray(x) for x in leaves]
    flat: dict[str, Any] = {}

    def begun(*args):
        carry, (active, complete, row) = begin(jtu.tree_unflatten(treedef, args))
        found, flat["carry"] = jtu.tree_flatten(carry)
        rows, flat["row"] = jtu.tree_flatten(row)
        return [*found, _flag(active), _flag(complete), *rows]

    first = jax.make_jaxpr(begun)(*map(_one, leaves))
    n = len(leaves)
    size = flat["carry"].num_leaves
    carried = first.out_avals[:size]

    def stepped(*args):
        carry = jtu.tree_unflatten(flat["carry"], args[n:])
        carry, (active, complete, row) = step(jtu.tree_unflatten(treedef, args[:n]), carry)
        found = _same("carry", flat["carry"], carry, carried)
        rows = _same("row", flat["row"], row, first.out_avals[size + 2 :])
        return [*found, _flag(active), _flag(complete), *rows]

    def ended(*args):
        carry = jtu.tree_unflatten(flat["carry"], args[n:])
        out, flat["out"] = jtu.tree_flatten(end(jtu.tree_unflatten(treedef, args[:n]), carry))
        return out

    both = [*map(_one, leaves), *map(_one, carried)]
    jaxprs = [first, jax.make_jaxpr(stepped)(*both), jax.make_jaxpr(ended)(*both)]
    (first, second, last), leaves = _without_consts(jaxprs, leaves)
    program = Program(begin=first, step=second, end=last, rows=rows, block=block)
    out = lanes_p.bind(*leaves, program=program, road=current_road() if road is None else road)
    results = jtu.tree_unflatten(flat["out"], out[: len(last.out_avals)])
    return results, jtu.tree_unflatten(flat["row"], out[len(last.out_avals) :])


def once(function: Callable[[Any], Any], inputs: Any) -> Any:
    """`function` of one lane's numbers as vector code."""

    def begin(inputs):
        return (), Emitted(False, False, ())

    def step(inputs, carry):
        return carry, Emitted(False, False, ())

    return run(begin, step, lambda inputs, carry: function(inputs), inputs, rows=0)[0]


def _one(x: Any) -> jax.ShapeDtypeStruct:
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


def _without_consts(jaxprs: list[ClosedJaxpr], leaves: list) -> tuple[list[ClosedJaxpr], list]:
    """The jaxprs with the arrays that they close over as further inputs."""
    n = len(leaves)
    consts: list[Any] = []
    for jaxpr in jaxprs:
        for x in jaxpr.consts:
            if isinstance(x, jax.Array) and not any(x is y for y in consts):
                consts.append(x)
    if not consts:
        return jaxprs, leaves

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

        shapes = [*map(_one, jaxpr.in_avals[:n]), *map(_one, consts), *map(_one, rest)]
        return jax.make_jaxpr(function)(*shapes)

    return [opened(jaxpr) for jaxpr in jaxprs], [*leaves, *consts]
