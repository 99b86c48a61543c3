"""TOML files read strictly into classes: every fault is named with its place in the file."""

import difflib
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NewType, TypeVar, get_args, get_origin

import attrs
import cattrs
import numpy as np
from cattrs.gen import make_dict_structure_fn, override

# Whole numbers are of 32 bits, and a row is held as Python's numbers.
_MOST, _LONGEST = 2**31 - 1, 10**7

T = TypeVar("T")
Place = tuple[str | int, ...]
Tables = Mapping[str, Any]


class ConfigError(ValueError):
    """What is wrong with a file: one sentence for each fault, with its place in the file."""

    def __init__(self, *problems: str):
        super().__init__("\n".join(problems))
        self.problems = problems


Finite = NewType("Finite", float)


class Row(tuple[float, ...]):
    """Numbers in a row, written as a list or as `{ from = …, to = …, count = … }`."""

    __slots__ = ()


def read_toml(
    path: str | Path, kind: type[T], outdated: Callable[[Tables], Sequence[str]] | None = None
) -> T:
    """The file as an object of an attrs class; a trailing `_` of a field is not in its key.

    **Arguments:** the file; the class; what finds sentences about an outdated use in its tables,
    which is then refused with them alone.

    **Raises:** `ConfigError` that names every fault with its place.
    """
    try:
        tables = tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))  # some editors' mark
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"the file is not valid TOML: {error}") from None
    except RecursionError:
        raise ConfigError("the file is nested too deeply") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"the file cannot be read: {reason}") from None
    if outdated is not None and (old := outdated(tables)):
        raise ConfigError(*old)
    try:
        return _CONVERTER.structure(tables, kind)
    except RecursionError:
        raise ConfigError("the file is nested too deeply") from None
    except cattrs.BaseValidationError as error:
        raise ConfigError(*_problems(error, ())) from None


def keys_of(kind: type) -> list[str]:
    """Names of an attrs class' fields."""
    return [field.name for field in attrs.fields(kind)]


def unknown(what: str, name: str, place: str, known: Iterable[str]) -> str:
    """A sentence about a name that is none of those known, with the nearest of them."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    ending = name.split(".")[-1]
    near += [other for other in known if other.split(".")[-1] == ending and other not in near]
    hint = f"near names: {', '.join(near)}" if near else f"known: {', '.join(known)}"
    return f"unknown {what} `{name}` in {place}; {hint}"


def given(table: object, *but: str) -> dict[str, Any]:
    """What the keys of a table were set to, without those keys."""
    pairs = ((name, getattr(table, name)) for name in keys_of(type(table)) if name not in but)
    return {name: value for name, value in pairs if value is not None}


@contextmanager
def in_terms_of(
    table: str, *, keys: Iterable[str] | None = None, named: Mapping[str, str] | None = None
) -> Iterator[None]:
    """Errors of the library about its arguments, in the words of the file.

    **Arguments:** the table; `keys`, the arguments that stand in it (all by default); `named`,
    where arguments stand that are called otherwise in the file.
    """
    try:
        yield
    except (ValueError, TypeError) as error:
        text = str(error).rstrip(".")
        match = re.match(r"Argument `(\w+)`", text)
        if match is None:
            own = text.startswith(("Axis ", "Method ", "Measure "))
            if not own or isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{table}: {text}") from None
        name, rest = match[1], text[match.end() :]
        elsewhere = {"axes": "[axes]", "start": "[start]", "method": "[method]", **(named or {})}
        if name in elsewhere and keys is not None:
            place = elsewhere[name]
        else:
            place = f"`{name}` in {table}" if keys is None or name in keys else f"{table}: `{name}`"
        raise ConfigError(f"{place}{rest}") from None


def _problems(error: BaseException, place: Place) -> Iterator[str]:
    if isinstance(error, cattrs.ForbiddenExtraKeysError):
        known = [name.rstrip("_") for name in keys_of(error.cl)]
        for key in sorted(error.extra_fields):
            where = _table(place) if place else "the file"
            yield unknown("key" if place else "table", key, where, known)
    elif isinstance(error, cattrs.BaseValidationError):
        for inner in error.exceptions:
            yield from _problems(inner, (*place, *_step(inner)))
    elif isinstance(error, KeyError):
        yield f"missing key `{place[-1]}` in {_table(place[:-1])}"
    else:
        yield f"{_in_words(place)} {error}"


def _step(error: BaseException) -> Place:
    """The key, or the place in a list, at which an error happened."""
    for note in getattr(error, "__notes__", ()):
        if isinstance(note, cattrs.AttributeValidationNote):
            return (note.name.rstrip("_"),)
        if isinstance(note, cattrs.IterableValidationNote):
            return (note.index,)
    return ()


def _table(place: Place) -> str:
    name = ".".join(x for x in place if isinstance(x, str))
    numbers = [x for x in place if isinstance(x, int)]
    return f"[[{name}]] number {numbers[-1] + 1}" if numbers else f"[{name}]"


def _in_words(place: Place) -> str:
    if len(place) < 2:
        return _table(place)
    last = place[-1]
    if isinstance(last, int):
        return f"item {last + 1} of {_in_words(place[:-1])}"
    return f"`{last}` in {_table(place[:-1])}"


def _number(value: object, _: object = None) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"must be a number, but is {_shown(value)}")
    try:
        return float(value)
    except OverflowError:
        raise ValueError("must be a number below 1.8e308, but is a longer one") from None


def _finite(value: object, _: object = None) -> float:
    number = _number(value)
    if not math.isfinite(number):
        raise ValueError(f"must be a finite number, but is {number}")
    return number


def _integer(value: object, _: object = None) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"must be a whole number, but is {_shown(value)}")
    if abs(value) > _MOST:
        raise ValueError(f"must be a whole number up to {_MOST}, but is {_cut(str(value))}")
    return value


def _flag(value: object, _: object = None) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"must be true or false, but is {_shown(value)}")
    return value


def _text(value: object, _: object = None) -> str:
    if not isinstance(value, str) or not value:
        raise TypeError(f"must be a text in quotes, but is {_shown(value)}")
    if "\0" in value:
        raise ValueError(f"must be a text without null characters, but is {value!r}")
    return value


def _row(value: object, _: object = None) -> Row:
    if isinstance(value, list) and value:
        return Row(_CONVERTER.structure(value, list[Finite]))
    if not isinstance(value, dict):
        raise TypeError(
            "must be a list of numbers or { from = …, to = …, count = … }, but is "
            f"{_shown(value)}"
        )
    if set(value) != {"from", "to", "count"}:
        raise ValueError(f"must have the keys from, to and count, but has {', '.join(value)}")
    count = _integer(value["count"])
    if not 1 <= count <= _LONGEST:
        raise ValueError(
            f"must have a count of at least 1 and at most {_LONGEST}, but it is {count}"
        )
    return Row(np.linspace(_finite(value["from"]), _finite(value["to"]), count).tolist())


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "a table"
    return _cut(f'"{value}"' if isinstance(value, str) else repr(value))


def _cut(text: str) -> str:
    """The text, cut where it is too long for a sentence."""
    return text if len(text) <= 60 else f"{text[:57]}..."


def _word(kind: Any) -> Callable[[Any, Any], str]:
    words = get_args(kind)

    def hook(value: Any, _: Any) -> str:
        if value in words:
            return value
        listed = ", ".join(f'"{word}"' for word in words)
        raise ValueError(f"must be one of {listed}, but is {_shown(value)}")

    return hook


def _list(kind: object) -> Callable[[Any, Any], tuple[Any, ...]]:
    item, *rest = get_args(kind)
    size = None if rest == [...] else 1 + len(rest)

    def hook(value: object, _: object) -> tuple[Any, ...]:
        if not isinstance(value, list) and size is None:
            value = [value]  # one of several, without brackets
        if not isinstance(value, list) or len(value) != (size or len(value)):
            raise TypeError(f"must be a list of {size}, but is {_shown(value)}")
        return tuple(_CONVERTER.structure(value, list[item]))

    return hook


def _mapping(kind: object) -> Callable[[Any, Any], dict[str, Any]]:
    item = get_args(kind)[1]

    def hook(value: object, _: object) -> dict[str, Any]:
        if not isinstance(value, dict):
            raise TypeError(f"must be a table, but is {_shown(value)}")
        return dict(_CONVERTER.structure(dict(_flat(value)), Mapping[str, item]))

    return hook


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Items by their dotted names, whether these were put in quotes or not."""
    for key, value in table.items():
        if isinstance(value, dict) and any(isinstance(x, dict | list) for x in value.values()):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _class(kind: Any) -> Callable[[Any, Any], Any]:
    names = {
        name: override(rename=name.rstrip("_")) for name in keys_of(kind) if name.endswith("_")
    }
    settings: dict[str, Any] = {"_cattrs_forbid_extra_keys": True, **names}
    structured = make_dict_structure_fn(kind, _CONVERTER, **settings)

    def hook(value: object, _: object) -> Any:
        if not isinstance(value, dict):
            raise TypeError(f"must be a table, but is {_shown(value)}")
        return structured(value, kind)

    return hook


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter()
    plain = {float: _number, Finite: _finite, int: _integer, bool: _flag, str: _text, Row: _row}
    for kind, hook in plain.items():
        converter.register_structure_hook(kind, hook)
    for of, factory in {Literal: _word, tuple: _list, dict: _mapping}.items():
        converter.register_structure_hook_factory(
            lambda kind, of=of: get_origin(kind) is of, factory
        )
    converter.register_structure_hook_factory(attrs.has, _class)
    return converter


_CONVERTER = _converter()
