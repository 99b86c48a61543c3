"""Rows of the report: the numbers of a measurement fill the words of a claim or a fault."""

import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

CONFIRMED, UNDAMPED_ONLY, CONTRADICTED = "confirmed", "confirmed undamped only", "contradicted"
PARTLY = "confirmed in part"
WORDS = tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))
"""The words of the report, which are templates for `str.format`."""


Row = SimpleNamespace
"""A row of the report: the columns of its kind and its `numbers`; that of a claim has a `verdict`,
that of a fault a `number`."""

_COLUMNS = {
    "claims": ("name", "place", "claimed", "measured"),
    "faults": ("place", "printed", "right", "measured"),
}


def _rows_of(kind: str) -> Callable[[Callable], Callable[..., Row]]:
    """Return the decorator that makes a row of this kind of a measurement. That returns further
    values for the words, the verdict on a claim, and numbers."""

    def decorated(measure: Callable) -> Callable[..., Row]:
        def check(*found: Any, **first: Any) -> Row:
            further, *judged, numbers = measure(*found)
            words = WORDS[kind][measure.__name__.removeprefix("_")]
            filled = [x.format(**numbers, **further) for x in words]
            columns = dict(zip((*_COLUMNS[kind], "verdict"), [*filled, *judged], strict=False))
            return Row(**first, **columns, numbers=numbers)

        return check

    return decorated


claim, fault = _rows_of("claims"), _rows_of("faults")


def verdict(holds: bool, entirely: bool = True, otherwise: str = UNDAMPED_ONLY) -> str:
    """Return the verdict on a claim that holds at least in part; `otherwise` if not entirely."""
    return CONTRADICTED if not holds else CONFIRMED if entirely else otherwise


def listed(pattern: str, items: Iterable[Any], between: str = "; ") -> str:
    """Return items, each a tuple for the pattern or a single value, in one line."""
    return between.join(pattern.format(*(x if isinstance(x, tuple) else (x,))) for x in items)
