"""The local map of a grazing: what a periodic motion that just touches something does to others
near it.

Behind the motion stands its section map without the touch, which is smooth: from one reading of the
clock, that of the touch, to the next it is a matrix. A neighbour that would pass beyond the stop is
corrected by the discontinuity mapping. All numbers here are derivatives of what the machine says
(Nordmark 1991; di Bernardo, Budd, Champneys and Kowalczyk, Piecewise-smooth Dynamical Systems,
2008, chapters 6 to 8).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._programs import compiled
from ._corrector import tangent_at
from ._fewer_events import of_least_period, without_events
from ._shooting import Shooting
from ._touch import Touch, touch_at, touched
from .special import SpecialPoint, one

# A branch that is this steep in its parameter (share of a unit step in scaled unknowns) turns back.
_STEEP = 1e-6


class LocalMap(eqx.Module):
    """z ↦ N (z + kick·(-h)₊^order), h = slope·(p - p*) + ∂h·z: neighbours of a grazing motion, by
    how far they are from it where it grazes.

    A motion that grazes several times in its period has such a map for each touch; one leads to the
    next. Arrays of the host; m touches, n states.
    """

    matrices: np.ndarray
    """N, from each touch to the next; (m, n, n)."""
    gradients: np.ndarray
    """∂h at each; (m, n)."""
    kicks: np.ndarray
    """(m, n)."""
    orders: np.ndarray
    """Of the depth: 1/2 for a rigid stop; (m,)."""
    slopes: np.ndarray
    """Of h by the parameter; (m,)."""

    @property
    def matrix(self) -> np.ndarray:
        """Over the whole period, from the first touch on."""
        product = np.eye(self.matrices.shape[1])
        for N in self.matrices:
            product = N @ product
        return product

    def entries(self, count: int) -> np.ndarray:
        """e_n = ∂h·Nⁿ·kick of the first touch, n = 1 … count: what a penetration to the depth one
        adds to the distance n periods later."""
        found, u = [], self.kicks[0]
        for _ in range(count):
            u = self.matrix @ u
            found.append(self.gradients[0] @ u)
        return np.array(found)


class Section(NamedTuple):
    """The section of the smooth motion, beside the place where it grazes first."""

    state: np.ndarray
    slope: np.ndarray
    """Of the state by the parameter."""
    matrix: np.ndarray
    """From the first touch, whose kick is done, to the next section."""


class Graze(NamedTuple):
    """A grazing, as its local map says it."""

    problem: Shooting
    """Of the motion without the touch."""
    x: np.ndarray
    touches: list[Touch]
    map: LocalMap
    section: Section


def graze_at(point: SpecialPoint) -> Graze:
    """The local map of a special point that is a grazing.

    **Raises:** `ValueError` if nothing is touched there, if what is touched is no stop or switch,
    or if the motion turns back there in its parameter.
    """
    problem, x, number, clock = _without_touch(point)
    problem, x = of_least_period(problem, x)
    scale = problem.scale(point.scale[-1])
    tangent = tangent_at(problem, x, scale)
    if abs(tangent[-1]) < _STEEP:
        raise ValueError(
            "Argument `point` must be a grazing away from a fold, but the motion without the "
            "impact turns back there in its parameter."
        )
    along = tangent * scale / (tangent[-1] * scale[-1])
    period = float(problem.period(jnp.asarray(x)))
    touches = sorted(
        (touch_at(problem, x, along, *found) for found in touched(problem, x, number, clock)),
        key=lambda touch: touch.clock % period,
    )
    touches = touches[-1:] + touches[:-1]  # behind the first one comes the section
    ends = [
        touch.clock + (np.mod(then.clock - touch.clock, period) or period)
        for touch, then in zip(touches, [*touches[1:], touches[0]], strict=True)
    ]
    local = LocalMap(
        np.stack([
            transport(problem, x, touch.leg, touch.clock, end)
            for touch, end in zip(touches, ends, strict=True)
        ]),
        np.stack([touch.gradient for touch in touches]),
        np.stack([touch.kick.vector for touch in touches]),
        np.array([touch.kick.order for touch in touches]),
        np.array([touch.slope for touch in touches]),
    )  # fmt: skip
    return Graze(problem, x, touches, local, _section(problem, x, along, touches[0]))


def _without_touch(point: SpecialPoint) -> tuple[Shooting, np.ndarray, int, float]:
    """Equations and solution of the motion that grazes, without the impact that does; the event's
    number and the clock of the touch."""
    if point.kind != "grazing" or not point.touches:
        raise ValueError(
            "Argument `point` must be a grazing at which something is touched, but is "
            f"{one(point.kind)}: {point.detail}."
        )
    if not point.problem.follows_events:
        raise ValueError(
            "Argument `point` must be a grazing of a motion without rest on a stop, but this one "
            "rests."
        )
    old, x, i = point.problem, np.asarray(point.step.x), point.impact
    if i is None:
        nearest = point.step.seen.nearest
        return old, x, int(nearest.event), float(nearest.clock)
    if old.events[i].cycle is not None:
        raise ValueError(
            "Argument `point` must be a grazing of a stop, but there the section of the machine "
            "is touched: beyond it the motion has another number of cycles."
        )
    which = [i]
    if old.events[i].of(old.machine).holds_mode:
        beside = [j % old.legs for j in (i - 1, i + 1)]
        which += [j for j in beside if old.events[j].number == old.events[i].number][:1]
    which += [j for j in point.lost if j not in which]
    clock = float(np.asarray(old.parts(jnp.asarray(x))[0])[i])
    return *without_events(old, x, sorted(which)), old.events[i].number, clock


@compiled
def _carried(problem: Shooting, x, leg, s0, s1):
    """Derivative of the flight of a leg between two readings of the clock."""
    machine = problem.at(x)
    u = ravel_pytree(problem.state_at(x, leg, s0))[0]
    flight = problem.flight(machine, leg)
    return jax.jacfwd(lambda u: flight.fly(s0, s1, u, problem.steps)[0])(u)


@compiled
def _through(problem: Shooting, x, leg):
    """The saltation matrix of the event that begins a leg."""
    clock, states = problem.parts(x)
    return problem.saltation(problem.at(x), leg, clock[leg], states[leg])[0]


def transport(problem: Shooting, x: np.ndarray, leg: int, s0: float, s1: float) -> np.ndarray:
    """How a perturbation at clock `s0` is carried to a later clock, through all events between.

    **Arguments:** the equations of the motion and their solution; the leg in which `s0` lies;
    the later clock `s1`.
    """
    at, M = jnp.asarray(x), np.eye(problem.states)
    clock, period = np.asarray(problem.parts(at)[0]), float(problem.period(at))
    turn, begin, n = 0.0, s0, leg
    while True:
        end = (clock[n + 1] if n + 1 < len(clock) else clock[0] + period) + turn
        last = min(end, s1)
        if last > begin:
            between = jnp.asarray(begin - turn), jnp.asarray(last - turn)
            M = np.asarray(_carried(problem, at, n, *between)) @ M
        if s1 <= end:
            return M
        n = (n + 1) % problem.legs
        turn += period * (n == 0)
        begin = end
        if problem.events:
            M = np.asarray(_through(problem, at, n)) @ M


def _section(problem: Shooting, x: np.ndarray, along: np.ndarray, touch: Touch) -> Section:
    """The smooth motion on its first section.

    **Arguments:** as `touch_at`; the first touch.
    """
    at = jnp.asarray(x)
    clock, period = np.asarray(problem.parts(at)[0]), float(problem.period(at))
    place = period * (np.floor(touch.clock / period) + 1)
    # Legs begin at clocks within one period of the first.
    within = clock[0] + np.mod(place - clock[0], period) if problem.events else 0.0
    leg = max(0, int(np.searchsorted(clock, within, side="right")) - 1)
    state, slope = _placed(problem, at, jnp.asarray(along), leg, jnp.asarray(within))
    matrix = transport(problem, x, touch.leg, touch.clock, place)
    if problem.events and problem.events[0].cycle is not None:  # the section is an event
        matrix = np.asarray(_through(problem, at, 0)) @ matrix
    return Section(np.asarray(state), np.asarray(slope), matrix)


@compiled
def _placed(problem: Shooting, x, along, leg, s):
    """The state at a clock, and its derivative along the unknowns."""

    def there(x):
        return ravel_pytree(problem.state_at(x, leg, s))[0]

    return jax.jvp(there, (x,), (along,))
