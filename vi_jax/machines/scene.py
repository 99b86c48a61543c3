"""The paper's scene, in the phase or the time clock of its shaft; and Table 1 of the paper in SI
units, with conversions to a scene and back."""

import dataclasses
from collections.abc import Iterable, Mapping
from math import cos, pi, sin
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    REAL,
    SHARE,
    Range,
    concrete,
    in_range,
    instance_of,
    is_traced,
    number,
    on_host,
    one_of,
    optional_real,
    real,
    require,
    require_ranges,
    state_of_numbers,
    tuple_of,
)
from .._messages import warn
from .._types import Number, Scalar, State
from ..machine import (
    AbstractMachine,
    RigidStop,
    Shown,
    SoftStop,
    as_logged,
    at_section,
    clock_in_words,
    clock_word,
    convert_start,
    cycle_time,
    cycles_in_words,
    frequency_ratio,
    in_clock,
    in_cycle_clock,
    in_cycle_state,
    is_alive,
    known,
    like,
    logged_turn,
    may_rest,
    observed_later,
    overridden,
    phase_at,
    scales_known,
)
from ..machine import State as Named
from .drives import (
    UNITS,
    AbstractCrank,
    AbstractDrive,
    CosineCrank,
    IdealDrive,
    Motor,
    OscillatorState,
    SliderCrank,
)

# The largest error of a state on the section. In single precision, that of a turn is 5e-7.
_ON_SECTION = 1e-5


def _state(components: Mapping[str, Any]) -> State:
    """Return the state of a scene with these components."""
    return (OscillatorState if len(components) == 2 else Named)(**components)


class Scene(AbstractMachine):
    """A body on a spring, driven by a crank, with stops: Y'' + 2ξY' + Y = U(φ).

    Every number is a leaf, and may be a `vmap` axis or be differentiated. Absent parts (a stop, the
    drive's equation, a clock component) are left out of the compiled program.

    The clock is `"phase"` (the crank angle is the independent variable: a drive cycle is exactly
    2π, and the crank must keep turning forward) or `"time"` (any motion, also a start from rest).
    For an ideal drive both agree up to the factor ζ.
    """

    damping_ratio: Float[Array, "..."] = eqx.field(converter=real("damping_ratio"))
    """ξ = c/(2 m_C ω) (dimensionless), not negative."""
    drive: AbstractDrive
    stops: tuple[RigidStop, ...] = eqx.field(
        default=(), converter=lambda x: tuple_of("stops", x, RigidStop)
    )
    crank: AbstractCrank = eqx.field(default_factory=CosineCrank)
    clock_name: str = eqx.field(static=True, default="phase")
    section_phase: Float[Array, "..."] | None = eqx.field(
        default=None, converter=optional_real("section_phase")
    )
    """Crank angle of the section (radians, in [-2π, 2π]); `None` is 0. Phases of states and of
    impacts are counted from it."""
    soft_stops: tuple[SoftStop, ...] = eqx.field(
        default=(), converter=lambda x: tuple_of("soft_stops", x, SoftStop)
    )
    """Compliant stops; the unit of their stiffness is that of the body's own spring."""
    ranges: ClassVar = {
        "damping_ratio": NOT_NEGATIVE, "section_phase": Range(-2 * pi, 2 * pi), "room": POSITIVE,
    }  # fmt: skip
    units: ClassVar = UNITS  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]
    labels: ClassVar = ("Y = y/a", "V = dY/dτ")  # pyright: ignore

    def __check_init__(self):
        one_of("clock_name", self.clock_name, ("phase", "time"))
        instance_of("crank", self.crank, AbstractCrank, "a `CosineCrank()` or another crank")
        instance_of("drive", self.drive, AbstractDrive, "an `IdealDrive` or a `Motor`")
        if len(self.stops) > 2 or len({stop.side for stop in self.stops}) != len(self.stops):
            raise ValueError(
                "Argument `stops` must hold at most one stop on each side, but holds "
                f"{[stop.side for stop in self.stops]}."
            )
        room = None if self.room is None else concrete(self.room)
        if room is not None and not (room > 0).all():
            raise ValueError(
                "Argument `stops` must leave room between the two stops (gaps adding up to more "
                f"than 0), but their gaps add up to {room.min():g}."
            )
        require_ranges(self)

    @classmethod
    def ideal(
        cls,
        *,
        frequency_ratio: Number,
        restitution: Number = 0.5,
        gap: Number = 2.0,
        damping_ratio: Number = 0.0,
        crank: AbstractCrank | None = None,
    ) -> "Scene":
        """Return an ideally driven scene with one stop on the right.

        **Arguments:** ζ, k, d (unit: a) and ξ, scalars or arrays of one shape to `vmap` over;
        `crank` defaults to `CosineCrank()`. `gap=None` leaves the stop out.

        **Raises:** `ValueError` with the name of an argument that is out of range.
        """
        stops = () if gap is None else (RigidStop(gap, restitution),)
        return cls(
            damping_ratio=damping_ratio,
            drive=IdealDrive(frequency_ratio),
            stops=stops,
            crank=CosineCrank() if crank is None else crank,
        )

    @property
    def cycle(self) -> Scalar | float:
        """The cycle: 2π of crank angle, or in the time clock of an ideal drive 2π/ζ of time τ."""
        return self.period if self.clock_name == "time" else 2 * pi

    @property
    def period(self) -> Scalar | float:
        """The duration 2π/ζ of a cycle, in τ, of an ideal drive; 2π of crank angle for another."""
        speed = self.drive.fixed_speed
        return 2 * pi if speed is None else 2 * pi / speed

    def at_section(self, phase: Number) -> "Scene":
        """Return the same scene, observed at the crank angle `phase` (radians) instead of 0."""
        return dataclasses.replace(self, section_phase=phase)

    def observed_later(self, since_section: Number) -> "Scene":
        """Return the same scene, observed this crank angle (radians) after its section."""
        angle = self.phase_at(since_section)
        return self.at_section(jnp.where(angle > 2 * pi, angle - 2 * pi, angle))

    def phase_at(self, since_section: Number) -> Any:
        """Return the crank angle for an angle since the section."""
        return since_section if self.section_phase is None else since_section + self.section_phase

    def start(self, *, Y: Number = 0.0, V: Number = 0.0, **others: Any) -> State:
        """Return a state on the section.

        **Arguments:** position `Y` (unit: a), velocity `V` (a ω), and in `others` the drive's
        components: the crank speed `W` (ω) of a motor, by default its no-load speed κ w0 (0 for a
        motor that is being switched on).

        **Raises:** `ValueError` if a number is not finite, or the drive has no such component.
        """
        usual = {"Y": 0.0, "V": 0.0} | self.drive.components
        for name in others:
            if name not in usual:
                drive, near = type(self.drive).__name__, [x for x in usual if x == name.upper()]
                hint = f"it is called `{near[0]}`; " if near else ""
                raise ValueError(
                    f"Argument `{name}` must be left out: {hint}a state with drive `{drive}` has "
                    f"{', '.join(usual)}."
                )
        given = {name: x for name, x in others.items() if x is not None}
        values = {x: number(x, y) for x, y in (usual | {"Y": Y, "V": V} | given).items()}
        for name, value in values.items():
            require(name, value)
        return self.convert_start(_state(values))

    def is_timed(self, state: State) -> bool:
        """Return whether the angle of the shaft is part of the state."""
        return hasattr(state, "phase")

    def is_paced(self, state: State) -> bool:
        """Return whether the angle is the independent variable, and dτ/dφ depends on the state."""
        return self.drive.fixed_speed is None and not self.is_timed(state)

    def in_clock(self, clock: str) -> Any:
        """Return the same machine in the `"phase"` or the `"time"` clock."""
        one_of("clock", clock, ("phase", "time"))
        return dataclasses.replace(self, clock_name=clock)

    def convert_start(self, start: State) -> State:
        """Return a start made for either clock in the form of this machine's clock."""
        timed = self.clock_name == "time" and self.drive.fixed_speed is None
        parts = self._components("start", start, timed=timed)
        if timed and "phase" not in parts:
            parts["phase"] = jnp.zeros_like(parts["Y"])
        return state_of_numbers("start", _state(parts))

    def in_cycle_state(self, name: str, state: State) -> State:
        """Return a section state without the shaft's angle, if it is of the time clock. **Raises:**
        `ValueError` with the argument's name if the angle is known and not 0, `TypeError` for
        another object than a state of this machine."""
        parts = self._components(name, state, timed=True)
        phase = concrete(parts.pop("phase", 0.0))
        if phase is not None and not (abs(phase) <= _ON_SECTION).all():
            raise ValueError(
                f"Argument `{name}` must lie on the section, where its phase is 0, but has "
                f"{abs(phase).max():g}."
            )
        return _state(parts)

    def _components(self, name: str, state: object, *, timed: bool) -> dict[str, Any]:
        """Return the components of a state by name, of a `timed` one also with the shaft's angle.
        **Raises:** `TypeError` for another object."""
        names = ["Y", "V", *self.drive.components]
        kinds, found = (Named, OscillatorState), getattr(state, "__dict__", {})
        names += ["phase"] * (timed and "phase" in found)
        if isinstance(state, kinds) and set(found) == set(names):
            return {x: found[x] for x in names}
        parts = [x for x in ("last", "state") if isinstance(getattr(state, x, None), kinds)]
        hint = f"; take its `{parts[0]}`" if parts else ""
        has = f" of {', '.join(found)}" if isinstance(state, kinds) else ""
        raise TypeError(
            f"Argument `{name}` must be a state of {', '.join(names)} for this machine (use its "
            f"`start(...)`), but got a `{type(state).__name__}`{has}{hint}."
        )

    def _clock(self, state: State) -> Scalar | None:
        return state.phase if self.is_timed(state) else None

    def _with_earlier_clock(self, state: State) -> State:
        if not self.is_timed(state):
            return state
        return eqx.tree_at(lambda x: x.phase, state, state.phase - 2 * pi)

    def alive(self, state: State) -> jax.Array | None:
        """Return whether the shaft turns forward, in the phase clock; `None` in another."""
        return state.W > 0 if self.is_paced(state) else None

    def check_start(self, start: State) -> None:
        """Raise `ValueError` for a start beyond the section, or with W ≤ 0 in the phase clock."""
        if self.is_paced(start):
            speed = concrete(start.W)
            if speed is not None and not (speed > 0).all():
                raise ValueError(
                    "Argument `start` must have W > 0 in the phase clock, but has "
                    f'W = {speed.min():g}. Pass `clock="time"` to start from rest.'
                )
        if self.is_timed(start):
            phase = concrete(start.phase)
            if phase is not None and not (phase < 2 * pi).all():
                raise ValueError(
                    "Argument `start` must have its phase, counted from the last section, below "
                    f"2π, but has {phase.max():g}."
                )

    @property
    def _stops(self) -> tuple[RigidStop, ...]:
        return self.stops

    @property
    def _switches(self) -> tuple[SoftStop, ...]:
        return self.soft_stops

    def field(self, s: Scalar, state: State, *modes: Scalar) -> State:
        """Return d(state)/ds by crank angle (Eq. 8 to 9 of the paper) or by time τ (Eq. 5 to 7)."""
        rates = self.drive.field(self, s, state, self._pushes(s, state, modes))
        return like(state, rates, f"`field` of a {type(self.drive).__name__}")

    def pull(self, stretch: Any, speed: Number, pushes: Iterable[Any]) -> Any:
        """Return d²Y/dτ² from U - Y, V and the accelerations by compliant stops. With all three
        divided by W, it is dV/dφ."""
        pull = stretch - 2 * self.damping_ratio * speed
        for push in pushes:
            pull = pull + push
        return pull

    def _pushes(self, s, state, modes):
        for stop, mode in zip(self.soft_stops, modes, strict=True):
            yield stop.contribution(self, s, state, mode)

    def as_logged(self, clock: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the crank angle since the section for a reading of the clock."""
        speed = self.drive.fixed_speed
        return clock if speed is None or self.clock_name == "phase" else speed * clock

    def pace(self, s: Scalar, state: State) -> Scalar | None:
        """Return dτ/dφ = 1/W in the phase clock of a motor."""
        return 1 / state.W if self.is_paced(state) else None

    def frequency_ratio(self, duration: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return ζ, the mean crank speed over cycles of these durations (unit: ω)."""
        speed = self.drive.fixed_speed
        if speed is None:
            return 2 * pi / duration
        return jnp.broadcast_to(speed, duration.shape)

    def step_limit(self, s: Scalar, state: State) -> Scalar:
        """Return a fifth of the shorter of the drive's turn and the body's natural period, less
        near a soft stop."""
        speed = self.drive.speed(state)
        turn = 0.4 * pi / jnp.maximum(1.0, speed)
        for stop in self.soft_stops:
            turn = jnp.minimum(turn, stop.longest_step(self, s, state))
        return turn * speed if self.clock_name == "phase" else turn

    def relaxation(self, s: Scalar, state: State) -> Scalar | None:
        """Return the shortest decay time: 1/2ξ of the body, or that of the drive: the time w0/τ0 in
        which a motor returns to its speed. `None` if that of the drive is unknown."""
        drive_rate = self.drive.rate()
        if drive_rate is None:
            return None
        rate = jnp.maximum(2 * self.damping_ratio, drive_rate)
        pace = self.drive.speed(state) if self.clock_name == "phase" else 1.0
        return pace / jnp.maximum(rate, 1e-6)

    def mirrored(self, state: State) -> State | None:
        """Return -Y half a turn later, if both sides have the same stops and the crank is odd."""
        for stops in (self.stops, self.soft_stops):
            if not all(any(stop.mirrors(other) for other in stops) for stop in stops):
                return None
        if not isinstance(self.crank, CosineCrank) or overridden(self.crank, CosineCrank, "slide"):
            return None  # U(φ + π) is not -U(φ)
        return dataclasses.replace(state, Y=-state.Y, V=-state.V)

    def may_rest(self) -> bool:
        """Return False if only a slider within |U| ≤ 1 pulls the body, by the library's equations,
        and all gaps are known and larger."""
        known = (
            type(self.crank).slide in (CosineCrank.slide, SliderCrank.slide)
            and type(self.drive).field in (IdealDrive.field, Motor.field)
            and overridden(self, Scene, "field", "pull", "_pushes", "_switches") is None
        )
        if self.soft_stops or not known:
            return bool(self.stops)
        gaps = [concrete(stop.gap) for stop in self.stops]
        return any(gap is None or not (gap > 1).all() for gap in gaps)

    @property
    def room(self) -> Any:
        """The distance between two stops, known if the gaps are; `None` with fewer stops."""
        if len(self.stops) < 2:
            return None
        gaps: list[Any] = [concrete(stop.gap) for stop in self.stops]
        one, other = [stop.gap for stop in self.stops] if any(x is None for x in gaps) else gaps
        return one + other

    sketched_at: ClassVar[float] = 0.3 * pi

    def sketch(self, pen: Any, state: State, phase: float) -> None:
        crank = self.crank
        size = pen.size = max(0.8, 0.25 * pen.reach)  # the crank has radius 1
        rod = 1 / float(crank.ratio) if isinstance(crank, SliderCrank) else 3.0
        pin = cos(phase), sin(phase)
        slider = rod + float(crank.slide(jnp.asarray(phase)).U)
        spring = pen.reach + 1.0 + size + 0.5  # never shorter than half a crank in this motion
        rest = rod + spring
        body = rest + float(state.Y)
        ends = rest + pen.reach + 2.0 * size
        floor = -0.5 * size
        pen.floor(rod - 1.5, ends, floor)
        self._sketch_crank(pen, pin, slider)
        pen.body(slider, width=0.55, height=0.7, color=pen.red)
        pen.spring((slider + 0.28, 0.0), (body - size / 2, 0.0))
        pen.body(body, width=size, height=size)
        if float(self.damping_ratio) > 0:
            post, low = rest - pen.reach - 0.9 * size, floor - 0.55 * size
            pen.line((body, floor), (body, low), lw=1.3)
            pen.damper((post, low), (body, low))
            pen.wall(post, -1, low=low - 0.35 * size, high=low + 0.35 * size, color="0.5")
            pen.label((post + body) / 2, low - 0.42 * size, "$c$")
        for stop in (*self.stops, *self.soft_stops):
            back = pen.stop(stop, rest=rest, slot=0.34 * size)  # the spring passes through it
            words = "soft stop" if stop in self.soft_stops else "stop, $k$"
            if stop.sign > 0 or stop in self.soft_stops:
                pen.label(back + stop.sign * 0.3 * size, 0.8 * size + 0.25, words, color=pen.green)
        pen.label(slider, -0.7, "$m_B$", color=pen.red)
        pen.label(body, 0.0, "$m_C$", color=pen.blue)
        pen.label(slider + 0.9, 0.2 * size + 0.3, "$k_0$")
        top = 0.5 * size + 0.45
        pen.mark(rest, 0.5 * size, top + 0.6)
        if float(state.Y):
            pen.mark(body, 0.5 * size, top + 0.1)
            pen.length(rest, body, top, "$Y$", down=0.22)
        for stop in self.stops:
            place = rest + float(stop.place)
            if stop.sign > 0:
                pen.mark(place, 0.5 * size, top + 0.6)
                pen.length(rest, place, top + 0.5, "$d$", down=0.22)

    def _sketch_crank(self, pen: Any, pin: tuple[float, float], slider: float) -> None:
        pen.disc(0.0, 0.0, 1.0)
        pen.line((0.0, 0.0), pin)
        pen.line(pin, (slider, 0.0), lw=2.6)
        pen.pin(*pin)
        pen.pin(slider, 0.0)
        if not pen.labels:
            return
        angle = np.linspace(0, np.arctan2(pin[1], pin[0]), 40)
        pen.line((0.0, 0.0), (1.35, 0.0), color="0.5", lw=0.8, ls=":")
        pen.line(*zip(0.45 * np.cos(angle), 0.45 * np.sin(angle), strict=True), lw=1.0)
        pen.label(0.62, 0.2, "$\\varphi$")
        pen.label(pin[0] / 2 - 0.18, pin[1] / 2 + 0.12, "$a$")
        pen.label((pin[0] + slider) / 2, pin[1] / 2 + 0.28, "$l$")
        pen.arrow((-0.15, 1.2), (-0.95, 0.75), bend=0.3)
        pen.label(0.1, 1.45, self.drive.caption)


# A length of this many crank radii is probably not in metres: a choice. Table 1's gap is 2 radii,
# and would be 2,000 in millimetres.
_LONG = 1000.0

# A plain number, or an array of them to `vmap` over.
_Plain = Float[Array, "..."] | float


def _clock_in_words(scene: Scene, since_section: float, cycles: int) -> str:
    angle = float(scene.phase_at(since_section))
    return f"{clock_word(scene)} {angle:.6g} of {cycles_in_words(scene, cycles)}"


def _scales_known(scene: Scene) -> bool:
    return not scene.soft_stops and jax.eval_shape(scene.drive.rate) is not None


# The defaults for other machines are in `machine.clocks`.
in_clock.register(Scene, Scene.in_clock)
in_cycle_clock.register(Scene, lambda scene: scene.in_clock("phase"))
at_section.register(Scene, Scene.at_section)
observed_later.register(Scene, Scene.observed_later)
phase_at.register(Scene, Scene.phase_at)
convert_start.register(Scene, Scene.convert_start)
in_cycle_state.register(Scene, Scene.in_cycle_state)
cycle_time.register(Scene, lambda scene: scene.period)
logged_turn.register(Scene, lambda scene: 2 * pi)
as_logged.register(Scene, Scene.as_logged)
frequency_ratio.register(Scene, Scene.frequency_ratio)
cycles_in_words.register(Scene, lambda scene, cycles: f"{2 * cycles}π")
clock_word.register(Scene, lambda scene: "crank angle φ =")
clock_in_words.register(Scene, _clock_in_words)
scales_known.register(Scene, _scales_known)
is_alive.register(Scene, Scene.alive)
may_rest.register(Scene, Scene.may_rest)


def _si(name: str, unit: str, default: float | None, allowed: Range = REAL) -> Any:
    """Return a field for a number in this unit."""
    convert = real(name) if default is not None else optional_real(name)
    about = {"unit": unit, "range": allowed}
    return eqx.field(default=default, converter=convert, kw_only=True, metadata=about)


class Parameters(Shown):
    """The machine in SI units; the defaults are Table 1 of the paper (T0 = 10 N·m, κ = 0.9).

    The dimensionless groups, with ω = √(k0/m_C), are ξ = c/(2 m_C ω), d = Δ/a, μ = m_B a²/J,
    ε = m_C a²/J, for the motor τ0 = T0/(J ω²), w0 = Ω0/ω, and for the crank λ = a/l. A DC motor
    with constants K_t, K_e, resistance R and voltage u has κT0 = K_t u/R, κΩ0 = u/K_e.
    """

    body_mass: _Plain = _si("body_mass", "kg", 0.35, POSITIVE)
    """m_C, mass of the impacting body, kg."""
    slider_mass: _Plain = _si("slider_mass", "kg", 0.2, NOT_NEGATIVE)
    """m_B, mass of the slider, kg."""
    stiffness: _Plain = _si("stiffness", "N/m", 9 * pi**2, POSITIVE)
    """k0, stiffness of the spring, N/m."""
    damping: _Plain = _si("damping", "N*s/m", 0.5, NOT_NEGATIVE)
    """c, viscous damping of the body, N·s/m."""
    crank_radius: _Plain = _si("crank_radius", "m", 0.04, POSITIVE)
    """a, crank radius and unit of length, m."""
    rod_length: _Plain = _si("rod_length", "m", 0.12, POSITIVE)
    """l, length of the rod, m (exact kinematics only)."""
    inertia: _Plain = _si("inertia", "kg*m**2", 0.06, POSITIVE)
    """J, moment of inertia of the disc, kg·m²."""
    restitution: _Plain = _si("restitution", "", 0.5, SHARE)
    """k, coefficient of restitution, dimensionless."""
    gap: _Plain = _si("gap", "m", 0.08)
    """Δ, distance of the stop from the unstretched position, m."""
    torque: _Plain = _si("torque", "N*m", 10.0, NOT_NEGATIVE)
    """T0, stall torque of the motor at κ = 1, N·m."""
    control: _Plain = _si("control", "", 0.9)
    """κ, motor control, dimensionless; the frequency ratio ζ of an ideal drive."""
    no_load_speed: _Plain | None = _si("no_load_speed", "rad/s", None, POSITIVE)
    """Ω0, no-load speed of the motor at κ = 1, rad/s. `None` means ω, for which the tabulated κ =
    0.5…1.9 are the tabulated range of ζ; the paper does not give Ω0."""

    def __check_init__(self):
        require_ranges(self)
        for name in ("gap", "rod_length"):
            self._warn_if_long(name)

    def _warn_if_long(self, name: str) -> None:
        """Warn of lengths in millimetres: they are in range, but no stop is ever met."""
        length, radius = concrete(getattr(self, name)), concrete(self.crank_radius)
        if length is None or radius is None:
            return
        lengths, radii = np.broadcast_arrays(length, radius)
        long = abs(lengths) >= _LONG * radii
        if long.any():
            length, radius = lengths[long][0], radii[long][0]
            warn(
                f"Argument `{name}` is {length:g} m, {length / radius:.0f} times the crank radius "
                f"of {radius:g} m: lengths are in metres."
            )

    @property
    def units(self) -> dict[str, str]:
        written = ((f.name, f.metadata["unit"]) for f in dataclasses.fields(self))
        return {name: unit.replace("**2", "²").replace("*", "·") for name, unit in written}

    @property
    def natural_frequency(self) -> _Plain:
        """The natural frequency of the body on its spring, ω = √(k0/m_C), in rad/s."""
        return (self.stiffness / self.body_mass) ** 0.5

    def scene(self, *, drive: str = "motor", crank: str = "cosine") -> Scene:
        """Return the dimensionless scene. **Arguments:** `drive`, `"motor"` or `"ideal"` (with
        ζ = κ); `crank` is `"cosine"` (first approximation) or `"slider"` (exact kinematics)."""
        one_of("drive", drive, ("motor", "ideal"))
        one_of("crank", crank, ("cosine", "slider"))
        require_ranges(self)  # again: a number may have been replaced
        if known(self) and isinstance(self.stiffness, jax.Array):
            return on_host(self).scene(drive=drive, crank=crank)
        omega = self.natural_frequency
        if drive == "ideal":
            scene_drive: IdealDrive | Motor = IdealDrive(self.control)
        else:
            per_inertia = self.crank_radius**2 / self.inertia
            no_load = 1.0 if self.no_load_speed is None else self.no_load_speed / omega
            scene_drive = Motor(
                strength=self.torque / (self.inertia * omega**2),
                control=self.control,
                coupling=self.body_mass * per_inertia,
                slider_inertia=self.slider_mass * per_inertia,
                no_load_speed=no_load,
            )
        damping = self.damping / (2 * self.body_mass * omega)
        if is_traced(self):
            # Some parameters out of range give a scene with parameters in range.
            damping = jnp.where(in_range(self), damping, jnp.nan)
        exact = SliderCrank(self.crank_radius / self.rod_length) if crank == "slider" else None
        return Scene(
            damping_ratio=damping,
            drive=scene_drive,
            stops=(RigidStop(_ratio(self.gap, self.crank_radius), self.restitution),),
            crank=exact or CosineCrank(),
        )

    def metres(self, Y: Any) -> Any:
        """Return a dimensionless position Y in m."""
        return self.crank_radius * Y

    def metres_per_second(self, V: Any) -> Any:
        """Return a dimensionless velocity V = dY/dτ in m/s."""
        return self.crank_radius * self.natural_frequency * V

    def radians_per_second(self, W: Any) -> Any:
        """Return a dimensionless crank speed W (or a frequency ratio ζ) in rad/s."""
        return self.natural_frequency * W

    def seconds(self, tau: Any) -> Any:
        """Return a dimensionless time τ in s."""
        return tau / self.natural_frequency


def _ratio(a: Any, b: Any) -> Any:
    """Return a / b as a known number if both are, inside of `jit` too."""
    numerator, denominator = concrete(a), concrete(b)
    return a / b if numerator is None or denominator is None else numerator / denominator
