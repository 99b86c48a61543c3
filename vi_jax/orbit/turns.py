"""Turning points of a flight, and their distances to events that do not happen.

A body turns where its velocity vanishes, the guard g of an event where dg/ds does. Along a branch a
turn may grow until it touches: the branch ends there in a grazing.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from .._types import Flag, Scalar, State, Vector
from ..flow import Rates, SmoothMachine, guard_rates
from ..machine import event_of, events_of, guard_of, has_velocity, section_number, stops_of
from .flight import Flight, force_on
from .tolerances import EXACT, ROUNDING

# Newton's method has converged if it ends this close to a turn (as a share of the step): a choice.
# The remainder changes the height in second order and is subtracted.
_TURNED = 1e-3


class Path(NamedTuple):
    """A flight as a sequence of steps."""

    flight: Flight
    places: Float[Array, " steps"]
    """Clock at the start of each step."""
    states: Float[Array, "steps states"]
    """State at the start of each step."""
    h: Scalar
    """Length of the steps."""
    closed: bool
    """True if the flight ends in its first state (static)."""


class Nearest(NamedTuple):
    """The turning point that is nearest to an event which does not happen there, as a share of the
    distance's size."""

    margin: Scalar
    """Distance to the stop at a body's turn; for another event, its guard's distance below zero.
    Negative if the guard is crossed, infinite without such a turn."""
    clock: Scalar
    """Clock of the turn."""
    event: Scalar
    """The number of the event."""
    unit: Any = 1.0
    """The size of that distance along the motion (see `Shooting.guard_sizes`)."""

    @property
    def share(self) -> Any:
        return self.margin / self.unit


class _Turns(NamedTuple):
    """The turning points of a function of the state along a flight, one for each step."""

    turns: Bool[Array, " steps"]
    """True for each step that contains a turn."""
    height: Float[Array, " steps"]
    """Value of the function at the turn."""
    place: Float[Array, " steps"]
    """Clock (phase or time) of the turn."""
    before: Float[Array, " steps"]
    """The function's rate at the start of the step, or a number of its sign."""
    happens: Bool[Array, " steps"]
    """True if an event would happen there."""


class _Quantity(NamedTuple):
    """A quantity that may turn along a flight, by its number in the machine."""

    number: int

    def value(self, flight: Flight, s: Scalar, state: State) -> Scalar:
        raise NotImplementedError

    def rate(self, flight: Flight, s: Scalar, u: Vector) -> Scalar:
        """Return d/ds of the value along the flight, or another number of the same sign."""
        return self.rates(flight, flight.smooth, s, u).v

    def happens(self, flight: Flight, s: Scalar, u: Vector, length: Scalar) -> Flag:
        """Return whether an event would happen if the value were zero at `length` from here."""
        return jnp.ones((), bool)

    def rates(self, flight: Flight, smooth: SmoothMachine, s: Scalar, u: Vector) -> Rates:
        """Return the value and its first two derivatives with respect to s."""

        def value_here(s, state):
            return self.value(flight, s, state)

        return guard_rates(smooth.field, value_here, s, flight.unravel(u))


class _Guard(_Quantity):
    def value(self, flight, s, state):
        return guard_of(flight.machine, self.number, s, state, flight.modes, flight.contact)

    def happens(self, flight, s, u, length):
        if not events_of(flight.machine)[self.number].from_below:
            return super().happens(flight, s, u, length)
        state = flight.unravel(_state_after_step(flight, (s, length, u)))
        event, part, _ = event_of(flight.machine, self.number, flight.modes, ())
        condition = event.happens(flight.machine, s + length, state, *flight.modes[part])
        return jnp.ones((), bool) if condition is None else condition


class _Body(_Quantity):
    """A coordinate; it turns where its velocity is zero."""

    def value(self, flight, s, state):
        return flight.machine.coordinates[self.number].position(state)

    def rate(self, flight, s, u):
        state = flight.unravel(u)
        if has_velocity(flight.machine, state):
            return flight.machine.coordinates[self.number].velocity(state)
        return super().rate(flight, s, u)


class _Pull(_Quantity):
    """The force that pulls a body off a stop on which it rests."""

    def value(self, flight, s, state):
        return -force_on(flight, self.number, s, state)


_Margins = tuple[Float[Array, " steps"], Float[Array, " steps"]]
"""`Nearest.margin` of one event in each step, infinite without a turn; the clock of the turn."""


def turns_of(path: Path, sizes: Vector) -> tuple[Scalar, Scalar, Nearest, Nearest]:
    """Return least and greatest turn of the first coordinate, the turn nearest to an event, and the
    result of `pull_of`. Without a turn the first two are infinite. `sizes` are those of guards."""
    bodies, margins = turning_points(path)
    low = jnp.min(jnp.where(bodies[0].turns, bodies[0].height, jnp.inf))
    high = jnp.max(jnp.where(bodies[0].turns, bodies[0].height, -jnp.inf))
    return low, high, _least_margin(dict(enumerate(margins)), path.h, sizes), pull_of(path, sizes)


def _least_margin(margins: dict[int, _Margins], h: Scalar, sizes: Vector) -> Nearest:
    zero = jnp.zeros((), h.dtype)
    least = Nearest(jnp.full_like(zero, jnp.inf), zero, zero, jnp.ones_like(zero))
    for number, (margin, clock) in margins.items():
        i = jnp.argmin(margin)
        nearest = Nearest(margin[i], clock[i], jnp.full_like(zero, number), sizes[number])
        nearer = nearest.share < least.share
        least = jax.tree.map(lambda a, b, nearer=nearer: jnp.where(nearer, a, b), nearest, least)
    return least


def turning_points(path: Path) -> tuple[list[_Turns], list[_Margins]]:
    """Return the turning points of each coordinate, and the room of each event but the section."""
    flight, machine, begin = path.flight, path.flight.machine, path.places[0]
    found = partial(_turns_in, path)
    bodies = [found(_Body(k)) for k in range(len(machine.coordinates))]
    margins = []
    for stop in stops_of(machine):
        turn = bodies[stop.coordinate]
        facing = turn.turns & (stop.sign * turn.before > 0)
        if flight.contact:  # a released body begins to move with velocity zero
            free = flight.contact[stop.coordinate] == 0
            facing = facing & free & (turn.place > begin + _TURNED * path.h)
        margins.append((jnp.where(facing, -stop.beyond(turn.height), jnp.inf), turn.place))
    for number, event in enumerate(events_of(machine)):
        if number < len(stops_of(machine)) or number == section_number(machine):
            continue
        guard = _Guard(number)
        turn = found(guard)
        # A body that leaves sticking begins to slide with velocity and acceleration zero.
        is_later = turn.place > begin + _TURNED * path.h
        facing = turn.turns & (turn.before > 0) & is_later
        if event.from_below:  # it touches nothing unless it has been below zero
            guard_value = lambda s, u, guard=guard: guard.value(flight, s, flight.unravel(u))
            value = jax.vmap(guard_value)(path.places, path.states)
            # Just after the event itself it is zero, to rounding of either sign.
            below = -EXACT * jnp.max(jnp.abs(value))
            facing = facing & turn.happens & (jax.lax.cummin(value) < below)
        margins.append((jnp.where(facing, -turn.height, jnp.inf), turn.place))
    return bodies, margins


def _turns_in(path: Path, watched: _Quantity) -> _Turns:
    flight, places, states, h, closed = path
    # The end of the last step is the next event: its velocity is that of one more step.
    last = flight.once(_state_after_step, (places[-1], h, states[-1]))
    v = jax.vmap(partial(watched.rate, flight))(places, states)
    # A turn on the section itself is at the begin or the end of a closed flight. Its rate there is
    # rounding of either sign, so both must have the same sign.
    end = v[0] if closed else watched.rate(flight, places[-1] + h, last)
    if isinstance(watched, _Body) and not closed:  # friction may act from its turn on
        end = jnp.where(jnp.abs(end) <= ROUNDING * jnp.max(jnp.abs(v)), 0.0, end)
    v1 = jnp.concatenate([v[1:], end[None]])
    return jax.vmap(lambda *x: flight.once(partial(_turn, watched), (h, *x)))(places, states, v, v1)


def pull_of(path: Path, sizes: Vector) -> Nearest:
    """Return the least extremum of the force on a resting body, with the force as `margin`."""
    flight, forces = path.flight, {}
    for number, stop in enumerate(stops_of(flight.machine) if flight.contact else ()):
        turn = _turns_in(path, _Pull(number))
        rests = flight.contact[stop.coordinate] == 1.0 + number
        force = jnp.where(turn.turns & (turn.before > 0) & rests, -turn.height, jnp.inf)
        forces[number] = (force, turn.place)
    return _least_margin(forces, path.h, sizes)


def _state_after_step(flight: Flight, inputs: tuple[Scalar, Scalar, Vector]) -> Vector:
    """Return the state after one step from `inputs`: the clock, the step's length and the state."""
    s, h, u = inputs
    return flight.step(s, s + h, u, {})[0]


def _turn(
    watched: _Quantity, flight: Flight, inputs: tuple[Scalar, Scalar, Vector, Scalar, Scalar]
) -> _Turns:
    """Return the turning point in a step, if the rates `v0` and `v1` at its ends differ in sign.
    The unknown of Newton's method is the length from the start; each trial is a step."""
    h, s, u, v0, v1 = inputs
    # A turn may coincide with the end of a step.
    turns = (v0 * v1 < 0) | ((v1 == 0) & (v0 != 0))

    def at(moved: Flight, s: Scalar, u: Vector, length: Scalar) -> Rates:
        after = _state_after_step(moved, (s, length, u))
        return watched.rates(flight, moved.smooth, s + length, after)

    constants = stop_gradient((eqx.filter(flight, eqx.is_array), s, u))
    constant_flight = eqx.combine(constants[0], flight)
    limit = stop_gradient(h)

    def newton(_, length):
        here = at(constant_flight, *constants[1:], length)
        second = jnp.where(here.a == 0, 1.0, here.a)
        return jnp.clip(length - here.v / second, 0.0, limit)

    share = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 0.5)
    length = jax.lax.fori_loop(0, 4, newton, stop_gradient(h * share))
    here = at(flight, s, u, length)
    second = jnp.where(here.a == 0, 1.0, here.a)
    # A guard with a kink, as that of dry friction where its force vanishes, may have no turn.
    has_converged = jnp.abs(here.v) <= jnp.abs(_TURNED * limit * second)
    shift = jnp.where(has_converged, here.v, 0.0) / second
    happens = watched.happens(flight, s, u, length)
    return _Turns(turns, here.x - 0.5 * here.v * shift, s + length - shift, v0, happens)
