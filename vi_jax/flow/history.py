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
    FixedPast,
    Recorded,
    delays_in,
    delays_valid,
    form_of,
    history_before,
    reading,
    recorded_numbers,
    size_of,
    without_past,
)
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

    form: Recorded
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
    starts: tuple[Scalar, ...]
    keys: tuple[Scalar, ...]
    """The instants from which pieces are read: their starts, infinite for a piece that is not read,
    minus infinite for one that has begun, whatever the rounding of its start."""
    pieces: tuple[Array, ...]
    """Coefficients by power: (8, numbers)."""
    unit: Scalar | float


class Windows(eqx.Module):
    """The past during a step, as a function of `s`."""

    form: Recorded
    windows: tuple[Window, ...]

    def __call__(self, s: Scalar) -> Any:
        return self.form.by_name([_value(x, s) for x in self.windows])


def _value(window: Window, s: Scalar) -> Vector:
    place = s - window.delay
    start, piece = window.starts[0], window.pieces[0]
    for n in range(1, len(window.starts)):
        here = window.keys[n] <= stop_gradient(place)
        start = jnp.where(here, window.starts[n], start)
        piece = jnp.where(here, window.pieces[n], piece)
    time = place - start
    time = time if isinstance(window.unit, float) else time / window.unit
    value = piece[7]
    for n in range(6, -1, -1):
        value = value * time + piece[n]
    return value


class View(eqx.Module):
    """The history as a step sees it."""

    windows: Windows
    reach: Scalar
    """The end of the longest step."""
    image: Scalar
    """The instant of the next image, with its derivative; infinite if it lies beyond `reach`."""
    level: Scalar
    """The level of that image."""
    slack: Scalar | float
    """Instants closer than this are one."""
    places: tuple[Scalar, ...]
    known: tuple[Scalars, ...]
    """For each delay, the starts of its pieces, also of those that are not read."""


# --- before a run


def with_history(
    machine: AbstractMachine, start: State, given: History | None
) -> tuple[AbstractMachine, Memory]:
    """Return a machine with delays with a past bound to it, and the constants of its history. The
    history at the start is `given`, or `None` for `before`. **Raises:** `TypeError` or `ValueError`
    for invalid delays or histories."""
    machine = without_past(machine)
    before = history_before(machine, start)
    form, delays = form_of(machine, start, before), delays_in(machine)
    dtype = jnp.result_type(float, *jax.tree.leaves(start))
    lags = [jnp.asarray(x, dtype) for x in delays.values()]
    pieces = _number_of_pieces(machine, lags) if given is None else given.rows.shape[0]
    if given is not None and given.rows.shape[1] != _HEAD + 8 * form.size:
        raise ValueError(
            f"Argument `start` must have the history of a {type(machine).__name__}, but has that "
            "of another machine."
        )
    past = [form.pack(before(-lag)) for lag in lags]
    bound = reading(machine, FixedPast(form.by_name(past)))
    return bound, Memory(form, pieces, jnp.ones(form.size, dtype))


def _number_of_pieces(machine: AbstractMachine, lags: list[Any]) -> int:
    """Return the size of a ring: the machine's `history_size`, or from its longest delay."""
    size = getattr(machine, "history_size", None)
    if size is not None:
        if not isinstance(size, int) or size < 8:
            raise ValueError(
                f"`history_size` of a {type(machine).__name__} must be an integer of at least 8, "
                f"the steps in its longest delay, but is {size!r}."
            )
        return size
    known = [concrete(x) for x in (machine.cycle, *lags)]
    if any(x is None or x.ndim for x in known):
        return _UNKNOWN
    cycle, *lengths = (float(x) for x in known)
    # An odd number: places of many lanes at multiples of a power of two share the cache's lines.
    return int(min(_FEWEST + _PER_CYCLE * max(lengths) / cycle, 1e5)) | 1


def _from_before(
    machine: AbstractMachine, form: Recorded, before: Any, lags: list[Any], most: int
) -> History:
    """Return a history of one constant piece, or of `most` of equal length if it is a function."""
    longest, unit = functools.reduce(jnp.maximum, lags), unit_of(machine)
    number = most if callable(machine.before) else 1
    length = longest * (1 + 1e-6) / number

    def record(t: Scalar) -> Vector:
        return form.pack(before(t))

    def piece(n: Scalar) -> Array:
        ends = [_derivatives(record, (n - number + x) * length) for x in (0.0, 1.0)]
        head = jnp.stack([length, -jnp.ones_like(length)])
        return jnp.concatenate([head, _in_time(hermite(*ends, length), length, unit)])

    rows = jax.vmap(piece)(jnp.arange(number, dtype=longest.dtype))
    zero = jnp.zeros_like(longest)
    nothing = (zero,) * len(lags)
    return History(rows, zero + number, -length, zero, zero, nothing, nothing, zero + unit)


def _derivatives(function: Any, t: Scalar) -> list[Vector]:
    found, one = [], jnp.ones_like(t)
    for _ in range(4):
        found.append(function(t))
        function = lambda t, f=function: jax.jvp(f, (t,), (one,))[1]
    return found


def with_sizes(plan: Any, s: Scalar, start: State, modes: Scalars) -> Any:
    """Return the plan with the sizes of the recorded numbers, at most 1."""
    memory = plan.memory
    sizes = [
        size_of(
            lambda x, n=n: recorded_numbers(plan.machine, memory.form, s, x, modes)[n],
            start,
            plan.sizes,
        )
        for n in range(memory.form.size)
    ]
    known = jnp.stack([jnp.where(x > 0, jnp.minimum(x, 1.0), 1.0) for x in sizes])
    memory = eqx.tree_at(lambda x: x.sizes, memory, stop_gradient(known))
    return dataclasses.replace(plan, memory=memory)


def begun(plan: Any, start: State, s: Scalar) -> History:
    """Return the history of a lane at its start, with the places of its delays."""
    memory, given, machine = plan.memory, plan.history, without_past(plan.machine)
    if given is None:
        before, lags = history_before(machine, start), delays_in(machine).values()
        lags, most = [jnp.asarray(x, s.dtype) for x in lags], min(_BEFORE, memory.pieces // 2)
        given = _from_before(machine, memory.form, before, lags, most)
    missing = memory.pieces - given.rows.shape[0]
    rows = jnp.concatenate([given.rows, jnp.zeros((missing, given.rows.shape[1]), s.dtype)])
    given = given._replace(rows=rows)
    order, begins, exists = given.in_order()
    places, starts = [], []
    for delay in delays_in(machine).values():
        later = begins > stop_gradient(-jnp.asarray(delay)) + slack_of(plan, s)
        number = jnp.minimum(jnp.sum(later & exists), jnp.sum(exists) - 1)
        places.append(order[number].astype(s.dtype))
        starts.append(s + begins[number])
    places_and_starts = {"places": tuple(places), "starts": tuple(starts)}
    # The start may differ from the end of the history.
    level, slip = jnp.zeros_like(s), jnp.zeros_like(s)
    newest = s + given.newest
    return given._replace(newest=newest, level=level, slip=slip, **places_and_starts)


def is_covered(plan: Any, history: History, s: Scalar) -> Flag:
    """Return whether all delays are in their range, and the history at a start is long enough."""
    machine = without_past(plan.machine)
    covered = delays_valid(machine)
    for delay, start in zip(delays_in(machine).values(), history.starts, strict=True):
        covered = covered & (start <= s - jnp.asarray(delay) + slack_of(plan, s))
    return covered


def slack_of(plan: Any, s: Scalar) -> Scalar | float:
    """Return the difference of instants that are one."""
    return plan.in_units(1e-10 if s.dtype == jnp.float64 else 2e-5)


# --- a step


def opened(plan: Any, lane: Any) -> tuple[Any, Any]:
    """Return plan and lane for a step, with the past that it reads bound to the machine, and
    without the history in the lane."""
    plan = with_view(plan, lane.history, lane.s)
    return plan, lane._replace(history=None, slip=jnp.zeros_like(lane.s))


def with_view(plan: Any, history: History, s: Scalar) -> Any:
    """Return the plan for a step from `s`, with the past bound to the machine."""
    view = _view(plan, history, s)
    return dataclasses.replace(plan, machine=reading(plan.machine, view.windows), view=view)


def _view(plan: Any, history: History, s: Scalar) -> View:
    machine, form = without_past(plan.machine), plan.memory.form
    slack, windows, known = slack_of(plan, s), [], []
    reach = image = jnp.full_like(s, jnp.inf)
    level = -jnp.ones_like(s)
    delays = delays_in(machine).values()
    for delay, place, start in zip(delays, history.places, history.starts, strict=True):
        delay = jnp.asarray(delay, s.dtype)
        window, starts, its_reach, its_image, its_level = _window(
            plan, history, s, (delay, place, start), slack
        )
        windows.append(window)
        known.append(starts)
        reach = jnp.minimum(reach, stop_gradient(its_reach))
        sooner, same = its_image < image - slack, its_image <= image + slack
        level = jnp.where(sooner, its_level, jnp.where(same, _least(level, its_level), level))
        image = jnp.where(its_image < image, its_image, image)
    image = jnp.where(image <= reach, image, jnp.inf)
    past = Windows(form, tuple(windows))
    return View(past, reach, image, stop_gradient(level), slack, history.places, tuple(known))


def _least(a: Scalar, b: Scalar) -> Scalar:
    """Return the lower of two levels, of which -1 is none."""
    return jnp.where((a < 0) | (b < 0), jnp.maximum(a, b), jnp.minimum(a, b))


def _window(
    plan: Any, history: History, s: Scalar, where: tuple[Scalar, Scalar, Scalar], slack: Any
) -> tuple[Window, Scalars, Scalar, Scalar, Scalar]:
    """Return the pieces of one delay from a place on up to the next jump; the starts of all; the
    end of the longest step; the next image of a jump and its level, or infinite."""
    (delay, place, start), size = where, plan.memory.pieces
    passed = stop_gradient(s - delay) + slack
    width = history.rows.shape[1]
    number = jnp.mod(stop_gradient(history.head - place), size)
    starts, keys, pieces, known = [start], [-jnp.inf], [], [start]
    closed = jnp.zeros_like(start, bool)
    image, level, reach = jnp.full_like(start, jnp.inf), -jnp.ones_like(start), s + delay
    for n in range(_WINDOW + 1):  # of the last, only the start is used
        exists = n < number
        at = stop_gradient(place) + n
        at = jnp.where(at < size, at, at - size).astype(jnp.int32)
        row = jax.lax.dynamic_slice(history.rows, (at, jnp.zeros_like(at)), (1, width))[0]
        if n < _WINDOW:
            pieces.append(row[_HEAD:].reshape(8, -1))
        if n == 0:
            continue
        start = start + row[0]
        known.append(jnp.where(exists, start, jnp.inf))
        ahead = stop_gradient(start) > passed
        its_level = stop_gradient(row[1])
        jumps = exists & ~closed & ahead & (its_level >= 0)
        image = jnp.where(jumps, start + (row[1] - its_level) + delay, image)
        level = jnp.where(jumps, its_level, level)
        ends = jumps | (exists & ~closed if n == _WINDOW else jumps)
        reach = jnp.where(ends, start + delay, reach)
        closed = closed | jumps
        if n == _WINDOW:
            break
        used = exists & ~closed
        key = jnp.where(ahead, stop_gradient(start), -jnp.inf)
        starts.append(start)
        keys.append(jnp.where(used, key, jnp.inf))
    # A jump where the step begins, of which the piece is not written yet.
    jumps = (number <= _WINDOW) & ~closed & (stop_gradient(history.level) >= 0)
    image = jnp.where(jumps, s + history.slip + delay, image)
    level = jnp.where(jumps, history.level, level)
    reach = jnp.where(jumps, s + delay, reach)
    window = Window(delay, tuple(starts), tuple(keys), tuple(pieces), plan.unit)
    return window, tuple(known), reach, image, level


def end_of_step(
    plan: Any, lane: Any, free: Flag, h: Scalar, bound: Scalar
) -> tuple[Scalar, Scalar, Flag]:
    """Return length and end of an ordinary step, which ends at the next image of a jump and with
    the pieces that it reads; and whether it may end at `bound` instead."""
    view = plan.view
    h = jnp.where(free, jnp.minimum(h, stop_gradient(view.reach - lane.s)), h)
    left = stop_gradient(view.image - lane.s)
    meets = free & (left <= h * (1 + 1e-6))
    end = jnp.where(meets, jnp.where(meets, view.image, 0.0), lane.s + h)
    return h, end, free & (stop_gradient(bound) <= stop_gradient(view.image) + view.slack)


def new_piece(
    plan: Any, lane: Any, smooth: SmoothMachine, s1: Scalar, state: State, h: Scalar
) -> Array:
    """Return the polynomial of what a step records, (8, numbers) by power of the share of it."""

    def values(s: Scalar, state: State) -> tuple[Vector, ...]:
        return (recorded_numbers(smooth.machine, plan.memory.form, s, state, smooth.modes),)

    for _ in range(3):
        values = functools.partial(_with_rate, values, smooth)
    length = jnp.where(stop_gradient(h) > 0, h, 1.0)
    return hermite(values(lane.s, lane.state), values(s1, state), length)


def _with_rate(function: Any, smooth: SmoothMachine, s: Scalar, state: State) -> tuple:
    along = jnp.ones_like(s), smooth.field(s, state)
    values, rates = jax.jvp(function, (s, state), along)
    return (*values, rates[-1])


# The last four coefficients of a piece from what the first four leave at its end.
_POWERS = np.array([[1, 1, 1, 1], [4, 5, 6, 7], [6, 10, 15, 21], [4, 10, 20, 35]])
_LAST = np.round(np.linalg.inv(_POWERS))


def hermite(begin: Any, end: Any, h: Scalar) -> Array:
    """Return the polynomial of degree 7 through values and three derivatives at both ends of a
    step, by power of the share of the step: (8, numbers)."""
    first, last = (
        [x * (h**n / factor) for n, (x, factor) in enumerate(zip(y, (1, 1, 2, 6), strict=True))]
        for y in (begin, end)
    )
    a, b, c, d = first
    left = [
        last[0] - (a + b + c + d),
        last[1] - (b + 2 * c + 3 * d),
        last[2] - (c + 3 * d),
        last[3] - d,
    ]
    more = [sum(float(w) * x for w, x in zip(row, left, strict=True)) for row in _LAST]
    return jnp.stack([*first, *more])


def _in_time(piece: Array, h: Scalar, unit: Scalar | float) -> Vector:
    """Return the coefficients of a piece of length h by power of the time, in this unit."""
    return (piece * (unit / h) ** np.arange(8)[:, None]).ravel()


def piece_error(plan: Any, piece: Array, h: Scalar) -> Scalar:
    """Return the largest error of a piece of length h relative to the tolerance, for an adaptive
    method; 0 for one that is too short to be kept.

    Of the polynomial by powers about the middle of the step, which decrease like those of the
    motion, the next pair of coefficients is extrapolated from the last two pairs."""
    piece = stop_gradient(piece)
    about = [sum(w * piece[n] for n, w in enumerate(row) if w) for row in _CENTERED]
    earlier = jnp.maximum(jnp.abs(about[4]), jnp.abs(about[5]))
    later = jnp.maximum(jnp.abs(about[6]), jnp.abs(about[7]))
    error = later * jnp.minimum(1.0, later / jnp.where(earlier > 0, earlier, 1.0))
    size = jnp.maximum(jnp.abs(piece[0]), jnp.abs(jnp.sum(piece, axis=0)))
    rtol, atol, _ = plan.method.tolerances(error[0])
    error = _SHARE * jnp.max(error / (atol * plan.memory.sizes + rtol * size))
    return jnp.where(stop_gradient(h) > plan.view.slack, error, 0.0)


# Powers of θ = (1 + σ)/2 by powers of σ.
_CENTERED = np.array(
    [[math.comb(n, k) / 2.0**n if k <= n else 0.0 for n in range(8)] for k in range(8)]
)

# The share of the tolerance for the error of a piece is the inverse of this: a choice.
_SHARE = 1.0


def extended(
    plan: Any, history: History, step: tuple[Any, Any, Flag], arrived: Any, s: Scalar, jumps: Flag
) -> History:
    """Return the history after a step, and whether its ring is full. `step` is the lane before it,
    the trial, and whether it was taken; `s` is the clock after it, which begins anew with a cycle;
    `jumps`: an event happened there, so that the motion is not smooth."""
    (old, trial, taken), view, size = step, plan.view, plan.memory.pieces
    kept = taken & (stop_gradient(trial.h) > view.slack)
    head = jnp.stack([old.s - history.newest, history.level + history.slip])
    length = jnp.where(kept, trial.h, plan.unit)
    row = jnp.concatenate([head, _in_time(trial.piece, length, plan.unit)])[None]
    # The place is that of no piece in use. The piece counts if it is kept.
    place = stop_gradient(history.head).astype(jnp.int32)
    rows = jax.lax.dynamic_update_slice(history.rows, row, (place, jnp.zeros_like(place)))
    met = taken & (jnp.abs(stop_gradient(trial.s - view.image)) <= view.slack)
    level = jnp.where(met & (view.level + 1 < plan.memory.form.levels), view.level + 1, -1.0)
    level = jnp.where(taken & jumps, 0.0, level)
    slip = jnp.where(taken & jumps, arrived.slip, 0.0)
    waits = ~kept & (history.level >= 0) & ~(taken & jumps)
    shift, end = arrived.s - s, stop_gradient(arrived.s)
    places, starts = [], []
    delays = delays_in(without_past(plan.machine)).values()
    for delay, place, known in zip(delays, history.places, view.known, strict=True):
        start, steps = known[0], jnp.zeros_like(s)
        for x in known[1:]:
            begun = taken & (stop_gradient(x) <= end - stop_gradient(delay) + view.slack)
            start, steps = jnp.where(begun, x, start), steps + jnp.where(begun, 1.0, 0.0)
        places.append(jnp.mod(place + steps, size))
        starts.append(start - shift)
    return History(
        rows=rows,
        head=jnp.mod(history.head + jnp.where(kept, 1.0, 0.0), size),
        newest=jnp.where(kept, old.s, history.newest) - shift,
        level=stop_gradient(jnp.where(waits, history.level, level)),
        slip=jnp.where(waits, history.slip, slip),
        places=tuple(places),
        starts=tuple(starts),
        unit=history.unit,
    )


def is_full(plan: Any, history: History) -> Flag:
    """Return whether the next piece would replace one that is still read."""
    used = [jnp.mod(history.head - x, plan.memory.pieces) for x in history.places]
    return functools.reduce(jnp.maximum, used) >= plan.memory.pieces - 1
