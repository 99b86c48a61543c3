"""Where a motion whose events are found by the simulator gains or loses one of them."""

from collections.abc import Callable

import numpy as np

from ._refined_rest import refined_rest
from ._shooting import Shooting
from ._solve import advance, located
from ._touched import touched_beside
from .curve import SHORTER, Step, way
from .special import GRAZING, REST

BETWEEN_RESTS = "touches a stop between its rests"

# Places at which the groups of impacts change within one step are looked at, so many: a choice.
_PLACES = 16

# A place where the sequence of a motion's events changes is refined within so long a step.
_BEYOND = 1e-4


def changed_sequence(
    problem: Shooting, here: Step, last: Step, scale: np.ndarray
) -> tuple[str, Step, str] | None:
    """Kind, place and description of what ends a motion that rests between two points; `None` if
    its sequence of rests and impacts stays, or has another number of hops in a chatter. `SHORTER`
    where a motion between them would have to be looked for in shorter steps.

    **Arguments:** the equations; the points; the size of each unknown.
    """
    if here.seen.counted is None:
        return None
    found = _lost_or_gained(problem, here, last, scale)
    return _grazed(problem, here, last, scale) if found is None else found


def _lost_or_gained(
    problem: Shooting, here: Step, last: Step, scale: np.ndarray
) -> tuple[str, Step, str] | None:
    """Where the number of rests changes."""
    before, after = _rests(here), _rests(last)
    found = None if before == after else _changed(problem, here, last, scale, _rests)
    if found is None:
        return None
    what = f"a rest on a stop is {'gained' if after > before else 'lost'}"
    return REST, refined_rest(problem, found[0], scale), what


def _grazed(
    problem: Shooting, here: Step, last: Step, scale: np.ndarray
) -> tuple[str, Step, str] | None:
    """The first of the places where an impact outside of a chatter is gained or lost by a graze."""
    for _ in range(_PLACES):
        if _groups(here) == _groups(last):
            return None
        found = _changed(problem, here, last, scale, _groups)
        if found is None:
            return None
        at, here = found
        touch = touched_beside(problem, at, scale)
        if touch is not None:
            return GRAZING, touch, BETWEEN_RESTS
        if not bool(here.good):
            # There is none on the way there: the branch turns, and `last` is of another one.
            return SHORTER, last, ""
    return None


def _changed(
    problem: Shooting, here: Step, last: Step, scale: np.ndarray, number: Callable[[Step], object]
) -> tuple[Step, Step] | None:
    """The last point between two with as many rests or impacts as the first one, and one beyond it.

    Where there is no motion at all has another number: beyond a rest that is lost the hops of a
    chatter end one by one in grazings.
    """
    wanted = number(here)

    def same(step: Step) -> float:
        return 1.0 if bool(step.good) and number(step) == wanted else -1.0

    # A test that jumps is met short of its place by a share of the step: the second step is a short
    # one.
    at = located(problem, here, last, scale, same)
    if at is None:
        return None
    left = way(at, last, scale)
    beyond = last if left < _BEYOND else advance(problem, at.x, at.tangent, scale, _BEYOND)
    return located(problem, at, beyond, scale, same) or at, beyond


def _rests(step: Step) -> int:
    """The number of rests of a motion."""
    return int(step.seen.counted.rests)


def _groups(step: Step) -> tuple[int, ...]:
    """The number of groups of impacts on each stop, where one that is slower than the one before it
    belongs to its group, as the hops of a chatter do, however many there are.

    An impact that is gained or lost by a graze is as slow as can be, so that a group begins behind
    it. (Groups change as well where the order of fast impacts by their speeds does.)
    """
    counted = step.seen.counted
    speeds = [
        counted.speed[counted.stop == i] for i in range(int(counted.stop.max(initial=-1)) + 1)
    ]
    return tuple(int(np.sum(np.roll(v, -1) >= v)) for v in speeds)
