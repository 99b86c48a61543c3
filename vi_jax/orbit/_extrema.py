"""Where a number of the motion is largest or least along a branch."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from ._corrector import Step
from ._follow import Table
from ._quantities import rates_at

# A number that changes less than this along the branch (relative to 1 + its size, in the norm of
# the scaled unknowns) does not change but for rounding: a choice. Of a body that hits a stop the
# greatest position, which is that stop's place, changes by some 1e-16.
_STILL = 1e-9

# Where it goes on changing faster than this (as `_STILL`) beside its extreme, there is a corner: a
# choice, far above what is left at a place that is located to rounding.
_CORNER = 1e-4

Test = Callable[[Step], float]


class Extremum(NamedTuple):
    """A place at which a number is larger, or less, than at all others close by."""

    step: Step
    name: str
    detail: str


class Extrema:
    """Looks for extremes along a walk, step by step.

    **Arguments:** names of the numbers.
    """

    def __init__(self, names: tuple[str, ...]):
        self.names = names
        self._known: dict[int, tuple[Step, dict[str, float], dict[str, float]]] = {}

    def between(
        self, curve: Table, here: Step, last: Step, where: Callable[[Test], Step | None]
    ) -> list[Extremum]:
        """The extremes between two points that follow each other.

        **Arguments:** the curve; the points; the place between them at which a test is zero.
        """
        if not self.names:
            return []
        self._known = {id(here): self._known[id(here)]} if id(here) in self._known else {}
        values, before = self._at(curve, here)
        others, after = self._at(curve, last)
        found = []
        for name in self.names:
            least = _STILL * max(abs(values[name]), abs(others[name]))
            changes = max(abs(before[name]), abs(after[name])) > least
            if not (changes and before[name] * after[name] < 0):
                continue
            at = where(lambda step, name=name: self._at(curve, step)[1][name])
            if at is None:
                continue
            value, rate = (numbers[name] for numbers in self._at(curve, at))
            sense = 1 if before[name] > 0 else -1
            if sense * value < max(sense * values[name], sense * others[name]) - least:
                continue  # a pole, as of a multiplier at a grazing
            kind = "largest" if sense > 0 else "least"
            steep = max(abs(before[name]), abs(after[name]))
            corner = ", with a corner" if abs(rate) > _CORNER * steep else ""
            detail = f"{name} = {value:.10g} is {kind} of all close by{corner}"
            found.append(Extremum(at, name, detail))
        return found

    def _at(self, curve: Table, step: Step) -> tuple[dict[str, float], dict[str, float]]:
        """The numbers at a point, and how they change along the branch."""
        if id(step) not in self._known:
            direction = jnp.asarray(step.tangent * curve.scale)
            values, rates = rates_at(curve.problem, self.names, jnp.asarray(step.x), direction)
            # The step is kept, so that no other one gets its place in memory.
            self._known[id(step)] = step, _as_floats(values), _as_floats(rates)
        return self._known[id(step)][1:]


def _as_floats(numbers: dict) -> dict[str, float]:
    return {name: float(x) for name, x in numbers.items()}
