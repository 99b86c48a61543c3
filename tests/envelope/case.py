"""A row of the envelope: a corner of parameter space beside an expectation."""

import sys
from collections.abc import Callable
from typing import NamedTuple

import vi_jax as vi

QUICK = "--quick" in sys.argv

EXACT = {"ExactFlight": vi.ExactFlight()}
STEPPED = {
    "FixedStep(10)": vi.FixedStep(),
    "Adaptive(1e-11)": vi.Adaptive(rtol=1e-11),
}
ALL = EXACT | STEPPED
Found = dict[str, float]
"""Deviation from the expectation, by method."""


class Case(NamedTuple):
    """A row of the envelope."""

    range: str
    expected: str
    promise: dict[str, float]
    """By method, the deviation that is promised."""
    beyond: str
    """What happens beyond, or there."""
    measure: Callable[[], Found]
    long: bool = False


MADE: list[Case] = []


def case(
    range: str, expected: str, promise: dict[str, float], beyond: str = "", long: bool = False
):
    """Make a row of a function that measures it."""

    def added(measure: Callable[[], Found]) -> Callable[[], Found]:
        MADE.append(Case(range, expected, promise, beyond, measure, long))
        return measure

    return added


def within(exact: float, fixed: float, adaptive: float) -> dict[str, float]:
    """What is promised of the three methods."""
    return dict(zip(ALL, (exact, fixed, adaptive), strict=True))
