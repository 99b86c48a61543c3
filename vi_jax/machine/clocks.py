"""Properties that some machines define for themselves: several clocks, crank angles in words,
another form for a run. The functions have defaults for all machines; `machines.scene` and
`machines.linear` register their own."""

from collections.abc import Callable
from functools import singledispatch
from math import pi
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from .._checks import in_range
from .._messages import count_of
from .._types import Flag, Machine, Number, Scalar, State
from .cycles import counts_turns
from .delay_chain import check_history
from .parts import clock_of, stops_of, switches_of


@singledispatch
def in_clock(machine: Machine, clock: str) -> Machine:
    """Return the same machine with another independent variable."""
    raise ValueError(
        f"Argument `clock` must be left out for a {type(machine).__name__}, which has its own "
        f"clock, but got {clock!r}."
    )


@singledispatch
def in_cycle_clock(machine: Machine) -> Machine:
    """Return a machine with a shaft in its phase clock, and any other as it is. In the time clock
    the section would be an event, and the angle of the shaft one more component of the state."""
    return machine


@singledispatch
def at_section(machine: Machine, phase: Number) -> Machine:
    """Return the same machine with its section elsewhere in the cycle."""
    raise ValueError(
        f"Argument `section` must be left out for a {type(machine).__name__}, which has its own "
        f"section, but got {phase!r}."
    )


@singledispatch
def observed_later(machine: Machine, since_section: Number) -> Machine | None:
    """Return the same machine, observed so long after its section; `None` if that cannot move."""
    return None


@singledispatch
def phase_at(machine: Machine, since_section: Number) -> Any:
    """Return the clock reading this long after the section; a crank angle need not begin at 0."""
    return since_section


@singledispatch
def convert_start(machine: Machine, start: State) -> State:
    """Return a start in the form that a machine needs. **Raises:** `TypeError` for others."""
    check_history("start", machine, start)
    return start


@singledispatch
def in_cycle_state(machine: Machine, name: str, state: State) -> State:
    """Return a section state of any clock in the form for `in_cycle_clock`. **Raises:** `TypeError`
    for others."""
    check_history(name, machine, state)
    return state


@singledispatch
def cycle_time(machine: Machine) -> Scalar | float:
    """Return the duration of a cycle, if it is fixed."""
    return machine.cycle


@singledispatch
def logged_turn(machine: Machine) -> Scalar | float:
    """Return the length of a cycle in the unit of an impact log."""
    return machine.cycle


@singledispatch
def as_logged(machine: Machine, clock: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the value in an impact log for a reading of the clock that counts cycles."""
    return clock


@singledispatch
def frequency_ratio(machine: Machine, duration: Float[Array, "..."]) -> Any:
    """Return the mean speed of the drive over cycles of these durations; `None` without a drive."""
    return 2 * pi / duration if counts_turns(machine) else None


@singledispatch
def cycles_in_words(machine: Machine, cycles: int) -> str:
    """Return the duration of a number of cycles in words: 2 cycles, or 4π."""
    return count_of(cycles, "cycle")


@singledispatch
def clock_word(machine: Machine) -> str:
    """Return the words before a clock reading."""
    return "clock"


@singledispatch
def clock_in_words(machine: Machine, since_section: float, cycles: int) -> str:
    """Return a clock reading in words, within a motion of this number of cycles."""
    reading = f"{clock_word(machine)} {since_section:.6g}"
    return f"{reading} after its section (motion of {count_of(cycles, 'cycle')})"


@singledispatch
def scales_known(machine: Machine) -> bool:
    """Return whether the default number of fixed steps in a cycle is known to be enough. Contacts
    with soft stops may be much briefer than a cycle, and so may be the decay of a user's drive.
    Static."""
    return False


@singledispatch
def is_alive(machine: Machine, state: State) -> Flag | None:
    """Return whether the motion can continue: false if a crank stops in the phase clock; `None` if
    the clock cannot fail."""
    return None


@singledispatch
def may_rest(machine: Machine) -> bool:
    """Return whether a body may come to rest on a stop, as far as is known; static."""
    return bool(stops_of(machine))


def is_in_range(machine: Machine, start: State) -> Flag:
    """Return whether all numbers are in their ranges, and the start not beyond its section."""
    good = in_range((machine, stops_of(machine), switches_of(machine), start))
    clock = clock_of(machine, start)
    return good if clock is None else good & (clock < machine.cycle)


class Prepared(NamedTuple):
    """A machine in the form for a run, and the conversions of its states to that form and back."""

    machine: Any
    inward: Callable[[State], State] = lambda state: state
    outward: Callable[[State], State] = lambda state: state


@singledispatch
def prepared(machine: Machine) -> Prepared:
    """Return a machine in the form for a run (a linear one in natural modes), and the functions
    that convert states to that form and back."""
    return Prepared(machine)
