"""The guards of a machine's events at the ends and the stages of a step.

The error of a step is that of its state. It does not include guards that are other functions of the
state and of `s`: the force that holds a body at rest, the pull on a body that sticks, the distance
from a curved stop, a threshold that moves. These guards are evaluated at the stages as well. The
error of their integral over the step is added, and `aim.crests` finds where they may be positive.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from ..._types import Flag, Scalar, Scalars, State
from ...lanes import pin_flag
from ...machine import (
    AbstractEvent,
    AbstractMachine,
    RigidStop,
    clock_of,
    events_of,
    guard_of,
    limited_in,
    section_number,
    shared_loads,
    sides_of,
    size_of,
    stops_of,
)
from ..lane import Lane, any_of, select, to_event
from ..methods import Stage
from ..plan import Plan
from ..sizes import guard_rounding
from ..smooth import SmoothMachine, is_affine, is_number_of, stops_are_exact
from .roots import Field, Rates, guard_rates, landing, rate_of_position, rates

# Places in a step of a motion known in advance where guards are evaluated, as shares of it.
SHARES = tuple(n / 8 for n in range(1, 8))

# One of several stages closer together than this share of a step is used. A choice.
_MIN_DISTANCE = 0.08


class InnerGuards(NamedTuple):
    """Guards at the stages of a step; each array has a value for each stage."""

    forces: dict[int, Array]
    """For each coordinate: at rest, the force that pulls the body away from its stop, negative
    while it is pressed on; if it is free and slow, its velocity, positive after a turn; else -1."""
    events: dict[int, tuple[Array, ...]]
    """For each event, the values of each side of its guard (see `AbstractEvent.sides`)."""
    slow: dict[int, Flag]
    """For each coordinate, true if it is so slow, and so close to a stop, that it may turn twice
    within the step and touch the stop in between."""
    slack: dict[int, Scalar]
    """Bounds of the rounding errors of the forces."""
    error: Scalar | None = None
    """The largest error of the forces, relative to the tolerance."""

    def only(self, places: list[int]) -> "InnerGuards":
        kept = self.forces, self.events
        forces, events = jtu.tree_map(lambda x: x[np.asarray(places)], kept)
        return self._replace(forces=forces, events=events)


def checks_within_step(plan: Plan, state: State) -> bool:
    """Return whether some guards have to be evaluated at stages; known at trace time."""
    return plan.rests or bool(events_within_step(plan, state))


def events_within_step(plan: Plan, state: State) -> list[int]:
    """Return the numbers of the events whose guards are evaluated at stages: not those of stops on
    coordinates that are as accurate as the state."""
    machine, events, stops = plan.machine, events_of(plan.machine), []
    if not stops_are_exact(machine, state):
        known = [is_affine(x.position, state) for x in machine.coordinates]
        stops = [i for i, stop in enumerate(stops_of(machine)) if not known[stop.coordinate]]
    others = [number for number in plan.others(state) if events[number].checked_within_step]
    return [*stops, *others]


def guards_error(
    plan: Plan, lane: Lane, inner: InnerGuards, stages: list[Stage], h: Scalar, longest: Scalar
) -> Scalar | None:
    """Return the largest error of the guards at the stages of a step, relative to the tolerance;
    `None` without guards, or for a method without an estimate."""
    events, errors = events_of(plan.machine), [inner.error]
    for number, sides in inner.events.items():
        event, acts = events[number], events[number].holds_mode
        is_stop = isinstance(event, RigidStop)
        extent = plan.extent(event.coordinate) if is_stop else plan.guard_extent(number, lane)
        size = plan.in_units(extent)
        errors += [
            plan.method.guard_error(stages, x, h, longest, acts=acts, size=size) for x in sides
        ]
    known = [error for error in errors if error is not None]
    return functools.reduce(jnp.maximum, known) if known else None


def separate_stages(stages: list[Stage]) -> list[Stage]:
    found: list[Stage] = []
    for stage in sorted(stages, key=lambda x: x.share):
        if 0 < stage.share < 1 and (not found or stage.share - found[-1].share >= _MIN_DISTANCE):
            found.append(stage)
    return found


def inner_guards(
    plan: Plan, lane: Lane, free_machines: tuple[SmoothMachine, ...],
    ends: list[tuple[Rates, Rates]], stages: list[Stage], at: Callable[[Scalar], State],
    h: Scalar, longest: Scalar,
) -> InnerGuards:  # fmt: skip
    """Return the guards at the stages of a step; `ends` are each coordinate's rates at both ends,
    and `at(share)` is the state at stages without one."""
    if not stages:
        return InnerGuards({}, {}, {}, {})
    machine, arguments = plan.machine, (lane.modes, lane.contact or ())
    limited = limited_in(machine) if plan.rests else []
    contacts: Any = lane.contact
    checked = events_within_step(plan, lane.state)

    slow = {k: jnp.zeros((), bool) for k in limited}
    if not plan.method.resolves(machine):
        slow = {k: _is_slow(plan, lane, k, stop_gradient(ends[k]), h) for k in limited}
        if len(limited) > 1:
            slow = {k: x & (contacts[k] == 0) for k, x in slow.items()}

    def pulls(s: Scalar, state: State) -> dict[int, Scalar]:
        found = {}
        for k in limited:
            field, body = free_machines[k].field, machine.coordinates[k]
            backward = -lane.direction[k] * rate_of_position(field, body, s, state)
            free = jnp.where(slow[k], backward, -1.0)

            def force(_: Scalar, k: int = k, field: Field = field, body: Any = body) -> Scalar:
                return plan.away(k, contacts[k]) * rates(field, body, s, state).a

            found[k] = jax.lax.cond(contacts[k] > 0, force, lambda x: x, free)
        return found

    def guards(s: Scalar, state: State) -> dict[int, tuple[Scalar, ...]]:
        found, loads = {}, shared_loads(machine, s, state, *arguments)
        for number in checked:
            if number < len(stops_of(machine)):
                found[number] = (_distance(machine, lane, number, state),)
            else:
                found[number] = sides_of(machine, number, s, state, *arguments, loads)
        return found

    has_states = stages[0].state is not None
    places = [(x.s, x.state if has_states else jnp.asarray(x.share, h.dtype)) for x in stages]
    places = jtu.tree_map(lambda *x: jnp.stack(x), *stop_gradient(places))

    def at_places(function: Callable[..., Any]) -> Callable[[tuple], Any]:
        at_share = function if has_states else lambda s, share: function(s, at(share))
        return functools.partial(for_each, at_share)

    events = at_places(guards)(places) if checked else {}
    if not limited:
        return InnerGuards({}, events, slow, {})

    def of_forces(places: tuple) -> tuple[dict[int, Array], Scalar, dict[int, Scalar]]:
        forces, error, slack = at_places(pulls)(places), jnp.zeros_like(h), {}
        for k, x in forces.items():
            size = plan.extent(k) / plan.unit  # the integral of a force is a velocity
            force_error = plan.method.guard_error(stages, x, h, longest, acts=True, size=size)
            error = error if force_error is None else jnp.maximum(error, force_error)
            slack[k] = 64 * float(jnp.finfo(h.dtype).eps) * jnp.max(jnp.abs(x))
        return forces, error, slack

    def of_none(_: tuple) -> tuple[dict[int, Array], Scalar, dict[int, Scalar]]:
        nothing = jnp.full(len(stages), -1.0, lane.s.dtype)
        zero = jnp.zeros_like(h)
        return dict.fromkeys(limited, nothing), zero, dict.fromkeys(limited, zero)

    any_force = any_of(slow[limited[0]], ((contacts[k] > 0) | slow[k] for k in limited))
    forces, error, slack = jax.lax.cond(any_force, of_forces, of_none, places)
    return InnerGuards(forces, events, slow, slack, error)


def for_each(function: Callable[..., Any], given: tuple) -> Any:
    """Return the values of a function, as constants, for each row of its arguments, stacked along
    the first axis. A CPU runs a loop, which compiles the function once. On a GPU each pass of a
    loop starts kernels, and `vmap` took 0.7 of its time (H200, 100,000 lanes)."""
    if jax.default_backend() != "cpu":
        return jax.vmap(lambda x: stop_gradient(function(*x)))(given)
    return jax.lax.scan(lambda c, x: (c, stop_gradient(function(*x))), None, given)[1]


def may_be_above(
    begin: Sequence[Scalar], end: Sequence[Scalar], inner: Array, shares: Sequence[float],
    zero: Scalar | float,
) -> Flag:  # fmt: skip
    """Return whether a function may exceed `zero` within a step, by a quick test of value and slope
    at both ends, and of its values at stages.

    The top of a parabola between two places exceeds both by at most an eighth of its fall to the
    next place; a half of that fall is allowed here. If the function falls at the start of the step,
    or rises at its end, it has no top there. Nor has it one in the middle of four falls in a row,
    or of four rises.
    """
    (x0, v0), (x1, v1) = begin, end
    values = jnp.concatenate([x0[None], inner[np.argsort(shares)], x1[None]])
    rises = values[1:] - values[:-1]
    halves = 0.5 * jnp.abs(rises)
    slopes = jnp.concatenate([v0[None], rises, v1[None]])
    fours = [slice(n, slopes.size - 3 + n) for n in range(4)]
    falling, rising = slopes <= 0, slopes >= 0
    one_way = functools.reduce(operator.and_, (falling[x] for x in fours))
    one_way = one_way | functools.reduce(operator.and_, (rising[x] for x in fours))
    top = values[1:-1] + jnp.maximum(halves[1:], halves[:-1]) > zero
    within = jnp.any(top & ~one_way)
    return within | (v0 > 0) & (x0 + halves[0] > zero) | (v1 < 0) & (x1 + halves[-1] > zero)


# A force of one sign at both ends of a step may change it in between if in the middle it is less
# than 0.75 of their mean: a choice. Parabolas that do are below a half of it.
_SAG = 0.75 / 2


def may_turn_between(
    plan: Plan, lane: Lane, k: int, ends: tuple[Rates, Rates], h: Scalar
) -> Flag:  # fmt: skip
    """Return whether a body may turn twice within a step, by a quick test: the force goes from
    against its motion to along it, or sags while the body is slow. If only impacts matter, the body
    also has to get to a stop in this time."""
    begin, end = ends
    total, greater = begin.a + end.a, jnp.maximum(jnp.abs(begin.a), jnp.abs(end.a))
    slow = jnp.minimum(jnp.abs(begin.v), jnp.abs(end.v)) <= greater * h
    # The force in the middle, by the quintic through the ends, times h.
    middle = 1.5 * (end.v - begin.v) - 0.25 * h * total
    sags = (begin.a * end.a >= 0) & (middle * total <= _SAG * h * total * total)
    near = plan.meets_turns(lane.done)
    for stop in (x for x in stops_of(plan.machine) if x.coordinate == k):
        near = near | _reaches(stop, begin, h) | _reaches(stop, end, h)
    dips = (lane.direction[k] * begin.a < 0) & (lane.direction[k] * end.a > 0)
    return dips | slow & sags & near


def _is_slow(plan: Plan, lane: Lane, k: int, ends: tuple[Rates, Rates], h: Scalar) -> Flag:
    """Return whether a body may turn twice within a step and touch a stop in between, like one that
    has just left it: it is slow at the start of the step, moves the same way at the end, and at
    both could get to the stop in this time."""
    begin, end = ends
    slow = (jnp.abs(begin.v) <= jnp.abs(begin.a) * h) & (lane.direction[k] * end.v >= 0)
    if not stops_are_exact(plan.machine, lane.state):  # bodies that fall together do not turn
        eps = float(jnp.finfo(h.dtype).eps)
        slow = slow & (jnp.abs(begin.a) * h * h > eps * (plan.extent(k) + jnp.abs(begin.x)))
    stops = [stop for stop in stops_of(plan.machine) if stop.coordinate == k]
    return slow & any_of(slow, (_reaches(x, begin, h) & _reaches(x, end, h) for x in stops))


def _reaches(stop: RigidStop, here: Rates, h: Scalar) -> Flag:
    """Return whether a body may get to a stop within ±h, with this acceleration."""
    return -stop.beyond(here.x) <= (jnp.abs(here.v) + 0.5 * jnp.abs(here.a) * h) * h


def _distance(machine: AbstractMachine, lane: Lane, number: int, state: State) -> Scalar:
    """Return the distance of a coordinate beyond one of its stops; -1 at rest."""
    stop = stops_of(machine)[number]
    beyond = stop.beyond(machine.coordinates[stop.coordinate].position(state))
    if lane.contact is None:
        return beyond
    return jnp.where(lane.contact[stop.coordinate] != 0, -1.0, beyond)


# Newton's method on a smooth flow needs two or three attempts. If rounding prevents more accuracy,
# a lane with this many attempts (a choice) accepts a multiple of the tolerance (`_patient`).
_PATIENCE = 12.0

# A lane has failed after this many attempts without landing, by when a place is bisected to
# rounding. The last eight accept rounding near an equilibrium. Choices.
MOST_ATTEMPTS = 64.0

# The place of a jump within a step is bisected to this length (in s): a choice.
_SUDDEN = 1e-12


class Side(NamedTuple):
    """A smooth function at the ends of a step and at its stages."""

    begin: Rates
    end: Rates
    within: Array
    """The value at each stage."""
    slack: Scalar | float = 0.0
    """Values up to this count as zero."""
    is_used: Flag | None = None
    """True if the function is used; else it is a constant below zero. `None`: always used."""


class Crossing(NamedTuple):
    """An event g = 0 in a step: g at both ends, and how a step aimed at it landed."""

    event: AbstractEvent
    number: int
    """Its index among the machine's events."""
    begin: Rates
    end: Rates
    scale: Scalar
    """The size of g, for its rounding."""
    coordinate: int | None = None
    """The coordinate that a stop limits."""
    slack: Scalar | None = None
    """A step may be beyond the event by this rounding; `None` if positions on it are exact."""
    zero: Scalar | None = None
    """Values up to this count as zero at the start of the step, if the guard falls; `None` for an
    event that need not come from below."""
    above: Flag | None = None
    """True if the guard has jumped above zero at the start of the step, for example with the clock
    of a new cycle; `None` for a stop."""
    offset: Any = None
    """δ from the step's end to the event."""
    landed: Any = None
    near: Any = None
    """The step ended at the event, independent of its target."""
    again: Any = None
    """The step was aimed at the event and has to be corrected by δ."""
    sudden: Any = None
    """True if the event was located by its sign alone, so that δ has no meaning; `None` if none
    can."""
    jumped: Any = None
    """True if the guard jumped above zero there, so that the event's time has no derivative."""
    sides: tuple[Side, ...] = ()
    """The smooth functions whose maximum is g, if they were evaluated at stages."""

    @property
    def at_once(self) -> Flag | None:
        """True if the step begins on the event's surface at rest and about to cross it, or above
        it; `None` if steps begin on it exactly."""
        x, v, a = stop_gradient(self.begin)
        if self.slack is None:
            return None
        here = (jnp.abs(x) <= self.slack) & (v == 0) & (a > 0)
        return here if self.above is None else here | self.above


def crossings(
    plan: Plan, lane: Lane, smooth: SmoothMachine, paths: list[Any], end: tuple,
    ends: tuple[Flag, Flag], inner: InnerGuards,
) -> tuple[tuple[Crossing, ...], Scalars]:  # fmt: skip
    """Return the events in a step, and `Lane.below` at its end. `end` is s there, the step's length
    and the state; `ends` is whether the step was good, and ends an interval."""
    machine, (s1, h, new), (good, last) = plan.machine, end, ends
    others, below = _other_events(plan, lane, smooth, (s1, new), inner)
    stops = at_stops(plan, [(path.begin, path.end) for path in paths])
    guards = [*(_with_stages(lane, c, inner) for c in stops), *others]
    # The stops of one coordinate and a clock coincide only on a section, where a step ends; other
    # events may coincide.
    if plan.others(lane.state) or not stops_are_exact(machine, lane.state):
        eps = float(jnp.finfo(h.dtype).eps)
        guards = [guard._replace(slack=4 * eps * guard.scale) for guard in guards]
        for i, stop in enumerate(stops_of(machine)):
            if not is_number_of(machine.coordinates[stop.coordinate], new):  # its terms may cancel
                slack = plan.rounding_bounds(stop.coordinate, new)[0]
                guards[i] = guards[i]._replace(slack=slack)
        guards = _with_own_rounding(plan, lane, (s1, new), guards)
        guards = [guard if guard.coordinate is not None else _mark_jump(guard) for guard in guards]
    return tuple(_landed(plan, lane, good & last, good, h, each, guards) for each in guards), below


def _with_own_rounding(
    plan: Plan, lane: Lane, at_end: tuple[Scalar, State], guards: list[Crossing]
) -> list[Crossing]:
    """Return the guards with a smaller slack where one ends the step at zero to rounding, but is
    known better: a guard without a slope, such as (x - p)³, whose sign is that of x - p."""
    own = [guard for guard in guards if guard.event.is_plain]
    if not own:
        return guards
    s, state = stop_gradient(at_end)
    sizes = jtu.tree_map(lambda x: jnp.maximum(1.0, jnp.abs(x)), state)
    if plan.sizes is not None:
        sizes = jtu.tree_map(lambda size, x: jnp.maximum(size, jnp.abs(x)), plan.sizes, state)
    arguments, eps = (lane.modes, lane.contact or ()), float(jnp.finfo(s.dtype).eps)

    def of_each(_: None) -> Scalars:
        found = []
        for guard in own:
            value = lambda s, x, i=guard.number: guard_of(plan.machine, i, s, x, *arguments)
            rate = jax.jvp(lambda s, f=value: f(s, state), (s,), (jnp.ones_like(s),))[1]
            size = size_of(lambda x, f=value: f(s, x), state, sizes)
            size = size + jnp.maximum(plan.unit, jnp.abs(s)) * jnp.abs(rate)
            found.append(jnp.where(jnp.isfinite(size), 4 * eps * size, jnp.inf))
        return tuple(found)

    near = jnp.zeros((), bool)
    for guard in own:
        assert guard.slack is not None
        near = near | (jnp.abs(guard.end.x) <= guard.slack)
    far = tuple(jnp.full_like(s, jnp.inf) for _ in own)
    slack = jax.lax.cond(stop_gradient(near), of_each, lambda _: far, None)
    by_number = {guard.number: x for guard, x in zip(own, slack, strict=True)}
    found = []
    for guard in guards:
        assert guard.slack is not None
        least = jnp.minimum(guard.slack, by_number.get(guard.number, jnp.inf))
        found.append(guard if guard.number not in by_number else guard._replace(slack=least))
    return found


def _mark_jump(guard: Crossing) -> Crossing:
    """Set `above` of an event: its guard is above zero at the start of the step, by more than
    `_from_below` takes for zero in a guard that falls."""
    x, eps = stop_gradient(guard.begin.x), float(jnp.finfo(guard.scale.dtype).eps)
    zero = eps**0.5 * guard.scale if guard.zero is None else guard.zero
    return guard._replace(above=x > jump_share(x) * jnp.abs(x) + zero)


def at_stops(plan: Plan, ends: list[tuple[Rates, Rates]]) -> list[Crossing]:
    """Return the stops in a step, from the rates of each coordinate at its start and end."""
    found = []
    for i, stop in enumerate(stops_of(plan.machine)):
        begin, end = (x.scaled(stop.sign, stop.gap) for x in ends[stop.coordinate])
        scale = plan.extent(stop.coordinate) + jnp.abs(stop.gap)
        found.append(Crossing(stop, i, begin, end, scale, stop.coordinate))
    return found


def _with_stages(lane: Lane, c: Crossing, inner: InnerGuards) -> Crossing:
    """Return a stop with its distance at the stages, if evaluated; -1 while its body rests."""
    if c.number not in inner.events:
        return c
    begin, end, (values,) = c.begin, c.end, inner.events[c.number]
    if lane.contact is not None and c.coordinate is not None:
        moves = lane.contact[c.coordinate] == 0
        begin, end = _rates_if_armed(moves, begin), _rates_if_armed(moves, end)
    return c._replace(sides=(Side(begin, end, values),))


def _other_events(
    plan: Plan, lane: Lane, smooth: SmoothMachine, at_end: tuple[Scalar, State], inner: InnerGuards
) -> tuple[list[Crossing], Scalars]:
    """Return the events in a step other than stops, including the end of a cycle by a clock in the
    state; and `Lane.below` at the step's end. `at_end` are s and the state there."""
    machine, found, below = plan.machine, [], []
    numbers, arguments = plan.others(lane.state), (lane.modes, lane.contact or ())
    clocked = clock_of(machine, lane.state) is not None
    if not (numbers or clocked):
        return [], ()

    def guards(s: Scalar, x: State) -> list[list[Scalar]]:
        """Return for each event its guard, or its sides; and the clock relative to its end."""
        loads = shared_loads(machine, s, x, *arguments)
        values = [
            sides_of(machine, i, s, x, *arguments, loads)
            if len(inner.events.get(i, ())) > 1
            else [guard_of(machine, i, s, x, *arguments, loads)]
            for i in numbers
        ]
        if (clock := clock_of(machine, x)) is not None:
            values.append([clock - plan.end(lane.part)])
        return [[jnp.asarray(each) for each in of_one] for of_one in values]

    # All in one call, so that the field along which they change is compiled once.
    begin_rates, end_rates = (
        jax.tree.map(Rates, *guard_rates(smooth.field, guards, *place))
        for place in ((lane.s, lane.state), at_end)
    )
    for place, number in enumerate(numbers):
        event, values = events_of(machine)[number], inner.events.get(number, (jnp.zeros(0),))
        both = zip(begin_rates[place], end_rates[place], strict=True)
        sides = [Side(*x, y) for x, y in zip(both, values, strict=True)]
        scale = plan.guard_extent(number, lane) + plan.in_units(
            stop_gradient(functools.reduce(jnp.maximum, [abs(x.end.v) for x in sides]))
        )
        zero = None
        if event.from_below:
            (side,) = sides
            was_below = lane.below[len(below)]
            zero = _zero_of(plan, was_below, plan.guard_extent(number, lane), side)
            armed, risen = _from_below(was_below, side.begin, side.end, zero)
            begin, end = _rates_if_armed(armed, side.begin), _rates_if_armed(armed, side.end)
            sides = [Side(begin, end, jnp.where(armed, side.within, -1.0))]
            below.append(risen)
        if event.holds_mode:
            sides = [side._replace(begin=_falling(plan, side.begin, scale)) for side in sides]
        begin, end = sides[0].begin, sides[0].end
        for side in sides[1:]:  # the side that is the guard at the step's end
            greater = stop_gradient(side.end.x > end.x)
            begin, end = select(greater, (side.begin, side.end), (begin, end))
        crossing = Crossing(event, number, begin, end, scale, zero=zero)
        found.append(crossing._replace(sides=tuple(sides)) if number in inner.events else crossing)
    if clocked:
        number, (begin,), (end,) = section_number(machine), begin_rates[-1], end_rates[-1]
        section = events_of(machine)[number]
        found.append(Crossing(section, number, begin, end, plan.end(lane.part)))
    return found, tuple(below)


def _falling(plan: Plan, begin: Rates, scale: Scalar) -> Rates:
    """Return the rates of a guard at the start of a step, without a rise by rounding. After an
    event the guard and its slope may both be zero, as the velocity of a body that begins to slip;
    its second derivative then makes it fall."""
    x, v, a = stop_gradient(begin)
    near = jnp.abs(x) <= 4 * float(jnp.finfo(x.dtype).eps) * scale
    risen = near & (v > 0) & (2 * v <= -plan.in_units(landing_tolerance(x)) * a)
    return begin._replace(v=jnp.where(risen, 0.0, begin.v))


def _zero_of(plan: Plan, below: Scalar, extent: Scalar | float, side: Side) -> Scalar:
    """Return the distance from zero up to which a guard of this extent counts as zero: the rounding
    of its evaluation, and what the location of an event leaves. At the start of a motion it is what
    a search for an orbit leaves, in units of the guard's change: no cycle is this short."""
    begin, end = stop_gradient((side.begin, side.end))
    near, left = landing_tolerance(begin.x), furthest_landing(begin.x)
    rate = plan.in_units(jnp.maximum(jnp.abs(begin.v), jnp.abs(end.v)))
    bend = plan.in_units(plan.in_units(jnp.maximum(jnp.abs(begin.a), jnp.abs(end.a))))
    change = jnp.where(below < 0, near * (rate + bend), left * left * bend)
    return guard_rounding(extent + jnp.abs(begin.x)) + change


def _from_below(below: Scalar, begin: Rates, end: Rates, rounding: Scalar) -> tuple[Flag, Scalar]:
    """Return whether a guard that must have been negative counts now, and `Lane.below` at the
    step's end. A guard that begins at zero and falls counts."""
    here = stop_gradient(begin)
    falls = (here.x <= rounding) & (here.v < 0)
    # If the motion began on the surface, a falling guard may be rounding alone.
    deep = here.v * here.v > 2 * rounding * jnp.maximum(here.a, 0.0)
    falls = falls & ((below == 0) | deep)
    armed = (below > 0) | (here.x < -rounding) | falls
    return armed, jnp.where(armed | (stop_gradient(end.x) < -rounding), 1.0, below)


def _rates_if_armed(armed: Flag, r: Rates) -> Rates:
    """Return the rates of a guard that counts; else those of a constant -1."""
    return Rates(jnp.where(armed, r.x, -1.0), *(jnp.where(armed, x, 0.0) for x in (r.v, r.a)))


def beyond(event: Crossing) -> Flag:
    """Return whether a step ends beyond an event. It does not if it begins there, to rounding, and
    the guard falls at both ends: it may end at once, at a turning point. Nor does it if it stays
    there to rounding, like bodies that touch at rest."""
    begin, end = event.begin, event.end
    if event.slack is None:
        return end.x > 0
    ends = (end.x > event.slack) & ~((begin.v < 0) & (end.v < 0) & (begin.x >= end.x))
    return ends if event.above is None else ends | event.above


def _landed(
    plan: Plan, lane: Lane, ends: Flag, good: Flag, h: Scalar, guard: Crossing,
    guards: list[Crossing],
) -> Crossing:  # fmt: skip
    """Return the event with the result of a step aimed at it: landed, or to be aimed again. A step
    that ends an interval (`ends`) and meets a stop there, to rounding, counts as aimed at it. An
    impact on the section always belongs to the cycle that ends there."""
    end = guard.end
    aimed = good & (lane.target == to_event(guard.number))
    eps = float(jnp.finfo(h.dtype).eps)
    for other in guards:
        if other.number == guard.number:
            continue
        # A point beyond another event was not reached. Events may coincide, except for the stops of
        # one coordinate: then one is met after the other.
        same_coordinate = guard.coordinate is not None and guard.coordinate == other.coordinate
        if same_coordinate or other.slack is None:
            aimed = aimed & ~beyond(other)
        else:
            reached = (other.end.x <= 4 * other.slack) | ~beyond(other)
            if guard.above is not None:  # then the first listed comes first
                reached = reached | guard.above
            aimed, ends = aimed & reached, ends & reached
    offset, square = landing(end)
    size = stop_gradient(jnp.abs(offset))
    # Two tests of being on the event to rounding: along the path, or, near grazing, in position.
    close = size <= landing_tolerance(h) * tolerance_factor(plan, lane)
    slack = 4 * eps * guard.scale if guard.slack is None else guard.slack
    on_event = (jnp.abs(end.x) <= slack) & (end.v >= 0)
    real = stop_gradient(square) > 0
    # On the event a parabola may have no root: a body that is at rest on a surface.
    near = close & real | on_event
    landed = pin_flag(aimed & near, h)
    again = aimed & ~landed & real & (size < 0.25 * h)
    # When bodies touch at rest, their remaining speed is rounding.
    rises = end.v > 0 if guard.slack is None else end.v * lane.length > guard.slack
    again = again | ends & on_event & close & rises
    sudden, jumped = None, None
    if guard.above is not None:
        # A guard without a slope is followed further, to the clock's rounding.
        jumped = stop_gradient(end.x) > jump_share(h) * guard.scale
        shortest = 4 * eps * (plan.unit + jnp.abs(stop_gradient(lane.s)))
        shortest = jnp.where(jumped, jnp.maximum(plan.in_units(_SUDDEN), shortest), shortest)
        # Near an equilibrium on its surface, a guard is rounding and may be zero anywhere.
        last = lane.attempts >= MOST_ATTEMPTS - 8
        is_rounding = last & (jnp.abs(end.x) <= 16 * eps * guard.scale)
        found = (h <= shortest) & beyond(guard) | stop_gradient(is_rounding)
        sudden = pin_flag(aimed & ~near & found, h)
        landed, offset = landed | sudden, jnp.where(sudden, 0.0, offset)
        # If Newton's method does not converge, the place is bisected.
        again = again & ~sudden & (lane.attempts < _PATIENCE)
    jumped = None if sudden is None or jumped is None else sudden & jumped
    return guard._replace(
        offset=offset, landed=landed, again=again, near=near, sudden=sudden, jumped=jumped
    )


def tolerance_factor(plan: Plan, lane: Lane) -> Scalar:
    """Return the factor of a lane's landing tolerance: its unit, and `_patient` after many
    attempts."""
    one = jnp.ones_like(lane.attempts)
    return plan.in_units(jnp.where(lane.attempts >= _PATIENCE, _patient(one), one))


def _patient(x: Scalar) -> float:
    """Return the factor of the landing tolerance after many attempts: in single precision 0.1 would
    be another event."""
    return 1e3 if x.dtype == jnp.float64 else 10.0


def landing_tolerance(x: Scalar) -> float:
    """Return the largest accepted |δ|, the distance in `s` from the step's end to the event. The
    state is extrapolated over it to first order (`extrapolate`): errors are of order δ²."""
    return 1e-9 if x.dtype == jnp.float64 else 1e-4


def furthest_landing(x: Scalar) -> float:
    """Return the largest trusted |δ|: near grazing, or after many attempts."""
    return max(turn_tolerance(x), _patient(x) * landing_tolerance(x))


def jump_share(x: Scalar) -> float:
    """Return the share of its size above which a guard has jumped: rounding leaves less at an
    event. The first is a choice; in single precision it is the rounding of a guard."""
    return max(1e-9, 64 * float(jnp.finfo(x.dtype).eps))


def turn_tolerance(x: Scalar) -> float:
    """Return the largest accepted offset from a turn; the error of its height is cubic in it."""
    return 1e-5 if x.dtype == jnp.float64 else 1e-2
