"""Machines with delays: the past that their functions read, and the quantities that are delayed.

A machine with `delays` is simulated in another form, an instance of a subclass that has the past
within it. Its field and events have the arguments of a machine without delays, so that all else in
the package need not distinguish the two.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._checks import concrete
from .._types import Machine, Scalar, Scalars, State, Vector
from ..lanes import dependent_results
from .base import cached_in_trace
from .contacts import call_checked, check_takes, field_in, shown_modes
from .declared import overridden, switches_of, with_static
from .events import Reset, Switch, after_event, begin_modes, guard_of, section_number
from .state import State as Named
from .state import like

# A delay must be at least this share of a cycle: each step is at most as long as the delay.
_SHORTEST = 1e-3

# The number of delays after which the image of a jump is too smooth to matter for polynomials of
# degree 7, by the number of integrations from a delayed quantity to itself.
_LEVELS = {0: 7, 1: 7, 2: 3}


def has_delays(machine: Machine) -> bool:
    """Return whether a machine has delays, and its past is not bound to it yet."""
    return not hasattr(machine, "_past") and bool(machine.delays)


def delays_in(machine: Machine) -> dict[str, Any]:
    """Return the delays of a machine by name. **Raises:** `TypeError` or `ValueError` for invalid
    ones."""
    whose, given = f"`delays` of a {type(machine).__name__}", machine.delays
    if not isinstance(given, Mapping) or not all(map(str.isidentifier, given)):
        raise TypeError(f"{whose} must be times by name, `dict(turn=...)`, but is {given!r}.")
    cycle = concrete(jnp.asarray(machine.cycle))
    for name, delay in given.items():
        if jnp.shape(delay):
            raise ValueError(f"{whose} must be numbers, but {name} has shape {jnp.shape(delay)}.")
        number = concrete(jnp.asarray(delay))
        if number is None or cycle is None or _SHORTEST * cycle <= number < jnp.inf:
            continue
        raise ValueError(
            f"{whose} must be finite and at least a thousandth of a cycle, {_SHORTEST * cycle:.6g},"
            f" but {name} is {number:.6g}. A shorter delay is a time constant of the field."
        )
    return dict(given)


def delays_valid(machine: Machine) -> Any:
    """Return whether all delays, which may be traced, are in their range."""
    least = _SHORTEST * jnp.asarray(machine.cycle)
    flags = [(x >= least) & (x < jnp.inf) for x in map(jnp.asarray, machine.delays.values())]
    return functools.reduce(jnp.logical_and, flags)


class Recorded(eqx.Module):
    """The form of what a machine records: a state, and which of its numbers functions read."""

    structure: Any = eqx.field(static=True)
    shapes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    used: tuple[bool, ...] = eqx.field(static=True)
    levels: int = eqx.field(static=True)
    """Number of delays for which images of jumps are met."""
    names: tuple[str, ...] = eqx.field(static=True)
    """The names of the delays."""

    @property
    def size(self) -> int:
        """The number of numbers that are recorded."""
        return sum(
            jnp.zeros(x).size for x, used in zip(self.shapes, self.used, strict=True) if used
        )

    def pack(self, recorded: Any) -> Vector:
        """Return the numbers that are used, as a vector."""
        leaves = zip(jtu.tree_leaves(recorded), self.used, strict=True)
        return jnp.concatenate([jnp.ravel(x) for x, used in leaves if used])

    def unpack(self, numbers: Vector) -> Any:
        """Return what was recorded; 0 for numbers that no function reads."""
        leaves, place = [], 0
        for shape, used in zip(self.shapes, self.used, strict=True):
            leaf = jnp.zeros(shape, numbers.dtype)
            if used:
                leaf = numbers[place : place + leaf.size].reshape(shape)
                place += leaf.size
            leaves.append(leaf)
        return jtu.tree_unflatten(self.structure, leaves)

    def by_name(self, numbers: Any) -> Named:
        """Return the past from a vector of numbers for each delay."""
        return Named(**{x: self.unpack(y) for x, y in zip(self.names, numbers, strict=True)})


class FixedPast(eqx.Module):
    """A past that does not depend on time, for checks before a run."""

    past: Any

    def __call__(self, s: Scalar) -> Any:
        return self.past


# --- the form of a machine in which its past is bound to it


def reading(machine: Machine, past: Callable[[Scalar], Any]) -> Machine:
    """Return the form of a machine with delays that reads this past, a function of `s`."""
    machine = without_past(machine)
    new = object.__new__(_reading_kind(type(machine)))
    return with_static(new, **values_of(machine), _past=past)


def without_past(machine: Machine) -> Machine:
    """Return the machine as the user defined it."""
    return original(machine) if hasattr(machine, "_past") else machine


def values_of(machine: Machine) -> dict[str, Any]:
    """Return the values of the machine's own fields."""
    names = [field.name for field in dataclasses.fields(machine)]
    return {name: getattr(machine, name) for name in names if name not in _ADDED}


# The fields that other forms of a machine have besides its own.
_ADDED = ("_past", "_chain", "_begin")


@cached_in_trace
def original(machine: Machine) -> Machine:
    """Return the machine as the user defined it, from one of its other forms."""
    kind = type(machine).__mro__[1]
    return with_static(object.__new__(kind), **values_of(machine))


@functools.lru_cache(maxsize=64)
def _reading_kind(kind: type) -> type:
    def with_past(name: str) -> Callable[..., Any]:
        def function(self: Any, s: Scalar, state: State, *modes: Scalar) -> Any:
            given = s, state, self._past(s), *modes
            whose = f"`{'force' if hasattr(kind, 'force') else name}` of a {kind.__name__}"
            call = getattr(original(self), name)
            check_takes(call, whose, "`s`, the state, the past", given, len(modes))
            return call(*given)

        return function

    body: dict[str, Any] = {
        "__module__": kind.__module__,
        "__qualname__": kind.__qualname__,
        "__annotations__": {"_past": Any},
        "_past": eqx.field(default=None, kw_only=True),
        "field": with_past("field"),
        "_switches": property(lambda self: tuple(map(given_past, original(self)._switches))),
        "_others": property(lambda self: tuple(map(given_past, original(self)._others))),
    }
    if overridden(object.__new__(kind), _base(kind), "averages"):
        body["averages"] = with_past("averages")
    return type(kind)(kind.__name__, (kind,), body)


def _base(kind: type) -> type:
    return next(x for x in kind.__mro__ if x.__name__ == "AbstractMachine")


@dataclasses.dataclass(frozen=True)
class WithPast:
    """A function of an event, which receives the past after the state."""

    function: Callable[..., Any]

    def __call__(self, machine: Any, s: Scalar, state: State, *modes: Scalar) -> Any:
        return self.call((without_past(machine), s, state, machine._past(s), *modes))

    def call(self, given: tuple[Any, ...]) -> Any:
        return call_checked(self.function, "A function of an event", *given)


def given_past(event: Any, wrapper: type = WithPast) -> Any:
    """Return an event whose functions, if it is a switch or a reset, are wrapped."""
    names = ()
    if isinstance(event, Switch):
        names = ("function",)
    elif isinstance(event, Reset):
        names = ("_guard", "_reset", "_when", "_modes", "_value")
    functions = {name: getattr(event, name) for name in names}
    return with_static(event, **{k: f and wrapper(f) for k, f in functions.items()})


# --- what is recorded


def history_before(machine: Machine, start: State) -> Callable[[Scalar], Any]:
    """Return the history before the start, a function of t ≤ 0. **Raises:** `ValueError` if it is
    not known, `TypeError` if it cannot be computed."""
    whose, given = f"`before` of a {type(machine).__name__}", machine.before
    if callable(given):
        return lambda t: as_state(given(t), whose)
    if given is not None:
        value = as_state(given, whose)
        return lambda t: value
    if overridden(machine, _base(type(machine)), "recorded") is None:
        return lambda t: start
    zero = jnp.zeros((), float)
    modes = shown_modes(machine, _modes_at(machine, zero, start))
    value = as_state(machine.recorded(zero, start, _Unknown(whose), *modes), "`recorded`")
    return lambda t: value


class _Unknown:
    def __init__(self, whose: str):
        self._whose = whose

    def __getattr__(self, name: str) -> Any:
        raise ValueError(
            f"{self._whose} must be given, the history before the start, since its `recorded` "
            "reads the past: `before = vi.State(...)`."
        )


def _modes_at(machine: Machine, s: Scalar, state: State) -> Scalars:
    """Return modes of the right number; their values do not matter."""
    own = machine.modes(s, state) if callable(machine.modes) else machine.modes
    own = tuple(own.values()) if isinstance(own, Mapping) else own
    number = len(switches_of(machine)) + (len(own) if isinstance(own, tuple | list) else 1)
    return (jnp.ones_like(s),) * number


def as_state(found: Any, whose: str) -> Any:
    if isinstance(found, Mapping):
        found = Named(**{name: as_state(x, whose) for name, x in found.items()})
    if not jtu.tree_leaves(found):
        raise TypeError(f"{whose} must be a state, or numbers by name, but is {found!r}.")
    return jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(float, x)), found)


def recorded_numbers(
    machine: Machine, form: Recorded, s: Scalar, state: State, modes: Scalars
) -> Vector:
    """Return what a machine, with its past bound to it, records in a state."""
    return form.pack(_recorded(machine, form.structure, form.shapes, s, state, modes))


def _recorded(
    machine: Machine, structure: Any, shapes: Any, s: Scalar, state: State, modes: Scalars
) -> Any:
    original = without_past(machine)
    whose = f"`recorded` of a {type(machine).__name__}"
    given = s, state, machine._past(s), *shown_modes(machine, modes)
    check_takes(original.recorded, whose, "`s`, the state, the past", given, len(modes))
    empty = jtu.tree_unflatten(structure, [jnp.zeros(x, s.dtype) for x in shapes])
    found = like(empty, original.recorded(*given), whose)
    if jtu.tree_structure(found) != structure:
        raise TypeError(f"{whose} must return numbers like `before`: {empty!r}.")
    return found


def form_of(machine: Machine, start: State, before: Callable[[Scalar], Any]) -> Recorded:
    """Return the form of what a machine with delays records, from a start and its history."""
    zero, names = jnp.zeros((), jnp.result_type(float)), tuple(delays_in(machine))
    first = jax.eval_shape(before, zero)
    leaves, structure = jtu.tree_flatten(first)
    shapes = tuple(x.shape for x in leaves)
    form = Recorded(structure, shapes, (True,) * len(leaves), 7, names)
    blank = [jnp.zeros((form.size,)) for _ in names]
    bound = reading(machine, FixedPast(form.by_name(blank)))
    modes = begin_modes(bound, zero, start)

    def at(past: list[Any], state: State, modes: Any) -> tuple[Any, Any, Any]:
        """Return what reads the past: the flow, all else, and what is recorded."""
        by_name = Named(**dict(zip(names, past, strict=True)))
        bound = reading(machine, FixedPast(by_name))
        flow, others = field_in(bound, zero, state, modes), []
        for number in range(len(bound._stops), section_number(bound)):
            others.append(guard_of(bound, number, zero, state, modes))
            others.append(after_event(bound, number, zero, state, modes))
        if "averages" in vars(type(bound)):
            others.append(bound.averages(zero, state, *shown_modes(bound, modes)))
        return flow, others, _recorded(bound, structure, shapes, zero, state, modes)

    given = [form.unpack(x) for x in blank], start, modes
    traced, shape = jax.make_jaxpr(at, return_shape=True)(*given)
    pasts, states, rest = (len(jtu.tree_leaves(x)) for x in given)
    flows, others, _ = (len(jtu.tree_leaves(x)) for x in shape)

    def marks(sources: list[bool]) -> tuple[list[bool], list[bool], list[bool]]:
        found = dependent_results(traced.jaxpr, sources, smooth=False)
        return found[:flows], found[flows : flows + others], found[flows + others :]

    each, total = pasts // len(names), pasts + states + rest
    found = [marks([i < pasts and i % each == leaf for i in range(total)]) for leaf in range(each)]
    used = [any(flow) or any(other) for flow, other, _ in found]
    for _ in range(each):  # what is recorded may read other numbers of the past
        used = [
            x or any(a and b for a, b in zip(used, record, strict=True))
            for x, (_, _, record) in zip(used, found, strict=True)
        ]
    if not any(used):
        raise ValueError(
            f"A {type(machine).__name__} has `delays`, but nothing reads its past. Leave them out."
        )
    flow, _, record = marks([i < pasts and used[i % each] for i in range(total)])
    driven, gain = {i for i, x in enumerate(flow) if x}, 0
    if not any(x and y for x, y in zip(record, used, strict=True)):
        gain = _integrations(marks, pasts, states, rest, driven, used)
    return Recorded(structure, shapes, tuple(used), _LEVELS.get(gain, 2), names)


def _integrations(
    marks: Callable[[list[bool]], tuple[list[bool], ...]], pasts: int, states: int, rest: int,
    driven: set[int], used: list[bool],
) -> int:  # fmt: skip
    """Return the number of integrations from the past to what is recorded, at most 3. `driven` are
    the parts of the state whose rates read the past."""
    of_state = [
        marks([i == pasts + part for i in range(pasts + states + rest)]) for part in range(states)
    ]
    reached = {
        part
        for part, (_, _, record) in enumerate(of_state)
        if any(x and y for x, y in zip(record, used, strict=True))
    }
    for gain in (1, 2):
        if reached & driven:
            return gain
        moves = [part for part in range(states) if any(of_state[part][0][i] for i in reached)]
        reached = reached | set(moves)
    return 3
