"""A motor with an unbalanced rotor on an elastic support: the Sommerfeld effect."""

from math import cos, pi, sin
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, SHARE, Range
from .._types import Number, Scalar, State
from ..machine import Mechanical, RigidStop, turn_of
from ._base import ReadyMachine, draw_supported_body, number_field, stops_at


class UnbalancedRotor(ReadyMachine, Mechanical):
    """A body of mass M on a spring k and a damper c, with a motor of limited power that turns a
    rotor with an unbalance m at the radius r. If `gap` is given, the body moves between stops.

    With the body's displacement Y in units of m r/M, time τ = ω t, ω² = k/M, and the rotor's angle
    φ and speed W = dφ/dτ, the kinetic energy is ½Y'² - W Y' sin φ + W²/(2ε) and the motion

        Y'' + 2ξ Y' + Y = W² cos φ + W' sin φ
        W' = τ0 (κ - W/w0) + ε Y'' sin φ

    Passing the resonance takes power. The speed of a weak motor therefore stays behind its control
    and then jumps (Sommerfeld 1902). At a slowly varying speed ζ the load, averaged over a turn, is
    ε ξ ζ⁵/D with D = (1 - ζ²)² + 4ξ²ζ², and to first order in ε

        τ0 (κ - ζ/w0) = ε ξ ζ⁵/D

    (V. O. Kononenko, Vibrating Systems with a Limited Power Supply, 1969; I. I. Blekhman,
    Vibrational Mechanics, 2000). Gravity is left out, as for an upright or a fast shaft.

    An impact reverses and scales the velocity of the body, and jerks the shaft. It takes the energy
    ½(1 - k²)(1 - ε sin²φ)Y'².

    A cycle is a turn of the rotor, which may start from rest.

    **Arguments:**

    - `strength` τ0 = T0/(J ω²), the motor's stall torque at κ = 1; not negative.
    - `control` κ of the motor.
    - `no_load_speed` w0 at κ = 1 (unit: ω), positive.
    - `coupling` ε = (m r)²/(M J), with J the inertia of the shaft and the unbalance, in (0, 1).
    - `damping_ratio` ξ = c/(2 M ω), not negative.
    - `gap` of the stops (unit: m r/M), positive; `None` for no stops.
    - `restitution` in [0, 1].
    - `two_sided`: whether there is a stop on the left as well; static.
    """

    strength: Any = number_field("strength", 0.1, NOT_NEGATIVE)
    control: Any = number_field("control", 0.9)
    no_load_speed: Any = number_field("no_load_speed", 1.0, POSITIVE, "ω")
    coupling: Any = number_field("coupling", 0.01, Range(0.0, 1.0, open_low=True, open_high=True))
    damping_ratio: Any = number_field("damping_ratio", 0.05, NOT_NEGATIVE)
    gap: Any = number_field("gap", None, POSITIVE, "m r/M")
    restitution: Any = number_field("restitution", 0.5, SHARE)
    two_sided: bool = eqx.field(kw_only=True, static=True, default=False)
    q: ClassVar = ("Y", "phi")
    cycle: ClassVar = turn_of("phi", usual=2 * pi)  # of the resonance; less at a higher speed
    quantity_units: ClassVar = {
        "Y": "m r/M", "v.Y": "m r ω/M", "phi": "rad", "v.phi": "ω", "frequency_ratio": "ω",
        "rate": "ω", "time": "1/ω", "energy": "m² r² ω²/M", "power": "m² r² ω³/M",
    }  # fmt: skip
    labels: ClassVar = ("Y (m r/M)", "dY/dτ (m r ω/M)")  # pyright: ignore

    def mass(self, q: Any) -> list[list[Any]]:  # pyright: ignore
        """Return the mass matrix of body and shaft (units: M; m r; (m r)²/M)."""
        across = -jnp.sin(q.phi)
        return [[1.0, across], [across, 1 / self.coupling]]

    def force(self, t: Scalar, q: Any, v: Any) -> dict[str, Any]:
        torque = self.strength * (self.control - v.phi / self.no_load_speed)
        return dict(Y=-q.Y - 2 * self.damping_ratio * v.Y, phi=torque / self.coupling)

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        if self.gap is None:
            return ()
        return stops_at(self.gap, self.restitution, two_sided=self.two_sided, on="Y")

    def start(self, *, Y: Number = 0.0, V: Number = 0.0, W: Number | None = None) -> Any:
        """Return a state with φ = 0. The rotor's speed `W` (unit: ω) defaults to the no-load speed
        κ w0; `W=0` is a start from rest."""
        speed = self.control * self.no_load_speed if W is None else W
        return self.at(Y=Y, v={"Y": V, "phi": speed})

    def mirrored(self, state: Any) -> Any:
        if self.gap is not None and not self.two_sided:
            return None
        return state.replace(Y=-state.Y, phi=state.phi + pi, v=state.v.replace(Y=-state.v.Y))

    def relaxation(self, s: Scalar, state: State) -> Scalar:
        """Return the shortest time constant, of a strongly damped body or a strong motor."""
        rate = jnp.maximum(2 * self.damping_ratio, self.strength / self.no_load_speed)
        return (1 - self.coupling) / jnp.maximum(rate, 1e-6)

    def sketch(self, pen: Any, state: State, phase: float) -> None:
        place, size = float(state.Y), pen.size
        radius = 0.34 * size
        post = draw_supported_body(self, pen, place)
        pen.disc(place, 0.0, radius)
        unbalance = place + radius * cos(state.phi), radius * sin(state.phi)
        pen.line((place, 0.0), unbalance)
        pen.ball(*unbalance, 0.1 * size, color=pen.red)
        pen.label(place + 0.15 * size, 0.68 * size, "$m,\\ r$", color=pen.red)
        pen.label(place + 0.68 * size, 0.0, "$M$", color=pen.blue)
        pen.label((post + place) / 2, 0.7 * size, "$k,\\ c$")
