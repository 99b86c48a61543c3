"""The scene of the paper: oscillator, crank, drive and stops, in the phase or the time clock."""

import dataclasses
from collections.abc import Iterable
from math import pi
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    concrete,
    instance_of,
    number,
    optional_real,
    real,
    require,
    require_ranges,
    tuple_of,
)
from .._types import Number, Scalar, State
from ._drawn import draw_scene
from .drives import UNITS, AbstractCrank, AbstractDrive, CosineCrank, IdealDrive, Motor, SliderCrank
from .own import changed
from .shaft import ShaftMachine
from .shown import Shown
from .soft import SoftStop
from .stop import RigidStop


class Oscillator(Shown):
    """The body C on its spring, in units of its natural frequency."""

    damping_ratio: Float[Array, "..."] = eqx.field(default=0.0, converter=real("damping_ratio"))
    """ξ = c/(2 m_C ω) (dimensionless), not negative."""
    ranges: ClassVar = {"damping_ratio": NOT_NEGATIVE}

    def __check_init__(self):
        require_ranges(self)


class Scene(ShaftMachine):
    """A body on a spring, shaken by a crank, with stops: Y'' + 2ξY' + Y = U(φ).

    Every number is a leaf, so that it can be a `vmap` axis or be differentiated. Absent parts (a
    stop, the drive's equation, a clock component) are left out of the compiled program.

    The clock is `"phase"` (crank angle as the independent variable: the drive cycle is exactly 2π
    long, and the crank must keep turning forward) or `"time"` (any motion, also a start from rest).
    For an ideal drive both agree up to the factor ζ.
    """

    oscillator: Oscillator
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
    """Compliant stops; their stiffness in units of the body's own spring."""
    ranges: ClassVar = {"section_phase": Range(-2 * pi, 2 * pi), "room": POSITIVE}
    units: ClassVar = UNITS  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]

    def __check_init__(self):
        instance_of("oscillator", self.oscillator, Oscillator, "an `Oscillator`")
        instance_of("crank", self.crank, AbstractCrank, "a `CosineCrank()` or another crank")
        instance_of("drive", self.drive, AbstractDrive, "an `IdealDrive` or a `Motor`")
        self.drive.check()
        for stop in self.stops:
            if not isinstance(stop, RigidStop):
                raise TypeError(f"Argument `stops` must hold `RigidStop`s, but holds {stop!r}.")
        for stop in self.soft_stops:
            if not isinstance(stop, SoftStop):
                raise TypeError(f"Argument `soft_stops` must hold `SoftStop`s, but holds {stop!r}.")
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
        """An ideally driven scene with one stop on the right.

        **Arguments:** ζ, k, d (unit: a) and ξ, scalars or arrays of one shape to `vmap` over;
        `crank` defaults to `CosineCrank()`. `gap=None` leaves the stop out.

        **Raises:** `ValueError` naming the argument that is out of range.
        """
        stops = () if gap is None else (RigidStop(gap, restitution),)
        return cls(
            oscillator=Oscillator(damping_ratio),
            drive=IdealDrive(frequency_ratio),
            stops=stops,
            crank=CosineCrank() if crank is None else crank,
        )

    @property
    def damping_ratio(self) -> Float[Array, "..."]:
        """ξ, the damping ratio of the body on its spring (dimensionless)."""
        return self.oscillator.damping_ratio

    @property
    def cycle(self) -> Scalar | float:
        """2π of crank angle; in the time clock of an ideal drive 2π/ζ of time τ."""
        return self.period if self.clock_name == "time" else 2 * pi

    @property
    def period(self) -> Scalar | float:
        """2π/ζ of time τ for an ideal drive; of another a turn of the crank."""
        duration = self.drive.duration()
        return 2 * pi if duration is None else duration

    @property
    def labels(self) -> tuple[str, str]:
        """Position and velocity in the paper's units, the crank radius a and the frequency ω."""
        return "Y = y/a", "V = dY/dτ"

    def at_section(self, phase: Number) -> "Scene":
        """The same scene, observed where the crank angle is `phase` (radians) instead of 0."""
        return dataclasses.replace(self, section_phase=phase)

    def observed_later(self, since_section: Number) -> "Scene":
        """Observed so much crank angle (radians) after its own section."""
        angle = self.phase_at(since_section)
        return self.at_section(jnp.where(angle > 2 * pi, angle - 2 * pi, angle))

    def phase_at(self, since_section: Number) -> Any:
        """Crank angle from the one counted since the section."""
        return since_section if self.section_phase is None else since_section + self.section_phase

    def start(
        self,
        *,
        Y: Number = 0.0,
        V: Number = 0.0,
        W: Number | None = None,
        M: Number | None = None,
        **others,
    ) -> State:
        """A state on the section.

        `W` belongs to motor scenes and defaults to the motor's no-load speed κ w0. `M` defaults to
        the steady torque at that speed; a motor that is being switched on has `W=0, M=0`.

        **Arguments:** position `Y` (unit: a), velocity `V` (a ω), crank speed `W` (ω) and the
        torque `M` of a `DCMotor` (J ω²); `others` are further components of your own drive.

        **Raises:** `ValueError` if a number is not finite, or is given to a drive that has none.
        """
        Y, V = number("Y", Y), number("V", V)
        require("Y", Y)
        require("V", V)
        own = self.drive.begin(M=M, W=W, **others)
        return self.adopt(self.state_type(Y, V, *own.values()))

    @property
    def state_type(self) -> type:
        """The class of a state in the phase clock."""
        return self.drive.state

    @property
    def timed_states(self) -> dict[type, type]:
        """For the drive's class of states, that of its states by time; empty where both are the
        same."""
        timed = self.drive.timed_state
        return {} if timed is None else {self.drive.state: timed}

    @property
    def _stops(self) -> tuple[RigidStop, ...]:
        return self.stops

    @property
    def _switches(self) -> tuple[SoftStop, ...]:
        return self.soft_stops

    def field(self, s: Scalar, state: State, *modes: Scalar) -> State:
        """d(state)/ds: by crank angle (Eq. 8 to 9 of the paper) or by time τ (Eq. 5 to 7)."""
        return self.drive.field(self, s, state, self._pushes(s, state, modes))

    def pull(self, stretch: Any, speed: Number, pushes: Iterable[Any]) -> Any:
        """d²Y/dτ² from U - Y, V and what compliant stops add; from all three divided by W,
        dV/dφ."""
        pull = stretch - 2 * self.damping_ratio * speed
        for push in pushes:
            pull = pull + push
        return pull

    def _pushes(self, s, state, modes):
        """What each compliant stop adds to d²Y/dτ²."""
        for stop, mode in zip(self.soft_stops, modes, strict=True):
            yield stop.contribution(self, s, state, mode)

    def as_logged(self, clock: Float[Array, "..."]) -> Float[Array, "..."]:
        """The crank angle since the section, where time counts the cycles of an ideal drive."""
        speed = self.drive.fixed_speed
        return clock if speed is None or self.clock_name == "phase" else speed * clock

    def pace(self, s: Scalar, state: State) -> Scalar | None:
        """dτ/dφ = 1/W in the phase clock of a motor."""
        return 1 / state.W if self.is_paced(state) else None

    def frequency_ratio(self, duration: Float[Array, "..."]) -> Float[Array, "..."]:
        """ζ: mean crank speed over cycles of these durations (unit: ω)."""
        speed = self.drive.fixed_speed
        if speed is None:
            return 2 * pi / duration
        return jnp.broadcast_to(speed, duration.shape)

    def step_limit(self, s: Scalar, state: State) -> Scalar:
        """A fifth of the shorter of the drive's turn and the body's natural period."""
        speed = self.drive.speed(state)
        turn = 0.4 * pi / jnp.maximum(1.0, speed)
        for stop in self.soft_stops:
            turn = jnp.minimum(turn, stop.longest_step(self, s, state))
        return turn * speed if self.clock_name == "phase" else turn

    @property
    def scales_known(self) -> bool:
        """Not with soft stops, whose contacts may be much briefer than a cycle."""
        return not self.soft_stops

    def relaxation(self, s: Scalar, state: State) -> Scalar:
        """1/2ξ of a strongly damped body, or what the drive says: the time w0/τ0 in which a motor
        is back at speed, or in which the current of a `DCMotor` settles."""
        rate, of_drive = 2 * self.damping_ratio, self.drive.rate()
        if of_drive is not None:
            rate = jnp.maximum(rate, of_drive)
        pace = self.drive.speed(state) if self.clock_name == "phase" else 1.0
        return pace / jnp.maximum(rate, 1e-6)

    def mirrored(self, state: State) -> State | None:
        """Y → -Y half a turn later, if both sides have the same stops and the crank is odd."""
        for stops in (self.stops, self.soft_stops):
            if not all(any(stop.mirrors(other) for other in stops) for stop in stops):
                return None
        if not self.crank.is_odd:
            return None
        return dataclasses.replace(state, Y=-state.Y, V=-state.V)

    def may_rest(self) -> bool:
        """Not if all gaps are known and beyond the crank's reach, so that nothing presses on."""
        if not self._is_within_reach() or any(map(self._may_be_pressed, self.stops)):
            return True
        gaps = [concrete(stop.gap) for stop in self.stops]
        return any(gap is None or not (gap > 1).all() for gap in gaps)

    def _is_within_reach(self) -> bool:
        """Whether the equations are the library's, whose slider stays within |U| ≤ 1 and alone
        pulls at the body."""
        return (
            type(self.crank).slide in (CosineCrank.slide, SliderCrank.slide)
            and type(self.drive).field in (IdealDrive.field, Motor.field)
            and changed(self, Scene, ("field", "pull", "_pushes", "_switches")) is None
        )

    def _may_be_pressed(self, stop: RigidStop) -> bool:
        """Whether a compliant stop may press the body on a rigid one."""
        for soft in self.soft_stops:
            depth = concrete(soft.beyond(stop.place))
            apart = depth is not None and bool((depth <= 0).all())
            if changed(soft, SoftStop, ("force", "contribution")) or not (
                apart or soft.side == stop.side
            ):
                return True
        return False

    @property
    def room(self) -> Any:
        """Distance between two stops, of known gaps a known one; `None` with fewer."""
        if len(self.stops) < 2:
            return None
        gaps: list[Any] = [concrete(stop.gap) for stop in self.stops]
        one, other = [stop.gap for stop in self.stops] if any(x is None for x in gaps) else gaps
        return one + other

    def sketch(self, pen: Any, state: State, phase: float) -> None:
        """See `plot_sketch`."""
        draw_scene(self, pen, state, phase)
