"""A state together with the modes that the machine is in."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from .._types import Machine, State, Vector
from .events import modes_at_start, settled_modes
from .own import has_own_modes
from .shown import Shown


class HybridState(Shown):
    """A state together with the machine's discrete modes, a start that continues another motion.

    A machine with discrete modes (`AbstractMachine.modes`) is not determined by its state alone.
    `Run.last` and `Orbit.state` of such a machine are of this class. Its components are those of
    `state`: `run.last.Y` is `run.last.state.Y`.

    **Arguments:**

    - `state`: the state, as the machine's field receives it.
    - `modes`: the machine's discrete modes, a tuple in the order of its `modes`.
    """

    state: Any
    modes: tuple[Any, ...]

    def __getattr__(self, name: str) -> Any:
        if name in ("state", "modes") or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.state, name)

    def __getitem__(self, place: Any) -> Any:
        return self.state[place]


def bare(state: State) -> State:
    """The state without modes."""
    return state.state if isinstance(state, HybridState) else state


def modes_of(state: State) -> tuple[Any, ...] | None:
    """The machine's own modes in a state; `None` if it says nothing of them."""
    return state.modes if isinstance(state, HybridState) else None


def with_modes(state: State, modes: tuple[Any, ...] | None) -> State:
    """Return the state in these modes of the machine's own; as it is if there are none."""
    return HybridState(state, modes) if modes else state


def replaced(state: State, new: State) -> State:
    """Another state in the same modes."""
    return HybridState(new, state.modes) if isinstance(state, HybridState) else new


def begun(machine: Machine, state: State, axes: int = 0) -> State:
    """The state with the modes of a motion that begins in it; as it is if it has some, or the
    machine has none of its own.

    **Arguments:** `axes`, how many axes the state has in front.
    """
    if isinstance(state, HybridState) or not has_own_modes(machine):
        return state

    def begin(state: State) -> Any:
        zero = jnp.zeros_like(machine.position(state))
        return settled_modes(modes_at_start(machine, zero, state), zero)

    for _ in range(axes):
        begin = jax.vmap(begin)
    return with_modes(state, begin(state))


def raveled(state: State) -> tuple[Vector, Callable[[Vector], State]]:
    """`ravel_pytree` of a state whose modes stay what they are: they are no unknowns."""
    row, unravel = ravel_pytree(bare(state))
    return row, lambda row: replaced(state, unravel(row))
