"""Members of a class: what it replaces of its parent, and parameters that nothing in it reads."""

import copy
import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from types import CodeType, FunctionType
from typing import Any, ClassVar

from .._messages import warn


def overridden(part: object, base: type, *names: str) -> str | None:
    """Return the first of these members of `base` that the class of `part` overrides, or `None`."""
    kind = type(part)
    return next((x for x in names if getattr(kind, x, None) is not getattr(base, x, None)), None)


def is_builtin(kind: type) -> bool:
    """Return whether a class is one of this package."""
    return kind.__module__.partition(".")[0] == __name__.partition(".")[0]


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


# Members that a class body may hold as plain objects, which then keep the defaults of parameters.
_FIXED = ("contacts", "events", "cycle", "mass")


@functools.lru_cache(maxsize=256)
def warn_of_unread(kind: type, name: str) -> None:
    """Warn of a parameter of a user's class that no function in it reads, while the class body has
    plain contacts, a cycle or masses: those were made once, with its default."""
    name = name.partition(".")[0].partition("[")[0]
    base = next((x for x in kind.__mro__ if is_builtin(x)), None)
    if base is None or name in getattr(base, "__dataclass_fields__", {}):
        return
    own = kind.__mro__[: kind.__mro__.index(base)]
    members = [(key, x) for each in own for key, x in vars(each).items() if key[:2] != "__"]
    fields = getattr(kind, "__dataclass_fields__", {})
    fixed = [
        key for key, x in members if key in _FIXED and key not in fields and not _is_function(x)
    ]
    if name in fields and fixed and name not in set(_names_read([x for _, x in members])):
        warn(
            f"No method of a {kind.__name__} reads its parameter {name!r}, which may have no "
            f"effect: what the class body makes of it (as {', '.join(dict.fromkeys(fixed))}) keeps "
            "the default. Write a `@property`."
        )


def _is_function(member: Any) -> bool:
    return isinstance(member, property | FunctionType) or hasattr(member, "__wrapped__")


def _names_read(parts: list[Any]) -> Iterator[str]:
    """Yield names of attributes and variables, and texts, in the code of these objects, of those in
    them, and of functions that they call."""
    seen, waiting = set(), list(parts)
    while waiting:
        part = waiting.pop()
        if id(part) in seen or isinstance(part, type | str | float | int):
            continue
        seen.add(id(part))
        if isinstance(part, CodeType):
            yield from part.co_names
            yield from (x for x in part.co_consts if isinstance(x, str))
            waiting += [x for x in part.co_consts if isinstance(x, CodeType)]
        elif isinstance(part, FunctionType):
            called = [part.__globals__.get(x) for x in part.__code__.co_names]
            cells = [x.cell_contents for x in part.__closure__ or ()]
            waiting += [x for x in called if getattr(x, "__module__", "") == part.__module__]
            waiting += [part.__code__, *cells]
        elif isinstance(part, tuple | list):
            waiting += part
        elif isinstance(part, Mapping):
            waiting += part.values()
        inner = (getattr(part, x, None) for x in ("fget", "func", "__func__", "__wrapped__"))
        waiting += [x for x in inner if x is not None]
        waiting += getattr(part, "__dict__", {}).values() if not callable(part) else ()


class derived:
    """A property that a field of the same name in a subclass replaces, also one without a default.
    The class does not have the attribute; instances do."""

    def __init__(self, function: Callable[[Any], Any]):
        self.function, self.__doc__ = function, function.__doc__

    def __get__(self, part: Any, owner: type) -> Any:
        if part is None:
            raise AttributeError(f"A {owner.__name__} has this attribute, but its class does not.")
        return self.function(part)


def defines(part: object, name: str) -> bool:
    """Return whether a machine itself defines a member that is otherwise `derived`."""
    return hasattr(type(part), name) or name in vars(part)


class _Method:
    """A method of a machine, equal to any other of the same machine and name: its machine's arrays
    cannot be compared."""

    def __init__(self, method: Any):
        self._method = method
        self._key = method.__func__, id(method.__self__)

    def __call__(self, *arguments: Any) -> Any:
        return self._method(*arguments)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Method) and self._key == other._key


def hashable(on: Any) -> Any:
    """Return what a contact acts on, with a method of a machine in a form that can be hashed."""
    return _Method(on) if hasattr(on, "__func__") and hasattr(on, "__self__") else on


def with_static(part: Any, **values: Any) -> Any:
    """Return a copy of a part or a state with other values of fields, without its `__init__`."""
    new = copy.copy(part)
    for name, value in values.items():
        object.__setattr__(new, name, value)
    return new
