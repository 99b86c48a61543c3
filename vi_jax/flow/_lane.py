"""What the flat loop carries: one trajectory on its way, and what is asked of it."""

import functools
import operator
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Float, UInt32

from .._types import Flag, Scalar, Scalars, State
from ..machine import (
    AbstractMachine,
    RigidStop,
    clock_of,
    events_of,
    is_autonomous,
    mode_number,
    others_of,
    own_modes,
    section_in,
    section_number,
    stops_of,
    switches_of,
    with_modes,
)
from .methods import AbstractMethod
from .results import EventKind, code
from .smooth import TIME, Integrals, rounding, unit_of

# What the next step aims at: nothing, or one of those below. Numbers, which the loop carries.
FREE = 0.0


def to_event(number: int) -> float:
    """The target of a step that is aimed at the event of this number (see `events_of`), positive;
    `Lane.contact` names stops by the same numbers. All other targets are negative."""
    return 1.0 + number


def to_turn_of(k: int) -> float:
    """The target of a step that is aimed at a turning point of coordinate number k."""
    return -1.0 - 2 * k


def to_release(k: int) -> float:
    """The target of a step that is aimed at the release of coordinate number k from its stop."""
    return -2.0 - 2 * k


def total(tree: object, start: Scalar) -> Scalar:
    """Sum of all numbers in a tree and of `start`: finite if all of them are."""
    for leaf in jtu.tree_leaves(tree):
        start = start + jnp.sum(leaf)
    return start


def any_of(like: Flag, flags: Iterable[Flag]) -> Flag:
    """Whether any of these flags holds, of the shape of `like`."""
    return functools.reduce(operator.or_, flags, jnp.zeros_like(like))


def select(condition: Flag, a: object, b: object) -> Any:
    """`jnp.where` for pytrees; what is the same in both is left as it is."""
    return jtu.tree_map(lambda x, y: x if x is y else jnp.where(condition, x, y), a, b)


def in_place(values: tuple, k: int, value: object) -> tuple:
    """The values with another one in place number k."""
    return (*values[:k], value, *values[k + 1 :])


class Record(NamedTuple):
    """What is kept of an interval between two record points; `None` where it was not asked for."""

    integrals: Integrals
    y_max: Scalar | None
    y_min: Scalar | None
    impacts: Scalar
    impact_speed: Scalar | None
    impact_energy: Scalar | None
    rests: Scalar | None
    """Times the body came to rest on a stop."""
    log: Float[Array, "3 size"] | None
    """Clock, V⁻ and stop of each impact, NaN where there was none."""
    clearance: Scalar | None
    events: Float[Array, "4 listed"] | None
    """Clock, kind, number and value of each event, NaN where there was none."""


class Lane(NamedTuple):
    """One trajectory on its way. All floats: other types would keep the loop from fusing. A step
    makes another lane of it, and so does each event that is met there."""

    s: Scalar
    state: State
    record: Record
    direction: Scalars
    """Of each coordinate, the sign of its velocity since the last turn or impact."""
    contact: Scalars | None
    """Of each coordinate, 1 + i while it rests on stop number i, else 0; absent where none can."""
    modes: Scalars
    """Of each switch, then the machine's own."""
    below: Scalars
    """Of each event that happens from below (see `AbstractEvent.from_below`), 1 once its guard has
    been below zero since the last jump, else 0; and -1 till then from where the motion begins."""
    length: Scalar
    """Length proposed for an ordinary step."""
    attempt: Scalar
    """Length of the next step."""
    target: Scalar
    """What the next step aims at."""
    aims: Scalar
    """Times aimed since the last step taken."""
    part: Scalar
    """Index of the interval within its cycle."""
    done: Scalar
    """Number of completed intervals."""
    fault: Scalar
    """Reason why the lane ended before its time (see `results`), or 0."""
    steps: Scalar
    spent: Scalar
    """Steps tried in the interval on its way."""
    rejected: Scalar
    last_impulse: Scalar | None = None
    """The time of the interval at the last impulse of noise; absent where impulses come at times
    that are known beforehand."""
    completed: Flag | None = None
    """Whether the interval is complete, while the events of a step are applied; absent between
    steps."""

    def ended(self, where: Flag, when: Flag | None, reason: str | float) -> "Lane":
        """The lane with a reason to end, the name of one of `RESULTS` or its number, if the event
        was met (`where`) and ends the lane (`when`, `None` if it never can)."""
        if when is None:
            return self
        number = code(reason) if isinstance(reason, str) else reason
        return self._replace(fault=jnp.where(where & when, number, self.fault))

    def completing(self, when: Flag) -> "Lane":
        """The lane with its interval complete where `when` holds."""
        assert self.completed is not None
        return self._replace(completed=self.completed | when)

    def recording(self, **changes: Any) -> "Lane":
        """The lane with other fields of its record."""
        return self._replace(record=self.record._replace(**changes))

    def noting(
        self, when: Flag, clock: Scalar, kind: EventKind | Scalar, number: Any, value: Any
    ) -> "Lane":
        """The lane with an event in the log of all events, if it happened (`when`) and there is
        room; `kind`, `number` and `value` as in `EventLog`."""
        events = self.record.events
        if events is None:
            return self
        place = jnp.sum(jnp.where(jnp.isnan(events[1]), 0.0, 1.0))
        return self.recording(events=written(events, when, place, clock, kind, number, value))


def written(log: Array, when: Flag, place: Scalar, *entry: Any) -> Array:
    """A log with an entry at this place, if it has one."""
    here = when & (jnp.arange(log.shape[1], dtype=log.dtype) == place)
    column = jnp.stack([jnp.asarray(x, log.dtype) for x in entry])
    return jnp.where(here, column[:, None], log)


def ticks(machine: AbstractMachine, state: State) -> bool:
    """Whether the independent variable itself counts the cycles."""
    return clock_of(machine, state) is None and not is_autonomous(machine, state)


def has_fixed_cycle(machine: AbstractMachine, state: State) -> bool:
    """Whether all cycles have the same duration (`cycle_time`)."""
    return (
        ticks(machine, state)
        and machine.pace(jnp.zeros_like(machine.position(state)), state) is None
    )


class Impulses(eqx.Module):
    """White noise as the loop needs it: impulses on velocities, at instants of each cycle."""

    key: UInt32[Array, "2"]
    scales: tuple[Array | None, ...]
    """Of each array of the state, the standard deviation of one impulse on it; `None`: none."""
    count: int = eqx.field(static=True)
    """Impulses in a cycle; a multiple of the record points."""
    functions: tuple[Callable | None, ...] = eqx.field(static=True)
    """Of each array of the state, a factor of its own as a function of the state; `None`: none."""
    timed: bool = eqx.field(static=True)
    """Whether the time between two impulses is measured on the way; then the scales are those of a
    unit of time."""
    modes: tuple[Array | None, ...] = ()
    """Of each array of the state, the matrix that makes of an impulse on it one on what the loop
    carries in its place, where that are natural modes."""


class Plan(eqx.Module):
    """What the loop is to do, the same for all lanes of a batch. All that is static is a part of
    the compiled program."""

    machine: AbstractMachine
    method: AbstractMethod
    cycles: int = eqx.field(static=True)
    """Cycles to record."""
    parts: int = eqx.field(static=True)
    """Record points per cycle."""
    motion: bool = eqx.field(static=True)
    """Whether extremes, durations and impact speeds are recorded."""
    log: int = eqx.field(static=True)
    events: int = eqx.field(static=True)
    """Events of all kinds to log in each cycle."""
    averages: tuple[str, ...] = eqx.field(static=True)
    """Names of the machine's averages, if motion is recorded."""
    rests: bool = eqx.field(static=True)
    """Whether the body may come to rest on a stop."""
    backend: str = eqx.field(static=True)
    """Which compiler runs it (see `lanes.backend`)."""
    # Numbers that are no part of the program, so that others are not another one.
    settle: Scalar
    """Cycles before the first one recorded."""
    max_steps: Scalar
    max_impacts: Scalar
    noise: Impulses | None = None
    """Impulses of white noise; without it the program has nothing of it."""
    begin: Scalar | None = None
    """Clock of the start, where that is not on the section."""
    until: Scalar | None = None
    """Clock at which the one cycle ends, where that is not the machine's own."""
    own: Scalars | None = None
    """The machine's own modes in the start, where it says them."""
    stop: Any = None
    """What ends a lane early (see `RunOptions`); what it would have recorded then is no number."""

    sizes: State | None = None
    """Of each number of the state how small it is (see `loop.sizes_of`)."""
    extents: tuple[Any, ...] | None = None
    """Of each coordinate, then of the guard of each of `others`, how small it is, if it is less
    than 1; else 1, and of a machine whose numbers are about 1 absent. Of an event that holds a
    mode a pair, out of mode 0 and in it, where its guard is another quantity."""

    def extent(self, k: int) -> Scalar | float:
        """A length by which those of coordinate number k are judged."""
        return 1.0 if self.extents is None else self.extents[k]

    def guard_extent(self, number: int, lane: "Lane") -> Scalar | float:
        """A size by which the guard of an event that is no stop is judged in the lane's modes."""
        if self.extents is None:
            return 1.0
        found = self.extents[len(self.machine.coordinates) + self.others(lane.state).index(number)]
        if not events_of(self.machine)[number].holds_mode:
            return found
        held = lane.modes[mode_number(self.machine, number)] == 0
        return jnp.where(held, found[1], found[0])

    def rounding(self, k: int, state: State) -> tuple[Scalar | float, Scalar | float]:
        """What rounding leaves of place and velocity of coordinate number k (see `rounding`)."""
        return rounding(self.machine, k, state, self.extent(k), self.unit)

    def beyond_a_stop(self, state: State) -> Flag:
        """Whether a coordinate is beyond one of its stops by more than rounding."""
        found = jnp.zeros((), bool)
        for stop in stops_of(self.machine):
            place = self.machine.coordinates[stop.coordinate].position(state)
            slack, _ = self.rounding(stop.coordinate, state)
            found = found | (stop_gradient(stop.beyond(place)) > slack)
        return found

    @property
    def kept(self) -> int:
        """Number of intervals to record."""
        return self.cycles * self.parts

    @property
    def intervals(self) -> Scalar:
        """Number of intervals to go through: whole cycles before those recorded."""
        return self.settle + self.kept

    @property
    def instants(self) -> int:
        """Instants of a cycle that steps end on: record points and impulses of noise."""
        return self.parts if self.noise is None else self.noise.count

    @property
    def unit(self) -> Scalar | float:
        """The unit of `s` for the thresholds of the machine (see `unit_of`)."""
        return unit_of(self.machine)

    def in_units(self, threshold: Any) -> Any:
        """A threshold in `s`, given for a cycle of about 2π."""
        unit = self.unit
        return threshold if isinstance(unit, float) else threshold * unit

    def cycle_of(self, done: Scalar) -> Scalar:
        """The cycle on its way when so many intervals are done, counted from the start."""
        recorded = jnp.floor((done - self.settle) / self.parts)
        return jnp.where(done < self.settle, done, self.settle + recorded)

    def is_record_point(self, part: Scalar, done: Scalar) -> Flag:
        """Whether the end of the `part`-th piece between two impulses completes an interval."""
        behind, every = part + 1, self.instants // self.parts
        # A product of whole numbers is exact, a quotient need not be.
        whole = behind == every * jnp.round(behind / every)
        return (behind >= self.instants) | (done >= self.settle) & whole

    def others(self, state: State) -> list[int]:
        """The numbers of the events, besides stops, whose guards are looked at in each step."""
        last = section_number(self.machine) + (section_in(self.machine, state) is not None)
        return list(range(len(stops_of(self.machine)), last))

    def from_below(self, state: State) -> list[int]:
        """Those of `others` that happen only from below (see `AbstractEvent.from_below`)."""
        events = events_of(self.machine)
        return [number for number in self.others(state) if events[number].from_below]

    def end(self, part: Scalar) -> Scalar:
        """Clock reading at the end of the `part`-th piece of a cycle: an interval, or the way from
        one impulse of noise to the next."""
        cycle = jnp.asarray(self.machine.cycle if self.until is None else self.until, part.dtype)
        return cycle * (part + 1) / self.instants if self.instants > 1 else cycle

    def first_part(self, done: Scalar) -> Scalar:
        """`Lane.part` as a cycle begins, when so many intervals are done: 0, or in a cycle that is
        not recorded the last one, so that it is one interval; with noise it has all impulses."""
        if self.noise is not None:
            return jnp.zeros_like(done)
        return jnp.where(done < self.settle, self.parts - 1.0, jnp.zeros_like(done))

    def ticks(self, state: State) -> bool:
        """Whether `s` itself counts the cycles."""
        return ticks(self.machine, state)

    def clock(self, s: Scalar, state: State) -> Scalar:
        """The reading of what counts the cycles, `s` itself or the machine's clock."""
        clock = clock_of(self.machine, state)
        return s if clock is None else clock

    def timed(self, state: State) -> bool:
        """Whether the duration of a cycle is recorded, which only a fixed one need not be; or the
        time between impulses is measured."""
        if self.noise is not None and self.noise.timed:
            return True
        return self.motion and not has_fixed_cycle(self.machine, state)

    @property
    def meets_every_turn(self) -> bool:
        """Whether steps always end on every turning point: switches and events may be there."""
        return bool(switches_of(self.machine) or others_of(self.machine))

    def meets_turns(self, done: Scalar) -> Flag:
        """Whether steps end on every turning point, for extremes too, when so many intervals are
        done; else only on those close to a stop."""
        if self.motion and not self.meets_every_turn:
            return done >= self.settle
        return jnp.full_like(done, self.meets_every_turn, bool)

    def point(self, state: State, modes: Scalars) -> State:
        """What is kept of the end of an interval: the state, with the machine's own modes."""
        return with_modes(state, own_modes(self.machine, modes))

    def fresh(self, state: State) -> Record:
        """The record of an interval that begins in `state`."""
        Y = self.machine.position(state)
        zero = jnp.zeros_like(Y)
        names = (TIME, *self.averages) if self.timed(state) else self.averages
        return Record(
            integrals=dict.fromkeys(names, zero),
            y_max=Y if self.motion else None,
            y_min=Y if self.motion else None,
            impacts=zero,
            impact_speed=zero if self.motion else None,
            impact_energy=zero if self.motion else None,
            rests=zero if self.motion and self.rests else None,
            log=jnp.full((3, self.log), jnp.nan, Y.dtype) if self.log else None,
            clearance=jnp.full_like(Y, jnp.inf) if self.motion and self.log else None,
            events=jnp.full((4, self.events), jnp.nan, Y.dtype) if self.events else None,
        )

    def at_stop(
        self, k: int, contact: Scalar, part: Callable[[RigidStop], Any], otherwise: Scalar
    ) -> Scalar:
        """A part of the stop that coordinate number k rests on (see `Lane.contact`); `otherwise`
        while it rests on none."""
        for i, stop in enumerate(stops_of(self.machine)):
            if stop.coordinate == k:
                otherwise = jnp.where(contact == to_event(i), part(stop), otherwise)
        return otherwise

    def away(self, k: int, contact: Scalar) -> Scalar:
        """The sign of the direction away from the stop that coordinate number k rests on, or 0."""
        return self.at_stop(k, contact, lambda stop: -float(stop.sign), jnp.zeros_like(contact))

    def wall(self, k: int, contact: Scalar) -> tuple[Scalar | float, Scalar]:
        """The sign (1 right, -1 left) and the gap of the stop of coordinate number k that is named
        by `contact`; of its first stop if none is."""
        mine = [(i, stop) for i, stop in enumerate(stops_of(self.machine)) if stop.coordinate == k]
        (_, first), others = mine[0], mine[1:]
        sign, gap = float(first.sign), first.gap
        for i, stop in others:
            here = contact == to_event(i)
            sign, gap = jnp.where(here, float(stop.sign), sign), jnp.where(here, stop.gap, gap)
        return sign, gap
