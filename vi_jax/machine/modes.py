"""Modes of a machine: its own beside those of its events, and states with modes."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient

from .._checks import returned
from .._types import Machine, Scalar, State, Vector
from .event import Modes
from .parts import (
    declared_modes,
    events_of,
    has_own_modes,
    mode_number,
)
from .printing import Shown


def own_modes(machine: Machine, modes: Modes) -> Modes:
    """Return the modes of the machine that belong to no event."""
    return modes[mode_number(machine, len(events_of(machine))) :]


def modes_at_start(machine: Machine, s: Scalar, state: State) -> tuple[Any, ...]:
    """Return the machine's own initial modes of a motion that begins in `state`."""
    modes = machine.modes
    if not callable(modes):
        return _values(declared_modes(machine))
    whose = f"`modes` of a {type(machine).__name__}"
    return _values(returned(modes(s, state), whose, "the modes at the start"))


def _values(modes: Any) -> tuple[Any, ...]:
    if isinstance(modes, Mapping):
        return tuple(modes.values())
    return tuple(modes) if isinstance(modes, tuple | list) else (modes,)


def modes_after(machine: Machine, found: Any, modes: Modes, whose: str) -> tuple[Any, ...]:
    """Return the machine's own modes after an event, for which a function returned `found`: all, or
    a dictionary of those that change."""
    names = tuple(declared_modes(machine))
    if not isinstance(found, Mapping) or not names:
        return _values(found)
    extra = [name for name in found if name not in names]
    if extra:
        raise TypeError(
            f"{whose} returned the mode {extra[0]!r}, which the machine does not have. Its `modes` "
            f"are {', '.join(names)}."
        )
    pairs = zip(names, own_modes(machine, modes), strict=True)
    return tuple(found.get(name, old) for name, old in pairs)


def constant_modes(modes: Sequence[Any], s: Scalar) -> Modes:
    """Return modes as floats without derivatives, as the loop carries them."""
    return tuple(stop_gradient(jnp.asarray(mode, jnp.result_type(s))) for mode in modes)


class HybridState(Shown):
    """A state together with the machine's discrete modes, a start that continues another motion.

    A machine with discrete modes (`AbstractMachine.modes`) is not determined by its state alone.
    Its `Run.last` and `Orbit.state` are of this class. The components are those of `state`:
    `run.last.Y` is `run.last.state.Y`.

    **Arguments:**

    - `state`: the state, as the machine's field receives it.
    - `modes`: the machine's discrete modes, a tuple in the order of its `modes`.
    - `history`: the history of a machine with delays, as a run returns it; by default `None`, the
      machine's `before`.
    """

    state: Any
    modes: tuple[Any, ...]
    history: Any = eqx.field(default=None, repr=False)

    def __getattr__(self, name: str) -> Any:
        if name in ("state", "modes", "history") or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.state, name)

    def __getitem__(self, place: Any) -> Any:
        return self.state[place]


def without_modes(state: State) -> State:
    """Return the state without modes."""
    return state.state if isinstance(state, HybridState) else state


def modes_of(state: State) -> tuple[Any, ...] | None:
    """Return the machine's own modes in a state, or `None` if it contains no modes."""
    return state.modes if isinstance(state, HybridState) else None


def history_of(state: State) -> Any:
    """Return the history of a machine with delays in a state, or `None`."""
    return state.history if isinstance(state, HybridState) else None


def with_modes(state: State, modes: tuple[Any, ...] | None, history: Any = None) -> State:
    """Return the state with these own modes of the machine, and this history; unchanged without
    both."""
    return HybridState(state, modes or (), history) if modes or history is not None else state


def replaced(state: State, new: State) -> State:
    """Return another state in the same modes, with the same history."""
    return dataclasses.replace(state, state=new) if isinstance(state, HybridState) else new


def begun(machine: Machine, state: State, axes: int = 0) -> State:
    """Return the state with a motion's initial modes, unless it has some or the machine none."""
    if isinstance(state, HybridState) or not has_own_modes(machine):
        return state

    def begin(state: State) -> Any:
        zero = jnp.zeros_like(machine.position(state))
        return constant_modes(modes_at_start(machine, zero, state), zero)

    for _ in range(axes):
        begin = jax.vmap(begin)
    return with_modes(state, begin(state))


def raveled(state: State) -> tuple[Vector, Callable[[Vector], State]]:
    """Return `ravel_pytree` of a state whose modes are no unknowns: they stay unchanged."""
    row, unravel = ravel_pytree(without_modes(state))
    return row, lambda row: replaced(state, unravel(row))
