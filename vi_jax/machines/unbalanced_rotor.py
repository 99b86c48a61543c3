"""A motor with an unbalanced rotor on an elastic support: the Sommerfeld effect."""

import dataclasses
from math import cos, pi, sin
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, POSITIVE, SHARE, Range, number, require
from .._types import Number, Scalar, State
from ..machine import Coordinate, RigidStop, ShaftMachine, Shown
from ._base import PhaseMachine, number_field, stops_at, supported


class RotorState(Shown):
    """The state of body and shaft in the phase clock."""

    units: ClassVar = {"Y": "m r/M", "V": "m r ω/M", "P": "J ω", "phase": "rad"}

    Y: Scalar
    """Displacement of the body (unit: m r/M)."""
    V: Scalar
    """dY/dτ (unit: m r ω/M)."""
    P: Scalar
    """Momentum of the shaft, W - ε V sin φ, kept by impacts (unit: J ω); W on the section."""


class TimedRotorState(RotorState):
    """The state of body and shaft in the time clock."""

    phase: Scalar
    """Angle of the rotor since the last section (radians)."""


class UnbalancedRotor(ShaftMachine, PhaseMachine):
    """A body of mass M on a spring k and a damper c, with a motor of limited power that turns a
    rotor with an unbalance m at the radius r. If `gap` is given, the body moves between stops.

    With the body's displacement Y in units of m r/M, time τ = ω t, ω² = k/M, and the rotor's speed
    W = dφ/dτ:

        Y'' + 2ξ Y' + Y = W² cos φ + W' sin φ
        W' = τ0 (κ - W/w0) + ε Y'' sin φ

    Passing the resonance takes power. The speed of a weak motor therefore stays behind its control
    and then jumps (Sommerfeld 1902). At a slowly varying speed ζ the load, averaged over a turn, is
    ε ξ ζ⁵/D with D = (1 - ζ²)² + 4ξ²ζ², and to first order in ε

        τ0 (κ - ζ/w0) = ε ξ ζ⁵/D

    (V. O. Kononenko, Vibrating Systems with a Limited Power Supply, 1969; I. I. Blekhman,
    Vibrational Mechanics, 2000). Gravity is left out, as for an upright or a fast shaft.

    An impact changes the velocity of the body and the speed of the shaft. The velocity is reversed
    and scaled. The momentum of the shaft P = W - ε Y' sin φ, a component of the state, is
    conserved. The energy ½Y'² + ½Y² - W Y' sin φ + W²/(2ε) then decreases by ½(1 - k²)(1 - ε
    sin²φ)V⁻².

    The independent variable is φ, a cycle 2π, and the rotor must turn forward. With
    `simulate(..., clock="time")` it is time, and a start from rest is possible.

    **Arguments:**

    - `strength` τ0 = T0/(J ω²), the motor's stall torque at κ = 1; not negative.
    - `control` κ of the motor.
    - `no_load_speed` w0 at κ = 1 (unit: ω), positive.
    - `coupling` ε = (m r)²/(M J), with J the inertia of the shaft and the unbalance, in [0, 1).
    - `damping_ratio` ξ = c/(2 M ω), not negative.
    - `gap` of the stops (unit: m r/M), positive; `None` for no stops.
    - `restitution` in [0, 1].
    - `two_sided`: whether there is a stop on the left as well; static.
    - `clock_name`: `"phase"` or `"time"`; static.
    """

    strength: Any = number_field("strength", 0.1, NOT_NEGATIVE)
    control: Any = number_field("control", 0.9)
    no_load_speed: Any = number_field("no_load_speed", 1.0, POSITIVE, "ω")
    coupling: Any = number_field("coupling", 0.01, Range(0.0, 1.0, open_high=True))
    damping_ratio: Any = number_field("damping_ratio", 0.05, NOT_NEGATIVE)
    gap: Any = number_field("gap", None, POSITIVE, "m r/M")
    restitution: Any = number_field("restitution", 0.5, SHARE)
    two_sided: bool = eqx.field(kw_only=True, static=True, default=False)
    clock_name: str = eqx.field(kw_only=True, static=True, default="phase")
    quantity_units: ClassVar = {
        **RotorState.units, "frequency_ratio": "ω", "rate": "ω", "time": "1/ω",
        "energy": "m² r² ω²/M", "power": "m² r² ω³/M",
    }  # fmt: skip
    state_type: ClassVar = RotorState  # pyright: ignore
    timed_type: ClassVar = TimedRotorState  # pyright: ignore
    labels: ClassVar = ("Y (m r/M)", "dY/dτ (m r ω/M)")  # pyright: ignore

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        """The stop on the right, and one on the left if two-sided; empty without `gap`."""
        if self.gap is None:
            return ()
        return stops_at(self.gap, self.restitution, two_sided=self.two_sided)

    def speed(self, phase: Number, state: State) -> Scalar:
        """Return W = dφ/dτ of the rotor (unit: ω) at this angle."""
        return state.P + self.coupling * state.V * jnp.sin(phase)

    def load(self, speed: Number) -> Float[Array, "..."]:
        """Return ε ξ ζ⁵/D, the averaged load of the vibration at this rotor speed (unit: J ω²)."""
        z = jnp.asarray(speed)
        detuned = (1 - z * z) ** 2 + (2 * self.damping_ratio * z) ** 2
        return self.coupling * self.damping_ratio * z**5 / detuned

    def averaged_control(self, speed: Number) -> Float[Array, "..."]:
        """Return κ of a motor at this mean speed, to first order in ε and without stops."""
        return jnp.asarray(speed) / self.no_load_speed + self.load(speed) / self.strength

    def field(self, s: Scalar, state: State) -> Any:
        """Return d(state)/dφ, or d(state)/dτ for a state of the time clock, between impacts."""
        phase = self._angle(s, state)
        sine, cosine = jnp.sin(phase), jnp.cos(phase)
        W = state.P + self.coupling * state.V * sine
        motor = self.strength * (self.control - W / self.no_load_speed)
        force = W * W * cosine - state.Y - 2 * self.damping_ratio * state.V
        # Both equations solved for Y''; the equation of the shaft is that of its momentum.
        push = (force + sine * motor) / (1 - self.coupling * sine * sine)
        twist = motor - self.coupling * state.V * W * cosine
        if self.is_timed(state):
            return TimedRotorState(state.V, push, twist, W)
        pace = _pace(W)
        return RotorState(pace * state.V, pace * push, pace * twist)

    def effective_mass(self, s: Scalar, state: State) -> Scalar:
        """Return 1 - ε sin²φ, the mass in an impact, which also accelerates the shaft (unit: M)."""
        sine = jnp.sin(self._angle(s, state))
        return 1 - self.coupling * sine * sine

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """The coordinate of the body, with its effective mass."""
        return (super().coordinates[0]._replace(mass=self.effective_mass),)

    def start(self, *, Y: Number = 0.0, V: Number = 0.0, W: Number | None = None) -> Any:
        """Return a state on the section φ = 0. `W` (unit: ω) defaults to the no-load speed κ w0;
        `W=0` is a start from rest, for the time clock."""
        speed = self.control * self.no_load_speed if W is None else W
        Y, V, P = number("Y", Y), number("V", V), number("W", speed)
        for name, value in (("Y", Y), ("V", V), ("W", P)):
            require(name, value)
        return self.convert_start(RotorState(Y, V, P))

    def mirrored(self, state: State) -> Any:
        """Return -Y half a turn later, unless there is a stop on one side only."""
        if self.gap is not None and not self.two_sided:
            return None
        return dataclasses.replace(state, Y=-state.Y, V=-state.V)

    def section_speed(self, state: State) -> Any:
        """Return the momentum of the shaft, which is its speed at φ = 0."""
        return state.P

    def pace(self, s: Scalar, state: State) -> Scalar | None:
        """Return dτ/dφ = 1/W if the angle is the independent variable."""
        return _pace(self.speed(s, state)) if self.is_paced(state) else None

    def step_limit(self, s: Scalar, state: State) -> Scalar:
        """Return a fifth of the rotor's turn, or of the body's period if that is shorter."""
        speed = self._speed(s, state)
        turn = 0.4 * pi / jnp.maximum(1.0, speed)
        return turn * speed if self.clock_name == "phase" else turn

    def relaxation(self, s: Scalar, state: State) -> Scalar:
        """Return the shortest time constant, of a strongly damped body or a strong motor."""
        rate = jnp.maximum(2 * self.damping_ratio, self.strength / self.no_load_speed)
        pace = self._speed(s, state) if self.clock_name == "phase" else 1.0
        return pace * (1 - self.coupling) / jnp.maximum(rate, 1e-6)

    def _angle(self, s: Scalar, state: State) -> Scalar:
        return state.phase if self.is_timed(state) else s

    def _speed(self, s: Scalar, state: State) -> Scalar:
        """Return the absolute speed of the rotor (unit: ω)."""
        return jnp.abs(self.speed(self._angle(s, state), state))

    def alive(self, state: State) -> jax.Array | None:
        """Return False in the phase clock if the rotor does not turn forward: its state is NaN."""
        return jnp.isfinite(state.P) if self.is_paced(state) else None

    def sketch(self, pen: Any, state: State, phase: float) -> None:
        """Draw a body on its spring, with the unbalanced rotor in it."""
        place, size = float(state.Y), pen.size
        radius = 0.34 * size
        post = supported(self, pen, place)
        pen.disc(place, 0.0, radius)
        heavy = place + radius * cos(phase), radius * sin(phase)
        pen.line((place, 0.0), heavy)
        pen.ball(*heavy, 0.1 * size, color=pen.red)
        pen.label(place + 0.15 * size, 0.68 * size, "$m,\\ r$", color=pen.red)
        pen.label(place + 0.68 * size, 0.0, "$M$", color=pen.blue)
        pen.label((post + place) / 2, 0.7 * size, "$k,\\ c$")


def _pace(W: Scalar) -> Scalar:
    """Return dτ/dφ; NaN if the rotor does not turn forward."""
    return jnp.where(W > 0, 1 / W, jnp.nan)
