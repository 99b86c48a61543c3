"""Where an impact is lost, a stop touched, or the sequence of events changes between two points of
a branch."""

import numpy as np

from ._hopf import hopf_between
from ._shooting import Shooting
from ._solve import advance, located
from ._words import ANEW, REORDERED, RESTS
from .curve import Step

# Events that are to come together do so within this: a choice.
_TOGETHER = 1e-9

# What changes within so much of the way to a place changes there, and so does a test that has
# become so small a share of what it was: choices, above what the tests are off by where the
# equations are singular.
_SHORT, _NOISE = 1e-4, 1e-3


def first_lost(
    problem: Shooting, here: Step, new: Step, scale: np.ndarray
) -> tuple[Step, int | None] | None:
    """The first of these places between two points, one being looked for where a test changes its
    sign, and the number of the event that is lost, or what stands for it (see `named`); `None` if
    there is none.

    **Arguments:** the equations; the points; the size of each unknown.
    """
    found, tests = [], []

    def room(step: Step) -> float:
        return float(np.clip(step.seen.nearest.room, -1.0, 1.0))

    for i, event in enumerate(problem.events):
        if new.seen.approach[i] <= 0 < here.seen.approach[i]:
            alone_there = event.cycle is not None and not problem.conditions
            hopf = hopf_between(problem, here, new) if alone_there else None
            if hopf is not None:
                found.append((hopf, RESTS))
            else:
                tests.append((lambda step, i=i: float(step.seen.approach[i]), i))
    if room(new) < 0 < room(here):
        tests.append((room, None))
    if new.seen.order < 0 < here.seen.order:
        tests.append((lambda step: float(step.seen.order), ANEW))
    if new.seen.apart < -_TOGETHER < here.seen.apart:
        # Of events that are together all along the rounding is left out.
        off = 0.0 if here.seen.apart > _TOGETHER else _TOGETHER
        tests.append((lambda step: float(step.seen.apart) + off, REORDERED))
    first = min(found, key=lambda f: _way(here, f[0]), default=None)
    for test, impact in tests:
        end = new if first is None else _short_of(problem, here, first[0], scale)
        # What falls together with the first one, or comes later, is not located.
        if first is not None and (not bool(end.good) or test(end) > -_NOISE * test(here)):
            continue
        at = located(problem, here, end, scale, test)
        if at is not None:
            first = at, impact
    return first


def _way(here: Step, at: Step) -> float:
    return float(np.dot(here.tangent, at.x - here.x))


def _short_of(problem: Shooting, here: Step, at: Step, scale: np.ndarray) -> Step:
    """A point between two, right before the second."""
    length = float(np.dot(here.tangent, (at.x - here.x) / scale))
    return advance(problem, here.x, here.tangent, scale, (1 - _SHORT) * length)
