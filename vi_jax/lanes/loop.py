"""`run`: one lane's loop, written as JAX; batched by `vmap` it runs as vector code."""

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu

from . import _backward as _backward  # how `lanes_p` is differentiated in reverse mode
from ._primitive import lanes_p
from ._shared import within
from ._trace import Functions, traced

BACKENDS = ("auto", "xla")

_backend: ContextVar[str] = ContextVar("backend", default="auto")


class Emitted(NamedTuple):
    """What `begin` and `step` return besides the carry."""

    active: Any
    """Whether the lane goes on."""
    complete: Any
    """Whether a row is complete."""
    row: Any
    """The row, a pytree."""


def backend(name: str) -> AbstractContextManager:
    """Trace lanes for `"xla"` within this context, or for the backend that suits the machine
    (`"auto"`).

    Programs that are already compiled keep their backend.
    """
    if name not in BACKENDS:
        raise ValueError(f"Argument `name` must be one of {BACKENDS}, but got {name!r}.")
    return within(_backend, name)


def current_backend() -> str:
    """The backend that this context asks for."""
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
    """One lane's loop to its end: begin, step while it is active, end.

    Batched by `vmap`, all lanes run together: on a CPU as vector code for groups of them, on all
    cores that the process may use, each place of a group taking up the next lane when its own has
    ended. Differentiable forward and in reverse, to any order (in reverse by a tape of the steps
    taken, or by running forward along each number). The functions see scalars (and small arrays) of
    one lane; what they close over is shared. Functions that close over nothing, but may have
    constants bound by `functools.partial`, are traced once for inputs that are alike.

    **Arguments:**

    - `begin(inputs)`, `step(inputs, carry)`: the next carry, and what they `Emitted`;
    - `end(inputs, carry)`: the results;
    - `inputs`: a pytree of arrays;
    - `rows`: room for rows; they are stored in the order in which they are completed, and what a
      lane does not come to is not a number (0 for integers);
    - `backend`: `"xla"` or `"auto"`; by default what the context says.

    **Returns:** the results, and the rows with a leading axis of length `rows`.
    """
    leaves, treedef = jtu.tree_flatten(inputs)
    leaves = [jnp.asarray(x) for x in leaves]
    program, consts, *structures = traced(Functions(begin, step, end), treedef, leaves, rows=rows)
    backend = current_backend() if backend is None else backend
    found = lanes_p.bind(*leaves, *consts, program=program, backend=backend)
    n = len(program.out_avals)
    results, row = map(jtu.tree_unflatten, structures, (found[:n], found[n:]))
    return results, row


def once(function: Callable[[Any], Any], inputs: object) -> Any:
    """`function(inputs)` as vector code, without a loop; batched by `vmap` as `run` is.

    **Arguments:** a function of a pytree of scalars and small arrays; the pytree.
    """
    return run(_begin_ended, _no_step, functools.partial(_end_with, function), inputs, rows=0)[0]


def _begin_ended(inputs: object) -> tuple[Any, Emitted]:
    return (), Emitted(False, False, ())


def _no_step(inputs: object, carry: object) -> tuple[Any, Emitted]:
    return carry, Emitted(False, False, ())


def _end_with(function: Callable[[Any], Any], inputs: object, carry: object) -> Any:
    return function(inputs)
