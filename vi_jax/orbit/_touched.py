"""The touch of a stop beside which a motion that strikes it, and rests on one, ends."""

import numpy as np

from ._shooting import Shooting
from ._solve import advance
from .curve import Step

# How far beside a place a motion is looked for that does not strike (in the parameter's scale):
# choices; a walk that stalls at a touch is closer to it than the second.
_BESIDE = (1e-7, 1e-6, 1e-5, 1e-4)

# What is gone of the way to the touch, so often: so much is left of the way to it in the end, and
# the motion still is one that does not strike.
_SHARE, _TIMES = 0.99, 4


def touched_beside(problem: Shooting, at: Step, scale: np.ndarray) -> Step | None:
    """The motion that just touches a stop, close to one at which the impacts change; `None` if
    there is none.

    Where an impact gets slower and slower the equations have a root in them, and cannot be solved
    close to the touch. Those of the motions that do not strike are smooth up to there, and so is
    how far they stay from the stop.

    **Arguments:** the equations; the point; the size of each unknown.
    """
    along = np.eye(len(at.x))[-1]
    for far in _BESIDE:
        for sense in (far, -far):
            near = advance(problem, at.x, along, scale, sense)
            beyond = advance(problem, near.x, along, scale, sense) if bool(near.good) else near
            if not bool(beyond.good):
                continue
            room, rise = _room(near), (_room(beyond) - _room(near)) / sense
            # They touch the stop where their room ends: beside the place, no further off.
            if rise * sense > 0 and room < 2 * far * abs(rise):
                return _ended(problem, near, along, scale, rise)
    return None


def _ended(
    problem: Shooting, near: Step, along: np.ndarray, scale: np.ndarray, rise: float
) -> Step:
    """The last motion before the touch.

    **Arguments:** the equations; a motion beside it; the parameter's direction; the size of each
    unknown; how the room of the motion rises with the parameter.
    """
    for _ in range(_TIMES):
        step = advance(problem, near.x, along, scale, -_SHARE * _room(near) / rise)
        if not bool(step.good):
            break
        near = step
    return near


def _room(step: Step) -> float:
    """How far from a stop a body turns that does not strike it there."""
    return float(step.seen.nearest.room)
