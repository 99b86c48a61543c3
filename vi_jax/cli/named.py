"""Machines and other objects by name, from a file, a command or a page.

Three kinds of values are special. `{ from, to, count }` is a row of evenly spaced numbers. A table
with the key `class` is an object made from its other keys. Dotted keys are names, such as
`stops.0.gap = [1.0, 2.0]`. All others are unchanged.
"""

import difflib
import importlib
import inspect
import re
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..machine import AbstractMachine


class InputError(ValueError):
    """An error in a file, a name or its arguments, described in one sentence."""


def check_keys(given: Iterable[str], known: Iterable[str], place: str) -> None:
    """Raise `InputError` with similar names for a key that does not exist."""
    known = list(known)
    for key in given:
        if key not in known:
            similar = difflib.get_close_matches(key, known, n=3, cutoff=0.5)
            hint = f"near names: {', '.join(similar)}" if similar else f"known: {', '.join(known)}"
            raise InputError(f"unknown key `{key}` in {place}; {hint}")


def machine_of(name: object, keywords: Mapping[str, Any]) -> AbstractMachine:
    """Return the machine from a class or a function. **Raises:** `InputError`."""
    machine = make_object(name, keywords, "[arguments]")
    if not isinstance(machine, AbstractMachine):
        raise InputError(f"{name} must make a machine, but made {machine!r}")
    return machine


def make_object(name: object, keywords: Mapping[str, Any], place: str) -> Any:
    """Return the result of calling a class or a function with keywords. **Raises:** `InputError`.

    **Arguments:** `name`, `package.module:name` or `path/to/file.py:name`. A method of a class, as
    in `vi_jax:Parameters.scene`, receives its own keywords, and the class all others. `keywords`
    are as in the file, and `place` is their place in it.
    """
    module, _, path = str(name).rpartition(":")
    if not module or not path:
        raise InputError(f"a machine or a class is module:name or path/to/file.py:name, not {name}")
    *outer, last = path.split(".")
    before, folder = [*sys.path], str(Path(module).resolve().parent)
    sys.path[:0] = ["", folder] if module.endswith(".py") else [""]
    try:
        owner = _imported(module)
        for attribute in outer:
            owner = getattr(owner, attribute)
        make = getattr(owner, last)
        parameters = inspect.signature(make).parameters
        if inspect.isclass(owner) and inspect.isfunction(make):
            class_keywords = {key: x for key, x in keywords.items() if key not in parameters}
            make = getattr(make_object(f"{module}:{'.'.join(outer)}", class_keywords, place), last)
            keywords = {key: x for key, x in keywords.items() if key in parameters}
        check_keys(keywords, parameters, place)
        return make(**{key: _converted(parameters[key], value_of(x, place))
                       for key, x in keywords.items()})  # fmt: skip
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        if str(error).startswith("Argument `"):
            raise InputError(f"{place}: {error}") from None
        raise InputError(f"{name} raised {type(error).__name__}: {error}{_line(error)}") from error
    finally:
        sys.path[:] = before


def _imported(module: str) -> Any:
    if not module.endswith(".py"):
        return importlib.import_module(module)
    found = importlib.import_module(Path(module).stem)
    if Path(str(found.__file__)) != Path(module).resolve():
        raise ImportError(f"the file needs another name than that of {found.__file__}")
    return found


def _converted(parameter: inspect.Parameter, value: Any) -> Any:
    """Return an integer as a float if the class declares one: it would be compile-time."""
    words = f"{parameter.annotation} {type(parameter.default).__name__}"
    wants_float = re.search(r"[Ff]loat|Array", words) and not re.search(r"\bint\b", words)
    return float(value) if wants_float and type(value) is int else value


def _line(error: BaseException) -> str:
    """Return the last line of user code in the traceback of an error, as text."""
    libraries = (str(Path(__file__).parents[1]), "site-packages", "<frozen")
    for line in reversed(traceback.extract_tb(error.__traceback__)):
        if not any(library in line.filename for library in libraries):
            return f" ({line.filename}, line {line.lineno})"
    return ""


def value_of(value: Any, place: str) -> Any:
    """Return a value of a file as the library needs it (see above). **Raises:** `InputError`."""
    if isinstance(value, list):
        return tuple(value_of(x, place) for x in value)
    if not isinstance(value, dict):
        return value
    if "class" in value:
        keywords = {key: x for key, x in value.items() if key != "class"}
        return make_object(value["class"], keywords, place)
    if "from" in value:
        if value.keys() != {"from", "to", "count"}:
            raise InputError(f"{place}: a row of numbers has `from`, `to` and `count`: {value}")
        try:
            return np.linspace(value["from"], value["to"], value["count"]).tolist()
        except (TypeError, ValueError, MemoryError) as error:
            raise InputError(f"{place}: {value} is no row of numbers: {error}") from None
    return {name: value_of(x, f"{place}: {name}") for name, x in _flat(value)}


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield items by their dotted names, in quotes or not."""
    for key, value in table.items():
        if isinstance(value, dict) and not value.keys() & {"class", "from"}:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
