"""Tests of starts for their return to a motion, and images of states, in lanes of one program."""

import copy
import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._checks import count, given_number, on_host
from .._messages import ReportProgress, silent
from .._programs import compiled
from .._types import State
from ..flow import RESULTS, MethodLike, Run, RunOptions, simulate, simulate_pool, sizes_on_host
from ..machine import (
    AbstractMachine,
    angles_in,
    begun,
    components,
    in_rows,
    is_autonomous,
    modes_of,
    states_from_rows,
    without_modes,
)
from ..orbit import (
    ALIKE,
    CORRECTED,
    CycleMap,
    MotionSections,
    Orbit,
    check_multipliers,
    cycle_map,
    distance,
    find_orbit,
    is_equilibrium,
    map_state,
)

Row = Float[np.ndarray, " _"]
"""The components of a state, or of a kick."""
Rows = Float[np.ndarray, "_ _"]
"""The components of several states."""

RETURNS, ELSEWHERE, INADMISSIBLE = 1, 0, -1
"""Verdicts on a start: it returns to the motion, it does not, or it cannot be simulated."""

# Lanes of the program that judges starts: those beyond the last start are not run. A choice.
_LANES = 1024

# Section states a period apart are the same within this, relative to the motion's size (see
# `orbit.distance`): a choice.
SAME = 1e-5

# Sections of a motion that are recorded in one run. A choice: longer motions take several runs.
RECORDED = 16


_is_equilibrium = compiled(is_equilibrium)


class Settling:
    """A classifier of starts by their return to a motion.

    A start has returned once a section state of its motion lies within `tolerance` (relative to the
    motion's size) of one of the motion's. This is tested after 1, 2, 3, 4, 5, 6, … cycles, each
    time a quarter more: a motion that decays towards an equilibrium returns long before it has
    shrunk to rounding, where its sections would be noise. After `settle` cycles a start is
    elsewhere.
    """

    def __init__(self, the_map: CycleMap, like: State, rows: Rows, settle: int, tolerance: float):
        self.the_map, self.like, self.settle, self.tolerance = the_map, like, settle, tolerance
        sizes, angles = sizes_on_host(the_map.machine, like, rows), angles_in(the_map.machine, like)
        self.motion = MotionSections(rows, np.zeros((len(rows), 0)), sizes, angles)
        """The motion, which also tells the distance of states in all comparisons."""
        self.begin = 0.0
        """Time of the starts after the section, by the clock of a machine with a drive."""
        self._judged_so_far: list[int] = []
        self.report: ReportProgress = silent
        """Callback with the number of starts that are judged."""

    def starting_at(self, begin: float) -> "Settling":
        new = copy.copy(self)
        new.begin = begin
        return new

    @property
    def lanes(self) -> int:
        """The number of starts judged so far, those at other clocks included."""
        return sum(self._judged_so_far)

    def state(self, rows: object) -> State:
        return states_from_rows(self.like, rows)

    def judge(self, rows: Rows) -> Int[np.ndarray, " lanes"]:
        """Return `RETURNS`, `ELSEWHERE` or `INADMISSIBLE` for each start."""
        return np.concatenate([self._judged(*part) for part in _padded_parts(rows)])

    def _judged(self, rows: Rows, is_running: Bool[np.ndarray, " lanes"]) -> Int[np.ndarray, " _"]:
        count = int(is_running.sum())
        self._judged_so_far.append(count)
        self.report(count)
        # States on the motion need not return to it; an equilibrium meets no section at all.
        is_away = self.motion.distance(rows) > 0
        verdict = np.where(is_away | (self.begin > 0), ELSEWHERE, RETURNS)
        is_running &= verdict == ELSEWHERE
        done, step = 0, 1
        while done < self.settle and is_running.any():
            step = min(max(1, done // 4), self.settle - done)
            begin = 0.0 if done else self.begin
            later, good, bad_start = self._advanced(rows, step, is_running, begin)
            if not done:
                verdict[is_running & bad_start] = INADMISSIBLE
            # A repeating state has settled, or is nearer to an unstable motion than starts can be
            # distinguished: more cycles cost time, and end an equilibrium in noise.
            moves = (self.motion.between(later, rows) > CORRECTED) | (begin > 0)
            rows = np.where((is_running & good)[:, None], later, rows)
            is_running &= good
            returned = is_running.copy()
            returned[is_running] = self.motion.distance(rows[is_running]) <= self.tolerance
            verdict[returned] = RETURNS
            is_running &= ~returned & moves
            done += step
        return verdict[:count]

    def _advanced(
        self, rows: Rows, cycles: int, wanted: Bool[np.ndarray, " lanes"], begin: float
    ) -> list[np.ndarray]:
        """Return states so many cycles later, whether they got there, and whether the start is
        invalid. Only states are compared, so their modes must be those of a motion from there."""
        numbers = map(np.asarray, (rows, cycles, wanted, begin))
        *found, other = (np.asarray(x) for x in _advanced(self.the_map, self.like, *numbers))
        _refuse_other_modes(other)
        return found

    def states_after(self, rows: Rows, cycles: int) -> Rows:
        """Return states so many cycles later; NaN for a start that does not get there."""
        found = []
        for part, wanted in _padded_parts(rows):
            later, good, _ = self._advanced(part, cycles, wanted, self.begin)
            found.append(np.where(good[:, None], later, np.nan)[wanted])
        return np.concatenate(found)

    def first_change(self, rows: Float[np.ndarray, "rays points states"]) -> tuple[Any, Any]:
        """Return the index in each row of the first point that does not return, or the number of
        points, and whether that point is elsewhere (not inadmissible)."""
        rays, points, states = rows.shape
        verdict = self.judge(rows.reshape(-1, states)).reshape(rays, points)
        leaves = verdict != RETURNS
        first = np.where(leaves.any(axis=1), leaves.argmax(axis=1), points)
        first_verdict = verdict[np.arange(rays), np.minimum(first, points - 1)]
        return first, (first < points) & (first_verdict == ELSEWHERE)

    def section_states(self, rows: Rows, cycles: int) -> Float[np.ndarray, "lanes sections states"]:
        """Return the section states of some motions, from their starts on."""
        parts, last, begin = [rows[:, None]], rows, self.begin
        for _ in range(math.ceil(cycles / RECORDED)):
            later = _sections_of(self.the_map, self.like, last, np.asarray(begin))
            parts.append(np.asarray(later)[:, 1:])
            last, begin = parts[-1][:, -1], 0.0
        return np.concatenate(parts, axis=1)[:, : cycles + 1]

    def bisected(self, inside: Row, outside: Row, width: float) -> tuple[Row, Row]:
        """Return two starts between two others, `width` apart (by the motion's size), one that
        returns and one that does not. Fifteen points between them are judged in a round."""
        parts = np.linspace(0, 1, 17)[1:-1, None]
        while distance(outside, inside, self.motion.sizes) > width:
            between = inside + parts * (outside - inside)
            (place,), _ = self.first_change(between[None])
            ends = np.concatenate([inside[None], between, outside[None]])
            if (ends[place] == inside).all() and (ends[place + 1] == outside).all():
                break  # no number lies between them
            inside, outside = ends[place], ends[place + 1]
        return inside, outside

    def settled_rows(self, start: Row, longest: int) -> Rows | None:
        """Return the section states of a start's final motion, one period, at most `longest`."""
        last = self.states_after(start[None], self.settle)
        if not np.isfinite(last).all():
            return None
        rows = self.starting_at(0.0).section_states(last, 2 * longest)[0]
        for period in range(1, longest + 1):
            if self.motion.between(rows[:-period], rows[period:]).max() <= SAME:
                return rows[:period]
        return None

    def settled_orbit(self, start: Row, longest: int) -> Orbit | None:
        """Return the motion that a start settles on, made exact, or `None`."""
        rows = self.settled_rows(start, longest)
        return None if rows is None else self.orbit_near(rows[0], len(rows), ALIKE)

    def orbit_near(self, row: Row, cycles: int, near: float) -> Orbit | None:
        """Return the periodic motion that a search from a state finds, if within `near` of it."""
        the_map = self.the_map
        orbit = find_orbit(the_map.machine, self.state(row), cycles, method=the_map.method)
        if not bool(orbit.successful):
            return None
        sections = in_rows(on_host(orbit.sections))
        return orbit if self.motion.between(row, sections).min() <= near else None

    def at_phase(self, start: Row, phase: float) -> tuple["Settling", Row]:
        """Return a classifier of starts `phase` after a section state of the motion, and that
        state."""
        machine, method = self.the_map.machine, self.the_map.method
        if bool(_is_equilibrium(machine, self.state(start), machine.cycle, self.motion.sizes)):
            raise ValueError("Argument `phase` must be 0 for an equilibrium, which does not move.")
        row = self.motion.states[self.motion.between(start, self.motion.states).argmin()]
        state, autonomous = self.state(row), is_autonomous(machine, self.like)
        length = float(jnp.asarray(machine.cycle))
        if autonomous:
            run = simulate(machine, state, 1, method=method)
            assert run.duration is not None
            length = float(run.duration[0])
        if not phase < length:
            raise ValueError(
                f"Argument `phase` must be less than the {length:.9g} that its cycle takes, but "
                f"got {phase:.9g}. See `cycle`."
            )
        if autonomous:
            # With equal intervals it meets no section, and needs no clock.
            observed = machine.observed_every(phase)
            run = simulate(observed, state, 1, method=method, record="sections")
            return self, in_row(without_modes(run.last))
        state_row = _state_at_clock(self.the_map, self.like, row, np.asarray(phase))
        return self.starting_at(phase), np.asarray(state_row)


def in_row(state: State) -> Row:
    return in_rows(on_host(state), 0)


def one_orbit(name: str, orbit: object) -> Orbit:
    if not isinstance(orbit, Orbit) or orbit.residual.ndim or not bool(orbit.successful):
        raise ValueError(
            f"Argument `{name}` must be one orbit that was found, but is a batch, a failed search "
            "or something else. See `Orbit.result`."
        )
    check_multipliers(name, orbit)
    return orbit


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
    """Return a classifier of starts by their return to a motion, and a state of the motion (for an
    orbit that on section `cycle`)."""
    settle = count("settle", settle, least=1)
    tolerance = given_number("tolerance", tolerance, low=0.0, open_low=True)
    the_map = cycle_map(machine, method=method)
    state = map_state(the_map.machine, motion.state if isinstance(motion, Orbit) else motion, name)
    _refuse_other_modes(_in_other_modes(the_map, jtu.tree_map(lambda x: x[None], state)))
    like = without_modes(state)
    if isinstance(motion, Orbit):
        if not bool(one_orbit(name, motion).stable):
            raise ValueError(f"Argument `{name}` must be a stable orbit, but this one is not.")
        numbers, of_orbit = components(machine), components(motion.machine)
        for other in numbers.keys() & of_orbit.keys():
            if not np.allclose(numbers[other], of_orbit[other], rtol=1e-9, atol=0.0):
                raise ValueError(
                    f"Argument `{name}` must be an orbit of this machine, but its {other} is "
                    f"{of_orbit[other]:g}, not {numbers[other]:g}."
                )
        rows = in_rows(on_host(motion.sections))[: int(motion.cycles)]
        return Settling(the_map, like, rows, settle, tolerance), rows[cycle % len(rows)]
    start = in_row(like)
    settling = Settling(the_map, like, start[None], settle, tolerance)
    if bool(_is_equilibrium(the_map.machine, like, the_map.machine.cycle, settling.motion.sizes)):
        return settling, start
    rows = settling.settled_rows(start, longest)
    if rows is None:
        raise ValueError(
            f"Argument `{name}` must settle on a motion that repeats within {longest} cycles, but "
            f"does not within {settle} cycles. See `settle` and `longest`."
        )
    return Settling(the_map, like, rows, settle, tolerance), start


def _padded_parts(rows: Rows) -> Iterator[tuple[Rows, Bool[np.ndarray, " lanes"]]]:
    """Yield rows in parts of as many as there are lanes, the last padded, and which are wanted."""
    for i in range(0, len(rows), _LANES):
        part = rows[i : i + _LANES]
        padding = np.broadcast_to(part[:1], (_LANES - len(part), rows.shape[1]))
        yield np.concatenate([part, padding]), np.arange(_LANES) < len(part)


@compiled
def _advanced(
    the_map: CycleMap, like: State, rows: Array, cycles: Array, wanted: Array, begin: Array
):
    run = _runs(the_map, like, rows, 1, cycles - 1, begin, wanted)
    last = in_rows(run.sections, 2)[:, -1]
    good = run.successful & jnp.isfinite(last).all(axis=1)
    other = wanted & good & _in_other_modes(the_map, jax.vmap(lambda run: run.last)(run))
    return last, good, run.result == RESULTS.bad_start, other


def _in_other_modes(the_map: CycleMap, states: State) -> Any:
    """Return whether the machine's modes in some states differ from those of a new motion there."""
    modes, new = (
        modes_of(states) or (),
        modes_of(begun(the_map.machine, without_modes(states), 1)) or (),
    )
    pairs = zip(modes, new, strict=True) if modes else ()
    return sum((one != other for one, other in pairs), start=jnp.zeros((), bool))


def _refuse_other_modes(other: Any) -> None:
    if np.any(other):
        raise ValueError(
            "Argument `machine` must have modes that follow from its state on the section (see "
            "`AbstractMachine.modes`), but a motion arrives there in other modes than it begins in."
        )


def _runs(
    the_map: CycleMap, like: State, rows: Array, cycles: int, settle: Any, begin: Any,
    wanted: Array | None = None, until: Any = None,
) -> Run:  # fmt: skip
    """Simulate from some states, with sections recorded; with clocks for a machine with a drive."""
    unravel = ravel_pytree(like)[1]
    driven = not is_autonomous(the_map.machine, like)
    options = RunOptions(
        settle=settle, method=the_map.method, record="sections", rests=the_map.rests,
        begin=begin if driven else None, until=until,
    )  # fmt: skip
    return simulate_pool(lambda x: (the_map.machine, unravel(x)), rows, cycles, options, wanted)


@compiled
def _sections_of(the_map: CycleMap, like: State, rows: Array, begin: Array) -> Array:
    return in_rows(_runs(the_map, like, rows, RECORDED, 0, begin).sections, 2)


@compiled
def _state_at_clock(the_map: CycleMap, like: State, row: Array, clock: Array) -> Array:
    return in_rows(_runs(the_map, like, row[None], 1, 0, None, until=clock).sections, 2)[0, -1]


@compiled
def images(
    the_map: CycleMap, like: State, rows: Array, cycles: Array, begin: Array
) -> tuple[Array, Array]:
    """Return states so many cycles later (at least one), and their derivatives with respect to the
    states, (lanes, states, states). Another number of `cycles` needs no compilation."""

    def ends(rows):
        return in_rows(_runs(the_map, like, rows, 1, cycles - 1, begin).sections, 2)[:, -1]

    def along(direction):
        return jax.jvp(ends, (rows,), (jnp.broadcast_to(direction, rows.shape),))

    basis = jnp.eye(rows.shape[1], dtype=rows.dtype)
    last, slopes = jax.vmap(along, out_axes=(None, 2))(basis)
    return last, slopes
