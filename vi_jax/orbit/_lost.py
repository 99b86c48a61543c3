"""Where an impact is lost, a stop touched, or the sequence of events changes between two points of
a branch."""

from collections.abc import Callable

import numpy as np

from ._hopf import hopf_between
from ._shooting import Shooting
from ._words import ANEW, REORDERED, RESTS
from .curve import Step

# Events that are to come together do so within this: a choice.
_TOGETHER = 1e-9

# The place between two points at which a test is zero.
Where = Callable[[Step, Step, Callable[[Step], float]], Step | None]


def first_lost(
    problem: Shooting, here: Step, new: Step, where: Where
) -> tuple[Step, int | None] | None:
    """The first of these places between two points, one being looked for where a test changes its
    sign, and the number of the event that is lost, or what stands for it (see `named`); `None` if
    there is none.

    **Arguments:** the equations; the points; `where`, that looks for a place.
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
        tests.append((lambda step: float(step.seen.apart) + _TOGETHER, REORDERED))
    for test, impact in tests:
        at = where(here, new, test)
        if at is not None:
            found.append((at, impact))
    return min(found, key=lambda f: float(np.dot(here.tangent, f[0].x - here.x)), default=None)
