"""Closed forms between impacts: the oscillator with an ideal drive, and linear machines."""

from collections.abc import Callable
from math import factorial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.custom_derivatives import SymbolicZero
from jax.lax import stop_gradient
from numpy.polynomial.legendre import leggauss

from ..._checks import count
from ..._types import Flag, Scalar, Scalars, State
from ...machine import (
    AbstractMachine,
    Prepared,
    forces,
    horner,
    limited_in,
    overridden,
    phase_at,
    sincos,
    stops_of,
    switches_of,
)
from ...machines import (
    CosineCrank,
    IdealDrive,
    LinearMachine,
    ModalMachine,
    OscillatorState,
    Scene,
    modal,
)
from ..smooth import Integrals, SmoothMachine, constant, rate_of_integrals
from .base import AbstractMethod

# The series of a matrix exponential is summed over lengths in which the state changes at most by
# this multiple of its size. It ends when terms are below this share of a rounding error. Its 24
# terms are half the work of 18 terms over lengths half as long.
_LONGEST, _LAST = 2.0, 0.005

# A mode is negligible at a contact if its amplitude there is below this many rounding errors of the
# sum of all.
_MATTERS = 4

# Factor that widens bounds to cover rounding.
_WIDER = 1.001

# Steps in the shortest period, of one mode and of several. A sum of modes may leave a stop, return
# and leave again in a fifth of the period. The ends of such a step do not show it (one of some 150
# cycles of random machines of up to eight modes; none with ten steps).
_ALONE, _SEVERAL = 5, 10

# Series of (cos √y - sin √y/√y)/2y, for |y| < 1: the next term is 1e-17.
_BEND = tuple((-1) ** n * n / factorial(2 * n + 1) for n in range(1, 10))


def modal_flight(
    machine: ModalMachine, contact: Scalars, s: Scalar, h: Scalar, state: State
) -> Any:
    """Return the state a time h after that at s, exact to rounding for any h. Free flight of
    uncoupled modes is the closed form of each. A matrix exponential is used for modes coupled by
    damping, resting bodies (`contact`), and a force in resonance with a mode."""
    free = machine.plain > 0
    for rests in contact:
        free = free & (rests == 0)
    q, p = state.displacement, state.velocity
    closed = _closed(machine, s, h, q, p)
    series = _series_flight(machine, contact, s, h, (q, p), ~free)
    return type(state)(*(jnp.where(free, a, b) for a, b in zip(closed, series, strict=True)))


def longest(machine: ModalMachine, s: Scalar, state: State) -> Scalar:
    """Return a tenth of the period of the fastest mode that matters, or of the force; a fifth for a
    single mode. A mode matters if its free motion moves a contact by more than rounding. Others
    cannot make or hide an event. Decayed modes thus cost no steps."""
    q, p = state.displacement, state.velocity
    place, rate = (0.0, 0.0) if machine.steady is None else _steady_response(machine, s)
    frequencies = machine.modal_frequency
    amplitudes = jnp.abs(q - place) + jnp.abs(p - rate) * machine.inverse_frequency
    fastest, least = machine.frequency, _MATTERS * jnp.finfo(frequencies.dtype).eps
    for row in machine.rows:
        part = jnp.abs(row) * amplitudes
        matters = part > least * jnp.sum(part + jnp.abs(row * place))
        fastest = jnp.maximum(fastest, jnp.max(jnp.where(matters, frequencies, 0.0)))
    count = _ALONE if frequencies.size == 1 else _SEVERAL
    return stop_gradient(2 * jnp.pi / (count * fastest))


def clear(machine: ModalMachine, s: Scalar, state: State) -> Scalar:
    """Return a time of free flight in which no stop can be met; 0 if it is not known. A decaying
    mode stays within its amplitude a, and its acceleration within κa. So a parabola bounds the
    distance to a stop from below. The time is infinite if the amplitudes' sum does not reach it."""
    machine, s, state = constant((machine, s, state))  # a length has no derivative
    q, p = state.displacement, state.velocity
    place, rate = (0.0, 0.0) if machine.steady is None else _steady_response(machine, s)
    y, v = q - place, p - rate
    velocity_amplitude = machine.swing_time * (v + 0.5 * machine.damping * y)
    amplitude = jnp.sqrt(y * y + velocity_amplitude * velocity_amplitude)
    length = jnp.asarray(jnp.inf, q.dtype)
    for stop in stops_of(machine):
        row = machine.rows[stop.coordinate]
        part = jnp.abs(row) * amplitude
        reach, pull = jnp.sum(part), jnp.dot(machine.stiffness, part)
        middle = jnp.zeros_like(reach)
        if machine.steady is not None:
            middle, *turning = (jnp.dot(row, x) for x in machine.steady)
            swing = jnp.sqrt(turning[0] ** 2 + turning[1] ** 2)
            reach, pull = reach + swing, pull + machine.frequency**2 * swing
        room, speed = -stop.beyond(jnp.dot(row, q)), stop.sign * jnp.dot(row, p)
        root = jnp.sqrt(speed * speed + 2 * pull * jnp.maximum(room, 0.0))
        # The form without cancellation, of two equivalent ones.
        towards = 2 * room / jnp.where(speed + root > 0, speed + root, 1.0)
        away = (root - speed) / jnp.where(pull > 0, pull, 1.0)
        time_to_stop = jnp.where(speed > 0, towards, away)
        is_out_of_reach = -stop.beyond(middle) > _WIDER * reach
        time_to_stop = jnp.where(is_out_of_reach, jnp.inf, jnp.where(room > 0, time_to_stop, 0.0))
        length = jnp.minimum(length, time_to_stop)
    return jnp.where(machine.plain * machine.all_decay > 0, length / _WIDER, 0.0)


def _steady_response(machine: ModalMachine, s: Scalar) -> tuple[Any, Any]:
    assert machine.steady is not None
    constant, cosine, sine = machine.steady
    omega = machine.frequency
    c, d = jnp.cos(omega * s), jnp.sin(omega * s)
    return constant + cosine * c + sine * d, omega * (sine * c - cosine * d)


def _closed(machine: ModalMachine, s: Scalar, h: Scalar, q: object, p: object) -> tuple[Any, Any]:
    """Return the flight of each mode by itself: q'' + c q' + κ q = f."""
    half = 0.5 * machine.damping
    square = machine.stiffness - half * half
    known = machine.swing, machine.swing_time, machine.oscillates
    even, odd = _decaying_pair(known, half, square, h)
    if machine.steady is None:
        y, v, place, rate = q, p, 0.0, 0.0
    else:
        place, rate = _steady_response(machine, s)
        y, v = q - place, p - rate
        place, rate = _steady_response(machine, s + h)
    mean = half * odd
    new = place + (even + mean) * y + odd * v
    return new, rate + (even - mean) * v - machine.stiffness * odd * y


@jax.custom_jvp
def _decaying_pair(known: tuple, half: Any, square: Any, h: Scalar) -> tuple[Any, Any]:
    """Return e^(-at) cos(wt) and e^(-at) sin(wt)/w for w² (`square`) of any sign, and a (`half`);
    `known` are `swing`, `swing_time` and `oscillates` of the machine."""
    swing, swing_time, oscillates = known
    fade = jnp.exp(-half * h)
    pair = fade * jnp.cos(swing * h), fade * (swing_time * jnp.sin(swing * h))
    # Overdamped modes are rare: skipped if a lane has none.
    return jax.lax.cond(oscillates > 0, lambda *x: x[0], _without_turns, pair, half, square, h)


def _without_turns(pair: Any, half: Any, square: Any, h: Scalar) -> tuple[Any, Any]:
    """Return `_decaying_pair` for overdamped modes, and entries of `pair` for the others."""
    is_overdamped = square <= 0
    root = jnp.sqrt(jnp.where(is_overdamped, -square, 0.0))
    # The slower rate a - r, without the cancellation of a difference.
    slower = (half * half + square) / jnp.where(is_overdamped & (half + root > 0), half + root, 1.0)
    slower = jnp.where(half + root > 0, slower, half - root)
    fade = jnp.exp(-jnp.where(is_overdamped, slower, 0.0) * h)
    has_root = root > 0
    odd = jnp.where(has_root, -jnp.expm1(-2 * root * h) / jnp.where(has_root, 2 * root, 1.0), h)
    odd = fade * odd
    even = fade - root * odd
    return jnp.where(is_overdamped, even, pair[0]), jnp.where(is_overdamped, odd, pair[1])


def _pair_jvp(primals, tangents):
    known, half, square, h = primals
    even, odd = _decaying_pair(known, half, square, h)
    d_even, d_odd = jnp.zeros_like(even), jnp.zeros_like(odd)
    _, half_dot, square_dot, h_dot = tangents
    if not isinstance(half_dot, SymbolicZero):
        d_even, d_odd = d_even - h * even * half_dot, d_odd - h * odd * half_dot
    if not isinstance(square_dot, SymbolicZero):
        y = square * h * h
        flat = jnp.abs(y) < 1
        series = jnp.exp(-half * h) * h**3 * horner(_BEND, jnp.where(flat, y, 0.0))
        bend = (h * even - odd) / jnp.where(flat, 1.0, 2 * square)
        d_even = d_even - 0.5 * h * odd * square_dot
        d_odd = d_odd + jnp.where(flat, series, bend) * square_dot
    if not isinstance(h_dot, SymbolicZero):
        d_even = d_even - (half * even + square * odd) * h_dot
        d_odd = d_odd + (even - half * odd) * h_dot
    return (even, odd), (d_even, d_odd)


_decaying_pair.defjvp(_pair_jvp, symbolic_zeros=True)


def _series_flight(
    machine: ModalMachine, contact: Scalars, s: Scalar, h: Scalar, state: State, wanted: Flag
) -> tuple[Any, Any]:
    """Return the state by the series of the matrix exponential, in parts so short that it converges
    quickly; by none unless `wanted`. The force rotates with the motion, as two more numbers."""
    length = stop_gradient(jnp.abs(h)) * machine.fastest
    count = stop_gradient(jnp.where(wanted, jnp.maximum(jnp.ceil(length / _LONGEST), 1.0), 0.0))
    part, change = h / jnp.maximum(count, 1.0), length / jnp.maximum(count, 1.0)
    smallest = _LAST * jnp.finfo(h.dtype).eps
    project = _resting_projection(machine, contact)
    omega = machine.frequency
    steady, cosine, sine = (0.0 if f is None else f for f in machine.forces)

    def advance(carry):
        i, q, p = carry
        angle = omega * (s + i * part)
        one = jnp.ones_like(s)

        def term(carry):
            k, size, sums, (dq, dp, (u, c, d)) = carry
            hk = part / k
            force = steady * u + cosine * c + sine * d
            force = force - machine.stiffness * dq - machine.damping * dp - machine.coupled(dq, dp)
            new = hk * dp, hk * project(force), (jnp.zeros_like(u), -hk * omega * d, hk * omega * c)
            return k + 1.0, size * change / k, (sums[0] + new[0], sums[1] + new[1]), new

        first = q, p, (one, jnp.cos(angle), jnp.sin(angle))
        begin = one, one, (q, p), first
        _, _, (q, p), _ = jax.lax.while_loop(lambda x: x[1] > smallest, term, begin)
        return i + 1.0, q, p

    _, q, p = jax.lax.while_loop(lambda x: x[0] < count, advance, (jnp.zeros_like(s), *state))
    return q, p


def _resting_projection(machine: ModalMachine, contact: Scalars) -> Any:
    """Return a function that removes from an acceleration the part that resting contacts cancel:
    each contact's push keeps its velocity constant."""
    limited = limited_in(machine) if contact else []
    if not limited:
        return lambda pull: pull
    rows, pushes = ([x[k] for k in limited] for x in (machine.rows, machine.pushes))
    acting = [contact[k] > 0 for k in limited]
    gains = [[jnp.dot(row, push) for push in pushes] for row in rows]
    units = [[jnp.asarray(float(i == j)) for j in range(len(rows))] for i in range(len(rows))]
    # For each contact, the combination of pushes that changes its velocity by one, and no other's.
    changes = [
        sum(amount * push for amount, push in zip(forces(gains, acting, unit), pushes, strict=True))
        for unit in units
    ]

    def project(pull):
        new = pull
        for row, change, acts in zip(rows, changes, acting, strict=True):
            new = new - jnp.where(acts, jnp.dot(row, pull), 0.0) * change
        return new

    return project


# Series of the cosine and of sin(x)/x in x²: on an arc, of up to 2π/5, the next term is below
# 1e-16.
_COS = tuple((-1) ** n / factorial(2 * n) for n in range(10))
_SINC = tuple((-1) ** n / factorial(2 * n + 1) for n in range(10))
# (e^x - 1)/x
_EXP_SLOPE = tuple(1 / factorial(n + 1) for n in range(10))

# Below this distance from resonance |1 - ζ² + 2iξζ| the steady response, which grows like its
# inverse, would cancel against the free one; the response from rest is summed instead.
_NEAR = 1e-2

# Gauss–Legendre nodes and weights on [0, 1] for averages along an arc. For a fourth power of the
# state, whose phase changes by at most 5 radians in it, their error is 1e-15.
_NODES, _WEIGHTS = (0.5 * (x + shift) for x, shift in zip(leggauss(10), (1.0, 0.0), strict=True))


class ExactFlight(AbstractMethod):
    """The closed form of Y'' + 2ξY' + Y = cos φ between impacts, and of M x'' + C x' + K x = f for
    a linear machine (`vi.machines.Structure`). Only impact times need a root.

    It holds for ideal drives with a `CosineCrank`, for every ξ ≥ 0 (under-, critically and
    over-damped) and every ζ > 0, also ζ = 1 with ξ = 0 (the secular case). The motion is divided in
    arcs of at most a fifth of the shorter period, each ended at the next turning point. So an
    impact is missed only if it is shallower than rounding. Arcs of a linear machine of several
    modes are a tenth of the period of the fastest one that moves a contact by more than rounding.
    Modes coupled by damping, resonance and bodies at rest use the series of a matrix exponential.

    **Arguments:** `steps_per_cycle`, the number of arcs in a turn (at least 5, the default). More
    of them change only rounding.

    **Raises:** `ValueError` for fewer than 5 arcs.
    """

    steps_per_cycle: int = eqx.field(static=True, default=5)  # pyright: ignore

    def __check_init__(self):
        count("steps_per_cycle", self.steps_per_cycle, least=5)

    def tighter(self):
        return ExactFlight(2 * self.steps_per_cycle)

    def holds(self, machine):
        """Return whether the machine is linear, so that its resting coordinates are held; another
        machine does not move while it rests."""
        return isinstance(machine, LinearMachine | ModalMachine)

    def resolves(self, machine):
        """Return whether the machine is in its modes. Steps of several modes are a tenth of the
        fastest period: of 12,000 random structures pressed on stops none was off by over 1e-5."""
        return isinstance(machine, ModalMachine)

    def check(self, machine):
        lack = lack_of_closed_form(machine)
        if lack is not None:
            raise ValueError(f"Method `ExactFlight` needs a {lack}. Use `Adaptive` or `FixedStep`.")

    def longest(self, machine, s, state):
        """Return the longest step; for a linear machine by the modes that matter there."""
        if not isinstance(machine, ModalMachine):
            return super().longest(machine, s, state)
        return longest(machine, s, state) * (5 / self.steps_per_cycle)

    def clear(self, machine, s, state):
        """Return a bound from the amplitudes of all modes, limited to a fixed part of a cycle."""
        if not isinstance(machine, ModalMachine):
            return None
        return jnp.minimum(clear(machine, s, state), machine.cycle / self.steps_per_cycle)

    def step(self, smooth, s0, s1, state, beside):
        """Return the flight from `s0` to `s1`, exact to rounding, with averages by quadrature."""
        machine = smooth.machine
        if isinstance(machine, LinearMachine | ModalMachine):
            return _linear_flight(smooth, s0, s1, state, beside)
        zeta, xi, in_phase = _drive_numbers(machine)
        tau = (s1 - s0) / zeta if in_phase else s1 - s0
        phase = phase_at(machine, s0 if in_phase else zeta * s0)

        def along(share: float | None) -> OscillatorState:
            part = tau if share is None else share * tau
            return OscillatorState(*flight(zeta, xi, phase, state.Y, state.V, part))

        if beside:
            beside = _integrals_of_flight(smooth, s0, s1, state, along, beside)
        return along(None), beside, jnp.zeros_like(s0)


def _linear_flight(
    smooth: SmoothMachine, s0: Scalar, s1: Scalar, state: State, beside: Integrals
) -> tuple[State, Integrals, Scalar]:
    """Return the flight of a linear machine, as `ExactFlight.step`, in natural modes."""
    machine, h = smooth.machine, s1 - s0
    form = modal(machine) if isinstance(machine, LinearMachine) else Prepared(machine)
    begin = form.inward(state)

    def along(share: float) -> State:
        return form.outward(modal_flight(form.machine, smooth.contact, s0, share * h, begin))

    if beside:
        beside = _integrals_of_flight(smooth, s0, s1, state, along, beside)
    new = form.outward(modal_flight(form.machine, smooth.contact, s0, h, begin))
    return new, beside, jnp.zeros_like(s0)


def _integrals_of_flight(
    smooth: SmoothMachine, s0: Scalar, s1: Scalar, state: State, along: Callable, beside: Integrals
) -> Integrals:
    """Return the integrals of a flight from `s0` to `s1`, by quadrature. A held body stays as in
    `state`; `along` returns the state of the flight at a share of its length."""
    total = beside
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        at_node = along(float(node))
        if smooth.contact and not isinstance(smooth.machine, LinearMachine):
            rests = smooth.contact[0] > 0
            at_node = jtu.tree_map(lambda a, b, rests=rests: jnp.where(rests, a, b), state, at_node)
        rate = rate_of_integrals(smooth, s0 + float(node) * (s1 - s0), at_node, beside)
        share = float(weight) * (s1 - s0)
        total = jtu.tree_map(lambda x, v, share=share: x + share * v, total, rate)
    return total


def lack_of_closed_form(machine: AbstractMachine) -> str | None:
    """Return what the closed form needs of a machine and what the machine has instead, as text;
    `None` if it has a closed form."""
    if isinstance(machine, LinearMachine | ModalMachine):
        return _lack_of_linear(machine)
    if not isinstance(machine, Scene) or not isinstance(machine.drive, IdealDrive):
        drive = type(machine.drive if isinstance(machine, Scene) else machine).__name__
        return f"`Scene` with an `IdealDrive`, but got a `{drive}`"
    crank = machine.crank
    if not isinstance(crank, CosineCrank) or overridden(crank, CosineCrank, "slide"):
        return f"`CosineCrank`, but the machine has a `{type(crank).__name__}`"
    equations = (
        (machine, Scene, ("field", "pull", "_pushes", "phase_at", "damping_ratio")),
        (machine.drive, IdealDrive, ("field", "fixed_speed")),
    )
    for part, base, names in equations:
        override = overridden(part, base, *names)
        if override is not None:
            return (
                f"`{base.__name__}` with its own equations, but a `{type(part).__name__}` has "
                f"another `{override}`"
            )
    if switches_of(machine):
        return f"machine without soft stops, but it has {len(switches_of(machine))}"
    return None


def _lack_of_linear(machine: AbstractMachine) -> str | None:
    """Return `lack_of_closed_form` for a linear machine, whose subclass may differ."""
    name = type(machine).__name__
    if isinstance(machine, LinearMachine):
        # Resting bodies are held by the rows of the matrices' own coordinates.
        override = overridden(machine, LinearMachine, "field", "_accelerated", "coordinates")
        if override is not None:
            return f"linear machine as its matrices say, but a `{name}` has another `{override}`"
    if switches_of(machine):
        return f"machine without switches, but it has {len(switches_of(machine))}"
    return None


def _drive_numbers(machine: AbstractMachine) -> tuple[Scalar, Scalar, bool]:
    """Return ζ, ξ and whether the machine is in the phase clock."""
    assert isinstance(machine, Scene) and isinstance(machine.drive, IdealDrive)
    return machine.drive.frequency_ratio, machine.damping_ratio, machine.clock_name == "phase"


def flight(
    zeta: Scalar, xi: Scalar, phase: Scalar, Y: Scalar, V: Scalar, tau: Scalar
) -> tuple[Scalar, Scalar]:
    """Return Y and V after a time τ of free flight from (Y, V) at crank angle `phase`; zeta and xi
    are ζ and ξ.

    All are dimensionless scalars; |τ| is at most a fifth of the shorter of the periods 2π and 2π/ζ,
    less under strong damping (|ξτ| ≤ 0.4π). The solution is Eq. 14 of the paper, with damping.
    Changes of the order of τ are summed. So the rounding error of a short flight is small compared
    with its length, also if a body leaves the stop by less than the rounding error of its position.
    """
    # C = cos(ω_d τ) and S = sin(ω_d τ)/ω_d are entire in ω_d² = 1 - ξ², for either sign.
    square = (1 - xi * xi) * tau * tau
    bend, S = square * horner(_COS[1:], square), tau * horner(_SINC, square)
    loss = _expm1(-xi * tau)
    fade = 1 + loss
    fall = bend + loss + loss * bend  # of the free motion: fade·C - 1

    sine0, cosine0 = sincos(phase)
    turn = _phase_change(sine0, cosine0, 0.5 * zeta * tau)
    detune, drag = 1 - zeta * zeta, 2 * xi * zeta
    size = detune * detune + drag * drag
    near = size < _NEAR * _NEAR
    scale = 1 / jnp.where(near, 1.0, size)
    # Near resonance both are replaced by the response from rest.
    P = jnp.where(near, 0.0, detune * scale)
    Q = jnp.where(near, 0.0, drag * scale)
    y = Y - (P * cosine0 + Q * sine0)
    v = V - zeta * (Q * cosine0 - P * sine0)
    pull = fade * S
    Y_change = fall * y + pull * (xi * y + v) + (P * turn[0] + Q * turn[1])
    V_change = fall * v - pull * (xi * v + y) + zeta * (Q * turn[0] - P * turn[1])
    Y_rest, V_rest = jax.lax.cond(
        near, _from_rest, lambda *_: (jnp.zeros_like(tau), jnp.zeros_like(tau)),
        jnp.where(near, zeta, 1.0), jnp.where(near, xi, 0.0), (cosine0, sine0), turn, tau,
    )  # fmt: skip
    return Y + (Y_change + Y_rest), V + (V_change + V_rest)


def _expm1(x: Scalar) -> Scalar:
    """Return e^x - 1 for |x| up to 1.3, without cancellation."""
    part = 0.125 * x * horner(_EXP_SLOPE, 0.125 * x)
    for _ in range(3):
        part = part * (part + 2)
    return part


def _phase_change(sine: Scalar, cosine: Scalar, half: Scalar) -> tuple[Scalar, Scalar]:
    """Return the changes of a phase's cosine and sine, in this order, over the angle 2·`half`."""
    s, c = sincos(half)
    return -2 * s * (sine * c + cosine * s), 2 * s * (cosine * c - sine * s)


def _times(a, b):
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _minus(a, b):
    return a[0] - b[0], a[1] - b[1]


def _from_rest(zeta, xi, begin, turn, tau):
    """Return Y and V at a time `tau` after a start from rest, near resonance only; `begin` are
    cosine and sine of the phase at the start, `turn` their changes since.

    With p = -ξ + iω_d it is Re{[τ e^{pτ} E(w) e^{iφ0} - (e^{iφ1} - e^{p̄τ} e^{iφ0})/(iζ - p̄)] /
    (2iω_d)}, w = (iζ - p)τ, where E(w) = (e^w - 1)/w stays smooth through resonance. Complex
    numbers are pairs, because pairs of floats fuse.
    """
    omega = (1 - xi * xi) ** 0.5
    loss = _expm1(-xi * tau)
    # e^(pτ) - 1
    bend, sine = _phase_change(jnp.zeros_like(tau), jnp.ones_like(tau), 0.5 * omega * tau)
    change = (bend + loss + loss * bend, (1 + loss) * sine)
    decay = (1 + change[0], change[1])
    w = (xi * tau, (zeta - omega) * tau)
    series = (jnp.full_like(tau, _EXP_SLOPE[-1]), jnp.zeros_like(tau))
    for coefficient in _EXP_SLOPE[-2::-1]:
        re, im = _times(series, w)
        series = (re + coefficient, im)
    resonant = _times(_times(decay, series), (tau * begin[0], tau * begin[1]))
    other = (xi, zeta + omega)
    scale = 1 / (other[0] ** 2 + other[1] ** 2)
    inverse = (other[0] * scale, -other[1] * scale)
    lag = _times((change[0], -change[1]), begin)
    z = _minus(resonant, _times(_minus(turn, lag), inverse))
    # d/dτ of each part, from its definition; the common part of both at the start cancels.
    p, p_bar = (-xi, omega), (-xi, -omega)
    i_zeta = (jnp.zeros_like(zeta), zeta)
    rate_resonant = _times(p, resonant)
    rate_resonant = (rate_resonant[0] + turn[0], rate_resonant[1] + turn[1])
    rate_other = _minus(_times(i_zeta, turn), _times(p_bar, lag))
    rate = _minus(rate_resonant, _times(rate_other, inverse))
    # Re{z / (2iω)} = Im{z} / (2ω)
    half = 0.5 / omega
    return half * z[1], half * rate[1]
