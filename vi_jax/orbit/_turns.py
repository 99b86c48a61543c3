"""Where a flight comes nearest to what it does not meet."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from .. import lanes
from ..flow.events import Rates, guard_rates
from ..scene import AbstractScene

Scalar = Float[Array, ""]
Vector = Float[Array, " _"]

# Newton's method has met a turn if it ends this close to it (as a share of the step).
_TURNED = 1e-3


class Flight(NamedTuple):
    """A flight in steps of one length."""

    scene: AbstractScene
    moving: AbstractScene
    """The machine in its modes."""
    modes: tuple[Scalar, ...]
    step: Callable[[AbstractScene, Scalar, Scalar, Vector], Vector]
    """The state after a step from one clock to another."""
    unravel: Callable[[Vector], Any]
    places: Float[Array, " steps"]
    """Clock at the start of each step."""
    states: Float[Array, "steps states"]
    h: Scalar


class Turns(NamedTuple):
    """What the turning points of a flight say."""

    low: Scalar
    """The least Y at one."""
    high: Scalar
    room: Scalar
    """The smallest distance to a stop at one, or of a switch's guard below zero."""
    touch: Scalar
    """Clock there."""
    touched: Scalar
    """The stop there, or the switch, counted after the stops."""


class _Found(NamedTuple):
    """The turning points of a function of the state, one for each step."""

    turns: Bool[Array, " steps"]
    """Whether there is one."""
    height: Float[Array, " steps"]
    place: Float[Array, " steps"]
    before: Float[Array, " steps"]
    """The function's rate, or one of its sign, at the start of the step."""


def turns_of(flight: Flight) -> Turns:
    """The turning points of all coordinates and guards along a flight."""
    # The end of the last step is the next event: its velocity is that of a further step.
    last = lanes.once(
        lambda x: flight.step(flight.moving, x[0], x[0] + x[1], x[2]),
        (flight.places[-1], flight.h, flight.states[-1]),
    )
    bodies = [
        _found(flight, last, lambda _, x, c=c: c.position(x), lambda _, x, c=c: c.velocity(x))
        for c in flight.scene.coordinates
    ]
    rooms = []
    for stop in flight.scene.stops:
        at = bodies[stop.coordinate]
        facing = at.turns & (stop.sign * at.before > 0)
        rooms.append((jnp.where(facing, -stop.beyond(at.height), jnp.inf), at.place))
    for switch, mode in zip(flight.scene.switches, flight.modes, strict=True):

        def guard(s, state, switch=switch, mode=mode):
            return switch.guard(flight.scene, s, state, mode)

        def rise(s, state, guard=guard):
            return guard_rates(flight.moving.field, guard, s, state).v

        at = _found(flight, last, guard, rise)
        # A body that friction lets go begins to slide with velocity and acceleration zero.
        away = at.place > flight.places[0] + _TURNED * flight.h
        facing = at.turns & (at.before > 0) & away
        rooms.append((jnp.where(facing, -at.height, jnp.inf), at.place))
    room, touch = jnp.full((), jnp.inf, flight.h.dtype), jnp.zeros((), flight.h.dtype)
    touched = touch
    for i, (values, place) in enumerate(rooms):
        nearest = jnp.argmin(values)
        touch = jnp.where(values[nearest] < room, place[nearest], touch)
        touched = jnp.where(values[nearest] < room, float(i), touched)
        room = jnp.minimum(room, values[nearest])
    low = jnp.min(jnp.where(bodies[0].turns, bodies[0].height, jnp.inf))
    high = jnp.max(jnp.where(bodies[0].turns, bodies[0].height, -jnp.inf))
    return Turns(low, high, room, touch, touched)


def _found(flight: Flight, last: Vector, function: Callable, rate: Callable) -> _Found:
    """Turning points of a function of (s, state) with this rate, or one of its sign.

    Where it changes sign within a step, Newton's method from the step's start.
    """
    h = flight.h

    def turn(s, u, v0, v1):
        # A turn may fall on the end of a step.
        turns = (v0 * v1 < 0) | ((v1 == 0) & (v0 != 0))

        def at(moving: AbstractScene, s: Scalar, u: Vector, length: Scalar) -> Rates:
            state = flight.unravel(flight.step(moving, s, s + length, u))
            return guard_rates(moving.field, function, s + length, state)

        held = stop_gradient((flight.moving, s, u))
        limit = stop_gradient(h)

        def newton(_, length):
            here = at(*held, length)
            bend = jnp.where(here.a == 0, 1.0, here.a)
            return jnp.clip(length - here.v / bend, 0.0, limit)

        share = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 0.5)
        length = jax.lax.fori_loop(0, 4, newton, stop_gradient(h * share))
        here = at(flight.moving, s, u, length)
        bend = jnp.where(here.a == 0, 1.0, here.a)
        # A guard with a kink (as that of dry friction, where its force vanishes) may have no turn
        # there.
        met = jnp.abs(here.v) <= jnp.abs(_TURNED * limit * bend)
        shift = jnp.where(met, here.v, 0.0) / bend
        return _Found(turns, here.x - 0.5 * here.v * shift, s + length - shift, v0)

    def velocity(s, u):
        return rate(s, flight.unravel(u))

    v = jax.vmap(velocity)(flight.places, flight.states)
    v1 = jnp.concatenate([v[1:], velocity(flight.places[-1] + h, last)[None]])
    steps = flight.places, flight.states, v, v1
    return jax.vmap(lambda *x: lanes.once(lambda x: turn(*x), x))(*steps)
