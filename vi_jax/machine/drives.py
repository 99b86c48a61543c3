"""Cranks, drives of unlimited and of limited power, and states of the paper's scene."""

import abc
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, Range, number, real, require, require_ranges
from .._types import Scalar, State
from ..lanes import sincos
from .declared import overridden
from .numbers import Shown

# The units of the paper's scene, by the names of quantities, components and parameters.
UNITS: Mapping[str, str] = MappingProxyType({
    "position": "a", "velocity": "a ω", "time": "1/ω", "rate": "ω", "energy": "m_C a² ω²",
    "power": "m_C a² ω³", "Y": "a", "V": "a ω", "W": "ω", "M": "J ω²", "phase": "rad",
    "gap": "a", "frequency_ratio": "ω", "no_load_speed": "ω", "electrical_time": "1/ω",
    "section_phase": "rad", "": "1",
})  # fmt: skip

Number = Float[Array, "..."]


class OscillatorState(Shown):
    """State of an ideally driven scene, or of another machine, in the machine's units."""

    Y: Number
    """Position of the body (unit: a)."""
    V: Number
    """dY/dτ (unit: a ω)."""


class MotorState(OscillatorState):
    """State of a motor scene whose independent variable is the crank angle."""

    units: ClassVar = UNITS
    W: Number
    """Speed of the crank dφ/dτ (unit: ω)."""


class TimedMotorState(MotorState):
    """State of a motor scene whose independent variable is time."""

    phase: Number
    """Crank angle since the last section (radians)."""


class DCMotorState(MotorState):
    """State of a scene with a `DCMotor` whose independent variable is the crank angle."""

    M: Number
    """Torque of the motor, which its armature current gives (unit: J ω²)."""


class TimedDCMotorState(DCMotorState):
    """State of a scene with a `DCMotor` whose independent variable is time."""

    phase: Number
    """Crank angle since the last section (radians)."""


class Slide(NamedTuple):
    """The slider's displacement U, dU/dφ and d²U/dφ², with the crank angle φ (unit: a)."""

    U: Float[Array, "..."]
    U_phi: Float[Array, "..."]
    U_phiphi: Float[Array, "..."]


class AbstractCrank(Shown):
    """The kinematics of a crank; a subclass defines one method, `slide(phase)`."""

    @property
    def is_odd(self) -> bool:
        """True if the slider is at the opposite place half a turn later: U(φ + π) = -U(φ)."""
        return False

    @property
    def drawn_rod(self) -> Scalar | float:
        """The length of the rod in pictures (unit: a)."""
        return 3.0

    @abc.abstractmethod
    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """Return the slider's displacement at crank angle `phase` (radians), in crank radii."""


class CosineCrank(AbstractCrank):
    """The first approximation of the paper (Eq. 4): U = cos φ."""

    @property
    def is_odd(self):
        return overridden(self, CosineCrank, "slide") is None

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

    @property
    def drawn_rod(self):
        return 1 / self.ratio

    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """Return the exact U and its derivatives (dimensionless)."""
        sine, cosine = sincos(phase)
        inverse = 1 / (1 - (self.ratio * sine) ** 2) ** 0.5
        # (r - 1)/λ as -λ sin²/(1 + r): no cancellation for a long rod.
        lag = self.ratio * sine * sine * inverse / (1 + inverse)
        slope = self.ratio * sine * cosine * inverse
        bend = self.ratio * (cosine**2 - sine**2) * inverse + self.ratio * slope**2 * inverse
        return Slide(cosine - lag, -sine - slope, -cosine - bend)


# Reasons for the absence of a component, for error messages.
_WITHOUT = {
    "W": "an ideal drive turns at its frequency ratio",
    "M": "only a `DCMotor` has a torque of its own",
}


class AbstractDrive(Shown):
    """The drive of the crank of a `Scene`.

    A subclass defines the equations of body and shaft (`field`) and the class of its states. States
    have `Y` and `V` of the body, then the components of the drive. The crank speed `W` is one of
    them, unless `fixed_speed` returns it.
    """

    state: ClassVar[type]
    """The class of its states by crank angle."""
    timed_state: ClassVar[type | None] = None
    """The class of its states by time, with the crank angle `phase` as last component; `None` if
    the angle is a function of time."""
    caption: ClassVar[str] = "drive"
    """The label of the crank in pictures."""

    @property
    def fixed_speed(self) -> Float[Array, "..."] | None:
        """The crank speed (unit: ω), if it is not part of the state; else `None`."""
        return None

    @abc.abstractmethod
    def field(self, scene: Any, s: Any, state: State, pushes: Iterable[Any]) -> State:
        """Return d(state)/ds by crank angle or, if `scene.clock_name` is `"time"`, by time τ.
        **Arguments:** `scene`, for its `crank`, `phase_at` and `pull`; `s`; `state`; `pushes`, the
        accelerations of the body by compliant stops."""

    def rate(self) -> Float[Array, "..."] | None:
        """Return the fastest decay rate with respect to τ, or `None` if nothing decays."""
        return None

    def usual(self, name: str, known: dict[str, Any]) -> Any:
        """Return the default of a component in a start; `known` are the components before it."""
        raise ValueError(
            f"Argument `{name}` of `start` must be given for a `{type(self).__name__}`, which has "
            "no `usual` for it."
        )

    def check(self) -> None:
        """Raise `TypeError` for a drive without a member that a scene needs."""
        kind, state = type(self), getattr(self, "state", None)
        if not isinstance(state, type):
            raise TypeError(
                f"Drive `{kind.__name__}` must define `state`, the class of its states."
            )
        if self.fixed_speed is None and not isinstance(kind.timed_state, type):
            raise TypeError(
                f"Drive `{kind.__name__}` has no `fixed_speed`, so it must define `timed_state`: "
                "the class of its states by time, with the crank angle `phase` as last component."
            )

    def begin(self, **given: Any) -> dict[str, Any]:
        """Return the drive's components of a start, by name. A component that is not given, or
        `None`, has its `usual` value. **Raises:** `ValueError` if a number is not finite, or not a
        component of its state."""
        names = [part.name for part in dataclasses.fields(self.state)][2:]
        for name, value in given.items():
            if value is not None and name not in names:
                known = ["Y", "V", *names]
                near = [x for x in known if x.lower() == name.lower()]
                hint = f"it is called `{near[0]}`" if near else f"a state has {', '.join(known)}"
                reason = _WITHOUT.get(name, hint)
                raise ValueError(
                    f"Argument `{name}` must be left out: {reason}, but got {name}={value!r}."
                )
        found: dict[str, Any] = {}
        for name in names:
            value = given.get(name)
            found[name] = number(name, self.usual(name, found) if value is None else value)
            require(name, found[name])
        return found

    def speed(self, state: State) -> Float[Array, "..."]:
        """Return the absolute speed of the crank (unit: ω)."""
        fixed = self.fixed_speed
        return jnp.abs(state.W) if fixed is None else fixed


class IdealDrive(AbstractDrive):
    """A drive of unlimited power: the crank turns at a constant rate."""

    frequency_ratio: Float[Array, "..."] = eqx.field(converter=real("frequency_ratio"))
    """ζ = Ω/ω (dimensionless), positive."""
    ranges: ClassVar = {"frequency_ratio": POSITIVE}
    state: ClassVar = OscillatorState
    caption: ClassVar = "$\\varphi' = \\Omega$"

    def __check_init__(self):
        require_ranges(self)

    @property
    def fixed_speed(self):
        """The frequency ratio ζ, the speed of the crank under any load."""
        return self.frequency_ratio

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
    state: ClassVar = MotorState
    timed_state: ClassVar = TimedMotorState
    caption: ClassVar = "motor, $J$"

    def __check_init__(self):
        require_ranges(self)

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
        torque, more = self.torque(state, pace, paced)
        square = state.W if by_angle else state.W * state.W
        shaft = self.shaft(slide, torque, stretch, square)
        clock = () if by_angle else (state.W,)
        return type(state)(speed, pull, shaft, *more, *clock)

    def torque(
        self, state: State, pace: Number | None, paced: Callable[[Any], Any]
    ) -> tuple[Number, tuple[Number, ...]]:
        """Return the motor's torque (per J ω²), and the rates of the components after W. By crank
        angle, both are divided by W: by the function `paced`, or with `pace` = 1/W."""
        return self.line(state.W, pace), ()

    def usual(self, name, known):
        return self.control * self.no_load_speed

    def rate(self):
        """Return the rate, with respect to τ, at which the shaft returns to its speed."""
        return self.strength / self.no_load_speed

    def line(self, W: Number, pace: Number | None = None) -> Number:
        """Return the motor's steady torque at speed `W`, per J ω²; divided by W if `pace` = 1/W."""
        slope = 1 / self.no_load_speed
        if pace is None:
            return self.strength * (self.control - W * slope)
        return self.strength * (self.control * pace - slope)

    def shaft(self, slide: Slide, torque: Number, stretch: Number, square: Number) -> Number:
        """Return dW/dτ from the motor's torque (per J ω²), U - Y and W². It is linear in these
        three: divided by W they give dW/dφ."""
        load = self.coupling * stretch + self.slider_inertia * slide.U_phiphi * square
        return (torque - slide.U_phi * load) / self.inertia(slide)

    def inertia(self, slide: Slide) -> Number:
        """Return the effective inertia of the shaft, per J."""
        return 1 + self.slider_inertia * slide.U_phi**2


class DCMotor(Motor):
    """A DC motor with the inductance of its armature, at a constant voltage.

    The armature has L i' + R i + K_e φ' = u and the torque K_t i (primes: d/dt). The state has one
    more component, the torque M = K_t i/(J ω²), with

        τe dM/dτ = τ0 (κ - W/w0) - M,
        τe = ω L/R,  κ τ0 = K_t u/(R J ω²),  κ w0 = u/(K_e ω).

    M replaces the steady torque in `Motor`'s equation of the shaft. As τe → 0, the motor becomes a
    `Motor`, with a difference of first order in τe. The source gives the power κ w0 M, the armature
    turns M² w0/τ0 into heat, and the shaft gets M W (unit: J ω³). The armature holds the energy τe
    M² w0/(2 τ0) (unit: J ω²).

    Explicit methods are limited to steps of about τe, so that a small τe is expensive: below 0.05
    use `Motor`, unless you need the current itself.
    """

    electrical_time: Float[Array, "..."] = eqx.field(
        kw_only=True, converter=real("electrical_time")
    )
    """τe = ω L/R, the electrical time constant (dimensionless), positive."""
    ranges: ClassVar = {**Motor.ranges, "electrical_time": POSITIVE}
    state: ClassVar = DCMotorState
    timed_state: ClassVar = TimedDCMotorState

    def torque(self, state, pace, paced):
        return paced(state.M), (paced(self.build_up(state.W, state.M)),)

    def usual(self, name, known):
        return self.line(known["W"]) if name == "M" else super().usual(name, known)

    def build_up(self, W: Float[Array, "..."], M: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return dM/dτ at this speed and torque."""
        return (self.line(W) - M) / self.electrical_time

    def rate(self) -> Float[Array, "..."]:
        """Return the fastest rate of shaft and armature together, with respect to τ: 1/τe of the
        current or, if that is slow, √(τ0/(w0 τe)) of the oscillation of speed and current."""
        decay = 1 / self.electrical_time
        return jnp.maximum(decay, jnp.sqrt(decay * self.strength / self.no_load_speed))
