"""The chatter with which a body comes to rest on a stop, and the loss of its rest.

The hops of a chatter are computed one by one until one is slow compared with the fastest. Then the
body is put on its stop without rebound: the error of the state is of third order in that speed.

The body rests if its chatter ends before its release from the stop. Near that limit the hops are a
map with a saddle. Its variables are the time τ until the release and ξ = u/(β τ²), with the speed u
of the rebound and the force β τ. Motions below the saddle's stable manifold come to rest,
those above it escape (`escape_margin`).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient

from .._types import Flag, Scalar, State, Vector
from ..flow import TIME, Integrals, Rates, force_rate, guard_rates, rounding_bounds
from ..machine import RigidStop, push_of, stops_of
from .flight import Flight, force_on
from .tolerances import FAINT, LOCATED, ROUNDING, ROUNDINGS

# Most hops of a chatter, and most corrections of the landing of each: choices. With restitution
# 0.95 a rebound has 1e-4 of the first speed after 180 hops.
_HOPS, _CORRECTIONS = 400, 7

# A chatter shorter than this share of the time until the release ends before it: a choice. At the
# limit the share is 0.6 for each restitution.
_OVER = 0.1

# An escaping motion has at least this share of (ξ/ξ of the manifold τ²)^(5/6): a choice. At the
# limit the share is more than 0.4, with a restitution above 0.4.
_ESCAPES = 0.1


class Chatter(NamedTuple):
    """The state of a chatter just after an impact."""

    s: Scalar
    u: Vector
    integrals: Integrals
    is_over: Flag
    """True if there is no next impact, or if it comes too late."""


def last_hop(free: Flight, number: int, begin: Chatter, *, until: Scalar, steps: Scalar) -> Chatter:
    """Return the first impact of a chatter with a slow rebound, or the last one before the clock
    `until`; `free` is the flight with the body free, `begin` the first impact. The error of third
    order of a hop slower than `FAINT` is rounding, and its landing is accurate to a millionth."""
    stop = stops_of(free.machine)[number]
    averages = tuple(name for name in begin.integrals if name != TIME)

    def rates(s: Scalar, u: Vector) -> Rates:
        return _rates(free, stop, s, u)

    def continues(carry: tuple[Chatter, Scalar, int]) -> Flag:
        hops, fastest, count = carry
        here = rates(hops.s, hops.u)
        # The remaining distance at a landing must exceed roundings of the stop's place, and of the
        # body's: a distance that is a function of several numbers has the rounding of all of them.
        rounding = ROUNDINGS * jnp.finfo(here.v.dtype).eps * jnp.abs(stop.place)
        state = free.unravel(hops.u)
        rounding += rounding_bounds(free.machine, stop.coordinate, state, 0.0)[0]
        fast = (-here.v > FAINT * fastest) & (here.v**2 > rounding / LOCATED * jnp.abs(here.a))
        return ~hops.is_over & (fast | (here.a < 0)) & (count < _HOPS)

    def hop(carry: tuple[Chatter, Scalar, int]) -> tuple[Chatter, Scalar, int]:
        hops, fastest, count = carry
        first = _duration(free, stop, hops.s, hops.u)

        def inexact(carry):
            length, move, count = carry
            # The next one would be its square; the error of the derivatives is of its order.
            close = jnp.abs(move) <= ROUNDING * jnp.abs(length)
            return ~hops.is_over & ~close & (count < _CORRECTIONS)

        def correct(carry):
            length, _, count = carry
            arrival, _, _ = free.fly(hops.s, hops.s + length, hops.u, steps)
            here = rates(hops.s + length, arrival)
            move = here.x / jnp.where(here.v == 0, 1.0, here.v)
            return length - move, move, count + 1

        length, *_ = jax.lax.while_loop(inexact, correct, (first, jnp.full_like(first, jnp.inf), 0))
        u, added, _ = free.fly(hops.s, hops.s + length, hops.u, steps, averages)
        integrals = {name: x + added[name] for name, x in hops.integrals.items()}
        s, here = hops.s + length, rates(hops.s + length, u)
        height = jnp.abs(length * rates(hops.s, hops.u).v)
        lands = (length > 0) & (here.v > 0) & (jnp.abs(here.x) < LOCATED * height) & (s < until)
        rebound, _ = stop.after(free.machine, s, free.unravel(u), *free.modes)
        impact = Chatter(s, ravel_pytree(rebound)[0], integrals, ~lands)
        unchanged = hops._replace(is_over=~lands)
        impact = jax.tree.map(lambda a, b: jnp.where(lands, a, b), impact, unchanged)
        return impact, jnp.maximum(fastest, -rates(impact.s, impact.u).v), count + 1

    first = jnp.maximum(-rates(begin.s, begin.u).v, 0.0)
    return jax.lax.while_loop(continues, hop, (begin, first, 0))[0]


def _rates(free: Flight, stop: RigidStop, s: Scalar, u: Vector) -> Rates:
    """Return the distance of a body beyond its stop, and two derivatives d/ds, if it is free."""
    guard = partial(stop.guard, free.machine)
    return guard_rates(free.smooth.field, guard, s, free.unravel(u))


def _duration(free: Flight, stop: RigidStop, s: Scalar, u: Vector) -> Scalar:
    """Estimate the duration of a hop, with a force that grows linearly."""
    s, u = stop_gradient((s, u))
    here, body = _rates(free, stop, s, u), free.machine.coordinates[stop.coordinate]
    rise = stop.sign * force_rate(free.smooth, body, free.smooth, s, free.unravel(u))
    root = jnp.sqrt(jnp.maximum(0.25 * here.a**2 - 2 * rise * here.v / 3, 0.0))
    minus, plus = root - 0.5 * here.a, root + 0.5 * here.a
    if_pressed = -2 * here.v / jnp.where(plus > 0, plus, 1.0)
    if_pulled = 3 * minus / jnp.where(rise > 0, rise, 1.0)
    return stop_gradient(jnp.where(here.a > 0, if_pressed, if_pulled))


def remaining(free: Flight, number: int, hops: Chatter) -> Scalar:
    """Estimate the remaining time of a chatter; infinite if the force pulls the body off."""
    stop = stops_of(free.machine)[number]
    here, body = _rates(free, stop, hops.s, hops.u), free.machine.coordinates[stop.coordinate]
    share = stop.coefficient(stop.approach(-body.velocity(free.unravel(hops.u))))
    slowing = (1 - share) * here.a
    return jnp.where(slowing > 0, -2 * here.v / jnp.where(slowing > 0, slowing, 1.0), jnp.inf)


def escape_margin(held: Flight, number: int, hops: Chatter, s: Scalar, u: Vector) -> Scalar:
    """Return how far the last impact of a chatter is above the stable manifold of the hops.

    This is ((ξ/ξ of the manifold)^(5/6) - 1) τ^(5/3), negative if the body comes to rest. Close to
    the manifold ln(ξ/ξ of the manifold) grows from hop to hop as τ^-q with q close to 5/3. So the
    result depends little on the number of hops. Far from it the result is not zero if the last
    impact coincides with the release (τ = 0, while ξ τ² is not 0).

    **Arguments:** the flight in which the body rests; the number of its stop; the last impact;
    clock and state of the release.
    """
    machine, state, field = held.machine, held.unravel(u), held.smooth.field
    stop = stops_of(machine)[number]
    body = machine.coordinates[stop.coordinate]

    def force(s, state):
        return force_on(held, number, s, state)

    def time_derivative(function):
        def rate(s, state):
            return jax.jvp(function, (s, state), (jnp.ones_like(s), field(s, state)))[1]

        return rate

    first = time_derivative(force)
    second = time_derivative(first)
    beta, mu, nu = -first(s, state), second(s, state), -time_derivative(second)(s, state)
    time_left, free = s - hops.s, held.with_released(stop.coordinate)
    speed = -_rates(free, stop, hops.s, hops.u).v
    # Derivative with respect to the speed y' from the stop, along the change by an impact.
    push = push_of(body, state)

    def speed_from_stop(state: State) -> Scalar:
        return -_rates(free, stop, s, ravel_pytree(state)[0]).v

    unit = jax.jvp(speed_from_stop, (state,), (push,))[1]
    push = jax.tree.map(lambda x: x / unit, push)
    c = jax.jvp(lambda x: force(s, x), (state,), (push,))[1]
    bend = jax.jvp(lambda x: free.smooth.field(s, x), (state,), (push,))[1]
    p = jax.jvp(lambda x: force(s, x), (state,), (bend,))[1] + c**2
    speed_after = stop.approach(-body.velocity(held.unravel(hops.u)))
    share, slope = jax.jvp(stop.coefficient, (speed_after,), (jnp.ones_like(speed_after),))
    speed_before = speed_after / jnp.where(share > 0, share, 1.0)
    share, slope = jax.jvp(stop.coefficient, (speed_before,), (jnp.ones_like(speed_after),))
    k, k1 = share - slope * speed_before, slope * jnp.abs(unit)
    limit = _manifold(k, time_left, mu / beta, nu / beta, c, p, beta * k1)
    height = speed / (beta * limit)
    safe = jnp.where((share > 0) & (height > 0), height, 1.0) ** (5 / 6)
    margin = safe - jnp.sign(time_left) * (time_left**2) ** (5 / 6)
    # Far from the limit, as with a nearly constant force, the manifold is not known.
    ends_before = remaining(free, number, hops) < _OVER * time_left
    margin = jnp.where(ends_before, -jnp.abs(margin), margin)
    margin = jnp.where(hops.is_over, jnp.maximum(margin, _ESCAPES * safe), margin)
    return jnp.where(share > 0, margin, -jnp.inf)


def _manifold(
    k: Scalar, time_left: Scalar, M: Scalar, N: Scalar, c: Scalar, p: Scalar, k1: Scalar
) -> Scalar:
    """Return ξ on the stable manifold of the hops.

    **Arguments:** the restitution at low speeds; the time left until the release; D²F/β and -D³F/β
    along the rest, with the force F; the derivative c of F with respect to the speed from the stop;
    p = c² + the derivative of F along the field's derivative with respect to this speed; β times
    the derivative of the restitution with respect to the speed.
    """
    s = 1 - stop_gradient(k) ** 0.6

    def newton(_, s):
        residual, slope = (3 - s) * (1 - s) ** 2 - k * (3 - 2 * s), 3 * s**2 - 10 * s + 7
        return s + residual / (slope - 2 * k)

    s = jax.lax.fori_loop(0, 6, newton, s)
    G = 8 * s**4 - 49 * s**3 + 119 * s**2 - 140 * s + 70
    A = (
        45 * (s - 1) * (s - 2) ** 2 * M**2 + 18 * G * M * c + 48 * G * N
        - (16 * s**4 + 27 * s**3 - 387 * s**2 + 720 * s - 360) * c**2
        + 16 * s**2 * (16 * s**2 - 63 * s + 63) * p
        - 160 * (2 * s - 3) ** 4 * k1 / ((s - 1) * (s - 3))
    ) / (960 * (4 * s**4 - 24 * s**3 + 57 * s**2 - 66 * s + 33))  # fmt: skip
    correction = time_left * (3 * M + c) / 8 + time_left**2 * A
    return s * (3 - s) / 6 * (1 + jnp.maximum(correction, -0.9))
