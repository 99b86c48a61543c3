"""A Duffing oscillator between two stops; without a cubic term the classic impact oscillator."""

from math import cos
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, SHARE, number
from .._types import Number, Scalar
from ..machine import RigidStop
from ._base import ForcedMachine, draw_supported_body, number_field, stops_at
from .drives import OscillatorState


class Duffing(ForcedMachine):
    """x'' + δ x' + α x + β x³ = A cos ωt, between stops at ±gap or with a stop on the right.

    The independent variable is the phase ωt, a cycle 2π. With β = 0, a motion that stays off the
    stops is that of a linear oscillator. It grazes where A² = gap² ((α - ω²)² + δ²ω²).

    **Arguments:** `amplitude` A, `frequency` ω (positive), `damping` δ (not negative), `stiffness`
    α and `cubic` β (of any sign), `gap` (positive), `restitution` in [0, 1]; `two_sided`, whether
    there is a stop on the left as well; static.
    """

    amplitude: Any = number_field("amplitude", 0.3)
    frequency: Any = number_field("frequency", 1.0, POSITIVE)
    damping: Any = number_field("damping", 0.1, NOT_NEGATIVE)
    stiffness: Any = number_field("stiffness", 1.0)
    cubic: Any = number_field("cubic", 0.0)
    gap: Any = number_field("gap", 1.0, POSITIVE)
    restitution: Any = number_field("restitution", 0.8, SHARE)
    two_sided: bool = eqx.field(kw_only=True, static=True, default=True)
    labels: ClassVar = ("x", "dx/dt")  # pyright: ignore
    units: ClassVar = {"": "1"}  # pyright: ignore

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        return stops_at(self.gap, self.restitution, two_sided=self.two_sided)

    def field(self, s: Scalar, state: OscillatorState) -> OscillatorState:
        """Return d(state)/d(ωt) between impacts; the state's V is dx/dt."""
        x, v = state.Y, state.V
        force = self.amplitude * jnp.cos(s) - self.damping * v
        force = force - x * (self.stiffness + self.cubic * x * x)
        return OscillatorState(v / self.frequency, force / self.frequency)

    def start(self, *, Y: Number = 0.0, V: Number = 0.0) -> OscillatorState:
        return OscillatorState(number("Y", Y), number("V", V))

    def mirrored(self, state: OscillatorState) -> OscillatorState | None:
        return OscillatorState(-state.Y, -state.V) if self.two_sided else None

    def sketch(self, pen: Any, state: OscillatorState, phase: float) -> None:
        place, size = float(state.Y), pen.size
        post = draw_supported_body(self, pen, place)
        pull = 0.9 * size * cos(phase)
        if abs(pull) > 0.1 * size:
            pen.arrow((place, 0.75 * size), (place + pull, 0.75 * size))
        pen.label(place, 1.0 * size, "$A\\,\\cos\\,\\omega t$")
        pen.label((post + place) / 2, 0.75 * size, "$\\alpha x + \\beta x^3$")
