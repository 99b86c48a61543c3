"""Whether a curve of motions has come back to where it began."""

from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._programs import compiled
from .._types import Vector
from ..machine import angles_in, nearest_images
from ._corrector import Step
from ._follow import CLOSED, Ending, Event, Table
from ._shooting import Shooting

# The same motion is met again within this (scaled), in a direction that is the same within that:
# choices, ten thousand times what the corrector leaves, and far less than two passages differ by.
_AGAIN, _ALONG = 1e-7, 1e-2

# A curve is away from its first point, or near it, at so many lengths of its step: a choice.
_NEAR = 2.0


class Closing:
    """Looks at each step of a walk whether the curve has come back to where it was.

    It has if it passes the plane across one of its points, the first or a later one, at the same
    motion in the same direction. A curve that only comes close to itself passes that plane
    elsewhere. The motion may be met again some cycles later, with angles that have made whole
    turns, or with another of its events as the first one: that is the same motion.

    **Arguments:** the curve's table.
    """

    def __init__(self, table: Table):
        self.table = table
        self.begin([])

    def begin(self, points: list[Step]) -> None:
        """Take these points of the curve as those it came by."""
        self.points: list[Step] = list(points)
        self.begins, self.cycle = [], 0.0
        if points:
            self._begin_at(points[0])

    def rows(self, here: Step, new: Step) -> Iterator[Event]:
        """The rows of a table for a step between two points: one for each place close by at which
        the curve was before."""
        if not self.points:
            self._begin_at(here)
        if not self.points or self.points[-1] is not here:
            self.points.append(here)
        near = _NEAR * float(np.linalg.norm((new.x - here.x) / self.table.scale))
        xs = self._turned(np.stack([step.x for step in self.points]), new)
        apart = np.linalg.norm((xs - new.x) / self.table.scale, axis=1)
        if apart.max() <= near:
            return
        away = int(np.flatnonzero(apart > near)[-1])  # from the next one on it is near
        met = [self.points[i] for i in np.flatnonzero(apart[: away + 1] <= near) if i]
        places: list[tuple[np.ndarray, np.ndarray, float, Step | None]] = [
            *((x, t, self.cycle, None if i else self.points[0])
              for i, (x, t) in enumerate(self.begins)),
            *((np.asarray(step.x), np.asarray(step.tangent), self._cycle(step), step)
              for step in met),
        ]  # fmt: skip
        for begin, tangent, cycle, known in places:
            begin = self._some_cycles_later(begin, cycle, here)
            if min(self._apart(step, begin) for step in (here, new)) > near:
                continue

            def before(step: Step, begin=begin, tangent=tangent) -> float:
                return float(np.dot(tangent, (begin - step.x) / self.table.scale))

            def ending(at: Step, begin=begin, tangent=tangent, known=known) -> Ending | None:
                same = self._apart(at, begin) < _AGAIN
                if not same or np.linalg.norm(at.tangent - tangent) >= _ALONG:
                    return None
                return Ending(at if known is None else known._replace(tangent=at.tangent), CLOSED)

            yield Event(before, ending)

    def _apart(self, step: Step, begin: np.ndarray) -> float:
        return float(np.linalg.norm((step.x - begin) / self.table.scale))

    def _begin_at(self, first: Step) -> None:
        """Take unknowns and tangent of the first motion, and of the same one observed
        otherwise."""
        self.cycle = self._cycle(first)
        x, scale, problem = jnp.asarray(first.x), self.table.scale, self.table.problem
        found = _others_with_rates(problem, x, jnp.asarray(first.tangent * scale))
        others = ((np.asarray(other), np.asarray(rate) / scale) for other, rate in found)
        self.begins = [
            (np.asarray(x), np.asarray(first.tangent)),
            *(other for other in others if self._apart(first, other[0]) > _AGAIN),
        ]

    def _cycle(self, step: Step) -> float:
        """The length of a cycle by the clock, where motions may be counted from any; else 0."""
        problem = self.table.problem
        if not problem.events or problem.autonomous:
            return 0.0
        return float(problem.at(jnp.asarray(step.x)).cycle)

    def _some_cycles_later(self, begin: np.ndarray, cycle: float, here: Step) -> np.ndarray:
        """The motion counted from the cycle in which its first event is nearest to that of another
        one, with its angles as near."""
        begin = self._turned(begin, here)
        if cycle:
            begin[: self.table.problem.legs] += cycle * np.round((here.x[0] - begin[0]) / cycle)
        return begin

    def _turned(self, xs: np.ndarray, here: Step) -> np.ndarray:
        """Motions with their angles at the turns nearest to those of another one."""
        problem, xs = self.table.problem, xs.copy()
        angles = angles_in(problem.machine, problem.like)
        if angles is not None:
            first, angles = len(problem.events), np.tile(angles, problem.legs)
            states = slice(first, first + angles.size)
            xs[..., states] = nearest_images(angles, xs[..., states], np.asarray(here.x)[states])
        return xs


@compiled
def _others_with_rates(problem: Shooting, x, along):
    """The same motion observed otherwise, each with its derivative along a direction."""
    return list(zip(*jax.jvp(partial(_observed_otherwise, problem), (x,), (along,)), strict=True))


def _observed_otherwise(problem: Shooting, x: Vector) -> list[Vector]:
    """The unknowns of the same motion with others of its events as the first, or without events
    from its other sections on."""
    if problem.autonomous:
        return []
    (clock, states), parameters = problem.parts(x), x[-len(problem.parameters) :]
    if not problem.events:
        sections = zip(*(part[1:] for part in problem.sections(x)), strict=True)
        later = [ravel_pytree(problem.state_at(x, leg, s))[0] for leg, s in sections]
        return [jnp.concatenate([state, parameters]) for state in later]
    found, period = [], problem.period(x)
    for first in range(1, problem.legs):
        if problem.events[first:] + problem.events[:first] == problem.events:
            later = jnp.concatenate([clock[first:], clock[:first] + period])
            found.append(problem.pack(later, jnp.roll(states, -first, axis=0), parameters))
    return found
