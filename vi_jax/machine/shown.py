"""How machines, states and results are shown: numbers with their units, as text and as a table."""

import dataclasses
import html
from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

from .numbers import by_name
from .units import NONE, unit_of, with_unit

# Longer texts go over several lines; of longer arrays only the range is shown.
_WIDTH, _LISTED = 88, 6


class Shown(eqx.Module):
    """A module that shows its numbers, in the units that its `units` state, if it has any."""

    def __new__(cls, *args: Any, **kwargs: Any):
        fields = {field.name for field in dataclasses.fields(cls)}
        for name in kwargs:
            if name not in fields and isinstance(getattr(cls, name, None), int | float):
                raise TypeError(
                    f"`{cls.__name__}` has no argument `{name}`: a number is declared with its "
                    f"type in the class, `{name}: float = {getattr(cls, name)!r}`."
                )
        return super().__new__(cls)

    def __repr__(self) -> str:
        return in_words(self, getattr(self, "units", NONE)) if known(self) else super().__repr__()

    def _repr_html_(self) -> str:
        if not known(self):
            return f"<pre>{html.escape(repr(self))}</pre>"
        units = getattr(self, "units", NONE)
        rows = [
            (name, number_in_words(x), unit_of(units, name)) for name, x in by_name(self).items()
        ]
        return table(type(self).__name__, rows)


class Summarized(eqx.Module):
    """A result that says what it holds."""

    def summary(self) -> str:
        """In words: a line, and further ones "name: value" that are indented."""
        raise NotImplementedError

    def drawn(self) -> Any:
        """A row of numbers to draw beside it, or `None`."""
        return None

    def __repr__(self) -> str:
        return self.summary() if known(self) else super().__repr__()

    def _repr_html_(self) -> str:
        return summary_table(repr(self), self.drawn() if known(self) else None)


def known(tree: object) -> bool:
    """Whether all numbers in a tree are there: none is traced, a placeholder, or given away."""
    return all(_is_shown(x) for x in jtu.tree_leaves(tree))


def _is_shown(x: object) -> bool:
    # JAX's own placeholder is a bare object; a solver's leaves may be functions and words.
    if isinstance(x, Tracer | jax.ShapeDtypeStruct) or type(x) is object:
        return False
    return not (isinstance(x, jax.Array) and x.is_deleted())


def in_words(x: object, units: Mapping[str, str] = NONE, name: str = "", indent: int = 0) -> str:
    """A module, a state or a number, as it would be written, each number with its unit."""
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
    """How the text of something begins, what is in it, by name, and how the text ends."""
    name = f"{type(x).__name__}("
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        values = [(f.name, getattr(x, f.name, None)) for f in dataclasses.fields(x) if f.repr]
        left_out = (type(None), tuple, str)  # what is not there, and what is empty
        there = [(k, part) for k, part in values if not isinstance(part, left_out) or part]
        return name, there, ")"
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
    """A number with its unit; of several, if they are many, their range and their shape."""
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


def table(title: str, rows: Iterable[tuple[str, ...]], after: str = "") -> str:
    """Cells in HTML under a title."""
    cells = "".join(
        f"<tr>{''.join(f'<td style=text-align:left>{html.escape(x)}</td>' for x in row)}</tr>"
        for row in rows
    )
    caption = f"<caption style=text-align:left>{html.escape(title)}</caption>"
    return f"<table>{caption}{cells}</table>{after}"


def summary_table(text: str, row: object = None) -> str:
    """A result in words as a table: its lines "name: value", the first one above."""
    first, *lines = text.splitlines()
    after = "" if row is None else sparkline(row)
    rows = (line.strip().rpartition(": ") if ": " not in line else line.strip().partition(": ")
            for line in lines)  # fmt: skip
    return table(first, (row[::2] for row in rows), after)


def sparkline(row: object, width: int = 240, height: int = 40) -> str:
    """A row of numbers as a small curve; nothing where fewer than two of them are finite."""
    y = np.asarray(row, float).ravel()
    good = np.isfinite(y)
    if good.sum() < 2:
        return ""
    low, span = y[good].min(), np.ptp(y[good]) or 1.0
    across = 2 + (width - 4) * np.arange(y.size) / (y.size - 1)
    up = height - 2 - (height - 4) * (y - low) / span
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across[good], up[good], strict=True))
    line = f'<polyline points="{points}" fill="none" stroke="currentColor"/>'
    return f'<svg width="{width}" height="{height}">{line}</svg>'
