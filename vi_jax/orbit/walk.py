"""The engine that follows curves, one way or both, step by step, until an event ends them.

The table of a curve (`Table`) lists its possible events. A row (`Event`) is a test that is positive
until the event happens. The engine finds the first event within a step; beyond it the curve is no
longer valid, and later events do not count.
"""

import abc
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._checks import count, from_host, given_number
from .._messages import ReportProgress, at_work, warn
from .._types import Vector
from ..machine import nearest_images
from .corrector import (
    Step,
    advance,
    distance_along,
    host_program,
    step_error,
    steps_depend_on_motion,
)
from .edit_events import half_difference, repeats_from
from .equations import Shooting
from .from_orbit import with_finer_steps, with_grown_sizes
from .locate import locate_zero
from .special import Point
from .tolerances import CORRECTED, EXACT, FAINT, LOCATED, NEARBY, ROUGHLY, ROUNDING, SAME

# Reasons to end of every curve: Ctrl-C was pressed, the corrector fails, the curve closes, a bound.
INTERRUPTED, STALLED, CLOSED, BOUNDS = "interrupted", "stalled", "closed", "bounds"

# In place of the reason to end if a step has led to another curve: the step is repeated, shorter.
SHORTER = "shorter"

# The numbers below are choices where no measurement is given.

# The tangents of two points close to each other on one curve have at least this product: they turn
# by less than 26°. A step stays within half that angle of its first tangent; one with a smaller
# cosine than this has reached another curve, beyond a jump of the equations, or another part.
SAME_CURVE = 0.9

# A walk stalls if its steps must be shorter than this share of the longest. The shortest
# steps that the branches of the tests need are 2e-3 of it.
_SHORTEST = 1e-6

# After a cut, this many steps keep their length before it grows again.
_STEADY = 3

# An earlier event's test must be below minus this share of its first value: above errors near
# singular equations.
_NOISE = 1e-3

# A curve begins at the zero of a test that is at most this share of its value a step further on.
_ZERO_AT_START = 1e-7


class Ending(NamedTuple):
    """The end of a curve."""

    last: Step
    reason: str
    point: Point | None = None
    """The special point at the end, if it is one."""
    until: Step | None = None
    """The step up to which other events on the curve are found, if not `last`."""


class Event(NamedTuple):
    """A row of a curve's table: an event that may end the curve."""

    test: Callable[[Step], float]
    """Positive until the event happens."""
    ending: Callable[[Step], Ending | None]
    """Return how the curve ends at the zero of the test; `None` if it does not end."""
    locate: Callable[[Step, Step], Step | None] | None = None
    """Locate the event between two points; by default a zero of its test (`locate_zero`)."""
    noise: float = 0.0
    """A negative value of at most this modulus is zero to rounding."""


class Table(abc.ABC):
    """The equations of a curve, its possible events, and the intervals of its parameters."""

    symmetric: bool = False
    """True if a motion can become its own image, or cease to be it."""

    def __init__(self, problem: Shooting, bounds: Sequence[tuple[float, float]]):
        self.problem, self.bounds = problem, bounds
        self.closing = Closing(self)
        # The equations and ends of the last search by `locate_zero`, and the points that it found.
        self._search: tuple[Any, ...] = (None, None, None)
        self._known_points: dict[float, Step] = {}

    @property
    def scale(self) -> np.ndarray:
        return self.problem.scale

    @abc.abstractmethod
    def event_rows(self, here: Step, new: Step) -> list[Event]:
        """Return the rows for a step between two points."""

    def advance(self, x: Any, tangent: Any, length: Any) -> Step:
        new = advance(self.problem, x, tangent, length)
        distance = float(np.linalg.norm((new.x - np.asarray(x)) / self.scale))
        deviates = distance > LOCATED and not abs(length) >= SAME_CURVE * distance
        return new._replace(good=np.asarray(False)) if deviates else new

    def locate_zero(self, here: Step, new: Step, test: Callable[[Step], float]) -> Step | None:
        """Return the point between two at which a test is zero; points found for another test
        between the same two are used again."""
        ends = self.problem, here, new
        if any(a is not b for a, b in zip(ends, self._search, strict=True)):
            self._search, self._known_points = ends, {}
        return locate_zero(*ends, test, self._known_points)

    def snap_to_bounds(self, step: Step) -> Step:
        """Move parameters that are on a bound to rounding exactly onto it. Beyond a bound a
        parameter may be invalid."""
        x = np.array(step.x)
        for i, ends in enumerate(self.bounds, -len(self.bounds)):
            for bound in ends:
                x[i] = bound if abs(x[i] - bound) < EXACT * self.scale[i] else x[i]
        return step._replace(x=x)

    def image_difference(self, step: Step) -> np.ndarray:
        """Return the difference of a motion from its own image; empty if it cannot be symmetric."""
        return half_difference(self.problem, step, mirrored=True) if self.symmetric else np.zeros(0)

    def points_between(self, here: Step, last: Step) -> list[tuple[Point, Step]]:
        """Return the events between two points that do not end the curve, in order."""
        return []

    def stall_end(self, steps: list[Step]) -> Ending:
        return Ending(steps[-1], STALLED)


def check_walk(*, step: object, max_step: object, max_points: object) -> dict[str, Any]:
    return {
        "step": given_number("step", step, low=0.0, open_low=True),
        "max_step": given_number("max_step", max_step, low=0.0, open_low=True),
        "max_points": count("max_points", max_points, least=2),
    }


def follow_both_ways(
    table: Callable[[], Table],
    start: Step,
    result: Callable[..., Any],
    *,
    what: str,
    progress: bool,
    settings: dict[str, Any],
) -> Any:
    """Follow the curve through a point ahead and back, with a new table for each way. `result`
    makes the result from the fields of a `Curve` and its `special` points; `what` is its name in
    messages. On Ctrl-C `Interrupted` is raised with the result so far."""
    tables = table(), table()
    start = tables[0].snap_to_bounds(start)
    ahead = _Walk(tables[0], start)
    back = _Walk(tables[1], start._replace(tangent=-start.tangent))

    def make_result() -> Any:
        problem = max(back.table.problem, ahead.table.problem, key=lambda p: p.steps)
        sizes = from_host(np.maximum(back.table.problem.sizes, ahead.table.problem.sizes))
        problem = dataclasses.replace(problem, sizes=sizes)
        behind, before = (rescaled(w.steps, w.table.scale, problem.scale) for w in (back, ahead))
        first = len(behind) - 1
        special = [
            *(dataclasses.replace(p, index=first - p.index) for p in reversed(back.special)),
            *(dataclasses.replace(p, index=first + p.index) for p in ahead.special),
        ]
        return result(
            problem=problem, steps=[*reversed(behind[1:]), *before],
            ends=(back.end, ahead.end), special=special,
        )  # fmt: skip

    walk = f"walk along the {what}"
    with at_work(walk, make_result, progress=progress, unit="point") as report:
        ahead.end = ahead.walk(report, **settings)
        back.end = CLOSED if ahead.end == CLOSED else back.walk(report, **settings)
    return make_result()


class _Walk:
    def __init__(self, table: Table, start: Step):
        self.table, self.steps, self.end = table, [start], INTERRUPTED
        self.special: list[Point] = []
        self._noise, self._worst = 0.0, (0.0, 0.0)  # error left by more steps; largest, and where

    def walk(self, report: ReportProgress, *, step: float, max_step: float, max_points: int) -> str:
        """Walk on in the direction of the first point's tangent; return the reason to end."""
        length, failed, steady, end, points = step, 0, 0, "max_points", 1
        while points < max_points:
            here = self.steps[-1]
            new = self.table.advance(here.x, here.tangent, length)
            turn = float(np.dot(np.asarray(new.tangent), np.asarray(here.tangent)))
            good = bool(new.good) and turn >= SAME_CURVE
            if good and self._refine_steps(new):
                length, failed, steady = step, 0, 0
                continue
            ending = self._first_ending(here, new) if good else Ending(here, SHORTER)
            if ending is not None and ending.reason == SHORTER:
                # The further off a solution is, the longer each trial takes.
                length, failed, steady = length * (0.4 if failed < 2 else 0.1), failed + 1, _STEADY
                if length >= _SHORTEST * max_step:
                    continue
                ending = self._stalled_ending(here)
            elif ending is None or ending.last is not here:
                last = new if ending is None else ending.until or ending.last
                for point, at in self.table.points_between(here, last):
                    self._append(at, point)
            if ending is not None:
                last = None if ending.last is here else self.table.snap_to_bounds(ending.last)
                self._append(last, ending.point)
                end = ending.reason
                break
            self._append(new)
            self._resize(new)
            report(1)
            failed, steady, points = 0, max(0, steady - 1), points + 1
            if turn > 0.99 and int(new.iterations) <= 6 and not steady:
                length = min(1.4 * length, max_step)
            elif turn < 0.97:
                length *= 0.7
        self._warn()
        return end

    def _append(self, step: Step | None, point: Point | None = None) -> None:
        if step is not None:
            moves = np.abs(np.asarray(step.x) - self.steps[-1].x) / self.table.scale
            kept = len(self.steps) - int(moves.max() <= EXACT)  # a special point may be a step
            self.steps[kept:] = [step]
        if point is not None:
            self.special.append(dataclasses.replace(point, index=len(self.steps) - 1))

    def _first_ending(self, here: Step, new: Step) -> Ending | None:
        """Return the first event between two points. An event is located if its test has changed
        sign, and then again up to the first event. Beyond it the curve is not one of the machine's:
        a test may have changed sign twice there."""
        rows = [(row, row.test(here)) for row in self.table.event_rows(here, new)]
        for row, begin in rows:
            ending = row.ending(here) if _falls_from_zero(row, begin, new) else None
            if ending is not None:
                return ending
        rows = [(row, begin) for row, begin in rows if begin > 0]
        first, end = None, new
        while True:
            share = 0.0 if first is None else _NOISE
            passed_rows = (
                i for i, (r, begin) in enumerate(rows) if r.test(end) <= -share * begin - r.noise
            )
            index = next(passed_rows, None)
            if index is None:
                return first
            row, _ = rows.pop(index)
            locate = row.locate or partial(self.table.locate_zero, test=row.test)
            zero = locate(here, end)
            ending = None if zero is None else row.ending(zero)
            if ending is None:
                continue
            # Later events, and those that coincide with the first one, are not located.
            first = ending
            length = (1 - FAINT) * distance_along(self.table.problem, here, first.last)
            end = self.table.advance(here.x, here.tangent, length)
            if first.reason == SHORTER or not bool(end.good):
                return first

    def _stalled_ending(self, last: Step) -> Ending:
        """Return the end of a curve at which the corrector fails: a very close bound, if there is
        one, else the table's `stall_end`. At a restitution of 0 or 1 the machine changes form."""
        table, axes = self.table, np.eye(len(last.x))
        for i, ends in enumerate(table.bounds, -len(table.bounds)):
            for bound in ends:
                length = (bound - float(last.x[i])) / table.scale[i]
                if abs(length) < LOCATED:  # a few times the remainder of the shortest steps
                    at = advance(table.problem, last.x, axes[i], length)
                    if bool(at.good):
                        return Ending(at, BOUNDS)
        return table.stall_end(self.steps)

    def _refine_steps(self, new: Step) -> bool:
        """Refine the steps of the flights if they depend on the motion; return True if changed."""
        table = self.table
        if not steps_depend_on_motion(table.problem):
            return False
        error = step_error(table.problem, new.x)
        if error > 10 * max(CORRECTED, self._noise):  # otherwise rounding
            refined = with_finer_steps(table.problem, new.x, error)
            if refined is not None:
                table.problem = refined
                return True
            self._noise = error
        self._worst = max(self._worst, (error, float(new.x[-1])))
        return False

    def _resize(self, new: Step) -> None:
        """Adopt the sizes of a motion that has become twice as large as before."""
        table, before = self.table, self.table.scale
        resized = with_grown_sizes(table.problem, new.observed.largest)
        if resized is None:
            return
        table.problem = resized
        self.steps = rescaled(self.steps, before, table.scale)
        table.closing.restart(self.steps[:-1])

    def _warn(self) -> None:
        error, value = self._worst
        if error > ROUGHLY:  # more steps are not allowed
            problem = self.table.problem
            warn(
                f"The flights of this curve have {problem.steps} steps each, but at "
                f"{problem.parameters[-1]} = {value:.6g} twice as many change its states by "
                f"{error:.1g}: follow it by a `method` of more steps a cycle."
            )


def _falls_from_zero(row: Event, begin: float, new: Step) -> bool:
    if begin > row.noise:
        return False
    end = row.test(new)
    return abs(begin) <= _ZERO_AT_START * abs(end) and end < -row.noise


def rescaled(steps: list[Step], before: np.ndarray, after: np.ndarray) -> list[Step]:
    def tangent(step: Step) -> np.ndarray:
        along = np.asarray(step.tangent) * before / after
        return along / np.linalg.norm(along)

    if np.array_equal(before, after):
        return steps
    return [step._replace(tangent=tangent(step)) for step in steps]


def common_rows(table: Table) -> list[Event]:
    """Return the rows of every curve: the bounds of its parameters, and negative loads."""

    def row(i: int, bound: float, sense: float) -> Event:
        def distance(step: Step) -> float:
            return sense * (float(step.x[i]) - bound) / float(table.scale[i])

        def ending(at: Step) -> Ending:
            return Ending(at, BOUNDS if abs(distance(at)) < LOCATED else SHORTER)

        return Event(distance, ending)

    intervals = enumerate(table.bounds, -len(table.bounds))
    rows = [row(i, *end) for i, (low, high) in intervals for end in ((low, 1.0), (high, -1.0))]
    load = lambda step: float(step.observed.least_load) + ROUNDING
    return [*rows, Event(load, lambda at: Ending(at, "jammed"))]


# A curve is away from its first point beyond so many lengths of its step, else near it: a choice.
_NEAR = 2.0


class Closing:
    """A detector of curves that come back to one of their points.

    A curve has come back if it passes the plane across one of its points at the same motion and in
    the same direction. A curve that only comes close to itself passes that
    plane elsewhere. The same motion may reappear some cycles later, with angles that have made
    whole turns, or with another of its events as the first one.
    """

    def __init__(self, table: Table):
        self.table = table
        self.restart([])

    def restart(self, points: list[Step]) -> None:
        self.points: list[Step] = list(points)
        self.starts, self.cycle = [], 0.0
        if points:
            self._store_start(points[0])

    def rows(self, here: Step, new: Step) -> Iterator[Event]:
        """Return the rows for a step between two points, one for each earlier point near it."""
        if not self.points:
            self._store_start(here)
        if not self.points or self.points[-1] is not here:
            self.points.append(here)
        near = _NEAR * float(np.linalg.norm((new.x - here.x) / self.table.scale))
        xs = self._shift_turns(np.stack([step.x for step in self.points]), new)
        distances = np.linalg.norm((xs - new.x) / self.table.scale, axis=1)
        if distances.max() <= near:
            return
        last_away = int(np.flatnonzero(distances > near)[-1])  # all later points are near
        close = [self.points[i] for i in np.flatnonzero(distances[: last_away + 1] <= near) if i]
        places: list[tuple[np.ndarray, np.ndarray, float, Step | None]] = [
            *((x, t, self.cycle, None if i else self.points[0])
              for i, (x, t) in enumerate(self.starts)),
            *((np.asarray(step.x), np.asarray(step.tangent), self._cycle_length(step), step)
              for step in close),
        ]  # fmt: skip
        for start, tangent, cycle, point in places:
            start = self._shift_cycles(start, cycle, here)
            if min(self._distance(step, start) for step in (here, new)) > near:
                continue

            def plane_distance(step: Step, start=start, tangent=tangent) -> float:
                return float(np.dot(tangent, (start - step.x) / self.table.scale))

            def ending(at: Step, start=start, tangent=tangent, point=point) -> Ending | None:
                same = self._distance(at, start) < SAME
                if not same or np.linalg.norm(at.tangent - tangent) >= NEARBY:
                    return None
                return Ending(at if point is None else point._replace(tangent=at.tangent), CLOSED)

            yield Event(plane_distance, ending)

    def _distance(self, step: Step, x: np.ndarray) -> float:
        return float(np.linalg.norm((step.x - x) / self.table.scale))

    def _store_start(self, first: Step) -> None:
        """Store unknowns and tangent of the first motion and of its other representations."""
        self.cycle = self._cycle_length(first)
        scale = self.table.scale
        found = _starts_with_rates(self.table.problem, first.x, first.tangent * scale)
        others = ((other, rate / scale) for other, rate in found)
        self.starts = [
            (first.x, np.asarray(first.tangent)),
            *(other for other in others if self._distance(first, other[0]) > SAME),
        ]

    def _cycle_length(self, step: Step) -> float:
        """Return the length of a cycle by the clock if motions may be counted from any, else 0."""
        problem = self.table.problem
        if not problem.events or problem.autonomous:
            return 0.0
        return problem.values(step.x)[2] / problem.cycles

    def _shift_cycles(self, x: np.ndarray, cycle: float, here: Step) -> np.ndarray:
        """Shift a motion by cycles and turns so that it is nearest to another one."""
        x = self._shift_turns(x, here)
        if cycle:
            x[: self.table.problem.legs] += cycle * np.round((here.x[0] - x[0]) / cycle)
        return x

    def _shift_turns(self, xs: np.ndarray, here: Step) -> np.ndarray:
        """Shift the angles of motions by the turns that bring them nearest to another one."""
        problem, xs = self.table.problem, xs.copy()
        angles = problem.angles
        if angles is not None:
            first, angles = len(problem.events), np.tile(angles, problem.legs)
            states = slice(first, first + angles.size)
            xs[..., states] = nearest_images(angles, xs[..., states], np.asarray(here.x)[states])
        return xs


@host_program
def _starts_with_rates(problem: Shooting, x, along):
    """Return the motion's other representations, each with its derivative along a direction."""
    return list(zip(*jax.jvp(partial(_other_starts, problem), (x,), (along,)), strict=True))


def _other_starts(problem: Shooting, x: Vector) -> list[Vector]:
    """Return the same motion from other events, or without events from its other sections."""
    clock, states = problem.parts(x)
    if not problem.events:
        sections = zip(*(part[1:] for part in problem.sections(x)), strict=True)
        later = [ravel_pytree(problem.state_at(x, leg, s))[0] for leg, s in sections]
        return [jnp.concatenate([state, x[states.size :]]) for state in later]
    found, period = [], problem.period(x)
    for first in range(1, problem.legs):
        if repeats_from(problem, first):
            later = jnp.concatenate([clock[first:], clock[:first] + period])
            found.append(problem.pack(later, jnp.roll(states, -first, axis=0), x, period))
    return found
