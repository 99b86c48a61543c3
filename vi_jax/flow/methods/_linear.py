"""The flight of a linear machine in its modes: closed form, or a matrix exponential by series."""

from math import factorial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import ModalMachine, forces, horner, stops_of

# The series of a matrix exponential is summed over lengths in which things change by twice
# themselves at most, until its terms are below this share of a rounding: that is 24 of them, with
# half the work of 18 terms over lengths half as long.
_LONGEST, _LAST = 2.0, 0.005

# A mode adds to a contact's distance what rounding does if its amplitude there is below so many
# roundings of the sum of all.
_MATTERS = 4

# By so much bounds are wider than what they bound, for rounding.
_WIDER = 1.001

# Steps in the shortest period, of one mode and of several: a sum of modes may leave a stop, come
# back and leave again in a fifth of it, which the ends of a step do not show (one of some 150
# cycles of random machines of up to eight modes; none with ten steps).
_ALONE, _SEVERAL = 5, 10

# Series of (cos √y - sin √y/√y)/2y, for |y| < 1: the next term is 1e-17.
_BEND = tuple((-1) ** n * n / factorial(2 * n + 1) for n in range(1, 10))


def modal_flight(
    machine: ModalMachine, contact: Scalars, s: Scalar, h: Scalar, state: State
) -> Any:
    """The state a time h after that at s, exact to rounding for any h.

    Free flight of uncoupled modes is the closed form of each. All else is a matrix exponential:
    modes coupled by damping, bodies at rest on stops, a force in resonance with a mode.

    **Arguments:** `contact`, of each coordinate whether it rests, as in `Lane.contact`.
    """
    free = machine.plain > 0
    for rests in contact:
        free = free & (rests == 0)
    q, p = state.displacement, state.velocity
    closed = _closed(machine, s, h, q, p)
    series = _by_series(machine, contact, s, h, (q, p), ~free)
    return type(state)(*(jnp.where(free, a, b) for a, b in zip(closed, series, strict=True)))


def longest(machine: ModalMachine, s: Scalar, state: State) -> Scalar:
    """A tenth of the period of the fastest mode that matters, or of the force; a fifth where there
    is but one mode.

    A mode matters if its free motion moves a contact by more than rounding: others cannot make or
    hide an event. Those that have faded away so cost no steps.
    """
    q, p = state.displacement, state.velocity
    place, rate = (0.0, 0.0) if machine.steady is None else _steady(machine, s)
    pace = machine.pace_of
    moves = jnp.abs(q - place) + jnp.abs(p - rate) * machine.slowness
    fastest, least = machine.frequency, _MATTERS * jnp.finfo(pace.dtype).eps
    for row in machine.rows:
        part = jnp.abs(row) * moves
        matters = part > least * jnp.sum(part + jnp.abs(row * place))
        fastest = jnp.maximum(fastest, jnp.max(jnp.where(matters, pace, 0.0)))
    count = _ALONE if pace.size == 1 else _SEVERAL
    return stop_gradient(2 * jnp.pi / (count * fastest))


def clear(machine: ModalMachine, s: Scalar, state: State) -> Scalar:
    """How long no stop can be met in free flight from here; 0 where that is not known.

    A mode that swings and fades stays within its amplitude a, and is accelerated by κa at most; so
    the distance to a stop is at least what a parabola leaves of it, and infinite where the sum of
    all amplitudes does not reach.
    """
    machine, s, state = stop_gradient((machine, s, state))  # a length has no derivative
    q, p = state.displacement, state.velocity
    place, rate = (0.0, 0.0) if machine.steady is None else _steady(machine, s)
    y, v = q - place, p - rate
    sway = machine.swing_time * (v + 0.5 * machine.damping * y)
    free = jnp.sqrt(y * y + sway * sway)
    length = jnp.asarray(jnp.inf, q.dtype)
    for stop in stops_of(machine):
        row = machine.rows[stop.coordinate]
        part = jnp.abs(row) * free
        reach, pull = jnp.sum(part), jnp.dot(machine.stiffness, part)
        middle = jnp.zeros_like(reach)
        if machine.steady is not None:
            middle, *turning = (jnp.dot(row, x) for x in machine.steady)
            swing = jnp.sqrt(turning[0] ** 2 + turning[1] ** 2)
            reach, pull = reach + swing, pull + machine.frequency**2 * swing
        room, speed = -stop.beyond(jnp.dot(row, q)), stop.sign * jnp.dot(row, p)
        root = jnp.sqrt(speed * speed + 2 * pull * jnp.maximum(room, 0.0))
        # Of two forms the one that does not cancel.
        towards = 2 * room / jnp.where(speed + root > 0, speed + root, 1.0)
        away = (root - speed) / jnp.where(pull > 0, pull, 1.0)
        until = jnp.where(speed > 0, towards, away)
        never = -stop.beyond(middle) > _WIDER * reach
        until = jnp.where(never, jnp.inf, jnp.where(room > 0, until, 0.0))
        length = jnp.minimum(length, until)
    return jnp.where(machine.plain * machine.fades > 0, length / _WIDER, 0.0)


def _steady(machine: ModalMachine, s: Scalar) -> tuple[Any, Any]:
    """The steady response at s, and its rate."""
    assert machine.steady is not None
    constant, cosine, sine = machine.steady
    omega = machine.frequency
    c, d = jnp.cos(omega * s), jnp.sin(omega * s)
    return constant + cosine * c + sine * d, omega * (sine * c - cosine * d)


def _closed(machine: ModalMachine, s: Scalar, h: Scalar, q: object, p: object) -> tuple[Any, Any]:
    """Each mode by itself: q'' + c q' + κ q = f."""
    half = 0.5 * machine.damping
    square = machine.stiffness - half * half
    known = machine.swing, machine.swing_time, machine.oscillates
    even, odd = _pair(known, half, square, h)
    if machine.steady is None:
        y, v, place, rate = q, p, 0.0, 0.0
    else:
        place, rate = _steady(machine, s)
        y, v = q - place, p - rate
        place, rate = _steady(machine, s + h)
    mean = half * odd
    new = place + (even + mean) * y + odd * v
    return new, rate + (even - mean) * v - machine.stiffness * odd * y


@jax.custom_jvp
def _pair(known: tuple, half: Any, square: Any, h: Scalar) -> tuple[Any, Any]:
    """e^(-at) cos(wt) and e^(-at) sin(wt)/w for w² of any sign.

    **Arguments:** `known`, of the machine `swing`, `swing_time` and `oscillates`; `half`, a;
    `square`, w².
    """
    swing, swing_time, oscillates = known
    fade = jnp.exp(-half * h)
    pair = fade * jnp.cos(swing * h), fade * (swing_time * jnp.sin(swing * h))
    # Overdamped modes are rare: skipped where a lane has none.
    return jax.lax.cond(oscillates > 0, lambda *x: x[0], _without_turns, pair, half, square, h)


def _without_turns(pair: Any, half: Any, square: Any, h: Scalar) -> tuple[Any, Any]:
    """The same for modes that do not oscillate, the others as in `pair`."""
    slow = square <= 0
    root = jnp.sqrt(jnp.where(slow, -square, 0.0))
    # The slower rate a - r, of which the difference would cancel.
    gentle = (half * half + square) / jnp.where(slow & (half + root > 0), half + root, 1.0)
    gentle = jnp.where(half + root > 0, gentle, half - root)
    fade = jnp.exp(-jnp.where(slow, gentle, 0.0) * h)
    some = root > 0
    odd = jnp.where(some, -jnp.expm1(-2 * root * h) / jnp.where(some, 2 * root, 1.0), h)
    odd = fade * odd
    even = fade - root * odd
    return jnp.where(slow, even, pair[0]), jnp.where(slow, odd, pair[1])


def _pair_jvp(primals, tangents):
    known, half, square, h = primals
    even, odd = _pair(known, half, square, h)
    d_even, d_odd = jnp.zeros_like(even), jnp.zeros_like(odd)
    _, by_half, by_square, by_h = tangents
    if not isinstance(by_half, SymbolicZero):
        d_even, d_odd = d_even - h * even * by_half, d_odd - h * odd * by_half
    if not isinstance(by_square, SymbolicZero):
        y = square * h * h
        flat = jnp.abs(y) < 1
        series = jnp.exp(-half * h) * h**3 * horner(_BEND, jnp.where(flat, y, 0.0))
        bend = (h * even - odd) / jnp.where(flat, 1.0, 2 * square)
        d_even = d_even - 0.5 * h * odd * by_square
        d_odd = d_odd + jnp.where(flat, series, bend) * by_square
    if not isinstance(by_h, SymbolicZero):
        d_even = d_even - (half * even + square * odd) * by_h
        d_odd = d_odd + (even - half * odd) * by_h
    return (even, odd), (d_even, d_odd)


_pair.defjvp(_pair_jvp, symbolic_zeros=True)


def _by_series(
    machine: ModalMachine, contact: Scalars, s: Scalar, h: Scalar, state: State, wanted: Flag
) -> tuple[Any, Any]:
    """The matrix exponential by its series, in parts so short that it converges at once; of none
    where it is not wanted.

    The force turns with the motion, as two numbers more.

    **Arguments:** `contact` as in `modal_flight`; `state`, q and p.
    """
    length = stop_gradient(jnp.abs(h)) * machine.fastest
    count = stop_gradient(jnp.where(wanted, jnp.maximum(jnp.ceil(length / _LONGEST), 1.0), 0.0))
    part, change = h / jnp.maximum(count, 1.0), length / jnp.maximum(count, 1.0)
    last = _LAST * jnp.finfo(h.dtype).eps
    held = _holding(machine, contact)
    omega = machine.frequency
    steady, cosine, sine = (0.0 if f is None else f for f in machine.forces)

    def turn(carry):
        i, q, p = carry
        angle = omega * (s + i * part)
        one = jnp.ones_like(s)

        def term(carry):
            k, size, sums, (dq, dp, (u, c, d)) = carry
            by = part / k
            pull = steady * u + cosine * c + sine * d
            pull = pull - machine.stiffness * dq - machine.damping * dp - machine.coupled(dq, dp)
            new = by * dp, by * held(pull), (jnp.zeros_like(u), -by * omega * d, by * omega * c)
            return k + 1.0, size * change / k, (sums[0] + new[0], sums[1] + new[1]), new

        first = q, p, (one, jnp.cos(angle), jnp.sin(angle))
        begin = one, one, (q, p), first
        _, _, (q, p), _ = jax.lax.while_loop(lambda x: x[1] > last, term, begin)
        return i + 1.0, q, p

    _, q, p = jax.lax.while_loop(lambda x: x[0] < count, turn, (jnp.zeros_like(s), *state))
    return q, p


def _holding(machine: ModalMachine, contact: Scalars) -> Any:
    """What is left of an acceleration where bodies rest on stops: as much of each contact's push as
    keeps its velocity is added."""
    limited = sorted({stop.coordinate for stop in stops_of(machine)}) if contact else []
    if not limited:
        return lambda pull: pull
    rows, pushes = ([x[k] for k in limited] for x in (machine.rows, machine.pushes))
    acting = [contact[k] > 0 for k in limited]
    gains = [[jnp.dot(row, push) for push in pushes] for row in rows]
    units = [[jnp.asarray(float(i == j)) for j in range(len(rows))] for i in range(len(rows))]
    # Of each contact, how much of every push changes its velocity, and no other one's, by one.
    changes = [
        sum(amount * push for amount, push in zip(forces(gains, acting, unit), pushes, strict=True))
        for unit in units
    ]

    def held(pull):
        new = pull
        for row, change, acts in zip(rows, changes, acting, strict=True):
            new = new - jnp.where(acts, jnp.dot(row, pull), 0.0) * change
        return new

    return held
