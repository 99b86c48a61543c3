"""A Duffing oscillator between two stops; with no cubic term the classic impact oscillator."""

from collections.abc import Mapping
from math import pi
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, SHARE
from .._numbers import number, real
from .._types import Scalar
from ..machine import OscillatorState, RigidStop
from ._base import PhaseMachine


class Duffing(PhaseMachine):
    """x'' + δ x' + α x + β x³ = A cos ωt, between stops at ±gap or with one on the right alone.

    The independent variable is the phase ωt, a cycle 2π. A motion of small amplitude that stays off
    the stops is that of a linear oscillator if β = 0: it grazes where A² = gap² ((α - ω²)² + δ²ω²).

    **Arguments:** `amplitude` A, `frequency` ω (positive), `damping` δ (not negative), `stiffness`
    α and `cubic` β (of any sign), `gap` (positive), `restitution` in [0, 1], `two_sided` whether
    there is a stop on the left as well; static.
    """

    amplitude: Scalar = eqx.field(kw_only=True, default=0.3, converter=real("amplitude"))
    frequency: Scalar = eqx.field(kw_only=True, default=1.0, converter=real("frequency"))
    damping: Scalar = eqx.field(kw_only=True, default=0.1, converter=real("damping"))
    stiffness: Scalar = eqx.field(kw_only=True, default=1.0, converter=real("stiffness"))
    cubic: Scalar = eqx.field(kw_only=True, default=0.0, converter=real("cubic"))
    gap: Scalar = eqx.field(kw_only=True, default=1.0, converter=real("gap"))
    restitution: Scalar = eqx.field(kw_only=True, default=0.8, converter=real("restitution"))
    two_sided: bool = eqx.field(kw_only=True, static=True, default=True)
    ranges: ClassVar[dict[str, Any]] = {
        "amplitude": REAL, "frequency": POSITIVE, "damping": NOT_NEGATIVE, "stiffness": REAL,
        "cubic": REAL, "gap": POSITIVE, "restitution": SHARE,
    }  # fmt: skip

    @property
    def stops(self) -> tuple[RigidStop, ...]:  # pyright: ignore
        """One on the right, and one on the left of a two-sided machine."""
        sides = ("right", "left") if self.two_sided else ("right",)
        return tuple(RigidStop(self.gap, self.restitution, side) for side in sides)

    @property
    def labels(self) -> tuple[str, str]:
        """Of pictures."""
        return "x", "dx/dt"

    @property
    def units(self) -> Mapping[str, str]:
        """None: its numbers are the equation's."""
        return {"": "1"}

    @property
    def period(self) -> Scalar:
        """2π/ω."""
        return 2 * pi / self.frequency

    def pace(self, s: Scalar, state: Any) -> Scalar:
        """dt/ds = 1/ω."""
        return 1 / self.frequency

    def field(self, s: Scalar, state: OscillatorState) -> OscillatorState:
        """By phase; V is dx/dt."""
        x, v = state.Y, state.V
        force = self.amplitude * jnp.cos(s) - self.damping * v
        force = force - x * (self.stiffness + self.cubic * x * x)
        return OscillatorState(v / self.frequency, force / self.frequency)

    def start(self, *, Y: Any = 0.0, V: Any = 0.0) -> OscillatorState:
        """At rest in the middle by default."""
        return OscillatorState(number("Y", Y), number("V", V))

    def mirrored(self, state: OscillatorState) -> OscillatorState | None:
        """x → -x half a cycle later, if there are two stops."""
        return OscillatorState(-state.Y, -state.V) if self.two_sided else None
