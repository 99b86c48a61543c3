"""Machines with delays: the past that their functions read, and the quantities that are delayed.

A machine with `delays` is simulated in another form, an instance of a subclass that has the past
within it. Its field and events have the arguments of a machine without delays, so that all else in
the package need not distinguish the two.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import concrete
from .._types import Machine, Scalar, Scalars, State, Vector
from ..lanes import dependent_results
from .base import AbstractMachine, cached_in_trace
from .contacts import check_takes, field_in, shown_modes
from .events import Reset, Switch, after_event, begin_modes, guard_of, section_number
from .overrides import overridden, with_static
from .state import State as Named
from .state import like

# A delay must be at least this share of a cycle: each step is at most as long as the delay.
_SHORTEST = 1e-3

# The number of delays after which the image of a jump is too smooth to matter for polynomials of
# degree 7, by the number of integrations from a delayed quantity to itself.
_LEVELS = (7, 7, 3, 2)


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


@cached_in_trace
def lags_of(machine: Machine) -> list[Scalar]:
    """Return the delays of a machine in any form as numbers."""
    return [1.0 * jnp.asarray(x) for x in delays_in(without_past(machine)).values()]


@cached_in_trace
def longest_delay(machine: Machine) -> Scalar:
    return functools.reduce(jnp.maximum, lags_of(machine))


def delays_valid(machine: Machine) -> Any:
    """Return whether all delays, which may be traced, are in their range."""
    least = _SHORTEST * jnp.asarray(machine.cycle)
    flags = [(x >= least) & (x < jnp.inf) for x in lags_of(machine)]
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
        """The number of numbers that are used."""
        return sum(math.prod(x) for x, used in zip(self.shapes, self.used, strict=True) if used)

    def pack(self, recorded: Any) -> Vector:
        """Return the numbers that are used, as a vector."""
        leaves = zip(jtu.tree_leaves(recorded), self.used, strict=True)
        return jnp.concatenate([jnp.ravel(x) for x, used in leaves if used])

    def unpack(self, numbers: Vector) -> Any:
        """Return what was recorded; 0 for numbers that are not used."""
        leaves, place = [], 0
        for shape, used in zip(self.shapes, self.used, strict=True):
            end = place + math.prod(shape) * used
            leaf = numbers[place:end].reshape(shape) if used else jnp.zeros(shape, numbers.dtype)
            leaves.append(leaf)
            place = end
        return jtu.tree_unflatten(self.structure, leaves)

    def by_name(self, numbers: Any) -> Named:
        """Return the past from a vector of numbers for each delay."""
        return Named(**{x: self.unpack(y) for x, y in zip(self.names, numbers, strict=True)})


class Past(eqx.Module):
    """The past in a form of a machine, a function of the clock and the form's state; by default one
    that does not depend on them, for checks before a run."""

    form: Any
    fixed: Any = eqx.field(default=None, kw_only=True)

    def __call__(self, machine: Any, s: Scalar, state: State) -> Any:
        return self.fixed

    def own(self, state: State) -> State:
        """Return the machine's own state from that of the form."""
        return state

    def rates(self, machine: Any, flow: Any, s: Scalar, state: State, modes: Scalars) -> Any:
        """Return the rates of the form's state from the machine's `flow`."""
        return flow

    @staticmethod
    def members(kind: type) -> dict[str, Any]:
        """Return the members that a form of this class has besides those which read the past."""
        return {}


def with_some_past(machine: Machine, start: State) -> Machine:
    """Return a machine that reads the history before the start, each delay ago, at all times;
    unchanged without delays."""
    if not has_delays(machine):
        return machine
    if "history" in getattr(start, "__dict__", {}):
        kind = type(machine).__name__
        raise TypeError(
            f"Argument `start` of a {kind}, which has delays, must not have a component `history`. "
            "A state of a `delay_chain` needs the chain as its machine, for an orbit "
            "`orbit.machine`."
        )
    before = history_before(machine, start)
    form = form_of(machine, start, before)
    past = form.by_name([form.pack(before(-x)) for x in lags_of(machine)])
    return reading(machine, Past(form, fixed=past))


def reading(machine: Machine, past: Past) -> Any:
    """Return the form of a machine with delays that reads this past."""
    machine = without_past(machine)
    new = object.__new__(_reading_kind(type(machine), type(past)))
    return with_static(new, **_values_of(machine), _past=past)


def without_past(machine: Machine) -> Machine:
    """Return the machine as the user defined it."""
    return _original(machine) if hasattr(machine, "_past") else machine


@cached_in_trace
def _original(machine: Machine) -> Machine:
    return with_static(object.__new__(type(machine).__mro__[1]), **_values_of(machine))


def _values_of(machine: Machine) -> dict[str, Any]:
    names = [field.name for field in dataclasses.fields(machine) if field.name != "_past"]
    return {name: getattr(machine, name) for name in names}


@functools.lru_cache(maxsize=64)
def _reading_kind(kind: type, past: type[Past]) -> type:
    def field(self: Any, s: Scalar, state: State, *modes: Scalar) -> Any:
        whose = f"`{'force' if hasattr(kind, 'force') else 'field'}` of a {kind.__name__}"
        flow = _called(without_past(self).field, whose, (), self, s, state, modes)
        return self._past.rates(self, flow, s, state, modes)

    def averages(self: Any, s: Scalar, state: State, *modes: Scalar) -> Any:
        whose = f"`averages` of a {kind.__name__}"
        return _called(without_past(self).averages, whose, (), self, s, state, modes)

    def observed_every(self: Any, interval: Any) -> Any:
        return reading(without_past(self).observed_every(interval), self._past)

    def observed_machine(self: Any) -> Any:
        machine: Any = without_past(self)
        return reading(machine.observed_machine, self._past)

    def parts(name: str) -> property:
        return property(lambda self: tuple(map(_given_past, getattr(without_past(self), name))))

    body: dict[str, Any] = {
        "__module__": kind.__module__,
        "__qualname__": kind.__qualname__,
        "__annotations__": {"_past": Any},
        "_past": eqx.field(default=None, kw_only=True),
        "field": field,
        "_switches": parts("_switches"),
        "_others": parts("_others"),
        "observed_every": observed_every,
    }
    if hasattr(kind, "observed_machine"):
        body["observed_machine"] = property(observed_machine)
    if overridden(object.__new__(kind), AbstractMachine, "averages"):
        body["averages"] = averages
    return type(kind)(kind.__name__, (kind,), body | past.members(kind))


def _called(
    function: Callable[..., Any], whose: str, first: tuple[Any, ...], machine: Any, s: Scalar,
    state: State, modes: Scalars,
) -> Any:  # fmt: skip
    """Return the result of a user's function, which receives the past after the state."""
    past = machine._past
    given = *first, s, past.own(state), past(machine, s, state), *modes
    words = "the machine, `t`, the state, the past" if first else "`t`, the state, the past"
    check_takes(function, whose, words, given, len(modes))
    try:
        return function(*given)
    except (AttributeError, LookupError) as error:
        raise TypeError(f"{whose} must be computable, but: {error}") from error


@dataclasses.dataclass(frozen=True)
class _WithPast:
    """A function of an event, which receives the past after the state."""

    function: Callable[..., Any]

    def __call__(self, machine: Any, s: Scalar, state: State, *modes: Scalar) -> Any:
        first = (without_past(machine),)
        found = _called(self.function, "A function of an event", first, machine, s, state, modes)
        return vars(found) if isinstance(found, Named) else found


def _given_past(event: Any) -> Any:
    """Return an event whose functions, if it is a switch or a reset, receive the past."""
    names = ()
    if isinstance(event, Switch):
        names = ("function",)
    elif isinstance(event, Reset):
        names = ("_guard", "_reset", "_when", "_modes", "_value")
    functions = {name: getattr(event, name) for name in names}
    return with_static(event, **{k: f and _WithPast(f) for k, f in functions.items()})


# --- what is recorded


def history_before(machine: Machine, start: State) -> Callable[[Scalar], Any]:
    """Return the history before the start, a function of t ≤ 0. **Raises:** `ValueError` if it is
    not known, `TypeError` if it cannot be computed."""
    whose, given = f"`before` of a {type(machine).__name__}", machine.before
    if callable(given):
        return lambda t: as_state(given(t), whose)
    if given is None and not overridden(machine, AbstractMachine, "recorded"):
        return lambda t: start
    if given is None:
        zero, past = jnp.zeros((), float), _Unknown(whose)
        bound = reading(machine, Past(None, fixed=past))
        modes = shown_modes(bound, begin_modes(bound, zero, start))
        given, whose = machine.recorded(zero, start, past, *modes), "`recorded`"
    value = as_state(given, whose)
    return lambda t: value


class _Unknown:
    def __init__(self, whose: str):
        self._whose = whose

    def __getattr__(self, name: str) -> Any:
        raise ValueError(
            f"{self._whose} must be given, the history before the start, since its `recorded` or "
            "the modes at the start read the past: `before = vi.State(...)`."
        )


def as_state(found: Any, whose: str) -> Any:
    if isinstance(found, Mapping):
        found = Named(**{name: as_state(x, whose) for name, x in found.items()})
    if not jtu.tree_leaves(found):
        raise TypeError(f"{whose} must be a state, or numbers by name, but is {found!r}.")
    return jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(float, x)), found)


def recorded_numbers(machine: Any, s: Scalar, state: State, modes: Scalars) -> Vector:
    """Return what a machine, with its past bound to it, records in a state; `modes` as its field
    receives them."""
    return machine._past.form.pack(_recorded(machine, s, state, modes))


def _recorded(machine: Any, s: Scalar, state: State, modes: Scalars) -> Any:
    form, whose = machine._past.form, f"`recorded` of a {type(machine).__name__}"
    found = _called(without_past(machine).recorded, whose, (), machine, s, state, modes)
    zeros = [jnp.zeros(x, s.dtype) for x in form.shapes]
    empty = jtu.tree_unflatten(form.structure, zeros)
    found = like(empty, found, whose)
    if jtu.tree_structure(found) != form.structure:
        raise TypeError(f"{whose} must return numbers like `before`: {empty!r}.")
    return found


def form_of(machine: Machine, start: State, before: Callable[[Scalar], Any]) -> Recorded:
    """Return the form of what a machine with delays records, from a start and its history."""
    zero, names = jnp.zeros((), float), tuple(delays_in(machine))
    leaves, structure = jtu.tree_flatten(jax.eval_shape(before, zero))
    shapes, number = tuple(x.shape for x in leaves), len(leaves)
    form = Recorded(structure, shapes, (True,) * number, _LEVELS[0], names)
    blank = form.by_name([jnp.zeros(form.size)] * len(names))
    modes = begin_modes(reading(machine, Past(form, fixed=blank)), zero, start)

    def readers(past: Any, state: State, modes: Any) -> Any:
        """Return what may read the past: what is recorded, the rates, all else."""
        bound = reading(machine, Past(form, fixed=past))
        shown, events = shown_modes(bound, modes), range(len(bound._stops), section_number(bound))
        others = [f(bound, n, zero, state, modes) for n in events for f in (guard_of, after_event)]
        if "averages" in vars(type(bound)):
            others.append(bound.averages(zero, state, *shown))
        flow = field_in(bound, zero, state, modes)
        return _recorded(bound, zero, state, shown), flow, others

    given, parts = (blank, start, modes), len(jtu.tree_leaves(start))
    traced = jax.make_jaxpr(readers)(*given).jaxpr
    one_by_one = np.eye(len(traced.invars), dtype=bool).tolist()
    # For each argument, which results depend on it.
    marks = np.array([dependent_results(traced, x, smooth=False) for x in one_by_one])
    rates, pasts = slice(number, number + parts), number * len(names)
    past: Any = marks[:pasts].reshape(len(names), number, -1).any(axis=0)
    state = marks[pasts : pasts + parts]
    used: Any = past[:, number:].any(axis=1)
    for _ in leaves:  # what is recorded may read other numbers of the past
        used |= past[:, :number] @ used
    if not used.any():
        raise ValueError(
            f"A {type(machine).__name__} has `delays`, but nothing reads its past. Leave them out."
        )
    driven, reached, gain = past[used, rates].any(axis=0), state[:, :number] @ used, 0
    if not (past[used, :number] & used).any():
        gain = 1
        while gain < 3 and not (reached & driven).any():
            reached, gain = reached | state[:, rates] @ reached, gain + 1
    return Recorded(structure, shapes, tuple(used.tolist()), _LEVELS[gain], names)
