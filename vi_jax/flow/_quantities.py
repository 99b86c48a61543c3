"""The quantities that a machine defines, by name: functions of its state, and averages over a
cycle."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.extend.core import Jaxpr
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._checks import concrete, fields_with, outside_of_traces, returned
from .._types import Scalar, State
from ..lanes import called, propagate_marks
from ..machine import (
    PLAIN,
    QUANTITIES,
    AbstractMachine,
    begin_modes,
    check_takes,
    components,
    is_builtin,
    leaf_names,
    near_names,
    overridden,
    shown_modes,
    with_some_past,
)
from .machine_checks import explain_errors

# Names that results use already: columns of runs, orbits, branches and scans, and axes.
_RESERVED = frozenset(
    """admissible clearance column cycle cycles duration error event exponent exponents extremes
    frequency_ratio history impact impact_energy impact_phase impact_rate impact_speed impact_stop
    impacts iterations lane monodromy multiplier multipliers number parameter period point regime
    reduced rejected residual rests result row sample sections section stability stable start state
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
    averages are not a mapping to numbers; `ValueError` if a name is in use already, or if one of
    them jumps."""
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
    jumping = _jumping(_Averages(machine, start, modes))
    if jumping is not None:
        raise ValueError(
            f"`averages` of a {type(machine).__name__} must be continuous, but {jumping!r} jumps: "
            "its mean would be inaccurate, with wrong derivatives. Let a `Switch` among the "
            "`events` have the sign that decides, and use its mode: `0.5 * (1 + side)`."
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
    units = returned(machine.units, f"`units` of a {type(machine).__name__}", "units by name")
    unknown = [x for x in units if x and x not in words and not hasattr(machine, x)]
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
    check_takes(function, label, "`t`, the state", arguments, len(arguments) - 2)
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


def _as_arrays(label: str, found: Any) -> dict[str, Array]:
    if not isinstance(returned(found, label, "numbers by name"), Mapping):
        raise TypeError(
            f"{label} must be a mapping of names to numbers, but returned {type(found).__name__}."
        )
    for name, value in found.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise ValueError(f"{label} must have names that are identifiers, but got {name!r}.")
        if not hasattr(value, "dtype") and not isinstance(value, int | float):
            raise TypeError(f"{label} must be numbers, but {name!r} is {value!r}.")
    return {name: jnp.asarray(value) for name, value in found.items()}


# Functions of these primitives may jump: a comparison chooses, the others count.
_DECIDES = frozenset("gt lt ge le eq ne sign floor ceil round rem".split())

# Lines through the state space on which jumps are looked for, points on each, and halvings of the
# interval with the greatest change. A jump keeps this share of the change on its line. Choices.
_LINES, _POINTS, _HALVINGS, _KEPT = 48, 129, 40, 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class _Averages:
    """A machine and a state of it, the same as any other with these types and static values."""

    machine: AbstractMachine
    state: State
    modes: tuple

    @property
    def key(self) -> Any:
        return type(self.machine), jtu.tree_structure((self.machine, self.state, self.modes))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Averages) and self.key == other.key


@functools.lru_cache(maxsize=256)
def _jumping(averages: _Averages) -> str | None:
    """Return the name of an average that jumps as a function of the state, or `None`. Only those
    with comparisons are tried, with arbitrary numbers in place of those that are not known."""
    rng = np.random.default_rng(0)

    def number(x: Any) -> np.ndarray:
        known = concrete(x)
        return rng.uniform(0.5, 1.5, jnp.shape(x)) if known is None else np.asarray(known)

    parts, rest = eqx.partition((averages.machine, averages.modes), eqx.is_array)
    machine, modes = eqx.combine(jtu.tree_map(number, parts), rest)
    state = jtu.tree_map(number, averages.state)

    def values(s: Scalar, state: State) -> dict[str, Array]:
        return {name: jnp.asarray(x) for name, x in machine.averages(s, state, *modes).items()}

    with outside_of_traces():
        row, unravel = ravel_pytree(jtu.tree_map(jnp.asarray, (0.0, state)))
        jaxpr = jax.make_jaxpr(lambda x: values(*unravel(x)))(row).jaxpr
        if not _decides(jaxpr, [True]):
            return None
        cycle = concrete(machine.cycle)
        sizes = np.maximum(1.0, np.abs(np.asarray(row)))
        sizes[0] = 1.0 if cycle is None else np.max(cycle)
        shape, scales = (2, _LINES, row.size), 10 ** rng.uniform(-3, 1, (_LINES, 1))
        ends = np.asarray(row) + rng.uniform(-1, 1, shape) * scales * sizes
        of_row = functools.partial(_jumps_between, lambda x: values(*unravel(x)))
        found = jax.jit(jax.vmap(of_row))(*ends)
    return next((name for name, jumps in found.items() if np.asarray(jumps).any()), None)


def _jumps_between(values: Callable[[Array], Any], begin: Array, end: Array) -> Any:
    """Return for each value whether it jumps on the line between two points: whether the greatest
    change between points of it stays as their distance is halved again and again."""
    at = lambda share: values(begin + share * (end - begin))
    shares = np.linspace(0, 1, _POINTS)
    on_line = jax.vmap(at)(shares)

    def jumps(name: str) -> Array:
        heights = on_line[name].astype(float)
        steps = jnp.abs(jnp.diff(heights))
        first = jnp.argmax(steps)

        def halve(_: int, ends: tuple) -> tuple:
            low, high = ends
            middle = 0.5 * (low + high)
            x, y, z = (at(share)[name].astype(float) for share in (low, middle, high))
            before = jnp.abs(y - x) >= jnp.abs(z - y)
            return jnp.where(before, low, middle), jnp.where(before, middle, high)

        ends = first / (_POINTS - 1.0), (first + 1) / (_POINTS - 1.0)
        low, high = jax.lax.fori_loop(0, _HALVINGS, halve, ends)
        left = jnp.abs(at(high)[name].astype(float) - at(low)[name].astype(float))
        return left > _KEPT * (jnp.max(heights) - jnp.min(heights))

    return {name: jumps(name) for name in on_line}


def _decides(jaxpr: Any, marks: list[bool]) -> bool:
    """Return whether a jaxpr compares or counts values that depend on the marked arguments."""
    found = []

    def mark(eqn: Any, depends: list[bool]) -> list[bool]:
        body = called(eqn)
        if body is not None:
            return propagate_marks(body if isinstance(body, Jaxpr) else body.jaxpr, depends, mark)
        found.append(eqn.primitive.name in _DECIDES)
        return [True] * len(eqn.outvars)

    propagate_marks(jaxpr, marks, mark)
    return any(found)
