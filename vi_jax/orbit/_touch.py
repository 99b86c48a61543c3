"""Where a motion grazes, and what an impact there would do to it.

All numbers are derivatives of what the machine says: its field, guards and jumps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._programs import compiled
from ..flow import guard_rates
from ..machine import events_of, guard_of, jump_of
from ._events import Event
from ._shooting import Shooting
from ._soft_kick import Kick, soft_kick
from ._turns import rooms_of

# A turn this near to a stop touches it: as for the special points.
_TOUCHES = 1e-6

# Touches that are closer than this share of a period are one: the depth of what is between them is
# then of the order of `_TOUCHES`. A choice.
_APART = 1e-3

# How fast a body approaches a stop on which its rebound is differentiated: laws that depend on the
# speed are taken at this one. A choice.
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


@compiled
def _rooms(problem: Shooting, x):
    """Distance and clock of each turn; (legs, events, steps) each."""
    machine = problem.at(x)
    clock, states = problem.parts(x)

    def follow(leg, s0, s1, u):
        after = problem.after(machine, leg, s0, u)
        flight = problem.flight(machine, leg)
        _, _, path = flight.fly(s0, s1, after, problem.steps)
        rooms = rooms_of(
            flight, path[0], path[1], (s1 - s0) / problem.steps, closed=not problem.events
        )
        return jnp.stack([r.room for r in rooms]), jnp.stack([r.clock for r in rooms])

    ends = problem.ends(clock, problem.period(x))
    return jax.vmap(follow)(jnp.arange(problem.legs), clock, ends, states)


def touched(
    problem: Shooting, x: np.ndarray, number: int, clock: float
) -> list[tuple[int, int, float]]:
    """Event, leg and clock of each touch, each once.

    **Arguments:** the equations and their solution; event and clock of the touch that is known,
    which may fall on the end of a flight, where no turn is seen.
    """
    at = jnp.asarray(x)
    rooms, places = (np.asarray(a) for a in _rooms(problem, at))
    begins, period = np.asarray(problem.parts(at)[0]), float(problem.period(at))
    within = float(begins[0] + np.mod(clock - begins[0], period))
    leg = max(0, int(np.searchsorted(begins, within, side="right")) - 1)
    found = [(number, leg, within)]
    for leg, other, step in np.argwhere(np.abs(rooms) <= _TOUCHES):
        place = float(places[leg, other, step])
        apart = [
            abs((place - known + period / 2) % period - period / 2)
            for event, _, known in found
            if event == other
        ]
        if min(apart, default=period) > _APART * period:
            found.append((int(other), int(leg), place))
    return found


@compiled
def _at_touch(problem: Shooting, x, along, number: int, leg, s):
    """What the machine says where its motion grazes: state, ∂h, a, d(h)/d(parameter), the gradient
    of dh/ds, and the jump's derivative."""

    def distance(machine, s, u):
        return -guard_of(machine, number, s, problem.unravel(u), problem.modes_in(leg))

    def there(x):
        u = ravel_pytree(problem.state_at(x, leg, s))[0]
        return distance(problem.at(x), s, u), u

    (_, slope), u = jax.jvp(lambda x: there(x)[0], (x,), (along,)), there(x)[1]
    machine = problem.at(x)
    field = problem.flight(machine, leg).smooth.field

    def rates(u):
        def guard(s, state):
            return distance(machine, s, ravel_pytree(state)[0])

        return guard_rates(field, guard, s, problem.unravel(u))

    gradient = jax.grad(lambda u: distance(machine, s, u))(u)
    fast = jax.grad(lambda u: rates(u).v)(u)
    return u, gradient, rates(u).a, slope, fast


@compiled
def _struck(problem: Shooting, x, number: int, leg, s, u, push):
    """How fast the jump of an impact changes along a direction."""
    machine = problem.at(x)

    def jumped(u):
        state = jump_of(machine, number, s, problem.unravel(u), problem.modes_in(leg))
        return ravel_pytree(state)[0]

    return jax.jvp(jumped, (u,), (push,))[1]


def touch_at(
    problem: Shooting, x: np.ndarray, along: np.ndarray, number: int, leg: int, clock: float
) -> Touch:
    """All about one touch.

    **Arguments:** the equations of the motion and their solution, with its derivative `along` the
    parameter; the event's number, the leg and the clock of the touch.
    """
    event = events_of(problem.machine)[number]
    at, s = jnp.asarray(x), jnp.asarray(clock)
    u, gradient, rate, slope, fast = (
        np.asarray(a) for a in _at_touch(problem, at, jnp.asarray(along), number, leg, s)
    )
    if not rate > 0:
        raise ValueError(
            f"Argument `point` must be a grazing at which the motion turns, but the "
            f"distance's second derivative is {float(rate):.3g} there."
        )
    if number < len(problem.machine.stops):
        push = fast / (fast @ fast)
        near = u - _SLOW * push
        after = np.asarray(_struck(problem, at, number, leg, s, *map(jnp.asarray, (near, push))))
        kick = Kick(-np.sqrt(2 * rate) * (after - push), 0.5)
    elif event.holds_mode:
        kick = soft_kick(problem, x, number, leg, clock, u, gradient, fast, float(rate))
    else:
        called = Event(number).called(problem.machine)
        raise ValueError(
            "Argument `point` must be the grazing of a stop or a switch, but it touches the "
            f"{called}, whose jump does not vanish with the speed."
        )
    return Touch(number, leg, clock, u, gradient, float(rate), float(slope), kick)
