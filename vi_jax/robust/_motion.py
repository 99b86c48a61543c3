"""The motion that starts are to come back to, and the one that a start settles on."""

import jax.numpy as jnp
import numpy as np

from .._checks import count, given_number
from .._types import State
from ..flow import MethodLike
from ..machine import AbstractMachine, bare, begin_modes, field_in, in_rows, is_autonomous
from ..orbit import Orbit, adopted, cycle_map, find_orbit
from ._settling import Row, Rows, Settling, advanced

# Section states a period apart are the same within this, relative to 1 + |state|; and an orbit that
# is found from one is that motion if it lies as near as that. Choices.
_SAME, _NEAR = 1e-5, 1e-3

# An equilibrium's rate of change, relative to 1 + |state|: a choice.
_STILL = 1e-8


def in_row(state: State) -> Row:
    """The numbers of a state."""
    return np.asarray(in_rows(state, 0))


def settling_on(
    machine: AbstractMachine,
    motion: Orbit | State,
    settle: int,
    tolerance: float,
    longest: int,
    method: MethodLike,
    name: str,
    cycle: int = 0,
) -> tuple[Settling, Row]:
    """What judges starts by whether they come back to a motion, and a state of the motion.

    **Arguments:** those of `edge_state`; the name of the motion's argument; which of the section
    states of an orbit is asked for.

    **Raises:** `ValueError` or `TypeError` for arguments that cannot be used.
    """
    settle = count("settle", settle, least=1)
    tolerance = given_number("tolerance", tolerance, low=0.0, open_low=True)
    the_map = cycle_map(machine, method=method)
    if isinstance(motion, Orbit):
        if motion.residual.ndim or not bool(motion.successful):
            raise ValueError(f"Argument `{name}` must be one orbit that was found, but is no such.")
        if not bool(motion.stable):
            raise ValueError(f"Argument `{name}` must be a stable orbit, but this one is not.")
        like = bare(adopted(the_map.machine, motion.state, name))
        rows = np.asarray(in_rows(motion.sections))[: int(motion.cycles)]
        return Settling(the_map, like, rows, settle, tolerance), rows[cycle % len(rows)]
    like = bare(adopted(the_map.machine, motion, name))
    start = in_row(like)
    settling = Settling(the_map, like, start[None], settle, tolerance)
    if stands_still(the_map.machine, like):
        return settling, start
    rows = settled_rows(settling, start, longest)
    if rows is None:
        raise ValueError(
            f"Argument `{name}` must settle on a motion that repeats within {longest} cycles, but "
            f"does not within {settle} cycles. See `settle` and `longest`."
        )
    return Settling(the_map, like, rows, settle, tolerance), start


def stands_still(machine: AbstractMachine, state: State) -> bool:
    """Whether a state is an equilibrium of a machine without a drive, which meets no section."""
    if not is_autonomous(machine, state):
        return False
    s = jnp.zeros((), in_row(state).dtype)
    rate = in_row(field_in(machine, s, state, begin_modes(machine, s, state)))
    return bool(np.all(np.abs(rate) <= _STILL * (1 + np.abs(in_row(state)))))


def settled_rows(settling: Settling, start: Row, longest: int) -> Rows | None:
    """The section states of one period of the motion that a start settles on; `None` if it has none
    of at most `longest` cycles, or comes to no end."""
    every = np.ones(1, bool)
    the_map, like, begin = settling.the_map, settling.like, settling.begin
    last, good, _ = advanced(the_map, like, start[None], settling.settle, every, begin)
    if not good[0]:
        return None
    rows = settling.starting(0.0).trail(last, 2 * longest)[0]
    for period in range(1, longest + 1):
        apart = np.abs(rows[period:] - rows[:-period]) / (1 + np.abs(rows[period:]))
        if apart.max() <= _SAME:
            return rows[:period]
    return None


def settled_orbit(settling: Settling, start: Row, longest: int) -> Orbit | None:
    """The motion that a start settles on, made exact; `None` where none is found."""
    rows = settled_rows(settling, start, longest)
    if rows is None:
        return None
    orbit = orbit_near(settling, rows[0], len(rows))
    return orbit if orbit is not None and distance_to(orbit, rows[0]) <= _NEAR else None


def orbit_near(settling: Settling, row: Row, cycles: int) -> Orbit | None:
    """The periodic motion that a search from a state finds."""
    the_map = settling.the_map
    orbit = find_orbit(the_map.machine, settling.state(row), cycles, method=the_map.method)
    return orbit if bool(orbit.successful) else None


def distance_to(orbit: Orbit, row: Row) -> float:
    """How far a state is from the nearest section state of an orbit, relative to 1 + |state|."""
    rows = np.asarray(in_rows(orbit.sections))
    return float((np.abs(rows - row) / (1 + np.abs(rows))).max(axis=1).min())
