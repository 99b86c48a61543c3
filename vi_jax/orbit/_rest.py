"""A periodic motion that rests on a stop, as a fixed point of the section map.

From impact to impact such a motion has endlessly many equations, as the impacts before a rest are
endless. The section map has one for each number of the state: chatter is completed at once and rest
forgets how it began, so that the map is smooth, though of lower rank, as long as no rest and no
impact outside of a chatter is gained or lost.

A branch ends where the sequence of rests and impacts changes. The place at which a rest is gained
or lost is known from the hops of its chatter: there each hop is the one before it on a smaller
scale (`refined_rest`). If an impact or a chatter comes upon the section, the motion goes on, but
its state there jumps, so that the branch stalls, and is taken up beyond (`past_section`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from .._programs import compiled
from .._types import Scalar, State, Vector
from ..flow import MethodLike, Run, means, simulate
from ..machine import (
    AbstractMachine,
    RigidStop,
    bare,
    in_rows,
    is_autonomous,
    leaf,
    modes_of,
    raveled,
    stops_of,
    with_modes,
)
from ._corrector import Step, advance, way
from ._cycle_map import CycleMap
from ._follow import SHORTER, Ending, Event
from ._locate import located
from ._observed import Counted, Observed
from ._problem import fixed_step_method, sized
from ._shooting import Leg, Shooting
from ._turns import Nearest
from ._words import GRAZING, REST
from .floquet import multipliers_of
from .results import Orbit

# Impacts of a cycle that are listed, hops of a chatter included: a choice. Others are counted only.
_LISTED = 32


class SectionMap(Shooting):
    """The equations P(u; p) - u = 0 of a fixed point of the section map P, which the simulator
    carries through impacts, chatter, rest and release; the unknowns are (u, p).

    Of the fields of `Shooting`, `events` is empty and `steps` is not used.
    """

    @property
    def follows_events(self) -> bool:
        """Whether the events are given, and in that order; here the simulator finds them."""
        return False

    @property
    def autonomous(self) -> bool:
        """Whether the period is an unknown; here it follows from the state on the section."""
        return False

    def _map(self, machine: AbstractMachine, u: Vector) -> Vector:
        """The state a period after `u`."""
        carried = CycleMap(machine, self.method, self.cycles, True)
        return raveled(carried(self._begun(machine, u)))[0]

    def own_modes(self, leg: Leg) -> tuple[Array, ...]:
        """The machine's own modes on the section: all that `modes` has."""
        return self.modes_in(leg)

    def _begun(self, machine: AbstractMachine, u: Vector) -> State:
        """The state `u`, put on those stops that it is beyond: where the motion rests on its
        section a guess of the state there may be."""
        state = self.unravel(u)
        for stop in stops_of(machine):
            body = machine.coordinates[stop.coordinate]
            beyond = stop.beyond(body.position(state)) > 0
            there = body.placed(state, stop.place, body.velocity(state))
            state = jtu.tree_map(partial(jnp.where, beyond), there, state)
        return with_modes(state, self.own_modes(0))

    def flown(self, x: Vector, **options: Any) -> Run:
        """The motion of a period, simulated with these options."""
        machine = self.at(x)
        begin = self._begun(machine, x[: self.states])
        return simulate(machine, begin, self.cycles, method=self.method, **options)

    def lacks(self, x: Vector) -> Vector:
        """What the motion lacks to be periodic."""
        u = x[: self.states]
        return self._map(self.at(x), u) - u

    def observe(self, x: Vector) -> Observed:
        """Multipliers, extremes, impacts and rests of a solution `x`."""
        machine, u = self.at(x), x[: self.states]
        run = self.flown(x, impact_log=_LISTED, rests=True)
        log, duration = run.impact_log, run.duration
        assert log is not None and duration is not None and run.rests is not None
        assert run.y_min is not None and run.y_max is not None and run.clearance is not None
        monodromy = jax.jacfwd(lambda u: self._map(machine, u))(u)
        begins = jnp.cumsum(duration) - duration
        if not is_autonomous(machine, self.like):
            begins = jnp.asarray(machine.cycle, x.dtype) * jnp.arange(self.cycles)
        clock = (log.phase + begins[:, None]).ravel()
        listed = Counted(
            jnp.sum(run.impacts), jnp.sum(run.rests), clock, log.speed.ravel(), log.stop.ravel()
        )
        one, time = jnp.ones((), x.dtype), jnp.sum(duration)
        nearest = Nearest(jnp.min(run.clearance), jnp.nan * one, -one)
        integrals = {name: jnp.sum(a * duration) for name, a in run.averages.items()}
        return Observed(
            multipliers=multipliers_of(monodromy),
            monodromy=monodromy,
            approach=jnp.zeros((0,), x.dtype),
            y_min=jnp.min(run.y_min),
            y_max=jnp.max(run.y_max),
            nearest=nearest,
            order=one,
            apart=jnp.inf * one,
            duration=time,
            averages=means(integrals, time),
            largest=jnp.full((self.states,), jnp.nan, x.dtype),
            counted=listed,
        )

    def state_at(self, x: Vector, leg: Leg, s: Scalar) -> State:
        """The state on the section that is met at clock `s`, counted in whole cycles."""
        rows = in_rows(self.flown(x, record="sections", rests=True).sections)
        return self.unravel(rows[jnp.round(s / self.at(x).cycle).astype(int)])


def section_map_of(
    orbit: Orbit, parameter: str, method: MethodLike
) -> tuple[SectionMap, np.ndarray]:
    """The equations of a motion that rests, and the unknowns it gives."""
    machine = orbit.machine
    carried = fixed_step_method(method, orbit.method, machine)
    problem = SectionMap(
        machine, carried, bare(orbit.state), int(orbit.cycles), (),
        (tuple(float(mode) for mode in modes_of(orbit.state) or ()),), 1, (parameter,),
    )  # fmt: skip
    x = np.append(raveled(orbit.state)[0], float(leaf(machine, parameter)))
    return sized(problem, x), x


# Impacts of a cycle among which a chatter is looked for: a choice; with restitution 0.8 some fifty
# hops take it from the scale of a cycle to a thousandth.
_HOPS = 256

# From where simulation tells the sides apart, the true place is less than this away (in the
# parameter's scale): a choice. Of tried machines it was 2e-5.
_FAR = 1e-3

# The place moves from hop to hop by less and less: so many times at least, and each time by a share
# that is as far from the expected one: choices. With restitution 0.1 it does so twice above the
# rounding; 0.9 to 1.2 times the expected share were seen before that is felt.
_LEAST, _ALIKE = 2, 0.2

# The secant begins with so long a step, and ends with one that is shorter than this: choices, below
# what is left of the rounding in the places.
_SECANT, _TOLERANCE = 1e-8, 1e-13

# Terms of the departure from the limit that are taken away: the first is a share τ of it, or τ²
# where the acceleration has no term in τ², as that of a wall that is shaken by a sine alone.
_TERMS, _FIRST = 2, (1, 2)


@compiled
def _impacts(problem: SectionMap, x):
    """Speed and stop of all impacts of a period, in their order."""
    log = problem.flown(x, impact_log=_HOPS).impact_log
    assert log is not None
    return log.speed.ravel(), log.stop.ravel()


def refined_rest(problem: Shooting, at: Step, scale: np.ndarray) -> Step:
    """The point at which a rest is gained or lost, from one close to it; the same where no chatter
    is found that takes until the stop lets go.

    **Arguments:** the equations of motions that rest; the point; the size of each unknown.
    """

    def speeds(place: float, stop: int) -> np.ndarray:
        x = jnp.asarray(at.x + place * at.tangent * scale)
        speed, where = (np.asarray(a) for a in _impacts(problem, x))
        return speed[where == stop]

    assert isinstance(problem, SectionMap)
    for i, stop in enumerate(stops_of(problem.at(jnp.asarray(at.x)))):
        V = speeds(0.0, i)
        k = float(stop.share(jnp.asarray(V[-1]))) if V.size > 1 else 0.0
        if 0 < k < 1:
            place = _critical(lambda place, i=i: speeds(place, i), V, k)
            if place is not None and abs(place) < _FAR:
                return at._replace(x=at.x + place * at.tangent * scale)
    return at


def _similar(k: float) -> tuple[float, float]:
    """Of hops on ever smaller scales r, and how fast a departure from them grows, as q: by r^-q a
    hop."""
    from scipy.optimize import brentq  # slow to load

    root: Any = brentq(lambda a: (3 - a) * (1 - a) ** 2 - k * (3 - 2 * a), 0.0, 1.0, xtol=1e-15)
    a = float(root)
    r = 1 - a
    # Derivatives by σ of u/(b τ²), of a hop and of the next one.
    this, after = (3 - 2 * a) / 6, k * ((3 - 4 * a) / r**2 + 2 * a * (3 - 2 * a) / r**3) / 6
    return r, float(-np.log(after / this) / np.log(r))


def _critical(speeds: Callable[[float], np.ndarray], V: np.ndarray, k: float) -> float | None:
    """The place at which the hops of a chatter get smaller by the same factor all along; `None` if
    none do.

    **Arguments:** `speeds`, those of the impacts on a stop by the place; what they are where the
    search begins, two at least; the stop's coefficient of restitution at low speeds.
    """
    from scipy.optimize import newton  # slow to load

    r, q = _similar(k)

    def by(hop: int, begin: float) -> float:
        """Where this hop and the next one fall by r²; NaN if nowhere near."""

        def off(place: float) -> float:
            V = speeds(place)
            return float(np.log(V[hop + 1] / V[hop] / r**2)) if hop + 1 < V.size else np.nan

        place: Any = newton(off, begin, x1=begin + _SECANT, tol=_TOLERANCE, maxiter=20, disp=False)
        return float(place) if abs(place) < _FAR else np.nan

    # The hops that fall so already tell the place best; what those before and after them tell
    # leads there.
    best = int(np.argmin(np.abs(V[1:] / V[:-1] / r**2 - 1)))
    places = [by(best, 0.0)]
    for hop in range(best + 1, V.size - 1):
        places.append(by(hop, places[-1]))
        if np.isnan(places[-1]):
            break
    for hop in reversed(range(best)):
        places.insert(0, by(hop, places[0]))
        if np.isnan(places[0]):
            break
    return _limit(np.array(places), r, q)


def _limit(places: np.ndarray, r: float, q: float) -> float | None:
    """What a sequence converges to, whose departure falls by r^(1 + q), r^(2 + q) … from term to
    term; `None` if it does not. Its begin and its end, where rounding is all that is left, are not
    counted."""
    steps = np.diff(places)

    def run(first: int) -> tuple[int, int]:
        """The longest part that falls by the factor of this term."""
        falls = np.abs(steps[1:] / (r ** (first + q) * steps[:-1]) - 1) < _ALIKE
        ends = np.flatnonzero(np.diff(np.concatenate([[False], falls, [False]])))
        begin, end = max(ends.reshape(-1, 2), key=np.ptp, default=(0, 0))
        return int(begin), int(end)

    runs = {first: run(first) for first in _FIRST}
    first = max(runs, key=lambda first: runs[first][1] - runs[first][0])
    begin, end = runs[first]
    if end - begin < _LEAST:
        return None
    places = places[begin : end + 2]
    for term in range(first, first + _TERMS):
        factor = r ** (term + q)
        places = places[1:] + np.diff(places) * factor / (1 - factor)
    return float(places[-1])


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


def sequence_rows(
    problem: Shooting, here: Step, scale: np.ndarray, named: Callable[[str, Step, str], Ending]
) -> list[Event]:
    """The rows of a table for motions that rest: where the number of rests changes, and where an
    impact outside of a chatter is gained or lost by a graze.

    **Arguments:** the equations; the point from which a step is made; the size of each unknown;
    what makes an ending of a kind, a place and what is said of it.
    """

    def rest(last: Step) -> Ending | None:
        found = _changed(problem, here, last, scale, _rests)
        if found is None:
            return None
        what = f"a rest on a stop is {'gained' if _rests(last) > _rests(here) else 'lost'}"
        return named(REST, refined_rest(problem, found[0], scale), what)

    def graze(last: Step) -> Ending | None:
        return _grazed(problem, here, last, scale, named)

    # The endings look for the place themselves: a count jumps, and may do so several times.
    whole = lambda here, last: last
    rows = (_rests, rest), (_groups, graze)
    return [Event(_same(here, number), ending, whole) for number, ending in rows]


def _same(here: Step, number: Callable[[Step], object]) -> Callable[[Step], float]:
    """1 for motions with as many rests or impacts as the first one, else -1.

    Where there is no motion at all has another number: beyond a rest that is lost the hops of a
    chatter end one by one in grazings.
    """
    wanted = number(here)
    return lambda step: 1.0 if bool(step.good) and number(step) == wanted else -1.0


def _grazed(
    problem: Shooting, begin: Step, last: Step, scale: np.ndarray,
    named: Callable[[str, Step, str], Ending],
) -> Ending | None:  # fmt: skip
    """The first of the places between two points at which the groups of impacts change by a graze;
    a shorter step is asked for where a motion would have to be looked for within it."""
    here = begin
    for _ in range(_PLACES):
        if _groups(here) == _groups(last):
            return None
        found = _changed(problem, here, last, scale, _groups)
        if found is None:
            return None
        before, (at, here) = here, found
        touch = touched_beside(problem, at, scale)
        if touch is not None:
            return named(GRAZING, touch, BETWEEN_RESTS)
        turned = min(way(before, at, scale), way(at, last, scale)) < 0
        if not bool(here.good) or turned:
            # There is none on the way there: the branch turns, and `last` is of another one.
            return Ending(begin, SHORTER)
    return None


def _changed(
    problem: Shooting, here: Step, last: Step, scale: np.ndarray, number: Callable[[Step], object]
) -> tuple[Step, Step] | None:
    """The last point between two with as many rests or impacts as the first one, and one beyond
    it."""
    same = _same(here, number)
    # A test that jumps is met short of its place by a share of the step: the second step is a short
    # one.
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
    for stop in stops_of(machine):
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
