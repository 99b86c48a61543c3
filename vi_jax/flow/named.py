"""The quantities that a machine names itself: functions of its state, and averages over a cycle."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._types import State
from ..machine import AbstractMachine, begin_modes, components, is_own, leaf_names, shown_modes
from ._own import in_words_of

# What results have by these names already: columns of runs, orbits, branches and scans, and axes.
_TAKEN = frozenset(
    """admissible clearance column cycle cycles duration error event exponent exponents extremes
    frequency_ratio history impact impact_energy impact_phase impact_rate impact_speed impact_stop
    impacts iterations lane monodromy multiplier multipliers number parameter period point regime
    rejected residual rests result row sample sections section stability stable start state
    steps y_max y_min""".split()
)


def has_averages(machine: AbstractMachine) -> bool:
    """Whether a machine names averages at all."""
    return is_own(type(machine).averages)


def has_quantities(machine: AbstractMachine) -> bool:
    """Whether a machine names functions of its state."""
    return is_own(type(machine).quantities)


def average_names(machine: AbstractMachine, start: State) -> tuple[str, ...]:
    """The names of a machine's averages in their order, by name.

    **Raises:** `TypeError` for averages that are no numbers by name; `ValueError` for a name that
    something else has.
    """
    if not has_averages(machine):
        return ()
    zero = jnp.zeros((), jnp.result_type(machine.position(start)))
    modes = shown_modes(machine, begin_modes(machine, zero, start))
    names = _names(machine, "averages", machine.averages, start, (zero, start, *modes))
    both = sorted(set(names) & set(quantity_names(machine, start)))
    if both:
        raise ValueError(
            f"`averages` of a {type(machine).__name__} must have names of their own, but "
            f"{both[0]!r} is one of its `quantities` too."
        )
    return names


def quantity_names(machine: AbstractMachine, start: State) -> tuple[str, ...]:
    """The names of the functions of a machine's state. **Raises:** as `average_names`."""
    if not has_quantities(machine):
        return ()
    zero = jnp.zeros((), jnp.result_type(machine.position(start)))
    return _names(machine, "quantities", machine.quantities, start, (zero, start))


def quantities_on(machine: AbstractMachine, sections: State, lead: int = 0) -> dict[str, Array]:
    """The machine's functions of its state on sections, which are in a row; by name. With `lead`
    axes in front of machine and sections, as `vmap` gives them."""
    if not has_quantities(machine):
        return {}
    dtype = jnp.result_type(*jtu.tree_leaves(sections))
    numbers, rest = eqx.partition(machine, eqx.is_array)

    def one(numbers: Any, state: State) -> dict[str, Array]:
        found = eqx.combine(numbers, rest).quantities(jnp.zeros((), dtype), state)
        return {name: jnp.asarray(x, dtype) for name, x in found.items()}

    one = jax.vmap(one, in_axes=(None, 0))
    for _ in range(lead):
        one = jax.vmap(one)
    return one(numbers, sections)


def _names(
    machine: AbstractMachine, which: str, function: Callable, start: State, arguments: tuple
) -> tuple[str, ...]:
    """The names of a machine's averages or quantities, sorted.

    **Arguments:** `which`, the method's name; `function`, the method; `start`, a state, whose own
    names are taken; `arguments`, those of the method.

    **Raises:** as `average_names`.
    """
    whose = f"`{which}` of a {type(machine).__name__}"
    with in_words_of(whose):
        found = jax.eval_shape(lambda *x: _as_arrays(whose, function(*x)), *arguments)
    taken = _TAKEN | set(leaf_names(machine)) | set(components(start))
    for name, value in found.items():
        if name in taken or name.startswith("section_"):  # as columns of a branch are called
            raise ValueError(f"{whose} must have names of their own, but {name!r} is taken.")
        if value.shape:
            raise TypeError(
                f"{whose} must be numbers, but {name!r} is an array of shape {value.shape}."
            )
    return tuple(sorted(found))  # as pytrees have them


def _as_arrays(whose: str, found: object) -> dict[str, Array]:
    if not isinstance(found, Mapping):
        raise TypeError(
            f"{whose} must be a mapping of names to numbers, but returned {type(found).__name__}."
        )
    for name, value in found.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"{whose} must have names that are identifiers, but got {name!r}.")
        if not hasattr(value, "dtype") and not isinstance(value, int | float):
            raise TypeError(f"{whose} must be numbers, but {name!r} is {value!r}.")
    return {name: jnp.asarray(value) for name, value in found.items()}
