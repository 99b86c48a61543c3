"""Following a branch: what happens between two of its points, and when it ends."""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax.numpy as jnp
import numpy as np

from ._closing import Closing
from ._conditions import alone, overtaken
from ._crossing import BESIDE, changed_between, crossing, tests_of, turns_back
from ._extrema import Extrema
from ._hopf import size_of
from ._lost import first_lost
from ._named import named
from ._origin import halves, origin
from ._past_section import why_stalled
from ._refined_sliding import refined
from ._sequence import BETWEEN_RESTS, changed_sequence
from ._shooting import Shooting
from ._sliding import change_at
from ._solution import orbit_of
from ._solve import advance, images_at, located
from ._symmetry import ALIKE, ROUNDED, may_be_symmetric
from ._words import DETAILS, HELD_FOLD, RESTS
from .curve import SHORTER, Step, way
from .special import (
    CROSSING,
    DOUBLING,
    EXTREMUM,
    FOLD,
    GRAZING,
    SYMMETRY,
    TORUS,
    TURN,
    SpecialPoint,
)

# The thresholds here are choices, but for those of which a measurement is given.
# What lies before the place where a branch springs is looked for on so much of the way there.
_SHORT = 0.999

# And what lies before an impact that is lost, where the monodromy matrix has a pole: on so much.
_BEFORE_POLE = 1 - 1e-6

# An autonomous motion of so much of the size of another is rest: what solves its equations there is
# an equilibrium.
_STILL = 1e-6

# One of so much of the size of its neighbours is about to shrink to rest.
_SHRINKS = 1e-2

# A motion so many times as long as that from which a branch begins has steps as much longer. Of a
# rimless wheel towards its homoclinic motion the multiplier is right to 2e-12 then.
_LONG = 4.0

# A step of a curve whose tangent turns by less than 26° (as `walk` asks) lies within half that of
# its first tangent: so far off, as the cosine, it is another curve, beyond a jump of the equations.
# Steps no longer than the second are rounding.
_ASIDE, _TINY = 0.9, 1e-6


class BranchMonitor:
    """Looks at each step of a walk along a branch: locates what happens in it and says when to end.

    **Arguments:** the equations of the motions, with the parameter as their last unknown; the size
    of each unknown; the intervals of its parameters, in their order; names of the numbers whose
    extremes are sought.
    """

    def __init__(
        self, problem: Shooting, scale: np.ndarray, bounds: list[tuple[float, float]],
        extrema: tuple[str, ...] = (),
    ):  # fmt: skip
        self.problem, self.scale, self.bounds = problem, scale, bounds
        self.extrema = Extrema(problem, extrema, scale)
        self.symmetric = may_be_symmetric(problem, [problem.machine, *problem.corners(bounds)])
        self.special: list[SpecialPoint] = []
        self.between: dict[int, list[Step]] = {}
        self.whole: dict[int, Step] = {}  # steps of special points, by what is observed there
        self.short: dict[int, Step] = {}  # and those right before them, where an impact is lost
        self.closing = Closing(problem, scale)
        self.size, self.duration = None, None

    def advance(self, x, tangent, length) -> Step:
        """The point at this length along the tangent."""
        new = advance(self.problem, x, tangent, self.scale, length)
        gone = float(np.linalg.norm((new.x - np.asarray(x)) / self.scale))
        if gone > _TINY and not abs(length) >= _ASIDE * gone:
            return new._replace(good=np.asarray(False))
        if not self.problem.autonomous or not bool(new.good):
            return new
        if self.size is None:
            self.size = size_of(self.problem, x)
        return new._replace(good=np.asarray(size_of(self.problem, new.x) > _STILL * self.size))

    def stop(self, here: Step, new: Step) -> tuple[Step, str] | None:
        """The last point of the branch, and why it ends between these two; `None` if it goes on."""
        reason, last = None, new
        for i, (low, high) in enumerate(self.bounds, -len(self.bounds)):
            if not low <= last.x[i] <= high:
                bound = low if last.x[i] < low else high
                last = self._where(here, last, lambda s, i=i, at=bound: float(s.x[i]) - at) or here
                reason = "bounds"
        if self._lengthened(here, last) > 0:
            last = self._where(here, last, lambda step: self._lengthened(here, step)) or here
            reason = "long"
        if overtaken(self.problem, last) > 0:
            last = self._where(here, last, lambda step: overtaken(self.problem, step)) or here
            reason = "multiplier"
        grazing = self._grazing(here, last) or self._sequence(here, last)
        if isinstance(grazing, str):
            return here, grazing
        if grazing is not None:
            last, reason = self.whole[id(grazing.step.seen)], grazing.kind
        if reason is None:
            again = self.closing.between(here, new, lambda test: self._where(here, new, test))
            last, reason = (new, None) if again is None else (again, "closed")
        spring = self._bifurcations(here, last, self.short.get(id(last.seen), last))
        if spring is not None:
            return spring, self.special[-1].kind
        if grazing is not None:
            self.special.append(grazing)
        return None if reason is None else (last, reason)

    def refine(self, problem: Shooting) -> None:
        """Go on with the same equations in more steps."""
        self.problem = self.extrema.problem = self.closing.problem = problem

    def stalled(self, steps: list[Step]) -> tuple[Step, str]:
        """The last point of a branch that the corrector follows no further, and why it ends."""
        last, reason = why_stalled(self.problem, steps[-1], self.scale)
        if reason == GRAZING:
            self.special.append(self._point(GRAZING, last, BETWEEN_RESTS))
        return last, reason

    def _lengthened(self, here: Step, new: Step) -> float:
        """By how much an autonomous motion is longer than its steps, as many as ever, allow."""
        if not self.problem.autonomous:
            return -1.0
        self.duration = float(here.seen.duration) if self.duration is None else self.duration
        return float(new.seen.duration) / self.duration - _LONG

    def _where(self, here: Step, new: Step, test: Callable[[Step], float]) -> Step | None:
        """The point between two at which a test is zero."""
        return located(self.problem, here, new, self.scale, test)

    def _point(self, kind: str, step: Step, detail: str, impact: int | None = None) -> SpecialPoint:
        self.whole[id(step.seen)] = step
        problem, step, scale = alone(self.problem, step, self.scale)
        orbit = orbit_of(problem, step)
        return SpecialPoint(
            kind, float(step.x[-1]), orbit, detail, problem, step, scale, impact
        )  # fmt: skip

    def _sprung(self, at: Step) -> tuple[Step, SpecialPoint]:
        """Where the branch springs from a motion of half its period: as a step of the branch, and
        as a special point of that motion."""
        begins, half, step = origin(*alone(self.problem, at, self.scale))
        at = at if self.problem.conditions else begins
        detail = "the branch springs from a motion of half the period"
        scale = np.append(np.ones(step.x.size - 1), self.scale[-1])
        return at, SpecialPoint(
            DOUBLING, float(step.x[-1]), orbit_of(half, step), detail, half, step, scale,
            springs=True,
        )  # fmt: skip

    def _grazing(self, here: Step, new: Step) -> SpecialPoint | None:
        """The first of the impacts lost and the stops touched between two points."""
        first = first_lost(self.problem, here, new, self.scale)
        if first is None:
            return None
        at, impact = first
        change = None if impact == RESTS else change_at(self.problem, at)
        at = at if change is None else refined(self.problem, at, change)
        kind, detail = named(self.problem, at, impact, change)
        impact = 0 if impact == RESTS else None if impact in DETAILS else impact
        if kind == GRAZING and impact is not None:
            short = self._before_pole(here, at)
            M, values = short.seen.monodromy, short.seen.multipliers
            at = at._replace(seen=at.seen._replace(monodromy=M, multipliers=values))
            self.short[id(at.seen)] = short
        return self._point(kind, at, detail, impact)

    def _sequence(self, here: Step, last: Step) -> SpecialPoint | str | None:
        """Where a motion that rests gains or loses one of its rests or impacts; `SHORTER` if the
        step has to be shorter to tell."""
        found = changed_sequence(self.problem, here, last, self.scale)
        if found is None:
            return None
        kind, at, detail = found
        return SHORTER if kind == SHORTER else self._point(kind, at, detail)

    def _before_pole(self, here: Step, last: Step) -> Step:
        """Right before a place where an impact is lost.

        There a multiplier goes to infinity, and comes back from the other side: its sign is that of
        rounding, and the tests for bifurcations may have changed twice.
        """
        end = self._on_the_way(here, last, _BEFORE_POLE)
        return end if bool(end.good) else last

    def _bifurcations(self, here: Step, last: Step, end: Step) -> Step | None:
        """Record what happens between two points, as far as `end`; the point where the branch
        springs, if met.

        There the two halves of the period become alike, or images of each other, and beyond it the
        same motions come again, observed half a period later or in the mirror.
        """
        alike = partial(halves, self.problem)
        for kind, difference in ((DOUBLING, alike), (SYMMETRY, self._images)):
            begin = difference(here)

            def along(step: Step, begin=begin, difference=difference) -> float:
                return float(np.dot(begin, difference(step)))

            if np.linalg.norm(begin) < ROUNDED or along(last) >= 0:
                continue
            at = self._where(here, last, along)
            if at is None or np.linalg.norm(difference(at)) > ALIKE:
                continue
            if kind == DOUBLING:
                at, point = self._sprung(at)
            else:
                at = self._crossing(here, at, FOLD)
                point = self._point(kind, at, "the branch springs from a symmetric motion")
            # Beyond it the tests have changed twice: what lies before it shows short of it.
            found = self._changes(here, self._on_the_way(here, at, _SHORT))
            self.between[id(at)] = found
            self.special.append(point)
            return at
        self.between[id(last)] = self._changes(here, end)
        return None

    def _on_the_way(self, here: Step, last: Step, share: float) -> Step:
        """The point at this share of the way between two."""
        length = way(here, last, self.scale)
        return self.advance(here.x, here.tangent, share * length)

    def _changes(self, here: Step, last: Step) -> list[Step]:
        """Record the bifurcations between two points, by the tests that change their signs.

        **Returns:** where they are, in their order.
        """
        before, after = tests_of(here), tests_of(last)
        changed = changed_between(before, after)
        held = bool(self.problem.conditions)
        both = FOLD in changed and CROSSING in changed and not held
        if both:
            changed.remove(CROSSING)
        found = []
        for kind in changed:
            at = self._where(here, last, lambda step, kind=kind: tests_of(step)[kind])
            if at is None:
                continue
            if kind == FOLD and not both and not turns_back(here, at, last, self.scale):
                continue  # rounding: the tangent is ill-defined close to where branches cross
            if kind in (FOLD, CROSSING) and self._shrinks(here, at, last):
                continue  # it has a multiplier 1 to rounding
            if kind in (FOLD, CROSSING) and self._springs(here, at):
                continue  # both are zero there
            if held and kind == FOLD:
                found.append((self._point(TURN, at, DETAILS[TURN]), at))
                continue
            if kind == CROSSING and (self.symmetric or not held):
                at = self._crossing(here, at, CROSSING)
            values = at.seen.multipliers
            complex_ones = np.abs(values[np.abs(values.imag) > 1e-9])
            off = {DOUBLING: values + 1, TORUS: complex_ones - 1}.get(kind, values - 1)
            # Else it is a pole of the determinant, or a real pair μ, 1/μ.
            if np.abs(off).min(initial=np.inf) < 1e-5:
                if kind == CROSSING and self.symmetric and self._apart(at) < ALIKE:
                    kind = SYMMETRY
                kind = FOLD if held and kind == CROSSING else kind
                detail = HELD_FOLD if held and kind == FOLD else DETAILS[kind]
                found.append((self._point(kind, at, detail), at))
        for at, name, detail in self.extrema.between(here, last, self._where):
            point = self._point(EXTREMUM, at, detail)
            found.append((dataclasses.replace(point, quantity=name), at))
        found.sort(key=lambda f: float(np.dot(here.tangent, f[1].x - here.x)))
        self.special += [point for point, _ in found]
        return [at for _, at in found]

    def _shrinks(self, here: Step, at: Step, last: Step) -> bool:
        """Whether an autonomous motion is about to shrink to rest."""
        if not self.problem.autonomous:
            return False
        size, *beside = (size_of(self.problem, step.x) for step in (at, here, last))
        return size < _SHRINKS * max(beside)

    def _springs(self, here: Step, at: Step) -> bool:
        """Whether the branch springs there: halves of a period are alike, or images."""
        apart, images = halves(self.problem, at), self._images(at)
        if apart.size and np.linalg.norm(apart) < ALIKE:
            return True
        before = np.linalg.norm(self._images(here))
        close = np.linalg.norm(images) < min(ALIKE, 0.5 * before)
        return bool(images.size and close and before > ROUNDED)

    def _crossing(self, here: Step, at: Step, kind: str) -> Step:
        """The point where branches cross (see `crossing`)."""

        def admits(step: Step, length: float) -> bool:
            # So close to where they cross the corrector may find the other branch.
            return not self.symmetric or (kind == FOLD) != (self._apart(step) < ALIKE * BESIDE)

        root = way(here, at, self.scale)
        tested = lambda step: tests_of(step)[kind]
        return crossing(self.problem, self.advance, here, root, tested, admits) or at

    def _images(self, step: Step) -> np.ndarray:
        """How far the motion is from being its own image; empty if it cannot be."""
        if not self.symmetric:
            return np.zeros(0)
        return np.asarray(images_at(self.problem, jnp.asarray(step.x)))

    def _apart(self, step: Step) -> float:
        return float(np.linalg.norm(self._images(step)))

    def path(self, steps: list[Step]) -> list[Step]:
        """The steps of a walk with the bifurcations located between them."""
        return [step for new in steps for step in [*self.between.get(id(new), ()), new]]
