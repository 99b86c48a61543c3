"""Whether a curve of motions has come back to where it began."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ._shooting import Shooting
from ._solution import sections_of
from .curve import Step

# The same motion is met again within this (scaled), in a direction that is the same within that:
# choices, ten thousand times what the corrector leaves, and far less than two passages differ by.
_AGAIN, _ALONG = 1e-7, 1e-2

# A curve is away from its first point, or near it, at so many lengths of its step: a choice.
_NEAR = 2.0

# Over this part of a unit what is smooth changes linearly: a choice.
_SHORT = 1e-6


class Closing:
    """Looks at each step of a walk whether the curve has come back to its first point.

    It has if it passes the plane across its beginning at the same motion in the same direction. A
    curve that only comes close to itself passes that plane elsewhere. The motion may be met again
    some cycles later, or with another of its events as the first one: that is the same motion.

    **Arguments:** the equations of the motions, the parameters as their last unknowns; the size of
    each unknown.
    """

    def __init__(self, problem: Shooting, scale: np.ndarray):
        self.problem, self.scale = problem, scale
        self.first: Step | None = None
        self.begins: list[tuple[np.ndarray, np.ndarray]] = []
        self.away = False

    def between(
        self, here: Step, new: Step, where: Callable[[Callable[[Step], float]], Step | None]
    ) -> Step | None:
        """The first point, as the last one of a closed curve, if it is met between two points; of
        the same motion observed otherwise that point as this curve has it.

        **Arguments:** points that follow each other; `where`, the point between them at which a
        test is zero.
        """
        if self.first is None:
            self.first = here
            self.begins = self._beginnings(here)
        near = _NEAR * float(np.linalg.norm((new.x - here.x) / self.scale))
        self.away = self.away or self._apart(new, self.begins[0][0]) > near
        if not self.away:
            return None
        for i, (begin, tangent) in enumerate(self.begins):
            begin = self._some_cycles_later(begin, here)

            def beyond(step: Step, begin=begin, tangent=tangent) -> float:
                return float(np.dot(tangent, (step.x - begin) / self.scale))

            if min(self._apart(step, begin) for step in (here, new)) > near:
                continue
            if not beyond(here) < 0 <= beyond(new):
                continue
            at = where(beyond)
            if at is None or self._apart(at, begin) > _AGAIN:
                continue
            if np.linalg.norm(at.tangent - tangent) < _ALONG:
                return at if i else self.first._replace(tangent=at.tangent)
        return None

    def _apart(self, step: Step, begin: np.ndarray) -> float:
        return float(np.linalg.norm((step.x - begin) / self.scale))

    def _beginnings(self, first: Step) -> list[tuple[np.ndarray, np.ndarray]]:
        """Unknowns and tangent of the first motion, and of the same one observed otherwise."""
        x = np.asarray(first.x)
        ahead, behind = (
            observed_otherwise(self.problem, x + sign * _SHORT * first.tangent * self.scale)
            for sign in (1, -1)
        )
        tangents = [(a - b) / (2 * _SHORT * self.scale) for a, b in zip(ahead, behind, strict=True)]
        others = zip(observed_otherwise(self.problem, x), tangents, strict=True)
        return [
            (x, np.asarray(first.tangent)),
            *(found for found in others if self._apart(first, found[0]) > _AGAIN),
        ]

    def _some_cycles_later(self, begin: np.ndarray, here: Step) -> np.ndarray:
        """The motion counted from the cycle in which its first event is nearest to that of another
        one."""
        problem = self.problem
        if not problem.events or problem.autonomous:
            return begin
        cycle = float(problem.at(jnp.asarray(begin)).cycle)
        begin = begin.copy()
        begin[: problem.legs] += cycle * np.round((here.x[0] - begin[0]) / cycle)
        return begin


def observed_otherwise(problem: Shooting, x: np.ndarray) -> list[np.ndarray]:
    """The unknowns of the same motion with others of its events as the first, or without events
    from its other sections on."""
    if problem.autonomous or not problem.follows_events:
        return []
    at, found = jnp.asarray(x), []
    parameters, period = x[-len(problem.parameters) :], float(problem.period(at))
    if not problem.events:
        if problem.cycles == 1:
            return []
        sections, _ = sections_of(problem, at)
        for n in range(1, problem.cycles):
            state = ravel_pytree(jax.tree.map(lambda leaf, n=n: leaf[n], sections))[0]
            found.append(np.append(np.asarray(state), parameters))
        return found
    clock, states = (np.asarray(a) for a in problem.parts(at))
    for first in range(1, problem.legs):
        if problem.events[first:] + problem.events[:first] == problem.events:
            later = np.append(clock[first:], clock[:first] + period)
            turned = problem.pack(later, np.roll(states, -first, axis=0), parameters)
            found.append(np.asarray(turned))
    return found
