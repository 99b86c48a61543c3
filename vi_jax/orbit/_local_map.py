"""The local map of a grazing: what a periodic motion that just touches something does to others
near it.

Behind the motion stands its section map without the touch, which is smooth: from one reading of the
clock, that of the touch, to the next it is a matrix. A neighbour that would pass beyond the stop is
corrected by the discontinuity mapping. All numbers here are derivatives of what the machine says
(Nordmark 1991; di Bernardo, Budd, Champneys and Kowalczyk, Piecewise-smooth Dynamical Systems,
2008, chapters 6 to 8).
"""

from math import log2
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..flow import guard_rates
from ..machine import after_event, events_of, guard_of, jump_of, stops_of
from ._flight import Event, Flight
from ._shooting import Shooting
from ._solution import on_host, tangent_at
from ._surgery import of_least_period, without_events
from ._turns import Path, turning
from ._words import one
from .special import Point

# A field that differs by less than this share of its size is continuous at a switch: a choice.
_CONTINUOUS = 1e-9

# How far off a touch is located, as a share of the state: a choice, ten times what is promised.
_PLACED = 1e-12

# The first contact lasts so much of a cycle, each further one a quarter of that, at most so many of
# them. Measured powers that agree within this are settled. Steps of a flight. Choices.
_SHARE, _TRIES, _AGREE, _STEPS = 0.02, 10, 0.03, 8

# The first contact is so brief that what turns the motion back anyway does most: there a stop gives
# less than this share of it. A deeper contact with a stiff stop is an impact, with powers of its
# own. A choice, with which the kick of a spring is right to 1e-3.
_WEAK = 0.03


class Kick(NamedTuple):
    """By how much an impact changes the state: vector·(-h)^order, at a fixed reading of the
    clock, h being the least distance that there would be without it."""

    vector: np.ndarray
    order: float


def soft_kick(
    problem: Shooting, x: np.ndarray, number: int, leg: int, clock: float, u: np.ndarray,
    gradient: np.ndarray, fast: np.ndarray, rate: float,
) -> Kick:  # fmt: skip
    """The kick of a switch that a motion grazes at this clock in the state u: `gradient` and `fast`
    are those of the distance h and of dh/ds, `rate` is d²h/ds²."""

    def fields(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The field, and what it is more beyond the surface."""
        before, after = _fields_beside_surface(problem, x, number, leg, clock, u)
        return before, after - before

    def greatest(length: float) -> tuple[float, np.ndarray]:
        """The root of the depth of a contact of this length, and the state there."""
        y = length * np.sqrt(rate / 8)
        return y, u - gradient / (gradient @ gradient) * y * y

    length = _SHARE * float(problem.period(x)) / problem.cycles
    (field, change), (y, deep) = fields(u), greatest(length)
    push = fields(deep)[1]
    # A stiff stop pushes by rounding, as far as the place of the touch is known.
    known = _PLACED * np.abs(gradient) @ np.abs(u) / y**2
    rounded = max(_CONTINUOUS * np.abs(field).max(), known * np.abs(push).max())
    if np.abs(change).max() > rounded:
        back = rate + float(fast @ change)
        if back <= 0:
            raise ValueError(
                "Argument `point` must be a grazing at which the motion leaves the surface again, "
                "but beyond the surface it would stick or continue: d²h/ds² changes from "
                f"{rate:.3g} to {back:.3g}."
            )
        return Kick(2 * np.sqrt(2 * rate) / back * change, 0.5)
    for _ in range(_TRIES):
        if abs(fast @ push) <= _WEAK * rate:
            break
        length /= 4
        push = fields(greatest(length)[1])[1]
    measured: list[tuple[float, np.ndarray]] = []
    orders: list[float] = []
    for _ in range(_TRIES):
        y, deep = greatest(length)
        measured.append((y, _change_by_contact(problem, x, number, leg, clock, deep, length)))
        if len(measured) > 1:
            (y0, k0), (y1, k1) = measured[-2:]
            order = log2(np.linalg.norm(k0) / np.linalg.norm(k1)) / log2(y0 / y1) / 2
            orders.append(order)
            if len(orders) > 1 and abs(orders[-1] - orders[-2]) < _AGREE:
                break
        length /= 4
    order = round(2 * orders[-1]) / 2 if abs(orders[-1] % 0.5 - 0.25) > 0.2 else orders[-1]
    (y0, k0), (y1, k1) = measured[-2:]
    first, second = k0 / y0 ** (2 * order), k1 / y1 ** (2 * order)
    # What is left of the first falls by four with the length, as its size does.
    return Kick(second + (second - first) / 3, order)


def _modes_beside_switch(problem: Shooting, machine, number, leg, s, u):
    before = problem.modes_in(leg)
    return before, after_event(machine, number, s, problem.unravel(u), before)[1]


@on_host
def _fields_beside_surface(problem: Shooting, x, number: int, leg, s, u):
    machine = problem.at(x)
    modes = _modes_beside_switch(problem, machine, number, leg, s, u)
    flights = [Flight(machine, m, problem.method, problem.like) for m in modes]
    state = problem.unravel(u)
    return jnp.stack([ravel_pytree(flight.smooth.field(s, state))[0] for flight in flights])


@on_host
def _fly(problem: Shooting, x, number: int, leg, touching: bool, s0, s1, u):
    """The state at `s1` and the guard there, in contact or apart."""
    machine = problem.at(x)
    # A body that just comes in: which mode that is, no rounding is to decide.
    modes = _modes_beside_switch(problem, machine, number, leg, s0, u)[int(touching)]
    end = Flight(machine, modes, problem.method, problem.like).fly(s0, s1, u, _STEPS)[0]
    return end, guard_of(machine, number, s1, problem.unravel(end), modes)


def _change_by_contact(problem: Shooting, x, number, leg, s, deep, length) -> np.ndarray:
    """What a contact changes in the state; `deep`, the greatest depth of the free flight."""
    from scipy.optimize import brentq  # slow to load

    unit = problem.radian

    def root(function: Any, low: float, high: float) -> float:
        off = lambda s1: float(function(s1)[1])
        if off(low) * off(high) > 0:
            raise ValueError(
                "Argument `point` must be a grazing of a stop that is less stiff: a contact so "
                "brief that it bends the motion little is less deep than rounding. Take a "
                "`RigidStop`."
            )
        found: Any = brentq(off, low, high, xtol=1e-15 * unit)
        return float(found)

    def apart(s1):
        return _fly(problem, x, number, leg, False, s, s1, deep)

    enters = root(apart, s - length, s)
    begin = apart(enters)[0]

    def inside(s1):
        return _fly(problem, x, number, leg, True, enters, s1, begin)

    places = enters + length * np.linspace(0, 1.5, 49)[1:]
    values = [float(inside(place)[1]) for place in places]
    below = [i for i, value in enumerate(values) if value < 0]
    first = below[0] if below else 0
    out = next((i for i in range(first, len(values)) if values[i] >= 0), None)
    if out is None:
        raise ValueError(
            "Argument `point` must be a grazing at which the motion leaves the surface again, but "
            "a brief contact does not end."
        )
    leaves = places[out]
    if out > 0 and values[out - 1] < 0:
        leaves = root(inside, places[out - 1], places[out])
    free = _fly(problem, x, number, leg, False, enters, leaves, begin)[0]
    return inside(leaves)[0] - free


# A turn this near to a stop, as a share of the motion, touches it: as for the special points.
_TOUCHES = 1e-6

# Touches that are closer than this share of a period are one: the depth of what is between them is
# then of the order of `_TOUCHES`. A choice.
_APART = 1e-3

# How fast a body approaches a stop on which its rebound is differentiated, as a share of the
# motion's speed: laws that depend on the speed are taken at this one. A choice.
_SLOW = 1e-8


class Touch(NamedTuple):
    """Where the motion grazes, and what an impact there would do."""

    number: int
    """The event's number among the machine's events."""
    leg: int
    """The flight in which it lies."""
    clock: float
    state: np.ndarray
    gradient: np.ndarray
    """∂h: of the distance by the state."""
    rate: float
    """a = d²h/ds², positive."""
    slope: float
    """Of the least distance by the parameter, along the motion."""
    kick: Kick
    """What the state loses by an impact, by the depth."""


@on_host
def _rooms(problem: Shooting, x):
    """Distance and clock of each turn; (legs, events, steps) each."""
    machine = problem.at(x)
    clock, states = problem.parts(x)

    def follow(leg, s0, s1, u):
        after = problem.after(machine, leg, s0, u)
        flight = problem.flight(machine, leg)
        _, _, path = flight.fly(s0, s1, after, problem.steps)
        h = (s1 - s0) / problem.steps
        _, rooms = turning(Path(flight, path[0], path[1], h, not problem.events))
        return jnp.stack([room for room, _ in rooms]), jnp.stack([s for _, s in rooms])

    ends = problem.ends(clock, problem.period(x))
    return jax.vmap(follow)(jnp.arange(problem.legs), clock, ends, states)


def touched(
    problem: Shooting, x: np.ndarray, number: int, clock: float, length: float
) -> list[tuple[int, int, float]]:
    """Event, leg and clock of each touch of a motion that goes as far as `length`, each once. The
    one that is known may fall on the end of a flight, where no turn is seen."""
    (rooms, places), period = _rooms(problem, x), float(problem.period(x))
    leg, within = problem.leg_at(x, clock)
    found = [(number, int(leg), float(within))]
    for leg, other, step in np.argwhere(np.abs(rooms) <= _TOUCHES * length):
        place = float(places[leg, other, step])
        apart = [
            abs((place - known + period / 2) % period - period / 2)
            for event, _, known in found
            if event == other
        ]
        if min(apart, default=period) > _APART * period:
            found.append((int(other), int(leg), place))
    return found


@on_host
def _at_touch(problem: Shooting, x, along, number: int, leg, s):
    """At a touch the state, ∂h, a, dh by the parameter, the gradient of dh/ds, and the kick."""

    def distance(machine, s, u):
        return -guard_of(machine, number, s, problem.unravel(u), problem.modes_in(leg))

    def guard_and_state(x):
        u = ravel_pytree(problem.state_at(x, leg, s))[0]
        return distance(problem.at(x), s, u), u

    _, slope, u = jax.jvp(guard_and_state, (x,), (along,), has_aux=True)
    machine = problem.at(x)
    field = problem.flight(machine, leg).smooth.field

    def rates(u):
        def guard(s, state):
            return distance(machine, s, ravel_pytree(state)[0])

        return guard_rates(field, guard, s, problem.unravel(u))

    def jumped(u):
        state = jump_of(machine, number, s, problem.unravel(u), problem.modes_in(leg))
        return ravel_pytree(state)[0]

    gradient = jax.grad(lambda u: distance(machine, s, u))(u)
    fast, rate, kick = jax.grad(lambda u: rates(u).v)(u), rates(u).a, None
    if number < len(stops_of(machine)):
        push = fast / (fast @ fast)
        unit = jnp.linalg.norm(gradient * problem.sizes[1:]) / problem.sizes[0]
        after = jax.jvp(jumped, (u - _SLOW * unit * push,), (push,))[1]
        kick = -jnp.sqrt(2 * rate) * (after - push)
    return u, gradient, rate, slope, fast, kick


def touch_at(
    problem: Shooting, x: np.ndarray, along: np.ndarray, number: int, leg: int, clock: float
) -> Touch:
    """All about one touch; `along`, the derivative of the motion by the parameter."""
    event = events_of(problem.machine)[number]
    u, gradient, rate, slope, fast, impact = _at_touch(problem, x, along, number, leg, clock)
    if not rate > 0:
        raise ValueError(
            f"Argument `point` must be a grazing at which the motion turns, but the "
            f"distance's second derivative is {float(rate):.3g} there."
        )
    if impact is not None:
        kick = Kick(impact, 0.5)
    elif event.holds_mode:
        kick = soft_kick(problem, x, number, leg, clock, u, gradient, fast, float(rate))
    else:
        called = Event(number).called(problem.machine)
        raise ValueError(
            "Argument `point` must be the grazing of a stop or a switch, but it touches the "
            f"{called}, whose jump does not vanish with the speed."
        )
    return Touch(number, leg, clock, u, gradient, float(rate), float(slope), kick)


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

    def later(self, u: np.ndarray, count: int) -> np.ndarray:
        """∂h·Nⁿ·u, n = 1 … count."""
        found, matrix = [], self.matrix
        for _ in range(count):
            u = matrix @ u
            found.append(self.gradients[0] @ u)
        return np.array(found)

    def entries(self, count: int) -> np.ndarray:
        """e_n = ∂h·Nⁿ·kick of the first touch, n = 1 … count: what a penetration to the depth one
        adds to the distance n periods later."""
        return self.later(self.kicks[0], count)

    def passages(self, n: int) -> np.ndarray:
        """What one impact of depth one in n periods leaves of the distance at the passages between
        its impacts, which must be positive: ∂h (Nʲ - Nⁿ) (I - Nⁿ)⁻¹ kick, j = 1 … n - 1."""
        power = np.linalg.matrix_power(self.matrix, n)
        found = self.later(np.linalg.solve(np.eye(len(power)) - power, self.kicks[0]), n)
        return found[:-1] - found[-1]

    def resonance(self, n: int, sign: int) -> float:
        """Zero where a curve of folds (`sign` 1) or doublings (-1) of the motion with one impact in
        n periods leaves the curve of grazings: ∂h adj(±I - Nⁿ) Nⁿ kick. With two numbers in the
        state that is eₙ."""
        power, unit = np.linalg.matrix_power(self.matrix, n), sign * np.eye(len(self.matrix))
        kicked = np.outer(power @ self.kicks[0], self.gradients[0])
        return float(np.linalg.det(unit - power + kicked) - np.linalg.det(unit - power))


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


def graze_at(point: Point) -> Graze:
    """The local map of a special point that is a grazing of a stop or a switch."""
    problem, x, number, clock = _without_touch(point)
    problem, x = of_least_period(problem, x)
    scale, tangent = problem.scale, tangent_at(problem, x)
    if abs(tangent[-1]) < _STEEP:
        raise ValueError(
            "Argument `point` must be a grazing away from a fold, but the motion without the "
            "impact turns back there in its parameter."
        )
    along = tangent * scale / (tangent[-1] * scale[-1])
    period = float(problem.period(x))
    places = touched(problem, x, number, clock, point.step.seen.length)
    touches = [touch_at(problem, x, along, *place) for place in places]
    touches.sort(key=lambda touch: touch.clock % period)
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


def _without_touch(point: Point) -> tuple[Shooting, np.ndarray, int, float]:
    """The motion that grazes without the impact that does; the event's number and its clock."""
    if point.kind != "grazing" or not point.touches:
        raise ValueError(
            "Argument `point` must be a grazing at which something is touched, but is "
            f"{one(point.kind)}: {point.detail}."
        )
    if point.problem.landings:
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
    clock = float(old.values(x)[0][i])
    return *without_events(old, x, sorted(which)), old.events[i].number, clock


@on_host
def _carried(problem: Shooting, x, leg, s0, s1):
    machine = problem.at(x)
    u = ravel_pytree(problem.state_at(x, leg, s0))[0]
    flight = problem.flight(machine, leg)
    return jax.jacfwd(lambda u: flight.fly(s0, s1, u, problem.steps)[0])(u)


@on_host
def _through(problem: Shooting, x, leg):
    """The saltation matrix of the event that begins a leg."""
    clock, states = problem.parts(x)
    return problem.saltation(problem.at(x), leg, clock[leg], states[leg])[0]


def transport(problem: Shooting, x: np.ndarray, leg: int, s0: float, s1: float) -> np.ndarray:
    """How a perturbation at clock `s0`, in this leg, is carried to a later clock."""
    M, (clock, _, period) = np.eye(problem.states), problem.values(x)
    turn, begin, n = 0.0, s0, leg
    while True:
        end = (clock[n + 1] if n + 1 < len(clock) else clock[0] + period) + turn
        last = min(end, s1)
        if last > begin:
            M = _carried(problem, x, n, begin - turn, last - turn) @ M
        if s1 <= end:
            return M
        n = (n + 1) % problem.legs
        turn += period * (n == 0)
        begin = end
        if problem.events:
            M = _through(problem, x, n) @ M


def _section(problem: Shooting, x: np.ndarray, along: np.ndarray, touch: Touch) -> Section:
    """The smooth motion on its first section."""
    period = float(problem.period(x))
    place = period * (np.floor(touch.clock / period) + 1)
    leg, within = problem.leg_at(x, place if problem.events else 0.0)
    state, slope = _placed(problem, x, along, leg, within)
    matrix = transport(problem, x, touch.leg, touch.clock, place)
    if problem.events and problem.events[0].cycle is not None:  # the section is an event
        matrix = _through(problem, x, 0) @ matrix
    return Section(state, slope, matrix)


@on_host
def _placed(problem: Shooting, x, along, leg, s):
    """The state on the section at clock `s`, and its derivative by the parameter."""
    turns = jnp.round(s / problem.period(x))  # 0 or 1: the section moves with the period

    def placed(x):
        return ravel_pytree(problem.state_at(x, leg, turns * problem.period(x)))[0]

    return jax.jvp(placed, (x,), (along,))
