"""Where an impact is lost, a stop touched, or the sequence of events changes between two points of
a branch."""

from collections.abc import Callable

import numpy as np

from ._hopf import hopf_between
from ._shooting import Shooting
from ._solve import advance, located
from ._words import ANEW, REORDERED, RESTS
from .curve import Step, way

# Events that are to come together do so within this: a choice.
_TOGETHER = 1e-9

# What changes within so much of the way to a place changes there, and so does a test that has
# become so small a share of what it was: choices, above what the tests are off by where the
# equations are singular.
_SHORT, _NOISE = 1e-4, 1e-3


def first_lost(
    problem: Shooting, here: Step, new: Step, scale: np.ndarray
) -> tuple[Step, int | None] | None:
    """The first of these places between two points, and the number of the event that is lost, or
    what stands for it (see `named`); `None` if there is none.

    One is looked for where a test has changed its sign, and then again on the way there: a test may
    have changed it back, since beyond the first place the motion is none of the machine's.

    **Arguments:** the equations; the points; the size of each unknown.
    """
    first, end = None, new
    tests = [(test, impact) for test, impact in _tests(problem, here) if test(here) > 0]
    while True:
        least = 0.0 if first is None else -_NOISE
        changed = [i for i, (test, _) in enumerate(tests) if test(end) <= least * test(here)]
        if not changed:
            return first
        test, impact = tests.pop(changed[0])
        at = None
        if impact is not None and impact >= 0 and problem.events[impact].cycle is not None:
            at = None if problem.conditions else hopf_between(problem, here, end)
            impact = impact if at is None else RESTS
        at = located(problem, here, end, scale, test) if at is None else at
        if at is None:
            continue
        # What falls together with the first one is not looked for, nor what comes later.
        first, end = (at, impact), _short_of(problem, here, at, scale)
        if not bool(end.good):
            return first


def _tests(problem: Shooting, here: Step) -> list[tuple[Callable[[Step], float], int | None]]:
    """What is positive of a motion of the machine, and the number of the event that is lost where
    it is not, or what stands for it.

    **Arguments:** the equations; the point from which the walk comes.
    """
    # Of events that are together all along the rounding is left out.
    off = 0.0 if here.seen.apart > _TOGETHER else _TOGETHER
    approaches = [
        (lambda step, i=i: float(step.seen.approach[i]), i) for i in range(len(problem.events))
    ]
    return [
        *approaches,
        (lambda step: float(np.clip(step.seen.nearest.room, -1.0, 1.0)), None),
        (lambda step: float(step.seen.order), ANEW),
        (lambda step: float(step.seen.apart) + off, REORDERED),
    ]


def _short_of(problem: Shooting, here: Step, at: Step, scale: np.ndarray) -> Step:
    """A point between two, right before the second."""
    length = way(here, at, scale)
    return advance(problem, here.x, here.tangent, scale, (1 - _SHORT) * length)
