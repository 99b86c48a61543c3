"""Cycles that end with a turn of an angle or a zero of a function, not with time; and machines
observed at equal intervals instead."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from math import pi
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._checks import concrete, returned
from .._types import Scalar, State
from .coordinates import component, has_component, with_component, wrap_angles
from .event import AbstractEvent, Section, TurnEnd
from .leaves import components
from .overrides import with_static


class Counter(abc.ABC):
    """The counter of a machine's cycles, its class attribute `cycle`. The `cycle` of an instance is
    the usual length of a cycle."""

    end: ClassVar = Section()
    """The event that ends a cycle."""

    def __init__(self, name: Any, usual: Any):
        self.name, self.usual = name, usual

    def __get__(self, machine: Any, owner: type) -> Any:
        return self if machine is None else self.length(machine)

    def length(self, machine: Any) -> Any:
        """Return the usual length of a cycle, from which the lengths of steps follow."""
        if self.usual is not None:
            if not callable(self.usual):
                return self.usual
            whose = f"`usual` in the `cycle` of a {type(machine).__name__}"
            return returned(self.usual(machine), whose, "about how long a cycle takes")
        raise ValueError(
            f"Argument `usual` must be given with the `cycle` of a {type(machine).__name__}: about "
            "how long a cycle takes."
        )

    @abc.abstractmethod
    def section(self, machine: Any, state: State) -> Any:
        """Return the function that rises through zero at the end of a cycle."""

    def value(self, machine: Any, state: State) -> Any:
        """Return the component of the state, or the value of the function, that ends cycles.
        **Raises:** `TypeError` if it cannot be computed."""
        whose = f"`cycle` of a {type(machine).__name__}"
        if not callable(self.name) and not has_component(self.name, state):
            raise TypeError(
                f"{whose} must name one of the components {', '.join(components(state))}, but "
                f"names {self.name!r}."
            )
        try:
            if not callable(self.name):
                return component(self.name, state)
            return returned(self.name(machine, state), f"The function in {whose}", "a number")
        except (AttributeError, LookupError) as error:
            raise TypeError(f"{whose} must be computable, but: {error}") from error

    def with_earlier_angle(self, state: State) -> State:
        """Return the state at the beginning of the next cycle."""
        return state


class Turn(Counter):
    """Cycles that are full turns of an angle."""

    end: ClassVar = TurnEnd()

    def __init__(self, name: str, start: Any = 0.0, usual: Any = None):
        super().__init__(name, usual)
        self.start = start

    def length(self, machine: Any) -> Any:
        """Return `usual`, or by default the duration of a turn at the speed of `start`."""
        if self.usual is not None:
            return super().length(machine)
        start = returned(machine.start(), f"`start` of a {type(machine).__name__}", "a state")
        self.value(machine, start)
        speed = self.speed(start)
        known = None if speed is None else concrete(speed)
        if speed is None or (known is not None and not known.all()):
            raise ValueError(
                f"Argument `usual` must be given to `turn_of({self.name!r})` of a "
                f"{type(machine).__name__}, about how long a turn takes, because its `start` does "
                "not turn."
            )
        return 2 * pi / abs(speed)  # plain numbers stay plain: nothing to compile

    def speed(self, state: State) -> Any:
        """Return the speed of the angle, or `None` if the state does not contain it."""
        name = f"v.{self.name}"
        return component(name, state) if has_component(name, state) else None

    def longest_step(self, machine: Any, state: State) -> Any:
        """Return a fifth of the usual turn, less if the angle turns faster."""
        speed, usual = self.speed(state), self.length(machine)
        if speed is None:
            return usual / 5
        return 0.2 * usual / jnp.maximum(1.0, usual * jnp.abs(speed) / (2 * pi))

    def section(self, machine: Any, state: State) -> Any:
        return self.value(machine, state) - (self.start + 2 * pi)

    def with_earlier_angle(self, state: State) -> State:
        return with_component(self.name, state, component(self.name, state) - 2 * pi)


class Passing(Counter):
    """Cycles that end where a component, or a function of the state, passes through zero."""

    def __init__(self, name: Any, sign: float, usual: Any = None):
        super().__init__(name, usual)
        self.sign = sign

    def section(self, machine: Any, state: State) -> Any:
        value = self.value(machine, state)
        return value if self.sign > 0 else -value


def turn_of(name: str, *, start: Any = 0.0, usual: Any = None) -> Any:
    """Count the cycles of a machine by the turns of an angle: `cycle = vi.turn_of("phi")`.

    At a full turn of the angle beyond `start`, a cycle ends and 2π is subtracted from the angle.
    The machine may start from rest in time; its orbits, branches and exponents are those of its
    turns. Along a branch impacts may pass the begin of a turn if the machine is the same a turn
    later. An angle that turns backward ends no cycle.

    **Arguments:** `name`, the angle in the state, in a `Mechanical` a coordinate; `start`, the
    angle (radians) at which a cycle begins; `usual`, the approximate duration of a turn, by default
    that at the speed of the machine's own `start`.
    """
    return Turn(name, start, usual)


def rising(name: str | Callable[..., Any], *, usual: Any) -> Any:
    """End the cycles of a machine where a component of its state rises through zero: `cycle =
    vi.rising("v", usual=6.3)`.

    **Arguments:** `name`, the component, or a function: `lambda m, z: z.x - m.level`; `usual`, the
    approximate length of a cycle, for the lengths of steps: a number, or a function of the machine.
    """
    return Passing(name, 1.0, usual)


def falling(name: str | Callable[..., Any], *, usual: Any) -> Any:
    """End the cycles of a machine where a component falls through zero (see `rising`)."""
    return Passing(name, -1.0, usual)


def counter_of(machine: Any) -> Counter | None:
    """Return the counter of a machine's cycles, or `None` without a counter."""
    found = getattr(type(machine), "cycle", None)
    return found if isinstance(found, Counter) else None


def counts_turns(machine: Any) -> bool:
    """Return whether the cycles of a machine are counted by `turn_of`."""
    return isinstance(counter_of(machine), Turn)


def at_intervals(machine: Any, interval: Any, renews: bool) -> Any:
    """Return the same machine with cycles of equal length, which no event ends; `renews`, whether
    it defines `renewed`."""
    kind = type(machine)
    observed = {"observed_usual": machine.cycle, "observed_interval": interval}
    return _as_kind(_observed_kind(kind, renews), kind, machine, interval, **observed)


def _as_kind(new_kind: type, kind: type, machine: Any, cycle: Any, **others: Any) -> Any:
    """Return a machine as another class, with the fields of `kind`; `cycle` replaces that field."""
    values = {name: getattr(machine, name) for name in _fields(kind)} | others
    if "cycle" in values:
        values["cycle"] = cycle
    return with_static(object.__new__(new_kind), **values)


def _fields(kind: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(kind)]


@functools.lru_cache(maxsize=64)
def _observed_kind(kind: type, renews: bool) -> type:
    def original(self: Any) -> Any:
        return _as_kind(kind, kind, self, self.observed_usual)

    def step_limit(self: Any, s: Scalar, state: State) -> Any:
        return jnp.minimum(original(self).step_limit(s, state), self.observed_interval / 5)

    def parts(name: str) -> property:
        return property(lambda self: tuple(map(_without_cycle_end, getattr(original(self), name))))

    body: dict[str, Any] = {
        "__module__": kind.__module__,
        "__qualname__": kind.__qualname__,
        "__annotations__": {"observed_interval": Any, "observed_usual": Any},
        "observed_interval": eqx.field(default=None, kw_only=True),
        "observed_usual": eqx.field(default=None, kw_only=True),
        "step_limit": step_limit,
        "observed_machine": property(original),
        "observed_every": lambda self, interval: original(self).observed_every(interval),
        **{name: parts(name) for name in ("_stops", "_switches", "_others")},
    }
    counter: Any = getattr(kind, "cycle", None)
    if isinstance(counter, Turn) and not renews:
        body["renewed"] = wrap_angles(counter.name)
    if "cycle" not in _fields(kind):
        body["cycle"] = property(lambda self: self.observed_interval)
    return type(kind)(kind.__name__, (kind,), body)


def _without_cycle_end(event: AbstractEvent) -> AbstractEvent:
    return with_static(event, ends_cycle=False) if event.ends_cycle else event
