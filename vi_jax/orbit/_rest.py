"""Motions that rest on a stop, as fixed points of the section map: where their sequence of rests
and impacts changes, and what lies beyond a place where the corrector has no answer.

Where an impact or a chatter comes upon the section the motion goes on, but its state there jumps:
it is that behind the impact instead of that before it. So a branch of fixed points stalls, and is
taken up beyond.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..machine import RigidStop
from ._corrector import Step, advance, way
from ._follow import SHORTER, Ending, Event
from ._locate import located
from ._refined_rest import refined_rest
from ._shooting import Shooting
from .special import GRAZING, REST

BETWEEN_RESTS = "touches a stop between its rests"

# The numbers below are choices but where a measurement is given.
# Places at which the groups of impacts change within one step are looked at, so many.
_PLACES = 16

# A place where the sequence of a motion's events changes is refined within so long a step.
_BEYOND = 1e-4

# How far beside a place a motion is looked for that does not strike (in the parameter's scale); a
# walk that stalls at a touch is closer to it than the second.
_BESIDE = (1e-7, 1e-6, 1e-5, 1e-4)

# What is gone of the way to the touch, so often: so much is left of the way to it in the end, and
# the motion still is one that does not strike.
_SHARE, _TIMES = 0.99, 4

# A body this close to a stop on the section meets it there: far above how close to the place a walk
# comes before it stalls. And how far beyond that place the motion is looked for.
_MEETS, _PAST = 1e-5, (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)


class Sequence:
    """The rows of a table for motions that rest.

    **Arguments:** the equations; the point from which a step is made; the size of each unknown;
    what makes an ending of a kind, a place and what is said of it.
    """

    def __init__(
        self, problem: Shooting, here: Step, scale: np.ndarray,
        named: Callable[[str, Step, str], Ending],
    ):  # fmt: skip
        self.problem, self.here, self.scale, self.named = problem, here, scale, named

    def rows(self) -> list[Event]:
        """Where the number of rests changes, and where an impact outside of a chatter is gained or
        lost by a graze."""
        rests = Event(self._same(_rests), self._rest, self._at_rest)
        return [rests, Event(self._same(_groups), self._graze, lambda here, last: last)]

    def _same(self, number: Callable[[Step], object]) -> Callable[[Step], float]:
        """1 for motions with as many rests or impacts as the first one, else -1.

        Where there is no motion at all has another number: beyond a rest that is lost the hops of a
        chatter end one by one in grazings.
        """
        wanted = number(self.here)
        return lambda step: 1.0 if bool(step.good) and number(step) == wanted else -1.0

    def _at_rest(self, here: Step, last: Step) -> Step | None:
        found = self._changed(here, last, _rests)
        return None if found is None else found[0]

    def _rest(self, at: Step) -> Ending:
        beyond = advance(self.problem, at.x, at.tangent, self.scale, _BEYOND)
        gained = bool(beyond.good) and _rests(beyond) > _rests(self.here)
        what = f"a rest on a stop is {'gained' if gained else 'lost'}"
        return self.named(REST, refined_rest(self.problem, at, self.scale), what)

    def _graze(self, last: Step) -> Ending | None:
        """The first of the places up to a point at which the groups of impacts change by a graze;
        a shorter step is asked for where a motion would have to be looked for within it."""
        here = self.here
        for _ in range(_PLACES):
            if _groups(here) == _groups(last):
                return None
            found = self._changed(here, last, _groups)
            if found is None:
                return None
            before, (at, here) = here, found
            touch = touched_beside(self.problem, at, self.scale)
            if touch is not None:
                return self.named(GRAZING, touch, BETWEEN_RESTS)
            turned = min(way(before, at, self.scale), way(at, last, self.scale)) < 0
            if not bool(here.good) or turned:
                # There is none on the way there: the branch turns, and `last` is of another one.
                return Ending(self.here, SHORTER)
        return None

    def _changed(
        self, here: Step, last: Step, number: Callable[[Step], object]
    ) -> tuple[Step, Step] | None:
        """The last point between two with as many rests or impacts as the first one, and one beyond
        it."""
        problem, scale, same = self.problem, self.scale, Sequence(
            self.problem, here, self.scale, self.named
        )._same(number)  # fmt: skip
        # A test that jumps is met short of its place by a share of the step: the second step is a
        # short one.
        at = located(problem, here, last, scale, same)
        if at is None:
            return None
        left = way(at, last, scale)
        beyond = last if left < _BEYOND else advance(problem, at.x, at.tangent, scale, _BEYOND)
        if np.linalg.norm((beyond.x - at.x) / scale) > 2 * _BEYOND:
            beyond = beyond._replace(good=np.asarray(False))  # it is of another branch
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


def past_section(problem: Shooting, last: Step, scale: np.ndarray) -> Step | None:
    """The motion beyond a place where a branch of motions that rest has stalled, if there one of
    its impacts falls on the section, or its rest begins or ends there; else `None`."""
    if problem.follows_events or problem.conditions:
        return None
    machine, x = problem.at(jnp.asarray(last.x)), np.asarray(last.x)
    state, rests = problem.unravel(jnp.asarray(x[: problem.states])), _rests(last)
    along = np.zeros(x.size)
    along[-1] = np.copysign(1.0, last.tangent[-1])
    for stop in machine.stops:
        body = machine.coordinates[stop.coordinate]
        if float(stop.beyond(body.position(state))) < -_MEETS * last.seen.length:
            continue
        for V in _speeds(stop, float(body.velocity(state))):
            there = body.placed(state, stop.place, jnp.asarray(V))
            begin = np.append(np.asarray(ravel_pytree(there)[0]), x[-1])
            for length in _PAST:
                found = advance(problem, begin, along, scale, length)
                if bool(found.good) and _rests(found) == rests:
                    return found
    return None


def _speeds(stop: RigidStop, V: float) -> list[float]:
    """The velocities with which a body may be on a stop instead: behind an impact or before one,
    or at rest."""
    share = float(stop.share(jnp.asarray(abs(V))))
    if float(stop.sign) * V > 0:
        return [-share * V, 0.0]
    return [-V / share, 0.0] if share > 0 else [0.0]
