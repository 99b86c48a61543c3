"""The plan of a simulation, the same for all lanes."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, UInt32

from .._types import Flag, Scalar, Scalars, State
from ..machine import (
    AbstractMachine,
    at_stop,
    clock_of,
    events_of,
    events_of_steps,
    is_autonomous,
    is_compound,
    limited_in,
    mode_number,
    others_of,
    own_modes,
    stops_of,
    switches_of,
    with_modes,
)
from .lane import Lane, Record
from .methods import AbstractMethod
from .sizes import rounding_bounds, unit_of
from .smooth import TIME


def s_counts_cycles(machine: AbstractMachine, state: State) -> bool:
    """Return whether the independent variable itself counts the cycles."""
    return clock_of(machine, state) is None and not is_autonomous(machine, state)


def has_fixed_cycle(machine: AbstractMachine, state: State) -> bool:
    """Return whether all cycles have the same duration (`cycle_time`)."""
    return (
        s_counts_cycles(machine, state)
        and machine.pace(jnp.zeros_like(machine.position(state)), state) is None
    )


class Impulses(eqx.Module):
    """White noise in the form that the loop uses: impulses on velocities at instants of a cycle."""

    key: UInt32[Array, "2"]
    scales: tuple[Array | None, ...]
    """For each array of the state, the standard deviation of one impulse; `None`: no noise."""
    count: int = eqx.field(static=True)
    """Impulses in a cycle; a multiple of the record points."""
    functions: tuple[Callable | None, ...] = eqx.field(static=True)
    """For each array of the state, a function of the state that scales its impulses, or `None`."""
    measures_time: bool = eqx.field(static=True)
    """True if the loop measures the time between impulses; `scales` are then per unit of time."""
    modes: tuple[Array | None, ...] = ()
    """For each array of the state, the matrix that transforms its impulse to natural modes, if the
    loop carries these instead."""


class Plan(eqx.Module):
    """The plan of a simulation, the same for all lanes. Static fields are compile-time
    constants."""

    machine: AbstractMachine
    method: AbstractMethod
    cycles: Any
    """Cycles to record: an integer outside of the loop, a number within."""
    parts: int = eqx.field(static=True)
    """Record points per cycle."""
    records_motion: bool = eqx.field(static=True)
    """True if extremes, durations and impact speeds are recorded."""
    log: int = eqx.field(static=True)
    events: int = eqx.field(static=True)
    """Events of all kinds to log in each cycle."""
    averages: tuple[str, ...] = eqx.field(static=True)
    """Names of the machine's averages, if motion is recorded."""
    rests: bool = eqx.field(static=True)
    """True if a body may come to rest on a stop."""
    backend: str = eqx.field(static=True)
    """The compiler of the loop (see `lanes.backend`)."""
    # These are arguments of the compiled program, so that other values do not compile again.
    settle: Scalar
    """Cycles before the first one recorded."""
    max_steps: Scalar
    max_impacts: Scalar
    noise: Impulses | None = None
    """Impulses of white noise; `None` leaves noise out of the program."""
    begin: Scalar | None = None
    """Clock of the start, if it is not on the section."""
    until: Scalar | None = None
    """Clock at which the only cycle ends, if it is not the end of the machine's cycle."""
    start_modes: Scalars | None = None
    """The machine's own modes at the start, if the start contains them."""
    first_modes: Scalars | None = None
    """All modes at the start (see `sizes.sizes_at_start`); `None` if they are not known yet."""
    stop: Any = None
    """A condition that ends a lane early (see `RunOptions`); the rest of its record is NaN."""
    constant_records: bool = eqx.field(static=True, default=False)
    """True if only the states have derivatives, and the records have none."""
    history: Any = None
    """The history of a machine with delays at the start, and in `memory` its constants."""
    memory: Any = None

    sizes: State | None = None
    """The size of each number of the state (see `sizes.sizes_of` and `limited_size`)."""
    extents: tuple[Any, ...] | None = None
    """The `limited_size` of each coordinate, then that of the guard of each of `others`; `None` for
    a machine whose numbers are about 1. An event that holds a mode has a pair of sizes, out of
    mode 0 and in it, since its guard is another quantity there."""

    def jump_at_start(self, s: Scalar) -> tuple[Flag, Scalar]:
        """Return whether the field may jump where a step begins, at an image of a jump or where the
        clock of a cycle begins anew; and the derivative of that instant, in a number of value 0.
        """
        # Each release of a body takes a few roundings of the clock.
        begins = stop_gradient(s) <= self.in_units(1024 * float(jnp.finfo(s.dtype).eps))
        jump = getattr(getattr(self.machine, "_past", None), "jump", None)
        return (begins, jnp.zeros_like(s)) if jump is None else (begins | jump[0], jump[1])

    def extent(self, k: int) -> Scalar | float:
        """Return the length scale of coordinate number k."""
        return 1.0 if self.extents is None else self.extents[k]

    def guard_extent(self, number: int, lane: "Lane") -> Scalar | float:
        """Return the size of the guard of an event other than a stop, in the modes of the lane."""
        if self.extents is None:
            return 1.0
        extent = self.extents[len(self.machine.coordinates) + self.others(lane.state).index(number)]
        if not events_of(self.machine)[number].holds_mode:
            return extent
        in_mode_zero = lane.modes[mode_number(self.machine, number)] == 0
        return jnp.where(in_mode_zero, extent[1], extent[0])

    def slip_rounding(self, switch: int, lane: "Lane") -> Scalar | float:
        """Return a bound of the rounding error of a slip; `switch` is the friction's index."""
        rounding = 256 * float(jnp.finfo(lane.s.dtype).eps)
        if self.extents is None:
            return rounding
        number = len(stops_of(self.machine)) + switch
        place = len(self.machine.coordinates) + self.others(lane.state).index(number)
        return rounding * self.extents[place][0]

    def rounding_bounds(self, k: int, state: State) -> tuple[Scalar | float, Scalar | float]:
        """Return bounds of the rounding errors of position and velocity of coordinate number k."""
        return rounding_bounds(self.machine, k, state, self.extent(k), self.unit)

    def beyond_a_stop(self, state: State, before: State | None = None) -> Flag:
        """Return whether a coordinate is beyond one of its stops by more than rounding, and further
        than `before`."""
        beyond = jnp.zeros((), bool)
        for stop in stops_of(self.machine):
            position = self.machine.coordinates[stop.coordinate].position(state)
            slack, _ = self.rounding_bounds(stop.coordinate, state)
            if before is not None:
                old = self.machine.coordinates[stop.coordinate].position(before)
                slack = slack + jnp.maximum(stop_gradient(stop.beyond(old)), 0.0)
            beyond = beyond | (stop_gradient(stop.beyond(position)) > slack)
        return beyond

    @property
    def recorded_intervals(self) -> Any:
        """The number of intervals that are recorded, without those of `settle`."""
        return self.cycles * self.parts

    @property
    def intervals(self) -> Scalar:
        """Number of simulated intervals: one for each cycle of `settle`, then the recorded ones."""
        return self.settle + self.recorded_intervals

    @property
    def instants(self) -> int:
        """Number of instants in a cycle at which steps end: record points or impulses of noise."""
        return self.parts if self.noise is None else self.noise.count

    @property
    def unit(self) -> Scalar | float:
        """The unit of `s` for the thresholds of the machine (see `unit_of`)."""
        return unit_of(self.machine)

    def in_units(self, threshold: Any) -> Any:
        """Return a threshold in `s`, given for a cycle of about 2π, in the unit of `s`."""
        unit = self.unit
        return threshold if isinstance(unit, float) and unit == 1.0 else threshold * unit

    def cycle_of(self, done: Scalar) -> Scalar:
        """Return the number of the current cycle, from the start, after `done` intervals."""
        recorded = jnp.floor((done - self.settle) / self.parts)
        return jnp.where(done < self.settle, done, self.settle + recorded)

    def is_record_point(self, part: Scalar, done: Scalar) -> Flag:
        """Return whether the `part`-th piece between two impulses completes an interval."""
        passed, every = part + 1, self.instants // self.parts
        # A product of integers is exact, a quotient may be rounded.
        is_multiple = passed == every * jnp.round(passed / every)
        return (passed >= self.instants) | (done >= self.settle) & is_multiple

    def others(self, state: State) -> list[int]:
        """Return the numbers of the events, other than stops, whose guards each step checks."""
        return events_of_steps(self.machine, state)

    def from_below(self, state: State) -> list[int]:
        """Return those of `others` that happen only from below (see `AbstractEvent.from_below`)."""
        events = events_of(self.machine)
        return [number for number in self.others(state) if events[number].from_below]

    def end(self, part: Scalar) -> Scalar:
        """Return the clock at the end of the `part`-th piece of a cycle: an interval, or the time
        from one impulse of noise to the next."""
        cycle = jnp.asarray(self.machine.cycle if self.until is None else self.until, part.dtype)
        return cycle * (part + 1) / self.instants if self.instants > 1 else cycle

    def first_part(self, done: Scalar) -> Scalar:
        """Return `Lane.part` at the start of a cycle, after `done` intervals. Without noise, a
        cycle that is not recorded is a single interval, the last of the cycle; else this is 0."""
        if self.noise is not None:
            return jnp.zeros_like(done)
        return jnp.where(done < self.settle, self.parts - 1.0, jnp.zeros_like(done))

    def s_counts_cycles(self, state: State) -> bool:
        return s_counts_cycles(self.machine, state)

    def clock(self, s: Scalar, state: State) -> Scalar:
        """Return the variable that counts the cycles: `s` or the machine's clock."""
        clock = clock_of(self.machine, state)
        return s if clock is None else clock

    def integrates_time(self, state: State) -> bool:
        """Return whether the loop integrates time: cycles without a fixed duration are recorded, or
        the time between impulses is measured."""
        if self.noise is not None and self.noise.measures_time:
            return True
        return self.records_motion and not has_fixed_cycle(self.machine, state)

    @property
    def meets_every_turn(self) -> bool:
        """True if steps end on every turning point, since switches and events may be there."""
        return bool(switches_of(self.machine) or others_of(self.machine))

    def meets_turns(self, done: Scalar) -> Flag:
        """Return whether steps end on every turning point, after `done` intervals, as extremes
        require; else only on those close to a stop."""
        if self.records_motion and not self.meets_every_turn:
            return done >= self.settle
        return jnp.full_like(done, self.meets_every_turn, bool)

    def recorded_state(self, state: State, modes: Scalars) -> State:
        """Return the recorded state of a record point: the state with the machine's own modes."""
        return with_modes(state, own_modes(self.machine, modes))

    def empty_record(self, state: State) -> Record:
        Y = self.machine.position(state)
        zero = jnp.zeros_like(Y)
        names = (TIME, *self.averages) if self.integrates_time(state) else self.averages
        return Record(
            integrals=dict.fromkeys(names, zero),
            y_max=Y if self.records_motion else None,
            y_min=Y if self.records_motion else None,
            impacts=zero,
            impact_speed=zero if self.records_motion else None,
            impact_energy=zero if self.records_motion else None,
            rests=zero if self.records_motion and self.rests else None,
            reduced=zero if self.records_motion and is_compound(self.machine) else None,
            log=jnp.full((5, self.log), jnp.nan, Y.dtype) if self.log else None,
            clearance=(jnp.full_like(Y, jnp.inf),) * max(1, len(limited_in(self.machine)))
            if self.records_motion and self.log
            else None,
            events=jnp.full((4, self.events), jnp.nan, Y.dtype) if self.events else None,
        )

    def away(self, k: int, contact: Scalar) -> Scalar:
        """Return the sign of the direction away from the stop of coordinate number k, or 0."""
        zero = jnp.zeros_like(contact)
        return at_stop(self.machine, k, contact, lambda stop: -float(stop.sign), zero)

    def sign_and_gap(self, k: int, contact: Scalar) -> tuple[Scalar | float, Scalar]:
        """Return the sign (1 right, -1 left) and the gap of the stop in `contact` of coordinate
        number k; those of its first stop if `contact` names no other."""
        sign = at_stop(self.machine, k, contact, lambda stop: float(stop.sign))
        return sign, at_stop(self.machine, k, contact, lambda stop: stop.gap)
