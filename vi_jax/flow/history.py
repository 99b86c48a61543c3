"""The history of a machine with delays: a ring of accepted steps in the lane.

A step is a piece, a polynomial of degree 7 for each recorded number, from the values and three
derivatives at both ends. A jump of the motion at t* (the start included) has images at t* + jT,
where a derivative of the delayed number jumps. Steps end there, up to the level j at which the
image is too smooth to matter. They do not end at other borders of the history, which multiply.

Pieces have the clock's derivatives at their ends; the image of a jump has those of the jump.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from .._checks import concrete
from .._types import Flag, Scalar, Scalars, State, Vector
from ..machine import (
    AbstractMachine,
    HybridState,
    Past,
    delays_valid,
    has_delays,
    history_before,
    history_of,
    lags_of,
    longest_delay,
    modes_of,
    reading,
    recorded_numbers,
    renews,
    shown_modes,
    size_of,
    with_some_past,
    without_modes,
    without_past,
)
from .methods import AbstractMethod, ExactFlight, Taylor
from .sizes import unit_of
from .smooth import SmoothMachine

# The numbers of a piece besides its coefficients: its start since that of the piece before; and the
# level of a jump at its start, or -1, with the derivative of the jump's time relative to the start.
_HEAD = 2

# Each step reads at most this many pieces of a delay. With more, more numbers are read, and fewer
# steps are shortened to end with the pieces. Two would repeat the shortest steps for ever.
_WINDOW = 3

# The pieces of a ring: the fewest, and those per cycle in the longest delay, or the number if its
# length is not known. Choices; the "reference" preset takes some 70 steps in a cycle.
_FEWEST, _PER_CYCLE, _UNKNOWN = 32, 128, 257

# Pieces of a history before the start that is a function, at most half of the ring.
_BEFORE = 64


class Memory(eqx.Module):
    """The constants of a history."""

    pieces: int = eqx.field(static=True)
    sizes: Vector
    """The sizes of the recorded numbers, for the error of their polynomials."""


class History(NamedTuple):
    """The history of a lane, of which times are relative to the beginning of the cycle."""

    rows: Array
    """The pieces, a ring: (pieces, 2 + 8 numbers), with coefficients by power of the time since a
    piece's start in the unit of `s`."""
    head: Scalar
    """The place of the next piece."""
    newest: Scalar
    """The start of the newest piece."""
    level: Scalar
    """The level of the jump at the end of the newest piece, or -1."""
    slip: Scalar
    """The derivative of that jump's time, in a number of value 0."""
    places: tuple[Scalar, ...]
    """For each delay, the place of the first piece that the next step reads, and its start."""
    starts: tuple[Scalar, ...]
    unit: Scalar
    """The unit of `s`."""

    def in_order(self) -> tuple[Array, Array, Array]:
        """Return the places of all pieces from the newest to the oldest, their starts, and whether
        they exist."""
        size = self.rows.shape[0]
        places = jnp.mod(stop_gradient(self.head) - 1 - jnp.arange(size), size).astype(jnp.int32)
        spans = self.rows[places, 0]
        back = jnp.concatenate([jnp.zeros_like(spans[:1]), jnp.cumsum(spans)[:-1]])
        return places, self.newest - back, stop_gradient(spans) > 0

    def at(self, t: Scalar) -> Vector:
        """Return the recorded numbers at a time before the end of the history, t ≤ 0."""
        places, starts, exists = self.in_order()
        number = jnp.minimum(jnp.sum((starts > t) & exists), jnp.sum(exists) - 1)
        powers = ((t - starts[number]) / self.unit) ** jnp.arange(8)
        return powers @ self.rows[places[number], _HEAD:].reshape(8, -1)


class Window(NamedTuple):
    """The pieces that a step reads, for one delay."""

    delay: Scalar
    pieces: tuple[tuple[Any, Scalar, Array], ...]
    """For each piece, the instant from which it is read, its start, and its coefficients by power,
    (8, numbers). The instant is the start, infinite for a piece that is not read, minus infinite
    for one that has begun, whatever the rounding of its start."""
    unit: Scalar | float

    def at(self, s: Scalar) -> Vector:
        place = s - self.delay
        _, start, piece = self.pieces[0]
        for instant, later, other in self.pieces[1:]:
            begun = instant <= stop_gradient(place)
            start, piece = jnp.where(begun, later, start), jnp.where(begun, other, piece)
        time = (place - start) / self.unit
        return functools.reduce(lambda value, x: value * time + x, piece[::-1])


class View(Past):
    """The past during a step."""

    windows: tuple[Window, ...]
    reach: Scalar
    """The end of the longest step."""
    image: Scalar
    """The instant of the next image, with its derivative; infinite if it lies beyond `reach`."""
    level: Scalar
    """The level of that image."""
    starts: tuple[Scalars, ...]
    """For each delay, the starts of its pieces, also of those that are not read."""
    jump: tuple[Flag, Scalar]
    """Whether the step begins at a jump or an image of one; and the derivative of that instant, in
    a number of value 0."""

    def __call__(self, machine: Any, s: Scalar, state: State) -> Any:
        return self.form.by_name([x.at(s) for x in self.windows])


# --- before a run


def with_memory(
    machine: AbstractMachine, start: State, given: History | None
) -> tuple[AbstractMachine, Memory]:
    """Return a machine with delays with a past bound to it, and the constants of its history. The
    history at the start is `given`, or `None` for `before`. **Raises:** `TypeError` or `ValueError`
    for invalid delays or histories."""
    bound: Any = with_some_past(machine, start)
    size = bound._past.form.size
    if given is not None and given.rows.shape[1] != _HEAD + 8 * size:
        raise ValueError(
            f"Argument `start` must have the history of a {type(machine).__name__}, but has that "
            "of another machine."
        )
    pieces = _number_of_pieces(machine) if given is None else given.rows.shape[0]
    return bound, Memory(pieces, jnp.ones(size, jnp.result_type(float, *jax.tree.leaves(start))))


def check_delays(machine: AbstractMachine, method: AbstractMethod) -> None:
    """**Raises:** `ValueError` for a machine with delays and what they do not work with."""
    kind = type(machine).__name__
    if isinstance(method, Taylor | ExactFlight):
        raise ValueError(
            f"Argument `method` must be `Adaptive` or `FixedStep` for a {kind}, which has delays, "
            f"but is {method!r}."
        )
    if renews(machine):
        raise ValueError(
            f"A {kind} must not have both `delays` and `renewed`, since its history would jump. "
            "Leave `renewed` out, and use differences of the drifting component."
        )


def with_first_history(machine: AbstractMachine, start: State) -> State:
    """Return a start with its history; unchanged without delays."""
    if not has_delays(machine) or history_of(start) is not None:
        return start
    state = without_modes(start)
    bound, memory = with_memory(machine, state, None)
    history = _first_history(bound, memory, state, unit_of(bound))
    return HybridState(state, modes_of(start) or (), history)


def _number_of_pieces(machine: AbstractMachine) -> int:
    """Return the size of a ring: the machine's `history_size`, or from its longest delay."""
    size = getattr(machine, "history_size", None)
    if size is not None:
        if not isinstance(size, int) or size < 8:
            raise ValueError(
                f"`history_size` of a {type(machine).__name__} must be an integer of at least 8, "
                f"the steps in its longest delay, but is {size!r}."
            )
        return size
    cycle, longest = concrete(jnp.asarray(machine.cycle)), concrete(longest_delay(machine))
    if cycle is None or longest is None:
        return _UNKNOWN
    # An odd number: places of many lanes at multiples of a power of two share the cache's lines.
    return int(min(_FEWEST + _PER_CYCLE * longest / cycle, 1e5)) | 1


def _first_history(bound: Any, memory: Memory, start: State, unit: Any) -> History:
    """Return the history before a start: one constant piece, or many if it is a function."""
    machine, form = without_past(bound), bound._past.form
    before, number = history_before(machine, start), 1
    if callable(machine.before):
        number = min(_BEFORE, memory.pieces // 2)
    record = lambda t: form.pack(before(t)).astype(memory.sizes.dtype)
    return history_of_function(machine, record, unit, number, memory.pieces)


def history_of_function(
    machine: AbstractMachine, record: Callable[[Scalar], Vector], unit: Any, number: int, room: int
) -> History:
    """Return the history of a machine from its recorded numbers as a function of t ≤ 0, in `number`
    pieces of equal length over the longest delay, with room for so many pieces."""
    zero = jnp.zeros((), jax.eval_shape(record, jnp.zeros(())).dtype)
    length = longest_delay(machine).astype(zero.dtype) * (1 + 1e-6) / number
    one = jnp.ones_like(zero)

    def piece(n: Scalar) -> Array:
        first, last = (
            _derivatives(record, lambda t: (one,), (n - number + x) * length) for x in (0.0, 1.0)
        )
        head = jnp.stack([length, -one])
        return jnp.concatenate([head, _in_time(hermite(first, last, length), length, unit)])

    rows = jax.vmap(piece)(jnp.arange(number, dtype=zero.dtype))
    rows = jnp.concatenate([rows, jnp.zeros((room - number, rows.shape[1]), zero.dtype)])
    nothing = (zero,) * len(lags_of(machine))
    return History(rows, zero + number, -length, zero, zero, nothing, nothing, zero + unit)


def _derivatives(function: Any, along: Any, *point: Any) -> tuple[Vector, ...]:
    """Return a function and three derivatives of it along a vector field."""
    values = lambda *point: (function(*point),)
    for _ in range(3):
        values = functools.partial(_with_rate, values, along)
    return values(*point)


def _with_rate(function: Any, along: Any, *point: Any) -> tuple[Vector, ...]:
    values, rates = jax.jvp(function, point, along(*point))
    return (*values, rates[-1])


def with_sizes(plan: Any, s: Scalar, start: State, modes: Scalars) -> Any:
    """Return the plan with the sizes of the recorded numbers, at most 1."""
    shown = shown_modes(plan.machine, modes)
    record = lambda x: recorded_numbers(plan.machine, s, x, shown)
    numbers = range(plan.memory.sizes.size)
    sizes = [size_of(lambda x, n=n: record(x)[n], start, plan.sizes) for n in numbers]
    known = jnp.stack([jnp.where(x > 0, jnp.minimum(x, 1.0), 1.0) for x in sizes])
    memory = eqx.tree_at(lambda x: x.sizes, plan.memory, stop_gradient(known))
    return dataclasses.replace(plan, memory=memory)


def begun(plan: Any, start: State, s: Scalar) -> tuple[History, Flag]:
    """Return the history of a lane at its start, with the places of its delays; and whether these
    are in their range, and the history is long enough."""
    given = plan.history
    if given is None:
        given = _first_history(plan.machine, plan.memory, start, plan.unit)
    order, begins, exists = given.in_order()
    places, starts, covered = [], [], delays_valid(without_past(plan.machine))
    for delay in lags_of(plan.machine):
        needed = stop_gradient(-delay) + slack_of(plan, s)
        number = jnp.minimum(jnp.sum((begins > needed) & exists), jnp.sum(exists) - 1)
        places.append(order[number].astype(s.dtype))
        starts.append(s + begins[number])
        covered = covered & (stop_gradient(begins[number]) <= needed)
    zero = jnp.zeros_like(s)  # a jump at level 0: the start may differ from the history's end
    history = given._replace(
        newest=s + given.newest, level=zero, slip=zero, places=tuple(places), starts=tuple(starts)
    )
    return history, covered


def slack_of(plan: Any, s: Scalar) -> Scalar | float:
    """Return the difference of instants that are one."""
    return plan.in_units(1e-10 if s.dtype == jnp.float64 else 2e-5)


# --- a step


def opened(plan: Any, lane: Any) -> tuple[Any, Any]:
    """Return plan and lane for a step, with the past that it reads bound to the machine, and
    without the history in the lane."""
    opened = lane._replace(history=None, slip=jnp.zeros_like(lane.s))
    return with_view(plan, lane.history, lane.s), opened


def with_view(plan: Any, history: History, s: Scalar) -> Any:
    """Return the plan for a step from `s`, with the past bound to the machine."""
    slack, lags = slack_of(plan, s), [x.astype(s.dtype) for x in lags_of(plan.machine)]
    found = [
        _window(plan, history, s, *x, slack)
        for x in zip(lags, history.places, history.starts, strict=True)
    ]
    windows, starts, reaches, images, levels = zip(*found, strict=True)
    reach = functools.reduce(jnp.minimum, reaches)
    image = functools.reduce(lambda a, b: jnp.where(b < a, b, a), images)
    same = [jnp.where(x <= image + slack, y, jnp.inf) for x, y in zip(images, levels, strict=True)]
    level = functools.reduce(jnp.minimum, same)
    image = jnp.where(image <= reach, image, jnp.inf)
    jump = stop_gradient(history.level) >= 0, history.slip
    view = View(plan.machine._past.form, windows, reach, image, level, starts, jump)
    return dataclasses.replace(plan, machine=reading(plan.machine, view))


def _window(
    plan: Any, history: History, s: Scalar, delay: Scalar, place: Scalar, start: Scalar, slack: Any
) -> tuple[Window, Scalars, Scalar, Scalar, Scalar]:
    """Return the pieces of one delay from a place on up to the next jump; the starts of all; the
    end of the longest step; the next image of a jump, or infinite, and its level."""
    size, width = history.rows.shape
    passed, place = stop_gradient(s - delay) + slack, stop_gradient(place)
    number = jnp.mod(stop_gradient(history.head) - place, size)
    pieces, starts, closed = [], [], jnp.zeros_like(s, bool)
    image, level, reach = jnp.full_like(s, jnp.inf), -jnp.ones_like(s), s + delay
    for n in range(_WINDOW + 1):  # of the last, only the start is used
        at = jnp.where(place + n < size, place + n, place + n - size).astype(jnp.int32)
        row = jax.lax.dynamic_slice(history.rows, (at, jnp.zeros_like(at)), (1, width))[0]
        instant: Any = -jnp.inf
        if n:
            # At the end is the jump where the step begins, of which no piece is written yet.
            is_end = n == number
            start = jnp.where(is_end, s, start + row[0])
            mark = jnp.where(is_end, history.level + history.slip, row[1])
            its_level, ahead = stop_gradient(mark), stop_gradient(start) > passed
            jumps = ~closed & (n <= number) & ahead & (its_level >= 0)
            image = jnp.where(jumps, start + (mark - its_level) + delay, image)
            level = jnp.where(jumps, its_level, level)
            ends = jumps | ~closed & is_end if n < _WINDOW else ~closed & (n <= number)
            reach = jnp.where(ends, stop_gradient(start + delay), reach)
            closed = closed | ends
            instant = jnp.where(ahead, stop_gradient(start), -jnp.inf)
            instant = jnp.where(closed | (n >= number), jnp.inf, instant)
        starts.append(jnp.where(n < number, start, jnp.inf) if n else start)
        pieces.append((instant, start, row[_HEAD:].reshape(8, -1)))
    window = Window(delay, tuple(pieces[:_WINDOW]), history.unit)
    return window, tuple(starts), stop_gradient(reach), image, level


def end_of_step(
    plan: Any, lane: Any, free: Flag, h: Scalar, bound: Scalar
) -> tuple[Scalar, Scalar, Flag]:
    """Return length and end of an ordinary step, which ends at the next image of a jump and with
    the pieces that it reads; and whether it may end at `bound` instead."""
    view = plan.machine._past
    h = jnp.where(free, jnp.minimum(h, stop_gradient(view.reach - lane.s)), h)
    meets = free & (stop_gradient(view.image - lane.s) <= h * (1 + 1e-6))
    end = jnp.where(meets, jnp.where(meets, view.image, 0.0), lane.s + h)
    return (
        h,
        end,
        free & (stop_gradient(bound) <= stop_gradient(view.image) + slack_of(plan, lane.s)),
    )


def new_piece(
    plan: Any, lane: Any, smooth: SmoothMachine, s1: Scalar, state: State, h: Scalar
) -> Array:
    """Return the polynomial of what a step records, (8, numbers) by power of the share of it."""
    modes = shown_modes(smooth.machine, smooth.modes)
    record = lambda s, state: recorded_numbers(smooth.machine, s, state, modes)
    along = lambda s, state: (jnp.ones_like(s), smooth.field(s, state))
    begin, end = (_derivatives(record, along, *x) for x in ((lane.s, lane.state), (s1, state)))
    # Of so short a step the end adds only rounding, which the derivatives of the piece multiply.
    short = stop_gradient(h) < plan.in_units(float(jnp.finfo(h.dtype).eps) ** 0.25)
    nothing = [jnp.zeros_like(begin[0])] * 4
    known = jnp.stack([*(x * (h**n / math.factorial(n)) for n, x in enumerate(begin)), *nothing])
    return jnp.where(short, known, hermite(begin, end, jnp.where(stop_gradient(h) > 0, h, 1.0)))


# The coefficients by power of a polynomial of degree 7 from its derivatives of order n at 0 and at
# 1, divided by n!.
_AT_0, _AT_1 = np.eye(4, 8), [[math.comb(k, n) for k in range(8)] for n in range(4)]
_HERMITE = np.round(np.linalg.inv(np.concatenate([_AT_0, _AT_1])))


def hermite(begin: Any, end: Any, h: Scalar) -> Array:
    """Return the polynomial of degree 7 through values and three derivatives at both ends of a
    step, by power of the share of the step: (8, numbers)."""
    given = [x * (h**n / math.factorial(n)) for ends in (begin, end) for n, x in enumerate(ends)]
    found = [[float(w) * x for w, x in zip(row, given, strict=True) if w] for row in _HERMITE]
    return jnp.stack([sum(x[1:], x[0]) for x in found])


def _in_time(piece: Array, h: Scalar, unit: Scalar | float) -> Vector:
    """Return the coefficients of a piece of length h by power of the time, in this unit."""
    return (piece * (unit / h) ** np.arange(8)[:, None]).ravel()


def piece_error(plan: Any, piece: Array, h: Scalar) -> Scalar:
    """Return the largest error of a piece of length h relative to the tolerance, for an adaptive
    method; 0 for one that is too short to be kept.

    Of the polynomial by powers of 2θ - 1, which decrease like those of the motion, the next pair of
    coefficients is extrapolated from the last two pairs. θ is the share of the step."""
    piece = stop_gradient(piece)
    about = [
        jnp.abs(sum(math.comb(n, k) / 2.0**n * piece[n] for n in range(k, 8))) for k in range(4, 8)
    ]
    earlier, later = jnp.maximum(about[0], about[1]), jnp.maximum(about[2], about[3])
    error = later * jnp.minimum(1.0, later / jnp.where(earlier > 0, earlier, 1.0))
    size = jnp.maximum(jnp.abs(piece[0]), jnp.abs(jnp.sum(piece, axis=0)))
    rtol, atol, _ = plan.method.tolerances(error[0])
    error = jnp.max(error / (atol * plan.memory.sizes + rtol * size))
    return jnp.where(stop_gradient(h) > slack_of(plan, h), error, 0.0)


def extended(
    plan: Any, history: History, step: tuple[Any, Any, Flag], arrived: Any, s: Scalar, jumps: Flag
) -> History:
    """Return the history after a step. `step` is the lane before it, the trial, and whether it was
    taken; `s` is the clock after it, which begins anew with a cycle; `jumps`: an event happened
    there, so that the motion is not smooth."""
    (old, trial, taken), view, slack = step, plan.machine._past, slack_of(plan, s)
    kept, size = taken & (stop_gradient(trial.h) > slack), plan.memory.pieces
    head = jnp.stack([old.s - history.newest, history.level + history.slip])
    length = jnp.where(kept, trial.h, history.unit)
    row = jnp.concatenate([head, _in_time(trial.piece, length, history.unit)])[None]
    # The place is that of no piece in use. The piece counts if it is kept.
    place = stop_gradient(history.head).astype(jnp.int32)
    rows = jax.lax.dynamic_update_slice(history.rows, row, (place, jnp.zeros_like(place)))
    met = taken & (jnp.abs(stop_gradient(trial.s - view.image)) <= slack)
    level = jnp.where(met & (view.level + 1 < view.form.levels), view.level + 1, -1.0)
    jumps = taken & jumps
    level, slip = jnp.where(jumps, 0.0, level), jnp.where(jumps | met, arrived.slip, 0.0)
    waits = ~kept & (history.level >= 0) & ~jumps
    shift, end = arrived.s - s, stop_gradient(arrived.s) + slack
    places, starts = [], []
    for delay, place, known in zip(lags_of(plan.machine), history.places, view.starts, strict=True):
        start = known[0]
        for later in known[1:]:
            begun = taken & (stop_gradient(later) <= end - stop_gradient(delay))
            start, place = jnp.where(begun, later, start), place + jnp.where(begun, 1.0, 0.0)
        places.append(jnp.mod(place, size))
        starts.append(start - shift)
    return history._replace(
        rows=rows,
        head=jnp.mod(history.head + jnp.where(kept, 1.0, 0.0), size),
        newest=jnp.where(kept, old.s, history.newest) - shift,
        level=stop_gradient(jnp.where(waits, history.level, level)),
        slip=jnp.where(waits, history.slip, slip),
        places=tuple(places),
        starts=tuple(starts),
    )


def is_full(plan: Any, history: History) -> Flag:
    """Return whether the next piece would replace one that is still read."""
    used = [jnp.mod(history.head - x, plan.memory.pieces) for x in history.places]
    return functools.reduce(jnp.maximum, used) >= plan.memory.pieces - 1
