"""Cranks, drives of unlimited and of limited power, and states of the paper's scene."""

import abc
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, Range, on_host, real, require_ranges
from .._types import State
from ..lanes import sincos
from ..machine import Shown

# The units of the paper's scene, by the names of quantities, components and parameters.
UNITS: Mapping[str, str] = MappingProxyType({
    "position": "a", "velocity": "a ω", "time": "1/ω", "rate": "ω", "energy": "m_C a² ω²",
    "power": "m_C a² ω³", "Y": "a", "V": "a ω", "W": "ω", "phase": "rad", "gap": "a",
    "frequency_ratio": "ω", "no_load_speed": "ω", "section_phase": "rad", "": "1",
})  # fmt: skip

Number = Float[Array, "..."]


class OscillatorState(Shown):
    """State of an ideally driven scene, or of another machine, in the machine's units."""

    Y: Number
    """Position of the body (unit: a)."""
    V: Number
    """dY/dτ (unit: a ω)."""


class Slide(NamedTuple):
    """The slider's displacement U, dU/dφ and d²U/dφ², with the crank angle φ (unit: a)."""

    U: Float[Array, "..."]
    U_phi: Float[Array, "..."]
    U_phiphi: Float[Array, "..."]


class AbstractCrank(Shown):
    """The kinematics of a crank; a subclass defines one method, `slide(phase)`, which returns the
    three arrays of a `Slide`."""

    @abc.abstractmethod
    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """Return the slider's displacement at crank angle `phase` (radians), and its first two
        derivatives with respect to it, in crank radii: `vi.Slide(U, U_phi, U_phiphi)`."""


class CosineCrank(AbstractCrank):
    """The first approximation of the paper (Eq. 4): U = cos φ."""

    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """Return U = cos φ and its derivatives (dimensionless)."""
        sine, cosine = sincos(phase)
        return Slide(cosine, -sine, -cosine)


class SliderCrank(AbstractCrank):
    """The exact kinematics of crank a and rod l: U = cos φ + (√(1 - λ² sin² φ) - 1)/λ."""

    ratio: Float[Array, "..."] = eqx.field(converter=real("ratio"))
    """λ = a/l (dimensionless), in (0, 1)."""
    ranges: ClassVar = {"ratio": Range(0.0, 1.0, open_low=True, open_high=True)}

    def __check_init__(self):
        require_ranges(self)

    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """Return the exact U and its derivatives (dimensionless)."""
        sine, cosine = sincos(phase)
        inverse = 1 / (1 - (self.ratio * sine) ** 2) ** 0.5
        # (r - 1)/λ as -λ sin²/(1 + r): no cancellation for a long rod.
        lag = self.ratio * sine * sine * inverse / (1 + inverse)
        slope = self.ratio * sine * cosine * inverse
        bend = self.ratio * (cosine**2 - sine**2) * inverse + self.ratio * slope**2 * inverse
        return Slide(cosine - lag, -sine - slope, -cosine - bend)


class AbstractDrive(Shown):
    """The drive of the crank of a `Scene`.

    A subclass defines the equations of body and shaft (`field`), and its components of a state
    (`components`). The crank speed `W` is one of them, unless `fixed_speed` returns it.
    """

    caption: ClassVar[str] = "drive"
    """The label of the crank in pictures."""

    @property
    def components(self) -> dict[str, Any]:
        """The drive's components of a state, which follow `Y` and `V` of the body, with their
        default values in `scene.start`."""
        return {}

    @property
    def fixed_speed(self) -> Float[Array, "..."] | None:
        """The crank speed (unit: ω), if it is not part of the state; else `None`."""
        return None

    @abc.abstractmethod
    def field(self, scene: Any, s: Any, state: State, pushes: Iterable[Any]) -> Any:
        """Return d(state)/ds, as a state or by name: by crank angle or, if `scene.clock_name` is
        `"time"`, by time τ. Without a `fixed_speed`, the state in the time clock has the crank
        angle `phase` as last component. **Arguments:** `scene`, for its `crank`, `phase_at` and
        `pull`; `s`; `state`; `pushes`, the accelerations of the body by compliant stops."""

    def rate(self) -> Float[Array, "..."] | float | None:
        """Return the fastest decay rate with respect to τ; 0 if nothing decays, `None` if it is
        unknown. Then the default method is `Adaptive`, since explicit fixed steps may be unstable.
        """
        return None

    def speed(self, state: State) -> Float[Array, "..."]:
        """Return the absolute speed of the crank (unit: ω)."""
        fixed = self.fixed_speed
        return jnp.abs(state.W) if fixed is None else fixed


class IdealDrive(AbstractDrive):
    """A drive of unlimited power: the crank turns at a constant rate."""

    frequency_ratio: Float[Array, "..."] = eqx.field(converter=real("frequency_ratio"))
    """ζ = Ω/ω (dimensionless), positive."""
    ranges: ClassVar = {"frequency_ratio": POSITIVE}
    caption: ClassVar = "$\\varphi' = \\Omega$"

    def __check_init__(self):
        require_ranges(self)

    @property
    def fixed_speed(self):
        """The frequency ratio ζ, the speed of the crank under any load."""
        return self.frequency_ratio

    def rate(self):
        return 0.0

    def field(self, scene, s, state, pushes):
        """Return d(state)/ds of the body by crank angle (Eq. 8 of the paper) or by time (Eq. 5)."""
        zeta = self.frequency_ratio
        timed = scene.clock_name == "time"
        slide = scene.crank.slide(scene.phase_at(zeta * s if timed else s))
        pull = scene.pull(slide.U - state.Y, state.V, pushes)
        if timed:
            return OscillatorState(state.V, pull)
        return OscillatorState(state.V / zeta, pull / zeta)


class Motor(AbstractDrive):
    """A DC motor of limited power with a linear torque-speed characteristic (Eq. 3 of the paper).

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
    caption: ClassVar = "motor, $J$"

    def __check_init__(self):
        require_ranges(self)

    @property
    def components(self):
        """The crank speed `W`, by default the no-load speed κ w0."""
        control, no_load_speed = on_host((self.control, self.no_load_speed))
        return {"W": control * no_load_speed}

    def field(self, scene, s, state, pushes):
        """Return d(state)/ds by crank angle (Eq. 8 to 9 of the paper) or by time (Eq. 5 to 7)."""
        by_angle = scene.clock_name == "phase"
        slide = scene.crank.slide(scene.phase_at(s if by_angle else state.phase))
        # Rates by angle are divided by W. Products with 1/W are shared: each costs in power series.
        pace = 1 / state.W if by_angle else None

        def paced(x):
            return x if pace is None else pace * x

        speed, stretch = paced(state.V), paced(slide.U - state.Y)
        pull = scene.pull(stretch, speed, map(paced, pushes))
        square = state.W if by_angle else state.W * state.W
        load = self.coupling * stretch + self.slider_inertia * slide.U_phiphi * square
        inertia = 1 + self.slider_inertia * slide.U_phi**2
        shaft = (self._torque(state.W, pace) - slide.U_phi * load) / inertia
        return {"Y": speed, "V": pull, "W": shaft} | ({} if by_angle else {"phase": state.W})

    def _torque(self, W: Number, pace: Number | None) -> Number:
        """Return the motor's torque at speed W, per J ω²; divided by W if `pace` = 1/W."""
        slope = 1 / self.no_load_speed
        if pace is None:
            return self.strength * (self.control - W * slope)
        return self.strength * (self.control * pace - slope)

    def rate(self):
        """Return the rate, with respect to τ, at which the shaft returns to its speed."""
        return self.strength / self.no_load_speed
