"""Following a branch: what happens between two of its points, and when it ends."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ._events import Event
from ._shooting import Shooting
from ._solve import advance, located, observe, orbit_of, state_at
from .curve import Step
from .special import CROSSING, DOUBLING, FOLD, GRAZING, HOPF, SYMMETRY, TORUS, SpecialPoint

# What lies before the place where a branch springs is looked for on so much of the way there.
_SHORT = 0.999

# How far beside a point where branches cross (in the norm of the scaled unknowns) it is looked at.
_BESIDE = 1e-3

# A motion of no more amplitude than this is rest.
_STILL = 1e-3

_NAMES = {"stop": "impact", "switch": "switch", "section": "section"}

# Halves of a period that differ by less than this are those of a motion of half the period.
_ALIKE = 1e-3


class Follower:
    """Looks at each step of a walk: locates what happens in it and says when to end."""

    def __init__(self, problem: Shooting, scale: np.ndarray, bounds: tuple[float, float]):
        self.problem, self.scale, self.bounds = problem, scale, bounds
        self.special: list[SpecialPoint] = []
        self.between: dict[int, list[Step]] = {}
        self.start: Step | None = None
        self.away = False

    def advance(self, x, tangent, length) -> Step:
        """The point at this length along the tangent."""
        return advance(self.problem, x, tangent, self.scale, length)

    def stop(self, here: Step, new: Step) -> tuple[Step, str] | None:
        """The last point, and why the branch ends between these two; `None` if it does not."""
        reason, last = None, new
        low, high = self.bounds
        if not low <= new.x[-1] <= high:
            bound = low if new.x[-1] < low else high
            last = self._where(here, new, lambda step: float(step.x[-1]) - bound) or here
            reason = "bounds"
        grazing = self._grazing(here, last)
        if grazing is not None:
            last, reason = grazing.step, grazing.kind
        origin = self._bifurcations(here, last)
        if origin is not None:
            return origin, "period-doubling"
        if grazing is not None:
            self.special.append(grazing)
        elif reason is None and self._closed(here, new):
            return here, "closed"
        return None if reason is None else (last, reason)

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

    def _grazing(self, here: Step, new: Step) -> SpecialPoint | None:
        """The first of the impacts lost and the stops touched between two points."""
        found = []

        def room(step: Step) -> float:
            return float(np.clip(step.seen.clearance, -1.0, 1.0))

        for i in range(len(self.problem.events)):
            if new.seen.approach[i] <= 0 < here.seen.approach[i]:
                at = self._where(here, new, lambda step, i=i: float(step.seen.approach[i]))
                if at is not None:
                    found.append((at, i))
        if room(new) < 0 < room(here):
            at = self._where(here, new, room)
            if at is not None:
                found.append((at, None))
        if new.seen.order < 0 < here.seen.order:
            at = self._where(here, new, lambda step: float(step.seen.order))
            if at is not None:
                detail = "a switch goes into another mode: the motion sticks or slips anew"
                return self._point(GRAZING, at, detail)
        if not found:
            return None
        at, impact = min(found, key=lambda f: float(np.dot(here.tangent, f[0].x - here.x)))
        if impact is None:
            touched = int(at.seen.touched) - len(self.problem.scene.stops)
            what = "a stop" if touched < 0 else f"the guard of switch {touched}"
            detail = f"touches {what} at {self._place(at, float(at.seen.touch))}"
        else:
            clock = float(np.asarray(self.problem.parts(jnp.asarray(at.x))[0])[impact])
            kind = self.problem.events[impact].kind
            detail = f"the {_NAMES[kind]} at {self._place(at, clock)} is lost"
            if kind == "section" and float(at.seen.y_max - at.seen.y_min) < _STILL:
                return self._point(HOPF, at, "the motion shrinks to rest", impact)
        return self._point(GRAZING, at, detail, impact)

    def _place(self, at: Step, clock: float) -> str:
        """A reading of the clock of impacts, in words, within one period from the section on."""
        period = float(self.problem.period(jnp.asarray(at.x)))
        return self.problem.scene.place_of(clock % period, self.problem.cycles)

    def _bifurcations(self, here: Step, last: Step) -> Step | None:
        """Record what happens between two points; the point where the branch springs, if met.

        There the two halves of the period become alike, and beyond it the same motions come again,
        observed half a period later.
        """
        apart = self._halves(here)
        if apart.size and np.dot(apart, self._halves(last)) < 0:
            at = self._where(here, last, lambda step: float(np.dot(apart, self._halves(step))))
            if at is not None:
                # Beyond it the tests have changed twice: what lies before it shows short of it.
                length = float(np.dot(here.tangent, (at.x - here.x) / self.scale))
                found = self._changes(here, self.advance(here.x, here.tangent, _SHORT * length))
                at = self._origin(at)
                self.between[id(at)] = found
                detail = "the branch springs from a motion of half the period"
                self.special.append(self._point(DOUBLING, at, detail))
                return at
        self.between[id(last)] = self._changes(here, last)
        return None

    def _changes(self, here: Step, last: Step) -> list[Step]:
        """Record the bifurcations between two points, by the tests that change their signs.

        **Returns:** where they are, in their order.
        """
        before, after = _tests(here), _tests(last)
        changed = {kind for kind in before if before[kind] * after[kind] < 0}
        both = {FOLD, CROSSING} <= changed
        if FOLD in changed:
            changed.discard(CROSSING)
        found = []
        for kind in changed:
            at = self._where(here, last, lambda step, kind=kind: _tests(step)[kind])
            if at is None:
                continue
            if kind == FOLD and not both and not self._turns_back(here, at, last):
                continue  # rounding: the tangent is ill-defined close to where branches cross
            if self.problem.autonomous and float(at.seen.y_max - at.seen.y_min) < 10 * _STILL:
                continue  # a motion about to shrink to rest has a multiplier 1 to rounding
            apart = self._halves(at)
            if kind in (FOLD, CROSSING) and apart.size and np.linalg.norm(apart) < _ALIKE:
                continue  # where the branch springs both are zero; that is seen by the halves
            if kind == CROSSING:
                at = self._crossing(here, at)
            values = at.seen.multipliers
            detail = {
                FOLD: "a multiplier passes 1 and the branch turns back",
                DOUBLING: "a multiplier passes -1",
                CROSSING: "a multiplier passes 1 and another branch crosses",
                TORUS: "a complex pair of multipliers leaves the unit circle",
            }[kind]
            on_circle = {
                FOLD: np.abs(values - 1).min(),
                DOUBLING: np.abs(values + 1).min(),
                CROSSING: np.abs(values - 1).min(),
                TORUS: np.abs(np.abs(values[np.abs(values.imag) > 1e-9]) - 1).min(initial=np.inf),
            }[kind]
            if on_circle < 1e-5:  # or else a pole of the determinant, or a real pair μ, 1/μ
                found.append((float(np.dot(here.tangent, at.x - here.x)), kind, at, detail))
        found.sort(key=lambda f: f[0])
        for _, kind, at, detail in found:
            if kind == CROSSING and self._symmetric(at):
                kind, detail = SYMMETRY, "a multiplier passes 1 and the motion loses its symmetry"
            self.special.append(self._point(kind, at, detail))
        return [at for _, _, at, _ in found]

    def _crossing(self, here: Step, at: Step) -> Step:
        """The point where branches cross, from points on both sides.

        Close to it the equations cannot be solved, but the branch passes through it smoothly, so
        that a polynomial through its neighbours tells where it is, and what the motion is there.
        """
        root = float(np.dot(here.tangent, (at.x - here.x) / self.scale))
        places = _BESIDE * np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
        beside = [self.advance(here.x, here.tangent, root + place) for place in places]
        if not all(bool(step.good) for step in beside):
            return at

        def through(values: Any) -> np.polynomial.Polynomial:
            return np.polynomial.Polynomial.fit(places, values, len(places) - 1)

        zeros = through([np.asarray(_tests(step)[CROSSING]) for step in beside]).roots()
        zeros = zeros[np.abs(zeros.imag) < 1e-12].real
        if not zeros.size or np.abs(zeros).min() > _BESIDE:
            return at
        place = zeros[np.argmin(np.abs(zeros))]

        def there(get: Callable[[Step], Any]) -> np.ndarray:
            return np.stack([through(x)(place) for x in zip(*map(get, beside), strict=True)])

        x, tangent = there(lambda step: step.x), there(lambda step: step.tangent)
        return at._replace(
            x=x, tangent=tangent / np.linalg.norm(tangent), seen=observe(self.problem, x)
        )

    def _symmetric(self, step: Step) -> bool:
        """Whether the motion is its own image under the symmetry of its machine."""
        problem, scene = self.problem, self.problem.scene
        if problem.cycles % 2 == 0 or scene.mirrored(problem.like) is None:
            return False
        x = jnp.asarray(step.x)
        clock = np.asarray(problem.parts(x)[0])
        turn = float(problem.period(x))
        # A place within the first flight, and the one half a period later.
        first = clock[0] + 0.25 * ((clock[1] if len(clock) > 1 else clock[0] + turn) - clock[0])
        states = []
        for place in (first, first + 0.5 * turn):
            leg = max(0, int(np.searchsorted(clock, place, side="right")) - 1)
            states.append(state_at(problem, x, jnp.asarray(leg), jnp.asarray(place)))
        image = ravel_pytree(scene.mirrored(states[0]))[0]
        apart = np.abs(np.asarray(image - ravel_pytree(states[1])[0]))
        return bool(apart.max() < _ALIKE)

    def _turns_back(self, here: Step, at: Step, last: Step) -> bool:
        """Whether the parameter there lies beyond that at both others, by more than rounding."""
        sides = [(float(at.x[-1]) - float(step.x[-1])) / self.scale[-1] for step in (here, last)]
        return bool(sides[0] * sides[1] > 0 and min(map(abs, sides)) > 1e-12)

    def path(self, steps: list[Step]) -> list[Step]:
        """The steps of a walk with the bifurcations located between them."""
        return [step for new in steps for step in [*self.between.get(id(new), ()), new]]

    def _origin(self, at: Step) -> Step:
        """The point where the branch springs, located on the motion of half the period.

        Both branches cross there, so that the equations of this one cannot be solved close by. The
        mean of the two halves is a motion of half the period but for a term of second order.
        """
        problem, count = self.problem, len(self.problem.parameters)
        legs, x = len(problem.events) // 2, jnp.asarray(at.x)
        turn = float(problem.period(x)) / 2
        half = dataclasses.replace(
            problem, cycles=problem.cycles // 2, events=problem.events[:legs],
            modes=problem.modes[: max(1, legs)], steps=problem.steps // 2,
        )  # fmt: skip
        clock, states = (np.asarray(a) for a in problem.parts(x))
        if legs:
            clock = 0.5 * (clock[:legs] + clock[legs:] - turn)
            states = 0.5 * (states[:legs] + states[legs:])
        else:
            states = states + 0.5 * self._halves(at)
        mean = np.asarray(half.pack(clock, states, at.x[-count:], turn))
        scale = np.append(np.ones(mean.size - count), self.scale[-count:])
        along = np.append(np.zeros(mean.size - 1), 1.0)

        def missing(shift: float) -> float:
            step = advance(half, mean, along, scale, shift)
            M = step.seen.monodromy
            return float(np.linalg.det(M + np.eye(len(M)))) if bool(step.good) else np.nan

        from scipy.optimize import newton  # slow to load

        shift, report = newton(  # pyright: ignore[reportAssignmentType]
            missing, 0.0, x1=1e-6, tol=1e-14, full_output=True, disp=False
        )
        if not report.converged or not abs(shift) < 1e-2:
            return at
        found = advance(half, mean, along, scale, float(shift))
        clock, states = (np.asarray(a) for a in half.parts(jnp.asarray(found.x)))
        turn = float(half.period(jnp.asarray(found.x)))
        if legs:
            clock, states = np.append(clock, clock + turn), np.concatenate([states, states])
        x = np.asarray(problem.pack(clock, states, found.x[-count:], 2 * turn))
        return at._replace(x=x, size=found.size, seen=observe(problem, x))

    def _halves(self, step: Step) -> np.ndarray:
        """How the second half of the period differs from the first; empty if it cannot be alike."""
        events, cycles = self.problem.events, self.problem.cycles
        legs = len(events)
        if cycles % 2 or legs % 2 or not _alike(events, cycles):
            return np.zeros(0)
        x = jnp.asarray(step.x)
        turn = float(self.problem.period(x)) / 2
        if not legs:
            middle = state_at(self.problem, x, jnp.asarray(0), jnp.asarray(turn))
            return np.asarray(ravel_pytree(middle)[0]) - step.x[: self.problem.states]
        clock, states = (np.asarray(a) for a in self.problem.parts(x))
        half = legs // 2
        late = clock[half:] - clock[:half] - turn
        return np.append(late, (states[half:] - states[:half]).ravel())


def _alike(events: tuple[Event, ...], cycles: int) -> bool:
    """Whether both halves of a period have the same events."""
    half = len(events) // 2
    later = [
        event._replace(number=event.number - cycles // 2) if event.kind == "section" else event
        for event in events[half:]
    ]
    return list(events[:half]) == later


def _tests(step: Step) -> dict[str, float]:
    """Functions that change sign at the bifurcations."""
    M, identity = step.seen.monodromy, np.eye(step.seen.monodromy.shape[0])
    values = step.seen.multipliers
    pairs = [
        1 - values[i] * values[j] for i in range(len(values)) for j in range(i + 1, len(values))
    ]
    return {
        FOLD: float(step.tangent[-1]),
        DOUBLING: float(np.linalg.det(M + identity)),
        CROSSING: float(np.linalg.det(M - identity)),
        TORUS: float(np.real(np.prod(pairs))),
    }
