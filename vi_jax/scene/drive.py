"""Drives: what turns the crank."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, number, require_ranges
from .crank import Slide


class IdealDrive(eqx.Module):
    """A drive of unlimited power: the crank turns at a constant rate."""

    frequency_ratio: Float[Array, "..."] = eqx.field(
        converter=lambda x: number("frequency_ratio", x)
    )
    """ζ = Ω/ω (dimensionless), positive."""
    ranges: ClassVar = {"frequency_ratio": POSITIVE}

    def __check_init__(self):
        require_ranges(self)


class Motor(eqx.Module):
    """A DC motor of limited power with a straight torque-speed line (Eq. 3 of the paper).

    (1 + μ U_φ²) φ'' + μ U_φ U_φφ φ'² = τ0 (κ - φ'/w0) + ε U_φ (Y - U)
    """

    strength: Float[Array, "..."] = eqx.field(converter=lambda x: number("strength", x))
    """τ0 = T0/(J ω²) (dimensionless), not negative; 0 lets the shaft coast."""
    control: Float[Array, "..."] = eqx.field(converter=lambda x: number("control", x))
    """κ, motor control (dimensionless)."""
    coupling: Float[Array, "..."] = eqx.field(converter=lambda x: number("coupling", x))
    """ε = k0 a²/(J ω²), the spring's reaction on the shaft (dimensionless), not negative."""
    slider_inertia: Float[Array, "..."] = eqx.field(converter=lambda x: number("slider_inertia", x))
    """μ = m_B a²/J (dimensionless), not negative."""
    no_load_speed: Float[Array, "..."] = eqx.field(
        default=1.0, converter=lambda x: number("no_load_speed", x)
    )
    """w0 = Ω0/ω, the no-load speed at κ = 1 (dimensionless), positive."""
    ranges: ClassVar = {
        "strength": NOT_NEGATIVE,
        "control": REAL,
        "coupling": NOT_NEGATIVE,
        "slider_inertia": NOT_NEGATIVE,
        "no_load_speed": POSITIVE,
    }

    def __check_init__(self):
        require_ranges(self)

    def torque(
        self, slide: Slide, Y: Float[Array, "..."], W: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """What accelerates the shaft at slider position `slide` and speed `W`, per J ω²."""
        motor = self.strength * (self.control - W * (1 / self.no_load_speed))
        spring = self.coupling * slide.U_phi * (Y - slide.U)
        return motor + spring - self.slider_inertia * slide.U_phi * slide.U_phiphi * W * W

    def inertia(self, slide: Slide) -> Float[Array, "..."]:
        """Inertia that the shaft feels, per J."""
        return 1 + self.slider_inertia * slide.U_phi**2
