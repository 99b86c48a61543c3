"""The table of a branch: possible events of a periodic motion that is followed in one parameter.

| event | test, positive before it | end of the branch |
|---|---|---|
| a bound is reached | distance of the parameter | `bounds` |
| an autonomous motion gets long | four times its first duration less the duration | `long` |
| another multiplier becomes the greatest | that held less the others | `multiplier` |
| an impact or a switch is lost | V⁻, or the rate of its guard | `grazing`, sliding |
| a stop or a surface is touched | least distance at a turn | the same |
| a switch changes to another mode | 1 or -1 | the same |
| two events come together | time between them | `grazing` |
| the cycle shrinks to rest | the rate of the section at the equilibrium | `hopf` |
| a chatter takes until the release | the time left | `rest` |
| a body is at the limit of release within a rest | the least force | `rest` |
| a flight between two rests vanishes | its length | `rest` |
| two halves of the period become equal, or images | their difference | `period-doubling`, … |
| the curve closes | distance to the plane across an earlier point | `closed` |

Folds, branch points, doublings, tori, extremes and zeros of watched functions do not end the branch
(`MotionTable.points_between`).
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from ..machine import stops_of
from .conditions import HeldMultiplier, bifurcation_tests, in_one_parameter, rates_at
from .corrector import Step, advance, distance_along, orbit_of
from .edit_events import (
    half_difference,
    locate_origin,
    may_be_symmetric,
    may_repeat,
    without_events,
)
from .equations import Shooting
from .flight import LANDS, LEAVES
from .flight import Event as MotionEvent
from .hopf import hopf_between, size_of_cycle
from .kinds import (
    CROSSING,
    CROSSING_SLIDING,
    DOUBLING,
    EXTREMUM,
    FOLD,
    GRAZING,
    HOPF,
    KINDS,
    REST,
    SYMMETRY,
    TORUS,
    TURN,
    TURNS,
    WATCHED,
)
from .locate import SPACING, crossing, dip_of, passes_zero
from .results import Orbit
from .sliding import change_at, locate_change, vanishing_part
from .special import Point, further_of, point_at
from .tolerances import ALIKE, BRIEF, FAINT, LOCATED, NEARBY, ON_CIRCLE, ROUNDING, SAME
from .walk import SAME_CURVE, Ending, Event, Table, common_rows
from .words import coincidence_in_words, grazing_in_words, place_in_words

# These thresholds are choices; measured ones have the figure in the comment.

# A branch ends at this multiple of its first duration; the steps are then as much longer. For a
# rimless wheel near its homoclinic motion the multiplier is then correct to 2e-12.
_LONG = 4.0

# The description of a branch point at which this branch begins.
_BEGINS = "a multiplier touches 1: this branch begins at another one, on both sides"

# Before a lost impact, tests are taken at the first of these shares of the step at which all
# multipliers are below the second number. The products of larger ones are rounding: at 5e5 a
# Neimark–Sacker point was missed.
_BEFORE_POLE, _LARGE = (LOCATED, 1e-5, 1e-4), 1e4

# Most halvings of a step to separate bifurcations in it: a 100,000th of it is left.
_MOST_HALVINGS = 17

# Most parabolas to find a dip of a test within a step: one, if the dip is a parabola. A choice.
_MOST_PARABOLAS = 3

Located = list[tuple[Point, Step]]


class MotionTable(Table):
    """Possible events of a branch in each of its steps; `extrema` are names of quantities whose
    extrema are sought, `watched` functions of the orbit, by name, whose zeros are sought."""

    def __init__(
        self, problem: Shooting, bounds: list[tuple[float, float]],
        extrema: tuple[str, ...], watched: Mapping[str, Callable[[Orbit], float]],
    ):  # fmt: skip
        super().__init__(problem, bounds)
        self.extrema, self.watched = extrema, watched
        self.symmetric = may_be_symmetric(problem, [problem.machine, *problem.corners(bounds)])
        self.size, self.duration = 0.0, 0.0  # those of the first motion
        self._last_steps: tuple[Step, Step] | None = None
        self._last_numbers: tuple[Any, dict[tuple[str, str], tuple[float, float]]] = np.zeros(0), {}

    def advance(self, x, tangent, length) -> Step:
        new = super().advance(x, tangent, length)
        if not self.problem.autonomous or not bool(new.good):
            return new
        self.size = self.size or size_of_cycle(self.problem, x)
        return new._replace(
            good=np.asarray(size_of_cycle(self.problem, new.x) > LOCATED * self.size)
        )

    def event_rows(self, here: Step, new: Step) -> list[Event]:
        rows = common_rows(self)
        if self.problem.autonomous:
            self.duration = self.duration or float(here.observed.duration)
            remaining = lambda step: _LONG - float(step.observed.duration) / self.duration
            rows.append(Event(remaining, lambda at: Ending(at, "long")))
        for held in self.problem.conditions:
            if isinstance(held, HeldMultiplier):
                margin = lambda step, held=held: -held.dominance_margin(step.observed)
                rows.append(Event(margin, lambda at: Ending(at, "multiplier")))
        rows += self._lost_rows(here)
        return [*rows, *self._origin_events(here), *self.closing.rows(here, new)]

    def _partway(self, here: Step, last: Step, share: float) -> Step:
        return self.advance(here.x, here.tangent, share * distance_along(self.problem, here, last))

    def _point(self, kind: str, step: Step, *args: Any, **more: Any) -> Point:
        return point_at(self.problem, step, kind, *args, **more)

    def _end_with(self, kind: str, at: Step, detail: str, impact: int | None = None) -> Ending:
        return Ending(at, kind, self._point(kind, at, detail, impact))

    def _divided_rest(self, at: Step) -> Ending:
        """Return the end at which the force on a body falls to zero within its rest."""
        place = place_in_words(self.problem, at, float(at.observed.pull.clock))
        detail = f"a rest on a stop is divided {place}, where the force on the body falls to zero"
        return self._end_with(REST, at, detail)

    def _merged_rests(self, at: Step, release: int) -> Point:
        """Return the point at which two rests merge, of the motion without the flight between."""
        both = [release, (release + 1) % self.problem.legs]
        clock = float(self.problem.values(at.x)[0][release])
        place = place_in_words(self.problem, at, clock)
        detail = f"two rests on a stop become one: the body no longer leaves it {place}"
        old, at = in_one_parameter(self.problem, at)
        (number, *_), (new, x) = old.events[release], without_events(old, at.x, both)
        if all(event.number != number for event in new.events):  # a rest joins itself
            detail = f"a rest on a stop lasts for ever: the body no longer leaves it {place}"
            held = list(old.held) or [0.0] * len(old.machine.coordinates)
            held[stops_of(old.machine)[number].coordinate] = 1.0 + number
            new = dataclasses.replace(new, held=tuple(held))
        at = advance(new, x, np.eye(x.size)[-1], 0.0)
        return point_at(new, at, REST, detail, is_origin=True)

    def _lost_rows(self, here: Step) -> Iterator[Event]:
        """Yield the rows of lost events, of touches, and of changes in the order of events."""
        for i, event in enumerate(self.problem.events):
            approach = lambda step, i=i: float(step.observed.approach[i])
            if event.cycle is not None and not self.problem.conditions:
                hopf_ending = lambda at: self._end_with(HOPF, at, KINDS[HOPF].detail, 0)
                yield Event(approach, hopf_ending, partial(hopf_between, self.problem))
            yield Event(approach, partial(self._ending, here, impact=i))
        # Ignore rounding for events that always coincide.
        rounding = ROUNDING * self.problem.radian
        slack = 0.0 if here.observed.order_margin > rounding else rounding
        for i, event in enumerate(self.problem.landings):
            detail = "a rest on a stop is lost: its chatter lasts until the release"
            rest_ending = partial(self._end_with, REST, detail=detail, impact=event)
            yield Event(lambda step, i=i: -float(step.observed.escape_margin[i]), rest_ending)
        if self.problem.rests:
            yield Event(lambda step: step.observed.least_hold_force, self._divided_rest)
        new_mode = lambda _: "a switch goes into another mode: the motion sticks or slips anew"
        coincidence = partial(coincidence_in_words, self.problem)
        ended = partial(self._ending, here)
        yield Event(lambda step: step.observed.relative_clearance, ended)
        yield Event(lambda step: float(step.observed.modes_agree), partial(ended, text=new_mode))
        yield Event(
            lambda step: float(step.observed.order_margin) + slack, partial(ended, text=coincidence)
        )

    def _ending(
        self, here: Step, at: Step, *, impact: int | None = None,
        text: Callable[[Step], str] | None = None,
    ) -> Ending:  # fmt: skip
        flight = _brief_flight(self.problem, at)
        if flight is not None:
            return Ending(at, REST, self._merged_rests(at, flight))
        change = change_at(self.problem, at)
        if change is not None:
            at = locate_change(self.problem, at, change)
        if change is not None and change.kind is not None:
            switch_name = MotionEvent(change.number).name_on(self.problem.machine)
            place = place_in_words(self.problem, at, change.clock)
            detail = (KINDS[change.kind].parts or ())[change.exists]
            detail = detail.format(name=switch_name, place=place)
            switch = MotionEvent(change.number).of(self.problem.at(at.x))
            if change.kind != CROSSING_SLIDING and float(getattr(switch, "static_ratio", 1.0)) > 1:
                detail += ", by a jump, as static friction is larger"
            return self._end_with(change.kind, at, detail, impact)
        if text is not None:
            return self._end_with(GRAZING, at, text(at))
        detail = grazing_in_words(self.problem, at, impact)
        if impact is None:
            return self._end_with(GRAZING, at, detail)
        # At a lost impact a multiplier goes to infinity and returns from the other side. Its sign
        # is that of rounding, and the tests for bifurcations may have changed sign twice.
        steps = (self._partway(here, at, 1 - share) for share in _BEFORE_POLE)
        steps = (step for step in steps if bool(step.good))
        before_pole = next(steps, at)
        M, values = before_pole.observed.monodromy, before_pole.observed.multipliers
        at = at._replace(observed=at.observed._replace(monodromy=M, multipliers=values))
        while not np.abs(before_pole.observed.multipliers).max() < _LARGE:
            further = next(steps, None)
            if further is None:
                break
            before_pole = further
        return self._end_with(GRAZING, at, detail, impact)._replace(until=before_pole)

    def _origin_events(self, here: Step) -> Iterator[Event]:
        """Yield the rows of places where both halves of the period become equal, or images of each
        other. Beyond, the same motions repeat, half a period later or mirrored."""
        for kind, differ in ((DOUBLING, self._half_difference), (SYMMETRY, self.image_difference)):
            begin = differ(here)
            if np.linalg.norm(begin) < SAME:
                continue

            def ending(at: Step, kind=kind, differ=differ) -> Ending | None:
                if kind == DOUBLING:
                    found = self._find_origin(at)
                    if found is None:
                        return None
                    at, point = found
                elif np.linalg.norm(differ(at)) > ALIKE:
                    return None
                else:
                    at = self._crossing(here, at, FOLD)
                    point = self._point(kind, at, "the branch begins at a symmetric motion")
                # Tests change sign twice there: locate earlier events from a point just before.
                return Ending(at, kind, point, self._partway(here, at, 1 - ALIKE))

            product = lambda step, begin=begin, differ=differ: float(np.dot(begin, differ(step)))
            yield Event(product, ending)

    def stall_end(self, steps: list[Step]) -> Ending:
        """Return the end at the motion of half the period, if the branch begins at it close by."""
        size = np.linalg.norm(self._half_difference(steps[-1]))
        found = self._find_origin(steps[-1]) if size > SAME else None
        return super().stall_end(steps) if found is None else Ending(found[0], DOUBLING, found[1])

    def _find_origin(self, at: Step) -> tuple[Step, Point] | None:
        """Return the step where the branch begins at a motion of half the period, and that one."""
        size, start = np.linalg.norm(self._half_difference(at)), in_one_parameter(self.problem, at)
        if size > NEARBY:
            return None
        begins, half, step = locate_origin(*start)
        if size > ALIKE and begins is start[1]:
            return None
        at = at if self.problem.conditions else begins
        detail = "the branch begins at a motion of half the period"
        point = point_at(half, step, DOUBLING, detail, is_origin=True)
        return at, dataclasses.replace(point, further=further_of(self.problem, at))

    def points_between(self, here: Step, last: Step) -> Located:
        """Return bifurcations, extrema and zeros of watched functions between two points,
        sorted."""
        before, self._last_steps = self._last_steps, (here, last)
        middle = None
        if before is not None and before[1] is here:
            middle = self._dip_between(before[0], here, last)
        steps = (here, last) if middle is None else (here, middle, last)
        found = [*self._split_bifurcations(steps, _MOST_HALVINGS), *self._zeros(here, last)]
        return sorted(found, key=lambda f: distance_along(self.problem, here, f[1]))

    def _zeros(self, here: Step, last: Step) -> Iterator[tuple[Point, Step]]:
        """Yield local extrema of quantities, and zeros of watched functions."""
        known_x, before = self._last_numbers
        is_first = not before
        before = before if np.array_equal(known_x, here.x) else self._numbers(here)
        self._last_numbers = last.x, self._numbers(last)
        for (kind, name), (value, begin) in before.items():
            other, end = self._last_numbers[1][kind, name]
            steep, least = max(abs(begin), abs(end)), ROUNDING * max(abs(value), abs(other))
            # A zero at the first motion counts on the way on which the function falls.
            starts_at_zero = is_first and kind == WATCHED and begin == 0 > end
            if not (starts_at_zero or passes_zero(begin, end)):
                continue
            if kind == EXTREMUM and steep <= least:
                continue
            at = self.locate_zero(here, last, lambda s, k=(kind, name): self._numbers(s)[k][1])
            if at is None:
                continue
            value_at_zero, rate = self._numbers(at)[kind, name]
            if kind == WATCHED:
                is_real, detail = abs(value_at_zero) <= LOCATED * steep, f"{name} passes zero"
            else:
                sense, extreme = (1, "largest") if begin > 0 else (-1, "least")
                # Otherwise it has a pole, as a multiplier at a grazing.
                is_real = sense * value_at_zero >= max(sense * value, sense * other) - least
                corner = ", with a corner" if abs(rate) > FAINT * steep else ""
                detail = f"{name} = {value_at_zero:.10g} is the {extreme} nearby{corner}"
            if is_real:
                yield self._point(kind, at, detail, quantity=name), at

    def _numbers(self, step: Step) -> dict[tuple[str, str], tuple[float, float]]:
        """Return the value of each sought quantity, and the number that vanishes: rate or value."""
        found = {}
        if self.extrema:
            direction = step.tangent * self.scale
            values, rates = rates_at(self.problem, self.extrema, step.x, direction)
            found = {(EXTREMUM, n): (float(values[n]), float(rates[n])) for n in self.extrema}
        if self.watched:
            orbit = orbit_of(*in_one_parameter(self.problem, step))
            values = {name: float(function(orbit)) for name, function in self.watched.items()}
            found |= {(WATCHED, name): (x, x) for name, x in values.items()}
        return found

    def _bifurcations(self, here: Step, last: Step, halves_left: int) -> Located:
        """Return the bifurcations between two points, from the tests that change sign. If they do
        not explain the change of the number of multipliers outside the unit circle, the step is
        halved: two that cross together leave no sign change."""
        held = bool(self.problem.conditions)
        kinds, found, explained = _changed_tests(here, last, held=held), [], 0
        sides = self._separate_turn(here, last) if TURNS in kinds and not held else ()
        if sides:
            return self._split_bifurcations((here, *sides, last), halves_left)
        for kind in kinds:
            at = self._bifurcation(kind, here, last)
            found, explained = [*found, *at], explained + len(at) * _CROSSING_MULTIPLIERS[kind]
        before, after = _outside_count(here), _outside_count(last)
        if before is None or after is None:
            return found
        change = abs(after - before)
        if change <= explained and (explained - change) % 2 == 0:
            return found
        middle = self._partway(here, last, 0.5) if halves_left else None
        if middle is None or not bool(middle.good):
            return self._double_bifurcation(here, last) or found
        return self._split_bifurcations((here, middle, last), halves_left - 1)

    def _dip_between(self, before: Step, here: Step, last: Step) -> Step | None:
        """Return a point between two at which a test has the other sign than at both: two
        bifurcations in one step. The parabola through three points says where to look."""
        length = distance_along(self.problem, here, last)
        earlier = -distance_along(self.problem, before, here)
        ends = [(s, step, bifurcation_tests(step)) for s, step in ((0.0, here), (length, last))]
        first = earlier, before, bifurcation_tests(before)
        for kind in ends[0][2]:
            points = [first, *ends]
            for _ in range(_MOST_PARABOLAS):
                place = dip_of([s for s, _, _ in points], [tests[kind] for *_, tests in points])
                if place is None or not 0 < place < length:
                    break
                step = self.advance(here.x, here.tangent, place)
                if not bool(step.good):
                    break
                tests = bifurcation_tests(step)
                if tests[kind] * ends[0][2][kind] < 0:
                    return step
                points = [ends[0], (place, step, tests), ends[1]]
        return None

    def _split_bifurcations(self, steps: tuple[Step, ...], halves_left: int) -> Located:
        parts = (self._bifurcations(a, b, halves_left) for a, b in itertools.pairwise(steps))
        return list(itertools.chain.from_iterable(parts))

    def _separate_turn(self, here: Step, last: Step) -> tuple[Step, ...]:
        """Return two points around a fold within a step that also contains a branch point, or none.
        At the fold the branch turns back and a multiplier passes 1. If both are closer to each
        other than `SPACING`, they count as one branch point."""
        at = self.locate_zero(here, last, lambda step: bifurcation_tests(step)[TURNS])
        if at is None:
            return ()
        root, length = (distance_along(self.problem, here, step) for step in (at, last))
        if not SPACING < root < length - SPACING:
            return ()
        sides = [self.advance(here.x, here.tangent, root + x) for x in (-SPACING, SPACING)]
        passes = [bifurcation_tests(step)[CROSSING] for step in sides]
        # A point on the crossing branch has another tangent.
        alike = np.dot(sides[0].tangent, sides[1].tangent) > SAME_CURVE
        is_fold = alike and all(bool(step.good) for step in sides) and passes[0] * passes[1] < 0
        return tuple(sides) if is_fold else ()

    def _double_bifurcation(self, here: Step, last: Step) -> Located:
        """Return the place between two close points where multipliers cross the circle together."""
        outside = _outside_count(here)
        at = self.locate_zero(here, last, lambda s: 1.0 if _outside_count(s) == outside else -1.0)
        if at is None:
            return []
        if float(here.tangent[-1]) * float(last.tangent[-1]) < 0:  # other branches cross as well
            at = self._crossing(here, at, FOLD)
        for kind, distances in _distances_from_circle(at).items():
            if np.sum(np.abs(distances) < 10 * ON_CIRCLE) > (2 if kind == TORUS else 1):
                return [(self._point(kind, at, f"{KINDS[kind].detail}; twice, at once"), at)]
        return []

    def _bifurcation(self, kind: str, here: Step, last: Step) -> Located:
        at = self.locate_zero(here, last, lambda step: bifurcation_tests(step)[kind])
        if at is None:
            return []
        held = bool(self.problem.conditions)
        if kind in (FOLD, TURNS) and not held and not _turns_back(here, at, last, self.scale):
            return []  # rounding: the tangent is ill-defined close to a crossing of branches
        if kind in (FOLD, TURNS, CROSSING) and self._shrinks_to_rest(here, at, last):
            return []  # a multiplier is 1 there to rounding
        if kind in (FOLD, TURNS, CROSSING) and vanishing_part(self.problem, at, FAINT):
            return []  # a part of the motion vanishes: solutions with and without it cross
        if kind in (FOLD, TURNS, CROSSING) and self._begins_at(here, at):
            return []  # both tests are zero there
        if held and kind == TURNS:
            return [(self._point(TURN, at, KINDS[TURN].detail), at)]
        if kind == TURNS or (kind == CROSSING and (self.symmetric or not held)):
            at = self._crossing(here, at, kind)
        if np.abs(_distances_from_circle(at)[kind]).min(initial=np.inf) >= ON_CIRCLE:
            return []  # a pole of the determinant, or a real pair μ, 1/μ
        detail = _BEGINS if kind == TURNS else KINDS[kind].detail
        if kind == TURNS:
            kind = CROSSING
        elif kind == CROSSING and self.symmetric and self._asymmetry(at) < ALIKE:
            kind, detail = SYMMETRY, KINDS[SYMMETRY].detail
        elif kind == CROSSING and held:
            kind, detail = FOLD, "a multiplier passes 1"
        return [(self._point(kind, at, detail), at)]

    def _shrinks_to_rest(self, here: Step, at: Step, last: Step) -> bool:
        if not self.problem.autonomous:
            return False
        size, *neighbours = (size_of_cycle(self.problem, step.x) for step in (at, here, last))
        return size < NEARBY * max(neighbours)

    def _begins_at(self, here: Step, at: Step) -> bool:
        """Return whether the branch begins there: halves of a period are equal, or images."""
        halves, images = self._half_difference(at), self.image_difference(at)
        if halves.size and np.linalg.norm(halves) < ALIKE:
            return True
        before = np.linalg.norm(self.image_difference(here))
        return bool(images.size and np.linalg.norm(images) < ALIKE and before > SAME)

    def _crossing(self, here: Step, at: Step, kind: str) -> Step:
        def admits(step: Step, length: float) -> bool:
            # So close to the crossing the corrector may find the other branch.
            return not self.symmetric or (kind == FOLD) != (self._asymmetry(step) < ALIKE * SPACING)

        root = distance_along(self.problem, here, at)
        test = lambda step: bifurcation_tests(step)[kind]
        return crossing(self.problem, self.advance, here, root, test, admits) or at

    def _half_difference(self, step: Step) -> np.ndarray:
        """Return the difference of the period's halves; empty if they cannot be equal."""
        return half_difference(self.problem, step) if may_repeat(self.problem) else np.zeros(0)

    def _asymmetry(self, step: Step) -> float:
        return float(np.linalg.norm(self.image_difference(step)))


def _brief_flight(problem: Shooting, at: Step) -> int | None:
    """Return the index of the release of the shortest flight, if it is brief and to its stop."""
    if not problem.landings:
        return None
    lengths = problem.lengths(at.x)
    first = int(np.argmin(lengths))
    leaving, after = (problem.events[i % problem.legs] for i in (first, first + 1))
    lands = leaving.use == LEAVES and after == leaving._replace(use=LANDS)
    return first if lands and lengths[first] < BRIEF * problem.radian else None


# The number of multipliers that cross the unit circle at a change of sign of each test.
_CROSSING_MULTIPLIERS = {FOLD: 1, TURNS: 0, DOUBLING: 1, CROSSING: 1, TORUS: 2}


def _changed_tests(here: Step, last: Step, *, held: bool) -> list[str]:
    """Return the tests that change sign from one step to another. At a fold the parameter turns
    back as a multiplier passes 1. If only the parameter turns back, the multiplier touches 1, and
    the branch leaves another one to both sides. If quantities are `held`, the two are
    independent."""
    before, after = bifurcation_tests(here), bifurcation_tests(last)
    changed = [kind for kind in before if passes_zero(before[kind], after[kind])]
    # Without damping a pair stays on the unit circle, to rounding of either sign.
    if TORUS in changed and max(abs(before[TORUS]), abs(after[TORUS])) < ROUNDING:
        changed.remove(TORUS)
    if held and FOLD in changed:
        changed.remove(FOLD)
    elif FOLD in changed:
        dropped = (CROSSING, TURNS) if CROSSING in changed else (FOLD,)
        changed = [kind for kind in changed if kind not in dropped]
    return changed


def _distances_from_circle(step: Step) -> dict[str, np.ndarray]:
    """Return the distances of the multipliers from the crossing of each kind."""
    values = step.observed.multipliers
    one, complex_ones = values - 1, np.abs(values[np.abs(values.imag) > 1e-9])
    return {
        DOUBLING: values + 1, TORUS: complex_ones - 1, FOLD: one, TURNS: one, CROSSING: one,
    }  # fmt: skip


def _outside_count(step: Step) -> int | None:
    """Return the number of multipliers outside the unit circle, or `None` if one is on it."""
    sizes = np.abs(step.observed.multipliers)
    if not np.isfinite(sizes).all() or (np.abs(sizes - 1) < ROUNDING).any():
        return None
    return int(np.sum(sizes > 1))


def _turns_back(here: Step, at: Step, last: Step, scale: np.ndarray) -> bool:
    sides = [(float(at.x[-1]) - float(step.x[-1])) / scale[-1] for step in (here, last)]
    return bool(sides[0] * sides[1] > 0 and min(map(abs, sides)) > 1e-12)
