"""Defaults of machines and their parts, and the members with which a user replaces them."""

import copy
import dataclasses
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, TypeVar

from .._types import Machine, Scalar, State

Method = TypeVar("Method", bound=Callable[..., Any])


def by_default(method: Method) -> Method:
    """Mark a method as a default, which subclasses may replace."""
    method.by_default = True  # pyright: ignore[reportFunctionMemberAccess]
    return method


def is_own(method: object) -> bool:
    """Return whether a method or property of a class is not a default (`by_default`)."""
    return not hasattr(getattr(method, "fget", method), "by_default")


def changed(part: object, base: type, names: Iterable[str]) -> str | None:
    """Return the first of these members that the class of `part` overrides, or `None`."""
    kind = type(part)
    return next((x for x in names if getattr(kind, x, None) is not getattr(base, x, None)), None)


def with_own_defaults(kind: type) -> None:
    """Let a class replace fields of its parent without a type, which a dataclass ignores: a plain
    value becomes the field's default, and a property replaces the field."""
    fields = getattr(kind, "__dataclass_fields__", {})
    types = dict(inspect.get_annotations(kind))
    for name in [x for x in vars(kind) if x in fields and x not in types]:
        value, field = vars(kind)[name], copy.copy(fields[name])
        if isinstance(value, property):
            types[name] = ClassVar[Any]
        elif not hasattr(value, "__get__"):
            field.default, field.default_factory = value, dataclasses.MISSING
            setattr(kind, name, field)
            types[name] = field.type
    kind.__annotations__ = types


class derived:
    """A property that a field of the same name in a subclass replaces, also one without a default.
    The class does not have the attribute; instances do."""

    by_default = True

    def __init__(self, function: Callable[[Any], Any]):
        self.function, self.__doc__ = function, function.__doc__

    def __get__(self, part: Any, owner: type) -> Any:
        if part is None:
            raise AttributeError(f"A {owner.__name__} has this attribute, but its class does not.")
        return self.function(part)


def defines(part: object, name: str) -> bool:
    """Return whether a machine itself defines a member that is otherwise `derived`."""
    return hasattr(type(part), name) or name in vars(part)


def with_static(part: Any, **values: Any) -> Any:
    """Return a copy of a part or a state with other values of fields, without its `__init__`."""
    new = copy.copy(part)
    for name, value in values.items():
        object.__setattr__(new, name, value)
    return new


def declared_modes(machine: Any) -> Mapping[str, Any]:
    """Return the initial discrete modes, by name, that the machine's class defines."""
    modes = machine.modes
    return modes if isinstance(modes, Mapping) else {}  # for a beam `modes` is a number of modes


def has_own_modes(machine: Any) -> bool:
    """Return whether a machine defines discrete modes."""
    return bool(declared_modes(machine)) or callable(machine.modes)


def stops_of(machine: Machine) -> tuple[Any, ...]:
    """Return the rigid stops of a machine, in the order in which logs number them."""
    return machine._stops


def switches_of(machine: Machine) -> tuple[Any, ...]:
    """Return the parts of a machine that have a mode: soft stops, frictions, switches."""
    return machine._switches


def others_of(machine: Machine) -> tuple[Any, ...]:
    """Return the events of a machine that are not switches."""
    return machine._others


def clock_of(machine: Machine, state: State) -> Scalar | None:
    """Return the component of the state that counts cycles; `None` if `s` does."""
    return machine._clock(state)


def with_earlier_clock(machine: Machine, state: State) -> State:
    """Return the state with its clock, or the angle of `turn_of`, set back by one cycle."""
    return machine._with_earlier_clock(state)


def section_in(machine: Machine, state: State) -> Scalar | None:
    """Return the function that rises through zero at the end of a cycle (see `rising` and
    `turn_of`); `None` if `s`, a clock or an event ends cycles."""
    return machine._section(state)


def outcomes_of(machine: Machine) -> tuple[str, ...]:
    """Return the names of the outcomes with which events and stops of a machine end a motion."""
    events = (*switches_of(machine), *others_of(machine), *stops_of(machine))
    return tuple(dict.fromkeys(x.ends for x in events if x.ends))
