"""Touches of a stop or a surface by a motion, and the kick that an impact gives there."""

from collections.abc import Callable
from math import log2
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..flow import guard_rates
from ..machine import after_event, events_of, guard_of, jump_of, stops_of
from .corrector import host_program
from .equations import Shooting
from .flight import Event, Flight
from .locate import bracketed_zero
from .tolerances import BRIEF, EXACT, LOCATED, ROUNDING
from .turns import Path, turning_points

# Duration of the first contact in cycles; each further contact has half of it; most contacts;
# measured powers that agree within the first number have converged, at rounding those within the
# second; steps of a flight. Choices.
_SHARE, _TRIES, _AGREE, _SIMILAR, _STEPS = 0.02, 12, 1e-3, 0.03, 4

# The first contact is so brief that the stop adds less than this share to the acceleration that
# turns the motion back anyway. A deeper contact with a stiff stop is an impact, with other powers.
# A choice, with which the kick of a spring is correct to 1e-3.
_WEAK = 0.03


# Share of a kick that may be rounding.
_NOISE = 3e-3

_TOO_STIFF = (
    "Argument `point` must be a grazing of a stop that is less stiff: a contact so brief that it "
    "bends the motion little is less deep than rounding. Take a `RigidStop`."
)


class NoLocalMapError(ValueError):
    """A grazing has no local map; the message is that of an argument `point`."""


class Kick(NamedTuple):
    """The change of the state by an impact: vector·(-h)^order at a fixed reading of the clock, with
    the least distance h without the impact."""

    vector: np.ndarray
    order: float


def soft_kick(
    problem: Shooting, x: np.ndarray, number: int, leg: int, clock: float, u: np.ndarray,
    touching: np.ndarray, gradient: np.ndarray, fast: np.ndarray, rate: float,
) -> Kick:  # fmt: skip
    """Return the kick of a switch that a motion grazes at this clock in the state u; `touching` is
    that state without the error of its distance and speed, `gradient` and `fast` are the gradients
    of the distance h and of dh/ds, `rate` is d²h/ds²."""

    def fields(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the field, and the change of the field beyond the surface."""
        before, after = _fields_at_surface(problem, x, number, leg, clock, u)
        return before, after - before

    def deepest_at(length: float) -> tuple[float, np.ndarray]:
        """Return the root of the depth of a contact of this length, and the state there."""
        y = length * np.sqrt(rate / 8)
        return y, touching - gradient / (gradient @ gradient) * y * y

    length = _SHARE * float(problem.period(x)) / problem.cycles
    (field, change), (y, deepest) = fields(touching), deepest_at(length)
    deep_change, sizes = fields(deepest)[1], np.asarray(problem.sizes)[1:]
    # A stiff stop pushes by rounding.
    place = float(np.abs(gradient) @ np.abs(u))
    depth_error = 4 * np.finfo(float).eps * place
    largest = lambda rates: np.abs(rates / sizes).max()
    rounding = max(ROUNDING * largest(field), EXACT * place / y**2 * largest(deep_change))
    if largest(change) > rounding:
        rate_beyond = rate + float(fast @ change)
        if rate_beyond <= 0:
            raise NoLocalMapError(
                "Argument `point` must be a grazing at which the motion leaves the surface again, "
                "but beyond the surface it would stick or continue: d²h/ds² changes from "
                f"{rate:.3g} to {rate_beyond:.3g}."
            )
        return Kick(2 * np.sqrt(2 * rate) / rate_beyond * change, 0.5)
    for _ in range(_TRIES):
        if abs(fast @ deep_change) <= _WEAK * rate:
            break
        length /= 4
        deep_change = fields(deepest_at(length)[1])[1]
    measured: list[tuple[float, np.ndarray]] = []
    orders: list[float] = []
    for _ in range(_TRIES):
        y, deepest = deepest_at(length)
        # An error of the depth is an impulse by a spring, its change one by a dashpot.
        speed = np.sqrt(2 * rate) * y
        dashpot = fields(touching - fast / (fast @ fast) * speed)[1] / speed
        error = 2 * np.sqrt(2 / rate) / y * largest(fields(deepest)[1]) + largest(dashpot)
        kick = _change_by_contact(problem, x, number, leg, clock, deepest, length)
        if depth_error * error > _NOISE * largest(kick):
            break
        measured.append((y, kick))
        if len(measured) > 1:
            (y0, k0), (y1, k1) = measured[-2:]
            order = log2(np.linalg.norm(k0 / sizes) / np.linalg.norm(k1 / sizes))
            orders.append(order / (2 * log2(y0 / y1)))
        if len(orders) > 1 and abs(orders[-1] - orders[-2]) < _AGREE:
            break
        length /= 2
    if len(orders) < 2 or abs(orders[-1] - orders[-2]) > _SIMILAR:
        raise NoLocalMapError(_TOO_STIFF)
    order = round(2 * orders[-1]) / 2 if abs(orders[-1] % 0.5 - 0.25) > 0.2 else orders[-1]
    (y0, k0), (y1, k1) = measured[-2:]
    first, second = k0 / y0 ** (2 * order), k1 / y1 ** (2 * order)
    # The error of the first falls with the length, as its size does.
    return Kick(2 * second - first, order)


def _modes_around_switch(problem: Shooting, machine, number, leg, s, u):
    before = problem.modes_in(leg)
    return before, after_event(machine, number, s, problem.unravel(u), before)[1]


@host_program
def _fields_at_surface(problem: Shooting, x, number: int, leg, s, u):
    machine = problem.at(x)
    modes = _modes_around_switch(problem, machine, number, leg, s, u)
    flights = [Flight(machine, m, problem.method, problem.like) for m in modes]
    return jnp.stack([flight.rate(s, u) for flight in flights])


@host_program
def _fly(problem: Shooting, x, number: int, leg, touching: bool, s0, s1, u):
    """Return the state at `s1` and the guard there, in contact or apart."""
    machine = problem.at(x)
    # The mode must not depend on rounding: at the touch the body just comes in.
    modes = _modes_around_switch(problem, machine, number, leg, s0, u)[int(touching)]
    end = Flight(machine, modes, problem.method, problem.like).fly(s0, s1, u, _STEPS)[0]
    return end, guard_of(machine, number, s1, problem.unravel(end), modes)


def _change_by_contact(problem: Shooting, x, number, leg, s, deep, length) -> np.ndarray:
    """Return the change of the state by a contact; `deep` is the free flight's deepest state."""
    unit = problem.radian

    def root(function: Callable[[float], Any], low: float, high: float) -> float:
        guard = lambda s1: float(function(s1)[1])
        try:
            return bracketed_zero(guard, low, high, tolerance=1e-15 * unit)
        except ArithmeticError:
            raise NoLocalMapError(_TOO_STIFF) from None

    def free_flight(s1):
        return _fly(problem, x, number, leg, False, s, s1, deep)

    contact_begin = root(free_flight, s - length, s)
    begin = free_flight(contact_begin)[0]

    def contact_flight(s1):
        return _fly(problem, x, number, leg, True, contact_begin, s1, begin)

    clocks = contact_begin + length * np.linspace(0, 1.5, 49)[1:]
    values = [float(contact_flight(clock)[1]) for clock in clocks]
    negative = [i for i, value in enumerate(values) if value < 0]
    first = negative[0] if negative else 0
    end_index = next((i for i in range(first, len(values)) if values[i] >= 0), None)
    if end_index is None:
        raise NoLocalMapError(
            "Argument `point` must be a grazing at which the motion leaves the surface again, but "
            "a brief contact does not end."
        )
    contact_end = clocks[end_index]
    if end_index > 0 and values[end_index - 1] < 0:
        contact_end = root(contact_flight, clocks[end_index - 1], clocks[end_index])
    free_end = _fly(problem, x, number, leg, False, contact_begin, contact_end, begin)[0]
    return contact_flight(contact_end)[0] - free_end


# Speed of approach, as a share of the motion's, at which rebounds are differentiated: laws that
# depend on the speed are taken at this one. A choice.
_SLOW = 1e-8


class Touch(NamedTuple):
    """A place where the motion grazes, and the effect of an impact there."""

    number: int
    """The event's number among the machine's events."""
    leg: int
    """The flight that contains it."""
    clock: float
    state: np.ndarray
    gradient: np.ndarray
    """∂h, the distance's derivative with respect to the state."""
    rate: float
    """a, the second derivative of the distance h from the event with respect to s; positive."""
    slope: float
    """Derivative of the least distance with respect to the parameter, along the motion."""
    kick: Kick
    """The change of the state by an impact, as a function of the depth."""


@host_program
def _turn_margins(problem: Shooting, x):
    """Return the distance of each turn, as a share of its size along the motion, and its clock;
    (legs, events, steps) each."""
    machine = problem.at(x)
    clock, states = problem.parts(x)

    def follow(leg, s0, s1, u):
        after = problem.after(machine, leg, s0, u)
        flight = problem.flight(machine, leg)
        _, _, path = flight.fly(s0, s1, after, problem.steps, rows=problem.steps)
        h = (s1 - s0) / problem.steps
        _, margins = turning_points(Path(flight, path[0], path[1], h, not problem.events))
        sizes = problem.guard_sizes(flight, s0, after)
        shares = [margin / size for (margin, _), size in zip(margins, sizes, strict=False)]
        return jnp.stack(shares), jnp.stack([s for _, s in margins])

    ends = problem.ends(clock, problem.period(x))
    return jax.vmap(follow)(jnp.arange(problem.legs), clock, ends, states)


def find_touches(
    problem: Shooting, x: np.ndarray, number: int, clock: float
) -> list[tuple[int, int, float]]:
    """Return event, leg and clock of each touch of a motion, each once. The known touch may fall on
    the end of a flight, where no turn is found."""
    (distances, places), period = _turn_margins(problem, x), float(problem.period(x))
    leg, leg_clock = problem.leg_at(x, clock)
    found = [(number, int(leg), float(leg_clock))]
    for leg, other, step in np.argwhere(np.abs(distances) <= LOCATED):
        place = float(places[leg, other, step])
        time_differences = [
            abs((place - known + period / 2) % period - period / 2)
            for event, _, known in found
            if event == other
        ]
        if min(time_differences, default=period) > BRIEF * period:
            found.append((int(other), int(leg), place))
    return found


@host_program
def _at_touch(problem: Shooting, x, along, number: int, leg, s):
    """Return the state, ∂h, h and its rates, h's derivative in the parameter, ∂(dh/ds), the kick at
    a touch."""

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

    def after_jump(u):
        state = jump_of(machine, number, s, problem.unravel(u), problem.modes_in(leg))
        return ravel_pytree(state)[0]

    gradient = jax.grad(lambda u: distance(machine, s, u))(u)
    fast, here, kick = jax.grad(lambda u: rates(u).v)(u), rates(u), None
    if number < len(stops_of(machine)):
        push = fast / (fast @ fast)
        speed_unit = jnp.linalg.norm(gradient * problem.sizes[1:]) / problem.sizes[0]
        push_after = jax.jvp(after_jump, (u - _SLOW * speed_unit * push,), (push,))[1]
        kick = -jnp.sqrt(2 * here.a) * (push_after - push)
    return u, gradient, here, slope, fast, kick


def touch_at(
    problem: Shooting, x: np.ndarray, along: np.ndarray, number: int, leg: int, clock: float
) -> Touch:
    """Return one touch; `along` is the derivative of the motion with respect to the parameter."""
    event = events_of(problem.machine)[number]
    u, gradient, here, slope, fast, impact = _at_touch(problem, x, along, number, leg, clock)
    rate = float(here.a)
    if not rate > 0:
        raise NoLocalMapError(
            f"Argument `point` must be a grazing at which the motion turns, but the "
            f"distance's second derivative is {rate:.3g} there."
        )
    if impact is not None:
        kick = Kick(impact, 0.5)
    elif event.holds_mode:
        # A stiff stop pushes by what the corrector has left of distance and speed.
        sizes = np.asarray(problem.sizes)[1:]
        left, slopes = np.array([here.x, here.v]), np.stack([gradient, fast])
        touching = u - sizes * np.linalg.lstsq(slopes * sizes, left, rcond=None)[0]
        kick = soft_kick(problem, x, number, leg, clock, u, touching, gradient, fast, rate)
    else:
        called = Event(number).name_on(problem.machine)
        raise NoLocalMapError(
            "Argument `point` must be the grazing of a stop or a switch, but it touches the "
            f"{called}, whose jump does not vanish with the speed."
        )
    return Touch(number, leg, clock, u, gradient, rate, float(slope), kick)
