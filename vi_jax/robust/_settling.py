"""Which starts come back to a motion, and where states go: many lanes of one compiled program."""

import copy
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from .._messages import Tell, silent
from .._programs import compiled
from .._types import State
from ..flow import RESULTS, Run, RunOptions, simulate_pool
from ..machine import in_rows, is_autonomous
from ..orbit import CycleMap

Row = Float[np.ndarray, " _"]
"""The numbers of a state, or of a kick."""
Rows = Float[np.ndarray, "_ _"]
"""Of several states."""

RETURNS, ELSEWHERE, INADMISSIBLE = 1, 0, -1
"""What becomes of a start: it comes back to the motion, it does not, or it is none (beyond a stop,
outside of the bounds)."""

# Lanes of the program by which starts are judged: those beyond the last start are not run, so that
# few starts cost few. A choice.
_LANES = 1024

# A motion whose sections change by less than this, relative to 1 + |state|, is where it will stay,
# or nearer to an unstable one than starts are told apart. A choice.
_STILL = 1e-11

# Sections of a motion that are recorded at once. A choice: longer ones are put together.
TRAIL = 16


class Settling:
    """Judges starts by whether they come back to a motion.

    A start has come back once a section state of its motion lies within `tolerance` (relative to
    1 + |state|) of one of the motion's. That is looked at after 1, 2, 3, 4, 5, 6, … cycles, each
    time a quarter more: a motion that decays towards an equilibrium is found back long before it
    has shrunk to rounding, where its sections would be noise.

    **Arguments:** the map of one cycle; a state, for its structure; the motion's section states;
    cycles after which a start that has not come back is elsewhere; the tolerance; how long after
    the section starts are, by the clock of a machine with a drive (a cycle ends on its section).
    """

    def __init__(
        self, the_map: CycleMap, like: State, motion: Rows, settle: int, tolerance: float,
        begin: float = 0.0,
    ):  # fmt: skip
        self.the_map, self.like, self.motion = the_map, like, motion
        self.begin = begin
        self.settle, self.tolerance = settle, tolerance
        self._judged_so_far: list[int] = []
        self.tell: Tell = silent
        """Told of each start that is judged."""

    def starting(self, begin: float) -> "Settling":
        """The same for starts at another clock."""
        new = copy.copy(self)
        new.begin = begin
        return new

    @property
    def lanes(self) -> int:
        """Starts judged so far, those at other clocks included."""
        return sum(self._judged_so_far)

    def state(self, row: object) -> State:
        """A state from its numbers."""
        return ravel_pytree(self.like)[1](jnp.asarray(row))

    def distances(self, rows: Rows) -> Float[np.ndarray, "lanes sections"]:
        """How far section states lie from each of the motion's, relative to 1 + |state|."""
        apart = np.abs(rows[:, None] - self.motion) / (1 + np.abs(self.motion))
        return apart.max(axis=2)

    def distance(self, rows: Rows) -> Float[np.ndarray, " lanes"]:
        """How far section states lie from the motion's nearest one."""
        return self.distances(rows).min(axis=1)

    def judge(self, rows: Rows) -> Int[np.ndarray, " lanes"]:
        """`RETURNS`, `ELSEWHERE` or `INADMISSIBLE` for each start."""
        found = [self._judged(rows[i : i + _LANES]) for i in range(0, len(rows), _LANES)]
        return np.concatenate(found)

    def _judged(self, rows: Rows) -> Int[np.ndarray, " lanes"]:
        """The same for at most as many as the program has lanes."""
        count = len(rows)
        self._judged_so_far.append(count)
        self.tell(count)
        here = np.concatenate([rows, np.broadcast_to(rows[:1], (_LANES - count, rows.shape[1]))])
        goes_on = np.arange(_LANES) < count
        # What is on the motion need not come back to it; an equilibrium meets no section at all.
        off = self.distance(here) > 0
        verdict = np.where(off | (self.begin > 0), ELSEWHERE, RETURNS)
        goes_on &= verdict == ELSEWHERE
        done, step = 0, 1
        while done < self.settle and goes_on.any():
            step = min(max(1, done // 4), self.settle - done)
            begin = 0.0 if done else self.begin
            there, good, bad_start = advanced(self.the_map, self.like, here, step, goes_on, begin)
            if not done:
                verdict[goes_on & bad_start] = INADMISSIBLE
            # What repeats has settled: to go on would cost, and end an equilibrium in noise.
            moves = np.max(np.abs(there - here) / (1 + np.abs(here)), axis=1) > _STILL
            moves |= begin > 0
            here = np.where((goes_on & good)[:, None], there, here)
            goes_on &= good
            returned = goes_on.copy()
            returned[goes_on] = self.distance(here[goes_on]) <= self.tolerance
            verdict[returned] = RETURNS
            goes_on &= ~returned & moves
            done += step
        return verdict[:count]

    def carried(self, rows: Rows, cycles: int) -> Rows:
        """States so many cycles later; NaN for a start that does not get there."""
        found = []
        for i in range(0, len(rows), _LANES):
            part, wanted = rows[i : i + _LANES], np.arange(_LANES) < len(rows) - i
            filled = np.broadcast_to(part[:1], (_LANES - len(part), rows.shape[1]))
            there, good, _ = advanced(
                self.the_map, self.like, np.concatenate([part, filled]), cycles, wanted, self.begin
            )
            found.append(np.where(good[:, None], there, np.nan)[: len(part)])
        return np.concatenate(found)

    def first_change(self, rows: Float[np.ndarray, "rays points states"]) -> tuple[Any, Any]:
        """Of points in a row, the first that does not come back.

        **Returns:** its place in each row, as many as there are points if all come back; and
        whether that one is elsewhere (not inadmissible).
        """
        rays, points, states = rows.shape
        verdict = self.judge(rows.reshape(-1, states)).reshape(rays, points)
        left = verdict != RETURNS
        first = np.where(left.any(axis=1), left.argmax(axis=1), points)
        there = verdict[np.arange(rays), np.minimum(first, points - 1)]
        return first, (first < points) & (there == ELSEWHERE)

    def trail(self, rows: Rows, cycles: int) -> Float[np.ndarray, "lanes sections states"]:
        """The section states of some motions, from their starts on."""
        parts, here, begin = [rows[:, None]], rows, self.begin
        for _ in range(math.ceil(cycles / TRAIL)):
            later = _trail(self.the_map, self.like, jnp.asarray(here), jnp.asarray(begin))
            parts.append(np.asarray(later)[:, 1:])
            here, begin = parts[-1][:, -1], 0.0
        return np.concatenate(parts, axis=1)[:, : cycles + 1]

    def bisected(self, inside: Row, outside: Row, width: float) -> tuple[Row, Row]:
        """Two starts on the line between two others, that comes back and that does not, so close
        to each other (relative to 1 + |state|). Fifteen points at once are judged between them."""
        parts = np.linspace(0, 1, 17)[1:-1, None]
        while np.max(np.abs(outside - inside) / (1 + np.abs(inside))) > width:
            between = inside + parts * (outside - inside)
            (place,), _ = self.first_change(between[None])
            ends = np.concatenate([inside[None], between, outside[None]])
            if (ends[place] == inside).all() and (ends[place + 1] == outside).all():
                break  # no number lies between them
            inside, outside = ends[place], ends[place + 1]
        return inside, outside


def advanced(
    the_map: CycleMap, like: State, rows: object, cycles: int, wanted: object, begin: float = 0.0
) -> tuple[Rows, Bool[np.ndarray, " lanes"], Bool[np.ndarray, " lanes"]]:
    """States so many cycles later, whether they got there, and whether they were no starts.

    **Arguments:** `begin`, the clock of the starts since the section.
    """
    numbers = (jnp.asarray(x) for x in (rows, cycles, wanted, begin))
    found = _advanced(the_map, like, *numbers)
    rows, good, bad = (np.asarray(x) for x in found)
    return rows, good, bad


@compiled
def _advanced(
    the_map: CycleMap, like: State, rows: Array, cycles: Array, wanted: Array, begin: Array
):
    run = _runs(the_map, like, rows, 1, cycles - 1, begin, wanted)
    last = in_rows(run.sections, 2)[:, -1]
    good = run.successful & jnp.isfinite(last).all(axis=1)
    return last, good, run.result == RESULTS.bad_start


def _runs(
    the_map: CycleMap, like: State, rows: Array, cycles: int, settle: Any, begin: Any,
    wanted: Array | None = None, until: Any = None,
) -> Run:  # fmt: skip
    """Runs from some states, their sections recorded; with clocks for a machine with a drive."""
    unravel = ravel_pytree(like)[1]
    driven = not is_autonomous(the_map.machine, like)
    options = RunOptions(
        settle=settle, method=the_map.method, record="sections", rests=the_map.rests,
        begin=begin if driven else None, until=until,
    )  # fmt: skip
    return simulate_pool(lambda x: (the_map.machine, unravel(x)), rows, cycles, options, wanted)


@compiled
def _trail(the_map: CycleMap, like: State, rows: Array, begin: Array) -> Array:
    return in_rows(_runs(the_map, like, rows, TRAIL, 0, begin).sections, 2)


@compiled
def until(the_map: CycleMap, like: State, row: Array, clock: Array) -> Array:
    """The state of a machine with a drive at a clock within the cycle that begins in a state."""
    return in_rows(_runs(the_map, like, row[None], 1, 0, None, until=clock).sections, 2)[0, -1]


@compiled
def images(
    the_map: CycleMap, like: State, rows: Array, cycles: Array, begin: Array
) -> tuple[Array, Array]:
    """States so many cycles later (at least one), and their derivatives by the states.

    **Arguments:** `rows`, (lanes, states); `cycles`, another number of which is not another
    program; `begin`, the clock of the states since the section.

    **Returns:** (lanes, states) and (lanes, states, states).
    """

    def ends(rows):
        return in_rows(_runs(the_map, like, rows, 1, cycles - 1, begin).sections, 2)[:, -1]

    def along(direction):
        return jax.jvp(ends, (rows,), (jnp.broadcast_to(direction, rows.shape),))

    basis = jnp.eye(rows.shape[1], dtype=rows.dtype)
    last, slopes = jax.vmap(along, out_axes=(None, 2))(basis)
    return last, slopes
