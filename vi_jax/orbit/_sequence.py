"""Where a motion whose events are found by the simulator gains or loses one of them."""

from collections.abc import Callable

from .curve import Step
from .special import GRAZING, REST

# A body that turns closer to a stop than this beside the place where the number of impacts changes
# grazes it there; else a chatter has one hop more before it is completed, and the motion goes on.
# A choice: a step of the parameter of 1e-12 beyond a graze leaves about its square root.
_GRAZES = 1e-5

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
    before, after = _number(here, "rests"), _number(last, "rests")
    found = None
    if before != after:
        found = where(here, last, lambda step: _same(step, "rests", before))
    if found is None:
        return None
    return REST, found[0], f"a rest on a stop is {'gained' if after > before else 'lost'}"


def _grazed(here: Step, last: Step, where: Where) -> tuple[str, Step, str] | None:
    """The first of the places where the number of impacts changes by a graze."""
    for _ in range(_PLACES):
        count = _number(here, "impacts")
        if count == _number(last, "impacts"):
            return None
        found = where(here, last, lambda step, count=count: _same(step, "impacts", count))
        if found is None:
            return None
        at, here = found
        if float(at.seen.nearest.room) < _GRAZES:
            return GRAZING, at, "touches a stop between its rests"
    return None


def _number(step: Step, name: str) -> int:
    """The number of rests or impacts of a motion."""
    return int(getattr(step.seen.counted, name))


def _same(step: Step, name: str, count: int) -> float:
    """1 where a motion has so many rests or impacts, else -1; where there is none at all too, as
    beyond a rest that is lost, where the hops of a chatter end one by one in grazings."""
    return 1.0 if bool(step.good) and _number(step, name) == count else -1.0
