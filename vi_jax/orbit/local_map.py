"""The local map of a grazing: the dynamics near a periodic motion that just touches something.

Without the touch the motion has a smooth section map: a matrix from one touch to the next, at fixed
readings of the clock. The discontinuity mapping corrects neighbours that would pass beyond the
stop. All numbers here are derivatives of the machine's functions (Nordmark 1991; di Bernardo, Budd,
Champneys and Kowalczyk, Piecewise-smooth Dynamical Systems, 2008, chapters 6 to 8).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .corrector import host_program, since_section, tangent_at
from .edit_events import with_least_period, with_sections, without_events
from .equations import Shooting
from .kinds import with_article
from .special import Point
from .tolerances import BRIEF, LOCATED
from .touch import NoLocalMapError, Touch, find_touches, touch_at


class LocalMap(eqx.Module):
    """The map z ↦ N (z + kick·(-h)₊^order), h = slope·(p - p*) + ∂h·z, of neighbours of a grazing
    motion, with their displacement z from it at the touch, in the sizes of the state.

    A motion that grazes several times in its period has such a map for each touch, from which it
    leads to the next. Host arrays; m touches, n states.
    """

    matrices: np.ndarray
    """N, from each touch to the next; (m, n, n)."""
    gradients: np.ndarray
    """∂h at each touch; (m, n)."""
    kicks: np.ndarray
    """The vector of each kick; (m, n)."""
    orders: np.ndarray
    """The power of the depth in each kick, 1/2 for a rigid stop; (m,)."""
    slopes: np.ndarray
    """Derivative of h with respect to the parameter; (m,)."""

    @property
    def matrix(self) -> np.ndarray:
        """The matrix of the whole period, from the first touch on."""
        product = np.eye(self.matrices.shape[1])
        for N in self.matrices:
            product = N @ product
        return product

    def entries(self, count: int) -> np.ndarray:
        """Return e_n = ∂h·Nⁿ·kick of the first touch, n = 1 … count: the change of the distance n
        periods after a penetration of depth one."""
        found, u, matrix = [], self.kicks[0], self.matrix
        for _ in range(count):
            u = matrix @ u
            found.append(self.gradients[0] @ u)
        return np.array(found)

    def kicked(self, n: int, touch: int = 0) -> np.ndarray:
        """Return the states after the kick and after each of n periods, (n + 1, states), of a
        motion with one kick of depth one in n periods, at this touch. They are solved for together,
        as a power of an unstable matrix is singular to rounding."""
        size = len(self.matrix)
        steps = np.kron(np.eye(n + 1, k=-1), self.matrix)
        steps[:size, -size:] += np.eye(size)  # the last one precedes the kick
        right = np.append(self.kicks[touch], np.zeros(n * size))
        return np.linalg.solve(np.eye(len(steps)) - steps, right).reshape(n + 1, size)

    def passages(self, n: int) -> np.ndarray:
        """Return ∂h (Nʲ - Nⁿ) (I - Nⁿ)⁻¹ kick, j = 1 … n - 1: the distances at the passages between
        the impacts, with one impact of depth one in n periods. They must be positive."""
        found = self.kicked(n)[1:] @ self.gradients[0]
        return found[:-1] - found[-1]

    def resonance(self, n: int, sign: int) -> float:
        """Return ∂h adj(±I - Nⁿ) Nⁿ kick, which is eₙ for two components of the state. It is zero
        where a curve of folds (`sign` 1) or doublings (-1) of the motion with one impact in n
        periods leaves the curve of grazings."""
        power, unit = np.linalg.matrix_power(self.matrix, n), sign * np.eye(len(self.matrix))
        kicked = np.outer(power @ self.kicks[0], self.gradients[0])
        return float(np.linalg.det(unit - power + kicked) - np.linalg.det(unit - power))


class Section(NamedTuple):
    """The section of the smooth motion near its first grazing."""

    state: np.ndarray
    slope: np.ndarray
    """Derivative of the state with respect to the parameter."""
    matrix: np.ndarray
    """The matrix from just after the first touch's kick to the next section, in the state's sizes.
    """


class LocalGrazing(NamedTuple):
    problem: Shooting
    """The equations of the motion without the touch."""
    x: np.ndarray
    touches: list[Touch]
    map: LocalMap
    section: Section

    @property
    def sizes(self) -> np.ndarray:
        """The sizes of the state, the units of the map's displacements."""
        return np.asarray(self.problem.sizes)[1:]


def graze_at(point: Point) -> LocalGrazing:
    problem, x, number, clock = _without_touch(point)
    problem, x = with_least_period(problem, x)
    scale, tangent = problem.scale, tangent_at(problem, x)
    if abs(tangent[-1]) < LOCATED:
        raise NoLocalMapError(
            "Argument `point` must be a grazing away from a fold, but the motion without the "
            "impact turns back there in its parameter."
        )
    along = tangent * scale / (tangent[-1] * scale[-1])
    period = float(problem.period(x))
    places = find_touches(problem, x, number, clock)
    touches = [touch_at(problem, x, along, *place) for place in places]
    touches.sort(key=lambda touch: touch.clock % period)
    touches = touches[-1:] + touches[:-1]  # the section follows the first touch
    ends = [
        touch.clock + (np.mod(following.clock - touch.clock, period) or period)
        for touch, following in zip(touches, [*touches[1:], touches[0]], strict=True)
    ]
    sizes = np.asarray(problem.sizes)[1:]
    matrices = [
        transport(problem, x, touch.leg, touch.clock, end)
        for touch, end in zip(touches, ends, strict=True)
    ]
    local = LocalMap(
        np.stack(matrices) * sizes / sizes[:, None],
        np.stack([touch.gradient for touch in touches]) * sizes,
        np.stack([touch.kick.vector for touch in touches]) / sizes,
        np.array([touch.kick.order for touch in touches]),
        np.array([touch.slope for touch in touches]),
    )  # fmt: skip
    return LocalGrazing(problem, x, touches, local, _section(problem, x, along, touches[0]))


def _without_touch(point: Point) -> tuple[Shooting, np.ndarray, int, float]:
    """Return the motion without the grazing impact, the event's number and its clock."""
    if point.kind != "grazing" or not point.touches:
        raise NoLocalMapError(
            "Argument `point` must be a grazing at which something is touched, but is "
            f"{with_article(point.kind)}: {point.detail}."
        )
    if point.problem.landings:
        raise NoLocalMapError(
            "Argument `point` must be a grazing of a motion without rest on a stop, but this one "
            "rests."
        )
    old, x, i = point.problem, np.asarray(point.step.x), point.impact
    if i is None:
        nearest = point.step.observed.nearest
        clock = since_section(old, x, float(nearest.clock))
        return *with_sections(old, x), int(nearest.event), clock
    if old.events[i].cycle is not None:
        raise NoLocalMapError(
            "Argument `point` must be a grazing of a stop, but there the section of the machine "
            "is touched: beyond it the motion has another number of cycles."
        )
    removed = {i, *point.lost}
    if old.events[i].of(old.machine).holds_mode:
        removed |= _changes_at_once(old, x, i)
    clock = since_section(old, x, float(old.values(x)[0][i]))
    return *with_sections(*without_events(old, x, sorted(removed))), old.events[i].number, clock


def _changes_at_once(problem: Shooting, x: np.ndarray, i: int) -> set[int]:
    """Return the events that coincide with event `i`, of the same switch: all of a brief contact,
    of which the release may come before the end."""
    is_brief = problem.lengths(x) < BRIEF * problem.radian
    found = {i}
    for step, leg in ((1, 0), (-1, -1)):
        j = i
        while is_brief[(j + leg) % problem.legs]:
            j = (j + step) % problem.legs
            if j in found or problem.events[j].number != problem.events[i].number:
                break
            found.add(j)
    return found


@host_program
def _flight_matrix(problem: Shooting, x, leg, s0, s1):
    machine = problem.at(x)
    u = ravel_pytree(problem.state_at(x, leg, s0))[0]
    flight = problem.flight(machine, leg)
    return jax.jacfwd(lambda u: flight.fly(s0, s1, u, problem.steps)[0])(u)


@host_program
def _event_matrix(problem: Shooting, x, leg):
    clock, states = problem.parts(x)
    return problem.saltation(problem.at(x), leg, clock[leg], states[leg])[0]


def transport(problem: Shooting, x: np.ndarray, leg: int, s0: float, s1: float) -> np.ndarray:
    """Return the matrix that maps a perturbation at clock `s0` in this leg to a later clock."""
    M, (clock, _, period) = np.eye(problem.states), problem.values(x)
    shift, begin, n = 0.0, s0, leg
    while True:
        end = (clock[n + 1] if n + 1 < len(clock) else clock[0] + period) + shift
        segment_end = min(end, s1)
        if segment_end > begin:
            M = _flight_matrix(problem, x, n, begin - shift, segment_end - shift) @ M
        if s1 <= end:
            return M
        n = (n + 1) % problem.legs
        shift += period * (n == 0)
        begin = end
        if problem.events:
            M = _event_matrix(problem, x, n) @ M


def _section(problem: Shooting, x: np.ndarray, along: np.ndarray, touch: Touch) -> Section:
    period = float(problem.period(x))
    place = period * (np.floor(touch.clock / period) + 1)
    leg, leg_clock = problem.leg_at(x, place if problem.events else 0.0)
    state, slope = _section_state(problem, x, along, leg, leg_clock)
    matrix = transport(problem, x, touch.leg, touch.clock, place)
    if problem.events and problem.events[0].cycle is not None:  # the section is an event
        matrix = _event_matrix(problem, x, 0) @ matrix
    sizes = np.asarray(problem.sizes)[1:]
    return Section(state, slope, matrix * sizes / sizes[:, None])


@host_program
def _section_state(problem: Shooting, x, along, leg, s):
    """Return the state on the section at clock `s`, and its derivative along the parameter."""
    turns = jnp.round(s / problem.period(x))  # 0 or 1: the section moves with the period

    def placed(x):
        return ravel_pytree(problem.state_at(x, leg, turns * problem.period(x)))[0]

    return jax.jvp(placed, (x,), (along,))
