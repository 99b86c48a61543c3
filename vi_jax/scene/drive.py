"""Drives: what turns the crank."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, require_ranges
from .._numbers import real
from .crank import Slide
from .shown import Shown


class IdealDrive(Shown):
    """A drive of unlimited power: the crank turns at a constant rate."""

    frequency_ratio: Float[Array, "..."] = eqx.field(converter=real("frequency_ratio"))
    """ζ = Ω/ω (dimensionless), positive."""
    ranges: ClassVar = {"frequency_ratio": POSITIVE}

    def __check_init__(self):
        require_ranges(self)


class Motor(Shown):
    """A DC motor of limited power with a straight torque-speed line (Eq. 3 of the paper).

    (1 + μ U_φ²) φ'' + μ U_φ U_φφ φ'² = τ0 (κ - φ'/w0) + ε U_φ (Y - U)
    """

    strength: Float[Array, "..."] = eqx.field(converter=real("strength"))
    """τ0 = T0/(J ω²) (dimensionless), not negative; 0 lets the shaft coast."""
    control: Float[Array, "..."] = eqx.field(converter=real("control"))
    """κ, motor control (dimensionless)."""
    coupling: Float[Array, "..."] = eqx.field(converter=real("coupling"))
    """ε = k0 a²/(J ω²), the spring's reaction on the shaft (dimensionless), not negative."""
    slider_inertia: Float[Array, "..."] = eqx.field(converter=real("slider_inertia"))
    """μ = m_B a²/J (dimensionless), not negative."""
    no_load_speed: Float[Array, "..."] = eqx.field(default=1.0, converter=real("no_load_speed"))
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

    def rate(self) -> Float[Array, "..."]:
        """The rate, by τ, at which the shaft comes back to speed."""
        return self.strength / self.no_load_speed

    def line(
        self, W: Float[Array, "..."], pace: Float[Array, "..."] | None = None
    ) -> Float[Array, "..."]:
        """The straight line: the motor's steady torque at speed `W`, per J ω²; with `pace` 1/W,
        divided by W."""
        slope = 1 / self.no_load_speed
        if pace is None:
            return self.strength * (self.control - W * slope)
        return self.strength * (self.control * pace - slope)

    def shaft(
        self,
        slide: Slide,
        torque: Float[Array, "..."],
        stretch: Float[Array, "..."],
        square: Float[Array, "..."],
    ) -> Float[Array, "..."]:
        """dW/dτ from the motor's torque (per J ω²), U - Y and W² at this place of the slider.

        It is linear in these three: divided by W they give dW/dφ.
        """
        load = self.coupling * stretch + self.slider_inertia * slide.U_phiphi * square
        return (torque - slide.U_phi * load) / self.inertia(slide)

    def inertia(self, slide: Slide) -> Float[Array, "..."]:
        """Inertia that the shaft feels, per J."""
        return 1 + self.slider_inertia * slide.U_phi**2


class DCMotor(Motor):
    """A DC motor with the inductance of its armature, at a constant voltage.

    With the armature's L i' + R i + K_e φ' = u and the torque K_t i (primes: d/dt), and the torque
    M = K_t i/(J ω²) as one more component of the state, it has

        τe dM/dτ = τ0 (κ - W/w0) - M

    and `Motor`'s equation of the shaft with M in the line's place, where

        τe = ω L/R,  κ τ0 = K_t u/(R J ω²),  κ w0 = u/(K_e ω).

    Its steady torque is `Motor`'s line, which it approaches at first order in τe as τe → 0. In
    units of J ω² (and J ω³) the source gives the power κ w0 M, the armature turns the power
    M² w0/τ0 into heat and holds the energy τe M² w0/(2 τ0), and the shaft gets the power M W.

    Explicit methods are kept to steps of about τe, so that a motor of small τe costs more the
    smaller it is: below 0.05 use `Motor`, unless the current itself is asked for.
    """

    electrical_time: Float[Array, "..."] = eqx.field(
        kw_only=True, converter=real("electrical_time")
    )
    """τe = ω L/R, the electrical time constant (dimensionless), positive."""
    ranges: ClassVar = {**Motor.ranges, "electrical_time": POSITIVE}

    def build_up(self, W: Float[Array, "..."], M: Float[Array, "..."]) -> Float[Array, "..."]:
        """dM/dτ at this speed and torque."""
        return (self.line(W) - M) / self.electrical_time

    def rate(self) -> Float[Array, "..."]:
        """The fastest rate of shaft and armature together, by τ.

        1/τe of the current, or where that is slow √(τ0/(w0 τe)), at which speed and current swing.
        """
        own = 1 / self.electrical_time
        return jnp.maximum(own, jnp.sqrt(own * self.strength / self.no_load_speed))
