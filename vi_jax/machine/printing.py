"""Numbers, states and results as text."""

import dataclasses
import inspect
from collections import OrderedDict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

from .._checks import on_host
from .._types import State
from .leaves import by_name, components, first_few, near_names
from .units import NONE, in_unit, unit_of, with_unit


def state_in_words(state: State, digits: int, units: Mapping[str, str]) -> str:
    """Return the numbers of a state with their units, as text; of a long state the first few, of
    an array with several axes, such as the history of a `delay_chain`, their range."""
    # JAX sorts the names of a dictionary, but not those of an `OrderedDict`.
    leaves = by_name(OrderedDict(state) if isinstance(state, Mapping) else state)
    parts = components(OrderedDict((k, x) for k, x in leaves.items() if np.ndim(x) < 2)).items()
    size = max((abs(float(x)) for _, x in parts), default=0.0)
    words = [f"{k} = {in_unit(plain(x, digits, size), units, k)}" for k, x in parts]
    words += [f"{k} = {number_in_words(x)}" for k, x in leaves.items() if np.ndim(x) > 1]
    return ", ".join(first_few(words))


# A number is shown as 0 below this share of the largest beside it: a choice.
_NOTHING = 1e-28


def plain(x: Any, digits: int, size: float = 0.0) -> str:
    """Return a number as text; zero has no sign. It is zero if it is rounding of rounding of
    numbers of this size."""
    x = float(x)
    return f"{0.0 if abs(x) < _NOTHING * size else x + 0.0:.{digits}g}"


# The longest text in one line, and the longest array that is printed in full.
_WIDTH, _LISTED = 88, 6


class Shown(eqx.Module):
    """A module whose representation has its numbers, with their units if it has `units`."""

    def __new__(cls, *args: Any, **kwargs: Any):
        fields = {field.name for field in dataclasses.fields(cls) if field.init}
        wrong = next((name for name in kwargs if name not in fields), None)
        if wrong is not None and isinstance(getattr(cls, wrong, None), int | float):
            raise TypeError(
                f"`{cls.__name__}` has no argument `{wrong}`: a number is declared with its "
                f"type in the class, `{wrong}: float = {getattr(cls, wrong)!r}`."
            )
        # A class may write `__init__`, with other arguments than its fields.
        taken = inspect.signature(cls.__init__).parameters if wrong else {}
        if wrong and wrong not in taken and all(x.kind != x.VAR_KEYWORD for x in taken.values()):
            names = [name for name in taken if name != "self"]
            known = near_names(wrong, names) if names else "it takes none"
            raise TypeError(f"`{cls.__name__}` has no argument `{wrong}`; {known}.")
        return super().__new__(cls)

    def __repr__(self) -> str:
        return in_words(self, getattr(self, "units", NONE)) if known(self) else super().__repr__()


class Summarized(eqx.Module):
    """A result whose representation is a summary."""

    def summary(self) -> str:
        """Return a summary: a line of text, then indented lines "name: value"."""
        raise NotImplementedError

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:  # of missing names
            kind = type(self)
            if name.startswith("_") or hasattr(kind, name):
                return object.__getattribute__(self, name)  # its own error
            names = [*vars(self), *(x for x in dir(kind) if x[0] != "_" and x not in vars(self))]
            raise AttributeError(
                f"`{kind.__name__}` has no attribute `{name}`; {near_names(name, names)}."
            )

    def __repr__(self) -> str:
        return on_host(self).summary() if known(self) else super().__repr__()


def known(tree: object) -> bool:
    """Return whether all numbers in a tree are known: not traced, placeholders, or deleted."""
    return all(_is_shown(x) for x in jtu.tree_leaves(tree))


def _is_shown(x: object) -> bool:
    # JAX's own placeholder is a bare object; a solver's leaves may be functions and strings.
    if isinstance(x, Tracer | jax.ShapeDtypeStruct) or type(x) is object:
        return False
    return not (isinstance(x, jax.Array) and x.is_deleted())


def in_words(x: object, units: Mapping[str, str] = NONE, name: str = "", indent: int = 0) -> str:
    """Return a module, a state or a number as text, as in Python, with units."""
    if eqx.is_array_like(x) and not isinstance(x, bool):
        return number_in_words(x, unit_of(units, name) if name else "")
    opened, parts, closed = _parts(x)
    parts = [
        (f"{key}=" if key else "") + in_words(part, units, key or name, indent + 2)
        for key, part in parts
    ]
    text = opened + ", ".join(parts) + closed
    if "\n" not in text and indent + len(text) <= _WIDTH:
        return text
    margin, end = "\n" + " " * (indent + 2), "\n" + " " * indent
    return opened + "".join(f"{margin}{part}," for part in parts) + end + closed.lstrip(",")


def _parts(x: object) -> tuple[str, list[tuple[str, Any]], str]:
    """Return the beginning of an object's text, its parts by name, and the end of the text."""
    name = f"{type(x).__name__}("
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        values = [(f.name, getattr(x, f.name, None)) for f in dataclasses.fields(x) if f.repr]
        left_out = (type(None), tuple, str)  # absent or empty
        shown = [(k, part) for k, part in values if not isinstance(part, left_out) or part]
        return name, shown, ")"
    if isinstance(x, tuple) and hasattr(x, "_fields"):
        return name, list(zip(x._fields, x, strict=True)), ")"  # pyright: ignore
    if name == "State(":
        return name, list(vars(x).items()), ")"
    if isinstance(x, Mapping):
        return "{", [(str(key), part) for key, part in x.items()], "}"
    if isinstance(x, tuple | list):
        left, right = "[]" if isinstance(x, list) else "()"
        return left, [("", part) for part in x], "," * (right == ")" and len(x) == 1) + right
    return getattr(x, "__qualname__", None) or repr(x), [], ""


def number_in_words(x: object, unit: str = "") -> str:
    """Return a number with its unit; of a large array the range and the shape."""
    x = np.asarray(x)
    if not x.ndim:
        return with_unit(f"{x + 0.0:.9g}" if x.dtype.kind == "f" else str(x), unit)
    if x.ndim == 1 and x.size <= _LISTED:
        return with_unit(f"[{', '.join(map(number_in_words, x))}]", unit)
    shape = " × ".join(map(str, x.shape))
    if not x.size or x.dtype.kind not in "fiu" or np.isnan(x).all():
        return f"{x.dtype} ({shape})"
    low, high = (number_in_words(f(x)) for f in (np.nanmin, np.nanmax))
    return f"{with_unit(f'{low} … {high}', unit)} ({shape})"
