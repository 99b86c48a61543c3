"""Motors of limited power: the paper's, by its torque–speed line."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, real, require_ranges
from .._types import State
from .crank import Slide
from .drive import AbstractDrive
from .states import MotorState, TimedMotorState

Number = Float[Array, "..."]


class Motor(AbstractDrive):
    """A DC motor of limited power with a straight torque-speed line (Eq. 3 of the paper).

    (1 + μ U_φ²) φ'' + μ U_φ U_φφ φ'² = τ0 (κ - φ'/w0) + ε U_φ (Y - U)
    """

    strength: Number = eqx.field(converter=real("strength"))
    """τ0 = T0/(J ω²) (dimensionless), not negative; 0 lets the shaft coast."""
    control: Number = eqx.field(converter=real("control"))
    """κ, motor control (dimensionless)."""
    coupling: Number = eqx.field(converter=real("coupling"))
    """ε = k0 a²/(J ω²), the spring's reaction on the shaft (dimensionless), not negative."""
    slider_inertia: Number = eqx.field(converter=real("slider_inertia"))
    """μ = m_B a²/J (dimensionless), not negative."""
    no_load_speed: Number = eqx.field(default=1.0, converter=real("no_load_speed"))
    """w0 = Ω0/ω, the no-load speed at κ = 1 (dimensionless), positive."""
    ranges: ClassVar = {
        "strength": NOT_NEGATIVE,
        "control": REAL,
        "coupling": NOT_NEGATIVE,
        "slider_inertia": NOT_NEGATIVE,
        "no_load_speed": POSITIVE,
    }
    state: ClassVar = MotorState
    timed_state: ClassVar = TimedMotorState
    caption: ClassVar = "motor, $J$"

    def __check_init__(self):
        require_ranges(self)

    def field(self, scene, s, state, pushes):
        """d(state)/ds of body and shaft: by crank angle (Eq. 8 to 9 of the paper) or by time (Eq. 5
        to 7)."""
        by_angle = scene.clock_name == "phase"
        slide = scene.crank.slide(scene.phase_at(s if by_angle else state.phase))
        # By angle all is divided by W. Products with 1/W are shared: a power series pays for each.
        pace = 1 / state.W if by_angle else None

        def paced(x):
            return x if pace is None else pace * x

        speed, stretch = paced(state.V), paced(slide.U - state.Y)
        pull = scene.pull(stretch, speed, map(paced, pushes))
        torque, more = self.torque(state, pace, paced)
        square = state.W if by_angle else state.W * state.W
        shaft = self.shaft(slide, torque, stretch, square)
        clock = () if by_angle else (state.W,)
        return type(state)(speed, pull, shaft, *more, *clock)

    def torque(
        self, state: State, pace: Number | None, paced: Callable[[Any], Any]
    ) -> tuple[Number, tuple[Number, ...]]:
        """The motor's torque (per J ω²), and the rates of its components after W. By crank angle
        they are divided by W, which `paced` does."""
        return self.line(state.W, pace), ()

    def usual(self, name, known):
        """A speed that a start leaves out is the no-load speed κ w0."""
        return self.control * self.no_load_speed

    def rate(self):
        """The rate, by τ, at which the shaft comes back to speed."""
        return self.strength / self.no_load_speed

    def line(self, W: Number, pace: Number | None = None) -> Number:
        """The straight line: the motor's steady torque at speed `W`, per J ω²; with `pace` 1/W,
        divided by W."""
        slope = 1 / self.no_load_speed
        if pace is None:
            return self.strength * (self.control - W * slope)
        return self.strength * (self.control * pace - slope)

    def shaft(self, slide: Slide, torque: Number, stretch: Number, square: Number) -> Number:
        """dW/dτ from the motor's torque (per J ω²), U - Y and W² at this place of the slider.

        It is linear in these three: divided by W they give dW/dφ.
        """
        load = self.coupling * stretch + self.slider_inertia * slide.U_phiphi * square
        return (torque - slide.U_phi * load) / self.inertia(slide)

    def inertia(self, slide: Slide) -> Number:
        """Inertia that the shaft feels, per J."""
        return 1 + self.slider_inertia * slide.U_phi**2
