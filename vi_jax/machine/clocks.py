"""Properties that only some machines define, for any machine: several clocks, crank angles in
words, another form for a run."""

from math import pi
from typing import Any

import jax
from jaxtyping import Array, Float

from .._checks import in_range
from .._messages import count_of
from .._types import Flag, Machine, Number, Scalar, State
from .cycles import counts_turns
from .declared import clock_of, stops_of, switches_of
from .linear import LinearMachine, Prepared
from .scene import Scene


def in_clock(machine: Machine, clock: str) -> Machine:
    """Return the same machine with another independent variable."""
    if isinstance(machine, Scene):
        return machine.in_clock(clock)
    raise ValueError(
        f"Argument `clock` must be left out for a {type(machine).__name__}, which has its own "
        f"clock, but got {clock!r}."
    )


def in_cycle_clock(machine: Machine) -> Machine:
    """Return a machine with a shaft in its phase clock, and any other as it is. In the time clock
    the section would be an event, and the angle of the shaft one more component of the state."""
    return machine.in_clock("phase") if isinstance(machine, Scene) else machine


def at_section(machine: Machine, phase: Number) -> Machine:
    """Return the same machine with its section elsewhere in the cycle."""
    if isinstance(machine, Scene):
        return machine.at_section(phase)
    raise ValueError(
        f"Argument `section` must be left out for a {type(machine).__name__}, which has its own "
        f"section, but got {phase!r}."
    )


def phase_at(machine: Machine, since_section: Number) -> Any:
    """Return the clock reading this long after the section; a crank angle need not begin at 0."""
    return machine.phase_at(since_section) if isinstance(machine, Scene) else since_section


def convert_start(machine: Machine, start: State) -> State:
    """Return a start in the form that a machine needs. **Raises:** `TypeError` for others."""
    return machine.convert_start(start) if isinstance(machine, Scene | LinearMachine) else start


def in_cycle_state(machine: Machine, name: str, state: State) -> State:
    """Return a section state of any clock in the form for `in_cycle_clock`."""
    if isinstance(machine, Scene | LinearMachine):
        return machine.in_cycle_state(name, state)
    return state


def cycle_time(machine: Machine) -> Scalar | float:
    """Return the duration of a cycle, if it is fixed."""
    return machine.period if isinstance(machine, Scene) else machine.cycle


def logged_turn(machine: Machine) -> Scalar | float:
    """Return the length of a cycle in the unit of an impact log."""
    return 2 * pi if isinstance(machine, Scene) else machine.cycle


def as_logged(machine: Machine, clock: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the value in an impact log for a reading of the clock that counts cycles."""
    return machine.as_logged(clock) if isinstance(machine, Scene) else clock


def frequency_ratio(machine: Machine, duration: Float[Array, "..."]) -> Any:
    """Return the mean speed of the drive over cycles of these durations; `None` without a drive."""
    if isinstance(machine, Scene):
        return machine.frequency_ratio(duration)
    return 2 * pi / duration if counts_turns(machine) else None


def cycles_in_words(machine: Machine, cycles: int) -> str:
    """Return the duration of a number of cycles in words: 2 cycles, or 4π."""
    return f"{2 * cycles}π" if isinstance(machine, Scene) else count_of(cycles, "cycle")


def clock_word(machine: Machine) -> str:
    """Return the words before a clock reading."""
    return "crank angle φ =" if isinstance(machine, Scene) else "clock"


def clock_in_words(machine: Machine, since_section: float, cycles: int) -> str:
    """Return a clock reading in words, within a motion of this number of cycles."""
    word = clock_word(machine)
    if isinstance(machine, Scene):
        return f"{word} {float(machine.phase_at(since_section)):.6g} of {2 * cycles}π"
    return f"{word} {since_section:.6g} after its section (motion of {count_of(cycles, 'cycle')})"


def scales_known(machine: Machine) -> bool:
    """Return whether the default number of fixed steps in a cycle is known to be enough. Contacts
    with soft stops may be much briefer than a cycle, and so may be the decay of a user's drive.
    Static."""
    if not isinstance(machine, Scene) or machine.soft_stops:
        return False
    return jax.eval_shape(machine.drive.rate) is not None


def is_alive(machine: Machine, state: State) -> Flag | None:
    """Return whether the motion can continue: false if a crank stops in the phase clock; `None` if
    the clock cannot fail."""
    return machine.alive(state) if isinstance(machine, Scene) else None


def may_rest(machine: Machine) -> bool:
    """Return whether a body may come to rest on a stop, as far as is known; static."""
    return machine.may_rest() if isinstance(machine, Scene) else bool(stops_of(machine))


def is_in_range(machine: Machine, start: State) -> Flag:
    """Return whether all numbers are in their ranges, and the start not beyond its section."""
    good = in_range((machine, stops_of(machine), switches_of(machine), start))
    clock = clock_of(machine, start)
    return good if clock is None else good & (clock < machine.cycle)


def prepared(machine: Machine) -> Prepared:
    """Return a machine in the form for a run (a linear one in natural modes), and the functions
    that convert states to that form and back."""
    if isinstance(machine, LinearMachine):
        return machine.prepared()
    return Prepared(machine)
