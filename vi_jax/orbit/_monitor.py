"""Following a branch: what happens between two of its points, and when it ends."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..machine import with_leaf
from ._events import Event
from ._hopf import hopf_between, size_of
from ._origin import halves, origin
from ._shooting import Shooting
from ._solution import orbit_of
from ._solve import advance, images_at, located, observe
from ._symmetry import may_be_symmetric
from .curve import Step
from .special import CROSSING, DOUBLING, FOLD, GRAZING, HOPF, SYMMETRY, TORUS, SpecialPoint

# The thresholds here are choices, but for those of which a measurement is given.
# What lies before the place where a branch springs is looked for on so much of the way there.
_SHORT = 0.999

# How far beside a point where branches cross (in the norm of the scaled unknowns) it is looked at.
_BESIDE = 1e-3

# An autonomous motion of so much of the size of another is rest: what solves its equations there is
# an equilibrium.
_STILL = 1e-6

# One of so much of the size of its neighbours is about to shrink to rest.
_SHRINKS = 1e-2

# A motion so many times as long as that from which a branch begins has steps as much longer. Of a
# rimless wheel towards its homoclinic motion the multiplier is right to 2e-12 then.
_LONG = 4.0

# Events that are to come together do so within this.
_TOGETHER = 1e-9

# Stand in the place of the number of an impact, for what grazes without being one.
_REORDERED, _RESTS, _ANEW = -1, -2, -3

# What is said of a special point, by its kind or by what stands for the impact.
_DETAILS = {
    FOLD: "a multiplier passes 1 and the branch turns back",
    DOUBLING: "a multiplier passes -1",
    CROSSING: "a multiplier passes 1 and another branch crosses",
    SYMMETRY: "a multiplier passes 1 and the motion loses its symmetry",
    TORUS: "a complex pair of multipliers leaves the unit circle",
    _REORDERED: "two of its events fall together, and come in another order beyond",
    _ANEW: "a switch goes into another mode: the motion sticks or slips anew",
}

# Halves of a period that differ by less than this are those of a motion of half the period.
_ALIKE = 1e-3

# And by less than this but for rounding.
_NOISE = 1e-7


class BranchMonitor:
    """Looks at each step of a walk along a branch: locates what happens in it and says when to end.

    **Arguments:** the equations of the motions, with the parameter as their last unknown; the size
    of each unknown; the interval of the parameter.
    """

    def __init__(self, problem: Shooting, scale: np.ndarray, bounds: tuple[float, float]):
        self.problem, self.scale, self.bounds = problem, scale, bounds
        machine, (name,) = problem.machine, problem.parameters
        self.symmetric = may_be_symmetric(
            problem, [machine, *(with_leaf(machine, name, bound) for bound in bounds)]
        )
        self.special: list[SpecialPoint] = []
        self.between: dict[int, list[Step]] = {}
        self.start: Step | None = None
        self.away, self.size, self.duration = False, None, None

    def advance(self, x, tangent, length) -> Step:
        """The point at this length along the tangent."""
        new = advance(self.problem, x, tangent, self.scale, length)
        if not self.problem.autonomous or not bool(new.good):
            return new
        if self.size is None:
            self.size = size_of(self.problem, x)
        return new._replace(good=np.asarray(size_of(self.problem, new.x) > _STILL * self.size))

    def stop(self, here: Step, new: Step) -> tuple[Step, str] | None:
        """The last point of the branch, and why it ends between these two; `None` if it goes on."""
        reason, last = None, new
        low, high = self.bounds
        if not low <= new.x[-1] <= high:
            bound = low if new.x[-1] < low else high
            last = self._where(here, new, lambda step: float(step.x[-1]) - bound) or here
            reason = "bounds"
        elif self._lengthened(here, new) > 0:
            last = self._where(here, new, lambda step: self._lengthened(here, step)) or here
            reason = "long"
        grazing = self._grazing(here, last)
        if grazing is not None:
            last, reason = grazing.step, grazing.kind
        spring = self._bifurcations(here, last)
        if spring is not None:
            return spring, self.special[-1].kind
        if grazing is not None:
            self.special.append(grazing)
        elif reason is None and self._closed(here, new):
            return here, "closed"
        return None if reason is None else (last, reason)

    def _lengthened(self, here: Step, new: Step) -> float:
        """By how much an autonomous motion is longer than its steps, as many as ever, allow."""
        if not self.problem.autonomous:
            return -1.0
        self.duration = float(here.seen.duration) if self.duration is None else self.duration
        return float(new.seen.duration) / self.duration - _LONG

    def _closed(self, here: Step, new: Step) -> bool:
        self.start = here if self.start is None else self.start
        apart = float(np.linalg.norm((new.x - self.start.x) / self.scale))
        length = float(np.linalg.norm((new.x - here.x) / self.scale))
        self.away = self.away or apart > 3 * length
        return self.away and apart < 0.5 * length

    def _where(self, here: Step, new: Step, test: Callable[[Step], float]) -> Step | None:
        """The point between two at which a test is zero."""
        return located(self.problem, here, new, self.scale, test)

    def _point(self, kind: str, step: Step, detail: str, impact: int | None = None) -> SpecialPoint:
        return SpecialPoint(
            kind, float(step.x[-1]), orbit_of(self.problem, step), detail, self.problem, step,
            self.scale, impact,
        )  # fmt: skip

    def _sprung(self, at: Step) -> tuple[Step, SpecialPoint]:
        """Where the branch springs from a motion of half its period: as a step of the branch, and
        as a special point of that motion."""
        at, half, step = origin(self.problem, at, self.scale)
        detail = "the branch springs from a motion of half the period"
        scale = np.append(np.ones(step.x.size - 1), self.scale[-1])
        return at, SpecialPoint(
            DOUBLING, float(step.x[-1]), orbit_of(half, step), detail, half, step, scale,
            springs=True,
        )  # fmt: skip

    def _grazing(self, here: Step, new: Step) -> SpecialPoint | None:
        """The first of the impacts lost and the stops touched between two points."""
        found, tests = [], []

        def room(step: Step) -> float:
            return float(np.clip(step.seen.nearest.room, -1.0, 1.0))

        for i, event in enumerate(self.problem.events):
            if new.seen.approach[i] <= 0 < here.seen.approach[i]:
                hopf = None if event.cycle is None else hopf_between(self.problem, here, new)
                if hopf is not None:
                    found.append((hopf, _RESTS))
                else:
                    tests.append((lambda step, i=i: float(step.seen.approach[i]), i))
        if room(new) < 0 < room(here):
            tests.append((room, None))
        if new.seen.order < 0 < here.seen.order:
            tests.append((lambda step: float(step.seen.order), _ANEW))
        if new.seen.apart < -_TOGETHER < here.seen.apart:
            tests.append((lambda step: float(step.seen.apart) + _TOGETHER, _REORDERED))
        for test, impact in tests:
            at = self._where(here, new, test)
            if at is not None:
                found.append((at, impact))
        if not found:
            return None
        at, impact = min(found, key=lambda f: float(np.dot(here.tangent, f[0].x - here.x)))
        if impact in _DETAILS:
            return self._point(GRAZING, at, _DETAILS[impact])
        if impact == _RESTS:
            return self._point(HOPF, at, "the motion shrinks to rest", 0)
        if impact is None:
            machine, touched = self.problem.machine, int(at.seen.nearest.event)
            guard = f"the guard of {Event(touched).called(machine)}"
            what = "a stop" if touched < len(machine.stops) else guard
            detail = f"touches {what} at {self._place(at, float(at.seen.nearest.clock))}"
        else:
            clock = float(np.asarray(self.problem.parts(jnp.asarray(at.x))[0])[impact])
            lost = self.problem.events[impact].of(self.problem.machine)
            detail = f"the {lost.name or lost.word} at {self._place(at, clock)} is lost"
        return self._point(GRAZING, at, detail, impact)

    def _place(self, at: Step, clock: float) -> str:
        """A reading of the clock of impacts, in words, within one period from the section on."""
        period = float(self.problem.period(jnp.asarray(at.x)))
        return self.problem.machine.place_of(clock % period, self.problem.cycles)

    def _bifurcations(self, here: Step, last: Step) -> Step | None:
        """Record what happens between two points; the point where the branch springs, if met.

        There the two halves of the period become alike, or images of each other, and beyond it the
        same motions come again, observed half a period later or in the mirror.
        """
        for kind, difference in ((DOUBLING, self._halves), (SYMMETRY, self._images)):
            begin = difference(here)

            def along(step: Step, begin=begin, difference=difference) -> float:
                return float(np.dot(begin, difference(step)))

            if np.linalg.norm(begin) < _NOISE or along(last) >= 0:
                continue
            at = self._where(here, last, along)
            if at is None or np.linalg.norm(difference(at)) > _ALIKE:
                continue
            if kind == DOUBLING:
                at, point = self._sprung(at)
            else:
                at = self._crossing(here, at, FOLD)
                point = self._point(kind, at, "the branch springs from a symmetric motion")
            # Beyond it the tests have changed twice: what lies before it shows short of it.
            length = float(np.dot(here.tangent, (at.x - here.x) / self.scale))
            found = self._changes(here, self.advance(here.x, here.tangent, _SHORT * length))
            self.between[id(at)] = found
            self.special.append(point)
            return at
        self.between[id(last)] = self._changes(here, last)
        return None

    def _changes(self, here: Step, last: Step) -> list[Step]:
        """Record the bifurcations between two points, by the tests that change their signs.

        **Returns:** where they are, in their order.
        """
        before, after = _tests(here), _tests(last)
        changed = [kind for kind in before if before[kind] * after[kind] < 0]
        both = FOLD in changed and CROSSING in changed
        if both:
            changed.remove(CROSSING)
        found = []
        for kind in changed:
            at = self._where(here, last, lambda step, kind=kind: _tests(step)[kind])
            if at is None:
                continue
            if kind == FOLD and not both and not self._turns_back(here, at, last):
                continue  # rounding: the tangent is ill-defined close to where branches cross
            if kind in (FOLD, CROSSING) and self._shrinks(here, at, last):
                continue  # it has a multiplier 1 to rounding
            if kind in (FOLD, CROSSING) and self._springs(here, at):
                continue  # both are zero there
            if kind == CROSSING:
                at = self._crossing(here, at, CROSSING)
            values = at.seen.multipliers
            complex_ones = np.abs(values[np.abs(values.imag) > 1e-9])
            off = {DOUBLING: values + 1, TORUS: complex_ones - 1}.get(kind, values - 1)
            # Else it is a pole of the determinant, or a real pair μ, 1/μ.
            if np.abs(off).min(initial=np.inf) < 1e-5:
                found.append((float(np.dot(here.tangent, at.x - here.x)), kind, at))
        found.sort(key=lambda f: f[0])
        for _, kind, at in found:
            if kind == CROSSING and self.symmetric and self._apart(at) < _ALIKE:
                kind = SYMMETRY
            self.special.append(self._point(kind, at, _DETAILS[kind]))
        return [at for _, _, at in found]

    def _shrinks(self, here: Step, at: Step, last: Step) -> bool:
        """Whether an autonomous motion is about to shrink to rest."""
        if not self.problem.autonomous:
            return False
        size, *beside = (size_of(self.problem, step.x) for step in (at, here, last))
        return size < _SHRINKS * max(beside)

    def _springs(self, here: Step, at: Step) -> bool:
        """Whether the branch springs there: halves of a period are alike, or images."""
        apart, images = self._halves(at), self._images(at)
        if apart.size and np.linalg.norm(apart) < _ALIKE:
            return True
        before = np.linalg.norm(self._images(here))
        close = np.linalg.norm(images) < min(_ALIKE, 0.5 * before)
        return bool(images.size and close and before > _NOISE)

    def _crossing(self, here: Step, at: Step, kind: str) -> Step:
        """The point where branches cross, from points on both sides, by a test that is zero there.

        Close to it the equations cannot be solved, but the branch passes through it smoothly, so
        that a polynomial through its neighbours tells where it is, and what the motion is there.
        """
        root = float(np.dot(here.tangent, (at.x - here.x) / self.scale))
        found: dict[float, Step] = {}
        for side, wanted in ((-_BESIDE, 3), (_BESIDE, 6)):
            for n in range(1, 9):
                if len(found) == wanted:
                    break
                step = self.advance(here.x, here.tangent, root + n * side)
                # So close to where they cross the corrector may find the other branch.
                other = self.symmetric and (kind == FOLD) == (self._apart(step) < _ALIKE * _BESIDE)
                if bool(step.good) and not other:
                    found[n * side] = step
            if len(found) < wanted:
                return at
        places, beside = np.array(list(found)), list(found.values())

        def through(values: Any) -> np.polynomial.Polynomial:
            return np.polynomial.Polynomial.fit(places, values, len(places) - 1)

        zeros = through([np.asarray(_tests(step)[kind]) for step in beside]).roots()
        zeros = zeros[np.abs(zeros.imag) < 1e-12].real
        if not zeros.size or np.abs(zeros).min() > _BESIDE:
            return at
        place = zeros[np.argmin(np.abs(zeros))]

        def there(get: Callable[[Step], Any]) -> np.ndarray:
            return np.stack([through(x)(place) for x in zip(*map(get, beside), strict=True)])

        x, tangent = there(lambda step: step.x), there(lambda step: step.tangent)
        unit = tangent / np.linalg.norm(tangent)
        return at._replace(x=x, tangent=unit, seen=observe(self.problem, x))

    def _images(self, step: Step) -> np.ndarray:
        """How far the motion is from being its own image; empty if it cannot be."""
        if not self.symmetric:
            return np.zeros(0)
        return np.asarray(images_at(self.problem, jnp.asarray(step.x)))

    def _halves(self, step: Step) -> np.ndarray:
        return halves(self.problem, step.x)

    def _apart(self, step: Step) -> float:
        return float(np.linalg.norm(self._images(step)))

    def _turns_back(self, here: Step, at: Step, last: Step) -> bool:
        """Whether the parameter there lies beyond that at both others, by more than rounding."""
        sides = [(float(at.x[-1]) - float(step.x[-1])) / self.scale[-1] for step in (here, last)]
        return bool(sides[0] * sides[1] > 0 and min(map(abs, sides)) > 1e-12)

    def path(self, steps: list[Step]) -> list[Step]:
        """The steps of a walk with the bifurcations located between them."""
        return [step for new in steps for step in [*self.between.get(id(new), ()), new]]


def _tests(step: Step) -> dict[str, float]:
    """Functions that change sign at the bifurcations."""
    M, identity = step.seen.monodromy, np.eye(step.seen.monodromy.shape[0])
    values = step.seen.multipliers
    with np.errstate(invalid="ignore"):  # a step without an answer has none here either
        doubling, crossing = np.linalg.det(M + identity), np.linalg.det(M - identity)
    pairs = [
        1 - values[i] * values[j] for i in range(len(values)) for j in range(i + 1, len(values))
    ]
    return {
        FOLD: float(step.tangent[-1]),
        DOUBLING: float(doubling),
        CROSSING: float(crossing),
        TORUS: float(np.real(np.prod(pairs))),
    }
