"""Motions of other branches, and other curves in two parameters, that begin at a special point."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._types import State
from ..flow import simulate
from ..machine import after_event, others_of, with_leaf
from .codimension_two import PERIODS
from .conditions import Special, bifurcation_tests
from .corrector import (
    Step,
    advance,
    jacobian_at,
    method_of_runs,
    orbit_of,
    sections_at,
    state_at,
    tangent_at,
)
from .edit_events import admissible_near, over_periods, repeated, without_events
from .equations import Shooting
from .find import find_orbit
from .flight import Event
from .from_orbit import events_in
from .kinds import (
    CROSSING,
    DOUBLING,
    FLIP,
    FOLD,
    GRAZING,
    RESONANCE_1,
    RESONANCE_2,
    RESONANT,
    REST,
    SLIDING,
    SYMMETRY,
    TORUS,
    starts,
)
from .local_map import graze_at
from .locate import locate_zero, passes_zero
from .results import Orbit
from .sliding import change_at, without_part
from .special import Point, point_at
from .tolerances import LISTED, LOCATED, ON_CIRCLE
from .torus import Torus, torus_near

_ORBIT = "orbit"

# Periods after which a stable motion has settled: a choice.
_SETTLES = 100


def _orbit_at(problem: Shooting, step: Step, what: str, distance: float) -> Orbit:
    if not bool(step.good):
        raise ValueError(f"No motion of {what} was found at distance {distance:g}; try another.")
    return orbit_of(problem, step)


def _doubled_orbit(point: Point, distance: float) -> Orbit:
    """Return a motion of twice the period, or of half of it if the branch begins at one."""
    if point.is_origin:
        problem, x = point.problem, point.step.x
        step = advance(problem, x, tangent_at(problem, x), distance)
        return _orbit_at(problem, step, "half the period", distance)
    new = over_periods(point.problem, 2)
    x = repeated(point.problem, point.step.x, new)
    null = np.linalg.svd(jacobian_at(new, x)[:, :-1])[2][-1]
    step = advance(new, x, np.append(null, 0.0), distance)
    return _orbit_at(new, step, "twice the period", distance)


def _crossing_orbit(point: Point, distance: float) -> Orbit:
    problem, x = point.problem, point.step.x
    jacobian = jacobian_at(problem, x)
    # The equations have two null vectors here: one leads along this branch, the other off it.
    plane = np.linalg.svd(jacobian)[2][-2:]
    along = plane.T @ (plane @ point.step.tangent)
    across = plane[0] * (plane[1] @ along) - plane[1] * (plane[0] @ along)
    step = advance(problem, x, across / np.linalg.norm(across), distance)
    return _orbit_at(problem, step, "the other branch", distance)


def _orbit_beyond_sliding(point: Point, distance: float) -> Orbit:
    """Return the motion on the other side of a sliding bifurcation."""
    problem, change = point.problem, change_at(point.problem, point.step)
    if change is not None and change.exists and change.modes[0] == change.modes[2]:
        new, start, _ = without_part(problem, point.step, change)
        found = admissible_near(new, start, distance)
        if found is not None:
            return orbit_of(new, found)
    accepts = lambda orbit: len(events_in(orbit)) != len(problem.events)
    return _search(point, distance, "another number of times of sticking or sliding", accepts)


def _orbit_beyond_rest(point: Point, distance: float) -> Orbit:
    """Return the motion with one rest more or less; where two become one, that with one."""
    if not point.is_origin:
        accepts = lambda orbit: int(orbit.rests) != len(point.problem.landings)
        return _search(point, distance, "another number of rests", accepts)
    found = admissible_near(point.problem, point.step.x, distance)
    if found is None:
        raise ValueError(f"No motion with one rest was found at distance {distance:g}.")
    return orbit_of(point.problem, found)


def _reordered_orbit(point: Point, distance: float) -> Orbit:
    """Return a motion with other events or another order, near where two events coincide."""
    problem, (clock, _, period) = point.problem, point.problem.values(point.step.x)
    here, begins = list(problem.events), range(len(problem.events))
    if problem.omits_sections:
        begins = range(problem.legs)
    elif all(event.cycle is None for event in here):
        # The same motion may begin whole cycles later, but not at any other of its events.
        n = problem.cycles
        begins = [int(np.sum(clock < i * period / n)) for i in range(n)]
    same_orders = [here[i:] + here[:i] for i in begins]
    accepts = lambda orbit: [event for _, event in events_in(orbit)] not in same_orders
    return _search(point, distance, "its events in another order", accepts, list(_swapped(point)))


def _swapped(point: Point) -> Iterator[State]:
    """Yield the state on the section after an event that coincides with it has changed sides."""
    problem, x = point.problem, jnp.asarray(point.step.x)
    machine, clock, states = problem.at(x), *problem.parts(x)
    lengths = np.abs(problem.lengths(x)) / problem.radian
    for i, event in enumerate(problem.events):
        after = problem.events[(i + 1) % problem.legs]
        if 0 not in (event.cycle, after.cycle) or lengths[i] > LOCATED:
            continue
        state, modes = problem.unravel(states[i]), problem.modes_in(i - 1)
        # The section's state is the one just after it.
        for each in (after, event) if event.cycle == 0 else (after,):
            state, modes = after_event(machine, each.number, clock[i], state, modes)
        yield state


def _torus(point: Point, distance: float) -> Torus:
    name, width = point.problem.parameters[-1], float(point.scale[-1])
    return torus_near(point.orbit, name, width, distance)


def _search(
    point: Point, distance: float, what: str, accepts: Callable[[Orbit], bool],
    guesses: Sequence[State] = (),
) -> Orbit:  # fmt: skip
    """Return a motion near a point that does not belong to the branch. The section map has no jump
    there unless an impact falls on the section, so its fixed points are sought: from the `guesses`
    on the section, from points close by on the branch, and from a settled simulation. The far side
    of the point is tried first."""
    problem, step, guesses = point.problem, point.step, list(guesses)
    for near_step in (advance(problem, step.x, step.tangent, distance), step):
        if np.all(np.isfinite(near_step.x)):
            guesses.append(jax.tree.map(lambda x: x[0], sections_at(problem, near_step.x)[0]))
    sense = np.copysign(1.0, float(step.tangent[-1]))
    n = problem.cycles
    options: Any = {"method": method_of_runs(problem, [step.x])}
    for side in (sense, -sense):
        value = point.parameter + side * distance * float(point.scale[-1])
        machine = with_leaf(problem.machine, problem.parameters[-1], value)
        for guess in (*guesses, None):
            if guess is None:
                guess = simulate(machine, guesses[-1], n, settle=_SETTLES * n, **options).last
            found = find_orbit(machine, guess, n, impact_log=LISTED, **options)
            if bool(found.successful) and accepts(found):
                return found
    raise ValueError(
        f"No motion with {what} was found at distance {distance:g} from this {point.kind}. Try "
        "another distance."
    )


def _orbit_beyond_grazing(point: Point, distance: float) -> Orbit:
    """Return the motion without the grazing impact, or with the touch as an additional impact."""
    old, step = point.problem, point.step
    if point.impact is not None and old.events[point.impact].use:
        raise ValueError(
            "`switch` at a grazing needs an impact of a motion in flight, but here a rest begins "
            "or ends with it: find the motion beyond it with `find_orbit`."
        )
    if point.impact is None and not point.touches:
        return _reordered_orbit(point, distance)
    _check_plain(old)
    if point.impact is not None and old.events[point.impact].cycle is not None:
        raise ValueError(
            "`switch` needs an impact that grazes, but here the section of the machine is touched: "
            "beyond it the motion has another number of cycles. Find it with `find_orbit`."
        )
    if point.impact is not None:
        new, start = without_events(old, step.x, point.lost)
    else:
        nearest = step.observed.nearest
        new, start = _with_touch(old, step.x, int(nearest.event), float(nearest.clock))
    found = admissible_near(new, start, distance)
    if found is not None:
        return orbit_of(new, found)
    raise ValueError(
        "Beyond this grazing there is no admissible motion with "
        f"{len(new.impacts)} impacts at distance {distance:g}."
    )


def _check_plain(problem: Shooting) -> None:
    if problem.modes[0] or others_of(problem.machine):
        raise ValueError(
            "`switch` at a grazing needs a machine without soft stops, friction or other switches, "
            "discrete modes and `events`: find the motion beyond it with `find_orbit`, or with "
            "`all_orbits` if it is unstable."
        )


def _with_touch(
    old: Shooting, x: np.ndarray, number: int, touch: float
) -> tuple[Shooting, np.ndarray]:
    (clock, states, period), events = old.values(x), list(old.events)
    u, hit = state_at(old, x, *old.leg_at(x, touch))[None], Event(number)
    if not events:
        clock, states, events = np.array([touch]), u, [hit]
    else:
        clock, states = np.append(clock, touch), np.append(states, u, axis=0)
        order = np.argsort(np.mod(clock, period))
        clock, states = np.mod(clock, period)[order], states[order]
        events = [[*events, hit][i] for i in order]
    new = dataclasses.replace(old, events=tuple(events), modes=((),) * len(events))
    return new, new.pack(clock, states, x, period)


def _as_kind(kind: str, point: Point, distance: float) -> Point:
    impact = point.impact if kind == GRAZING else None
    found = point_at(point.problem, point.step, kind, impact=impact)
    return dataclasses.replace(found, further=point.further)


def _in_two_parameters(
    point: Point, problem: Shooting, x: np.ndarray, condition: Special
) -> tuple[Shooting, np.ndarray]:
    ((name, (value, size)),) = point.further.items()
    problem_two = dataclasses.replace(
        problem, parameters=(name, *problem.parameters), conditions=(condition,),
        widths=np.insert(np.asarray(problem.widths), 0, size),
    )  # fmt: skip
    return problem_two, np.insert(x, -1, value)


# The first step along a curve is this share of the distance; each further one is twice as long, so
# many at most. With half the speed the found point is half as far off, within these bounds.
# Choices.
_FIRST, _STEPS, _HALF = 1e-3, 16, (0.35, 0.65)


def _point_near_resonance(kind: str, point: Point, distance: float) -> Point:
    """Return a fold or doubling of the motion with one impact, near a resonant grazing."""
    graze, sign = graze_at(dataclasses.replace(point, kind=GRAZING)), -1 if kind == DOUBLING else 1
    problem, local, touch = graze.problem, graze.map, graze.touches[0]
    _check_plain(problem)

    def depth(n: int) -> float:
        """Return the depth of an impact that equals its kick's remainder n periods later."""
        remainder = np.linalg.matrix_power(local.matrix, n) @ local.kicks[0]
        return float(np.linalg.norm(local.gradients[0]) * np.linalg.norm(remainder))

    periods = range(1, PERIODS + 1)
    n = next((n for n in periods if abs(local.resonance(n, sign)) < ON_CIRCLE * depth(n)), 1)
    fastest = min(point.step.observed.fastest, np.sqrt(2 * touch.rate) * depth(n))
    whole = over_periods(problem, n)
    new, x = _with_touch(whole, repeated(problem, graze.x, whole), touch.number, touch.clock)
    impact = int(np.argmin(np.abs(new.values(x)[0] - touch.clock)))

    def locate(share: float) -> tuple[Shooting, Step | None, float]:
        condition = Special(GRAZING, impact, speed=jnp.asarray(share * distance * fastest))
        two, begin = _in_two_parameters(point, new, x, condition)
        at = _locate_change(two, begin, distance, CROSSING if kind == FOLD else kind)
        return two, at, np.nan if at is None else float(at.x[-2] - begin[-2])

    (two, at, shift), (*_, half) = locate(1.0), locate(0.5)
    if (
        at is not None
        and _HALF[0] < half / shift < _HALF[1]
        and at.observed.admissible(range(new.legs))
    ):
        return point_at(two, at, kind)
    raise ValueError(
        f"No {kind} of a motion with one impact was found at distance {distance:g} from this "
        "resonant grazing. Try a shorter distance."
    )


def _locate_change(two: Shooting, x: np.ndarray, distance: float, test: str) -> Step | None:
    """Return the point closest to the resonance where a test changes sign. The motions with an
    impact of a given low speed are a curve in both parameters, which begins about at `x`."""
    begin = advance(two, x, np.eye(len(x))[-2], 0.0)
    ends = [begin._replace(tangent=sense * begin.tangent) for sense in (1.0, -1.0)]
    value = lambda step: bifurcation_tests(step)[test]
    for i, side in itertools.product(range(_STEPS), (0, 1)):
        here = ends[side]
        step = advance(two, here.x, here.tangent, _FIRST * distance * 2**i)
        if bool(step.good) and passes_zero(value(here), value(step)):
            return locate_zero(two, here, step, value)
        ends[side] = step if bool(step.good) else here
    return None


starts |= {
    (None, DOUBLING): {_ORBIT: _doubled_orbit},
    (None, GRAZING): {_ORBIT: _orbit_beyond_grazing},
    (None, CROSSING): {_ORBIT: _crossing_orbit},
    (None, SYMMETRY): {_ORBIT: _crossing_orbit},
    (None, TORUS): {"torus": _torus},
    (None, REST): {_ORBIT: _orbit_beyond_rest},
    **{(None, kind): {_ORBIT: _orbit_beyond_sliding} for kind in SLIDING},
    **{
        (curve, kind): {to: partial(_as_kind, to)}
        for curve, kind, to in (
            (FOLD, FLIP, DOUBLING), (FOLD, RESONANCE_1, TORUS), (FOLD, GRAZING, GRAZING),
            (DOUBLING, FLIP, FOLD), (DOUBLING, RESONANCE_2, TORUS), (DOUBLING, GRAZING, GRAZING),
            (TORUS, RESONANCE_1, FOLD), (TORUS, RESONANCE_2, DOUBLING), (TORUS, GRAZING, GRAZING),
            (GRAZING, FOLD, FOLD), (GRAZING, DOUBLING, DOUBLING), (GRAZING, SYMMETRY, SYMMETRY),
        )
    },
    (GRAZING, RESONANT): {to: partial(_point_near_resonance, to) for to in (FOLD, DOUBLING)},
}  # fmt: skip
