"""Rows of the report: the numbers of a measurement fill the words of a claim or a fault."""

import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

CONFIRMED, UNDAMPED_ONLY, CONTRADICTED = "confirmed", "confirmed undamped only", "contradicted"
PARTLY = "confirmed in part"
WORDS = tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))
"""The words of the report, which are templates for `str.format`."""


class Claim(NamedTuple):
    """One claim or assumption of the paper, and its place there."""

    name: str
    place: str
    claimed: str
    measured: str
    verdict: str
    numbers: dict[str, Any]


class Fault(NamedTuple):
    """One fault of the printed text, and its place there."""

    number: int
    place: str
    printed: str
    right: str
    measured: str
    numbers: dict[str, Any]


def _filled(group: str, measure: Callable, further: dict, numbers: dict) -> list[str]:
    row = WORDS[group][measure.__name__.removeprefix("_")]
    return [words.format(**numbers, **further) for words in row]


def claim(measure: Callable) -> Callable[..., Claim]:
    """Make a row of a measurement that returns further values for the words, verdict, numbers."""

    def check(*found: Any) -> Claim:
        further, verdict, numbers = measure(*found)
        return Claim._make([*_filled("claims", measure, further, numbers), verdict, numbers])

    return check


def fault(measure: Callable) -> Callable[[int], Fault]:
    """Make a numbered row of a measurement that returns further values for the words, numbers."""

    def check(number: int) -> Fault:
        further, numbers = measure()
        return Fault._make([number, *_filled("faults", measure, further, numbers), numbers])

    return check


def verdict(holds: bool, entirely: bool = True, otherwise: str = UNDAMPED_ONLY) -> str:
    """Return the verdict on a claim that holds at least in part; `otherwise` if not entirely."""
    return CONTRADICTED if not holds else CONFIRMED if entirely else otherwise


def listed(pattern: str, items: Iterable[Any], between: str = "; ") -> str:
    """Return items, each a tuple for the pattern or a single value, in one line."""
    return between.join(pattern.format(*(x if isinstance(x, tuple) else (x,))) for x in items)
