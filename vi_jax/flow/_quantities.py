"""The quantities that a machine defines, by name: functions of its state, and averages over a
cycle."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._checks import fields_with
from .._types import State
from ..machine import (
    PLAIN,
    QUANTITIES,
    AbstractMachine,
    begin_modes,
    components,
    is_builtin,
    leaf_names,
    near_names,
    overridden,
    shown_modes,
    with_some_past,
)
from ._machine_checks import explain_errors

# Names that results use already: columns of runs, orbits, branches and scans, and axes.
_RESERVED = frozenset(
    """admissible clearance column cycle cycles duration error event exponent exponents extremes
    frequency_ratio history impact impact_energy impact_phase impact_rate impact_speed impact_stop
    impacts iterations lane monodromy multiplier multipliers number parameter period point regime
    rejected residual rests result row sample sections section stability stable start state
    steps y_max y_min""".split()
)

# Names that `units` may have for any machine.
_WITH_UNITS = sorted({*PLAIN, *QUANTITIES.values(), "power"})


def has_averages(machine: AbstractMachine) -> bool:
    return overridden(machine, AbstractMachine, "averages") is not None


def has_quantities(machine: AbstractMachine) -> bool:
    return overridden(machine, AbstractMachine, "quantities") is not None


def average_names(machine: AbstractMachine, start: State) -> tuple[str, ...]:
    """Return the names of a machine's averages in their order. **Raises:** `TypeError` if the
    averages are not a mapping to numbers; `ValueError` if a name is in use already."""
    if not has_averages(machine):
        return ()
    machine = with_some_past(machine, start)
    zero = jnp.zeros((), jnp.result_type(machine.position(start)))
    modes = shown_modes(machine, begin_modes(machine, zero, start))
    names = _checked_names(machine, "averages", machine.averages, start, (zero, start, *modes))
    both = sorted(set(names) & set(quantity_names(machine, start)))
    if both:
        raise ValueError(
            f"`averages` of a {type(machine).__name__} must have names of their own, but "
            f"{both[0]!r} is one of its `quantities` too."
        )
    return names


def quantity_names(machine: AbstractMachine, start: State) -> tuple[str, ...]:
    """Return the names of the functions of a machine's state. **Raises:** as `average_names`."""
    if not has_quantities(machine):
        return ()
    zero = jnp.zeros((), jnp.result_type(machine.position(start)))
    return _checked_names(machine, "quantities", machine.quantities, start, (zero, start))


def check_units(machine: AbstractMachine, start: State, observed: tuple[str, ...]) -> None:
    """**Raises:** `ValueError` if the user's `units` of a machine have a name of nothing in it.
    `observed` are names of quantities, and of averages if these are computed."""
    owner = next(kind for kind in type(machine).__mro__ if "units" in vars(kind))
    if is_builtin(owner):
        return
    words = [*leaf_names(machine), *leaf_names(start), *components(start)]
    words += [name.rpartition(".")[2] for name in words]
    words += [*fields_with(type(machine), "unit"), *_WITH_UNITS, *observed]
    unknown = [x for x in machine.units if x and x not in words and not hasattr(machine, x)]
    words += average_names(machine, start) if unknown else ()
    for name in unknown:
        if name not in words:
            raise ValueError(
                f"`units` of a {type(machine).__name__} must name its parameters, components and "
                f"quantities, but has {name!r}; {near_names(name, list(dict.fromkeys(words)))}."
            )


def quantities_on(machine: AbstractMachine, sections: State, lead: int = 0) -> dict[str, Array]:
    """Return the machine's functions of its state on sections (states along one axis), by name.
    Machine and sections may have `lead` batch axes in front, as `vmap` gives them."""
    if not has_quantities(machine):
        return {}
    dtype = jnp.result_type(*jtu.tree_leaves(sections))
    numbers, rest = eqx.partition(machine, eqx.is_array)

    def of_state(numbers: Any, state: State) -> dict[str, Array]:
        found = eqx.combine(numbers, rest).quantities(jnp.zeros((), dtype), state)
        return {name: jnp.asarray(x, dtype) for name, x in found.items()}

    of_state = jax.vmap(of_state, in_axes=(None, 0))
    for _ in range(lead):
        of_state = jax.vmap(of_state)
    return of_state(numbers, sections)


def _checked_names(
    machine: AbstractMachine, attribute: str, function: Callable, start: State, arguments: tuple
) -> tuple[str, ...]:
    """Return the names of a machine's averages or quantities (`attribute`), sorted; names of
    components of `start` are in use already. **Raises:** as `average_names`."""
    label = f"`{attribute}` of a {type(machine).__name__}"
    with explain_errors(label):
        found = jax.eval_shape(lambda *x: _as_arrays(label, function(*x)), *arguments)
    taken = _RESERVED | set(leaf_names(machine)) | set(components(start))
    for name, value in found.items():
        if name in taken or name.startswith("section_"):  # columns of a branch have such names
            raise ValueError(f"{label} must have names of their own, but {name!r} is taken.")
        if value.shape:
            raise TypeError(
                f"{label} must be numbers, but {name!r} is an array of shape {value.shape}."
            )
    return tuple(sorted(found))  # in the order of pytrees


def _as_arrays(label: str, found: object) -> dict[str, Array]:
    if not isinstance(found, Mapping):
        raise TypeError(
            f"{label} must be a mapping of names to numbers, but returned {type(found).__name__}."
        )
    for name, value in found.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"{label} must have names that are identifiers, but got {name!r}.")
        if not hasattr(value, "dtype") and not isinstance(value, int | float):
            raise TypeError(f"{label} must be numbers, but {name!r} is {value!r}.")
    return {name: jnp.asarray(value) for name, value in found.items()}
