"""What tells one function (or class of a user's own) from another: its code and what it uses."""

import functools
import hashlib
import sys
import types
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

# Code that does not change while a study goes on, and is known by its name.
_LIBRARIES = {
    "vi_jax", "jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "optax", "optimistix",
    "lineax", "jaxtyping", "beartype", "xarray", "matplotlib", *sys.stdlib_module_names,
}  # fmt: skip

# What a class holds besides what its author wrote.
_MADE = (types.GetSetDescriptorType, types.MemberDescriptorType, types.WrapperDescriptorType)

_PLAIN = (int, float, complex, str, bytes, type(None), type(...), np.dtype)


class Unverifiable(Exception):
    """Something whose code or content cannot be looked at."""


def identity(thing: object) -> str:
    """A digest of a function, or of an object: its code, and all that it refers to.

    Code is what Python runs, so that comments and line breaks may change. A function refers to its
    defaults, the variables that it closes over and the globals that it names; functions and classes
    among them are looked at in the same way. Code of libraries is known by its name.

    **Raises:** `Unverifiable` with what cannot be looked at.
    """
    digest = hashlib.sha256()
    try:
        for word in _words(thing, {}):
            digest.update(word.encode("utf-8", "backslashreplace") + b"\0")
    except RecursionError:
        raise Unverifiable(f"{thing!r}, which refers to too much") from None
    return digest.hexdigest()[:16]


def _words(thing: object, seen: dict[int, Any]) -> Iterator[str]:
    """The words that `thing` is made of. `seen` holds what was begun: things refer in rings."""
    yield type(thing).__qualname__
    if isinstance(thing, _PLAIN):
        yield repr(thing)
    elif isinstance(thing, np.ndarray | np.generic | jax.Array):
        array = np.asarray(thing)
        yield f"{array.dtype} {array.shape} {array.tolist() if array.dtype.hasobject else ''}"
        yield hashlib.sha256(array.tobytes()).hexdigest()
    elif isinstance(thing, types.ModuleType):
        yield thing.__name__
    elif isinstance(thing, types.CodeType):
        yield from _code(thing, seen)
    elif isinstance(thing, tuple):
        yield from _all(thing, seen)
    elif isinstance(thing, set | frozenset):
        yield from sorted(identity(x) for x in thing)
    elif id(thing) in seen:
        yield str(list(seen).index(id(thing)))
    else:
        seen[id(thing)] = thing
        yield from _referring(thing, seen)


def _all(things: Iterable[Any], seen: dict[int, Any]) -> Iterator[str]:
    for thing in things:
        yield from _words(thing, seen)
    yield "end"


def _referring(thing: Any, seen: dict[int, Any]) -> Iterator[str]:
    """What can be part of a ring."""
    if isinstance(thing, types.FunctionType):
        yield from _function(thing, seen)
    elif isinstance(thing, type):
        yield from _class(thing, seen)
    elif isinstance(thing, list):
        yield from _all(thing, seen)
    elif isinstance(thing, Mapping):
        yield from _all([x for pair in thing.items() for x in pair], seen)
    elif isinstance(thing, types.MethodType):
        yield from _all((thing.__func__, thing.__self__), seen)
    elif isinstance(thing, functools.partial):
        yield from _all((thing.func, thing.args, thing.keywords), seen)
    elif isinstance(thing, property):
        yield from _all((thing.fget, thing.fset), seen)
    elif isinstance(thing, staticmethod | classmethod):
        yield from _words(thing.__func__, seen)
    elif isinstance(thing, types.BuiltinFunctionType | np.ufunc):
        yield f"{getattr(thing, '__module__', '')} {thing.__name__}"
    elif getattr(thing, "__wrapped__", None) is not None:  # as `jax.jit` makes it
        yield from _words(thing.__wrapped__, seen)
    else:
        yield from _object(thing, seen)


def _library(module: str | None) -> bool:
    return (module or "").split(".")[0] in _LIBRARIES


def _function(function: types.FunctionType, seen: dict[int, Any]) -> Iterator[str]:
    code, here = function.__code__, function.__globals__
    wrapped = getattr(function, "__wrapped__", None)
    if wrapped is not None and code.co_filename.startswith("<"):
        yield from _words(wrapped, seen)  # a check that a type checker wrote around it
        return
    names = _names(code)
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        yield name
        yield from _words(cell.cell_contents, seen) if _full(cell) else ["empty"]
    if _library(here.get("__name__")):
        yield f"{here['__name__']} {code.co_qualname}"
        return
    yield from _code(code, seen)
    yield from _all((function.__defaults__, function.__kwdefaults__), seen)
    for name in sorted(names & set(here)):
        yield name
        yield from _global(here[name], names, seen)


def _full(cell: types.CellType) -> bool:
    try:
        return bool(cell.cell_contents) or True
    except ValueError:
        return False


def _global(thing: object, names: set[str], seen: dict[int, Any]) -> Iterator[str]:
    """What a function may use of a global: of a user's module, what it may name there."""
    yield from _words(thing, seen)
    if isinstance(thing, types.ModuleType) and not _library(thing.__name__):
        if id(thing) not in seen:
            seen[id(thing)] = thing
            for name in sorted(names & set(vars(thing))):
                yield name
                yield from _global(vars(thing)[name], names, seen)


def _names(code: types.CodeType) -> set[str]:
    """Globals and attributes that code names, those of its inner functions included."""
    inner = (x for x in code.co_consts if isinstance(x, types.CodeType))
    return set(code.co_names).union(*(_names(x) for x in inner))


def _code(code: types.CodeType, seen: dict[int, Any]) -> Iterator[str]:
    yield f"{sys.version_info[:2]} {code.co_code.hex()} {code.co_names} {code.co_varnames}"
    yield from _all(code.co_consts, seen)


def _class(kind: type, seen: dict[int, Any]) -> Iterator[str]:
    yield f"{kind.__module__} {kind.__qualname__}"
    if _library(kind.__module__):
        return
    yield from _all(kind.__bases__, seen)
    for name, value in sorted(vars(kind).items()):
        written = getattr(getattr(value, "__code__", None), "co_filename", "")
        if isinstance(value, _MADE) or written.startswith("<"):
            continue
        if hasattr(value, "__get__") or (isinstance(value, _PLAIN) and name[:2] != "__"):
            yield name
            yield from _words(value, seen)


def _object(thing: object, seen: dict[int, Any]) -> Iterator[str]:
    """An object by its class and its content."""
    fields = dict(getattr(thing, "__dict__", {}))
    for kind in type(thing).__mro__:
        slots = vars(kind).get("__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if hasattr(thing, name) and name not in ("__dict__", "__weakref__"):
                fields[name] = getattr(thing, name)
    if not fields and _hides(type(thing)):
        raise Unverifiable(repr(thing))
    yield from _class(type(thing), seen)
    for name in sorted(fields):
        yield name
        yield from _words(fields[name], seen)


def _hides(kind: type) -> bool:
    """Whether an object may hold what cannot be seen; a bare `object` holds nothing."""
    open_to_view = kind.__dictoffset__ or any("__slots__" in vars(k) for k in kind.__mro__)
    return kind is not object and not open_to_view
