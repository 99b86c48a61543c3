"""Where a motion whose events are found by the simulator gains or loses one of them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .curve import Step
from .special import GRAZING, REST

# A body that turns closer to a stop than this beside the place where the number of impacts changes
# grazes it there; else a chatter has one hop more before it is completed, and the motion goes on.
# A choice: a step of the parameter of 1e-12 beyond a graze leaves about its square root.
GRAZES = 1e-5

BETWEEN_RESTS = "touches a stop between its rests"

# Places at which the number of impacts changes within one step are looked at, so many: a choice.
_PLACES = 16

# Where a test changes its sign between two points: the last point before that, and one beyond it.
Where = Callable[[Step, Step, Callable[[Step], float]], tuple[Step, Step] | None]


def changed_sequence(here: Step, last: Step, where: Where) -> tuple[str, Step, str] | None:
    """Kind, place and description of what ends a motion that rests between two points; `None` if
    its sequence of rests and impacts stays, or has another number of hops in a chatter.

    **Arguments:** the points; `where`, that looks for the place at which a test jumps.
    """
    if here.seen.counted is None:
        return None
    return _lost_or_gained(here, last, where) or _grazed(here, last, where)


def _lost_or_gained(here: Step, last: Step, where: Where) -> tuple[str, Step, str] | None:
    """Where the number of rests changes."""
    before, after = _rests(here), _rests(last)
    found = None
    if before != after:
        found = where(here, last, lambda step: _same(step, _rests, before))
    if found is None:
        return None
    return REST, found[0], f"a rest on a stop is {'gained' if after > before else 'lost'}"


def _grazed(here: Step, last: Step, where: Where) -> tuple[str, Step, str] | None:
    """The first of the places where the number of impacts on one of the stops changes by a
    graze."""
    for _ in range(_PLACES):
        counts = _impacts(here)
        if counts == _impacts(last):
            return None
        found = where(here, last, lambda step, counts=counts: _same(step, _impacts, counts))
        if found is None:
            return None
        at, here = found
        if float(at.seen.nearest.room) < GRAZES:
            return GRAZING, at, BETWEEN_RESTS
    return None


def _rests(step: Step) -> int:
    """The number of rests of a motion."""
    return int(step.seen.counted.rests)


def _impacts(step: Step) -> tuple[int, ...]:
    """The number of impacts of a motion on each stop, of those that are listed, and of all. A stop
    is grazed in the same step in which a chatter on another one loses a hop."""
    listed = step.seen.counted.stop.astype(int)
    return (int(step.seen.counted.impacts), *np.bincount(listed[listed >= 0]).tolist())


def _same(step: Step, number: Callable[[Step], Any], wanted: Any) -> float:
    """1 where a motion has so many rests or impacts, else -1; where there is none at all too, as
    beyond a rest that is lost, where the hops of a chatter end one by one in grazings."""
    return 1.0 if bool(step.good) and number(step) == wanted else -1.0
