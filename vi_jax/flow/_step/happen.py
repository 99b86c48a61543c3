"""What an event that is no impact makes of a lane, and what it sets off."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import (
    AbstractEvent,
    AbstractMachine,
    after_event,
    events_of,
    guard_of,
    happens_at,
    mode_number,
    section_number,
    value_of,
)
from .. import results
from .._arrival import Arrival, ended
from .._lane import CHANGES, LEAVES, RESETS, Plan, select, to_event
from .._log import clock_at, logged, noted
from ..events import rates
from ..smooth import beyond_a_stop, holding
from .faults import comes_back
from .guards import JUMPED
from .jump import directions, unheld

# Events of one instant that set each other off for ever happen so often each, by choice, before the
# lane ends.
_ROUNDS = 4


class _Instant(NamedTuple):
    """What happens at one instant, between two of its events."""

    arrival: Arrival
    due: Scalars
    """Of each event that is no impact, 1 while it is still to happen."""
    near: Scalars
    """Of each of those that happen from below, 1 if its guard is at zero too, and it has not
    happened."""


def happened(
    plan: Plan, taken: Flag, arrival: Arrival, due: dict[int, Flag], near: dict[int, Flag]
) -> Arrival:
    """The arrival after those events that are no impacts, and what they set off.

    Of events at one instant the first listed comes first. What a jump does to a guard decides what
    happens next: one that it takes from below zero to above happens, and so does one that was at
    zero as well and is not any more. An event does not set off itself.

    **Arguments:** `taken`, whether the step is taken; of the events by their numbers, which are
    `due`, and which are `near`: their guards are at zero to rounding.
    """
    zero = jnp.zeros_like(arrival.s)
    due_, near_ = (tuple(jnp.where(x, 1.0, zero) for x in y.values()) for y in (due, near))
    begin = _Instant(arrival, due_, near_)
    if len(due) == 1:
        end = _next(plan, taken, tuple(due), begin)
    else:

        def turn(x: _Instant, _: None) -> tuple[_Instant, None]:
            left = sum(x.due, start=zero) > 0
            return jax.lax.cond(
                left, lambda x: _next(plan, taken, tuple(due), x), lambda x: x, x
            ), None

        # Not as many turns as there are to do: that has no transpose.
        end, _ = jax.lax.scan(turn, begin, None, length=_ROUNDS * len(due))
        endless = sum(end.due, start=zero) > 0
        end = end._replace(arrival=ended(end.arrival, endless, endless, results.SIMULTANEOUS))
    return end.arrival


def set_off(
    plan: Plan, arrival: Arrival, when: Flag, before: tuple[State, Scalars],
    turns: dict[int, Flag], near: Scalars,
) -> tuple[Arrival, dict[int, Flag], Scalars]:  # fmt: skip
    """The arrival with those guards to come from below anew (see `Lane.below`) that a jump has put
    on their surface or beyond, and of what happened; which events the jump sets off; and what is
    left of those near.

    **Arguments:** `when`, where state or modes jumped; state and modes `before`; `turns`, of each
    event whether it was its turn; `near`, as in `_Instant`.
    """
    (old, modes), contact, machine = before, arrival.contact or (), plan.machine
    below, nearby, off = [], [], {}
    moving = holding(machine, arrival.modes, arrival.contact)
    along = jnp.ones_like(arrival.s), moving.field(arrival.s, arrival.state)
    numbers = plan.from_below(arrival.state)
    for number, armed, close in zip(numbers, arrival.onward.below, near, strict=True):

        def guard(s: Scalar, state: State, number: int = number) -> Scalar:
            return jnp.asarray(guard_of(machine, number, s, state, arrival.modes, contact))

        was = stop_gradient(guard_of(machine, number, arrival.s, old, modes, contact))
        now, rate = jax.jvp(guard, *stop_gradient(((arrival.s, arrival.state), along)))
        slack = float(jnp.finfo(now.dtype).eps) ** 0.5 * (1 + jnp.abs(now))
        moved, own = jnp.abs(now - was) > slack, turns.get(number, jnp.zeros_like(when))
        rises = when & (was < -slack) & (now > slack)
        if number == section_number(machine):
            rises = jnp.zeros_like(when)  # where a jump passes over the section no cycle ends
        # What is left of its way to zero it goes by itself, if it still does.
        missed = when & (close > 0) & (moved | (rate <= 0))
        off[number] = (rises | missed) & ~own
        nearby.append(jnp.where(own | missed, 0.0, close))
        below.append(jnp.where(own | (when & (now >= -slack) & moved), 0.0, armed))
    return arrival.going(below=tuple(below)), off, tuple(nearby)


def _next(plan: Plan, taken: Flag, numbers: tuple[int, ...], x: _Instant) -> _Instant:
    """The instant after the first listed of the events that are due."""
    machine, arrival, old = plan.machine, x.arrival, x.arrival.state
    modes_before, contact = arrival.modes, arrival.contact or ()
    none = jnp.zeros_like(taken)
    new, modes, any_turn, happens, jumps = old, modes_before, none, none, none
    kind, listed, value, turns = CHANGES, 0.0, jnp.nan, {}
    for number, due in zip(numbers, x.due, strict=True):
        event, met = events_of(machine)[number], (machine, number, arrival.s, old, modes_before)
        turns[number], any_turn = (due > 0) & ~any_turn, any_turn | (due > 0)
        when = happens_at(*met)
        here = turns[number] if when is None else turns[number] & when
        its_state, its_modes = after_event(*met, contact)
        its_modes = select(here, its_modes, modes_before)
        its_number = number - len(machine.stops)
        if event.holds_mode:
            slides = comes_back(machine, number, its_modes, arrival.s, its_state)
            arrival = ended(arrival, turns[number], slides, results.SLIDING)
            its_kind, its_value = CHANGES, its_modes[mode_number(machine, number)]
        else:
            jumps = jumps | here
            its_kind, its_value = RESETS, value_of(*met)
            its_number = its_number - len(machine.switches)
        if event.ends_cycle:
            arrival = arrival._replace(completed=arrival.completed | here)
        arrival = with_outcome(machine, event, arrival, here)
        new, modes = select(here, (its_state, its_modes), (new, modes))
        its_own = its_kind, its_number, its_value
        if len(numbers) > 1:
            its_own = select(here, its_own, (kind, listed, value))
        (kind, listed, value), happens = its_own, happens | here
    clock = clock_at(plan, arrival.s, old)
    events = noted(arrival.tally.events, taken & happens, clock, kind, listed, value)
    arrival = arrival.counting(events=events)
    if plan.log_switches:
        arrival = _listed(plan, arrival, taken & happens, clock, turns)
    arrival = _jumped(plan, arrival, happens, jumps, old, (new, modes))
    arrival = let_go(plan, arrival, taken, happens, (old, modes_before))
    off, near, before = {}, x.near, (old, modes_before)
    if machine.others:
        arrival, off, near = set_off(plan, arrival, happens, before, turns, near)
    due = [jnp.where(turns[n], 0.0, due) for n, due in zip(numbers, x.due, strict=True)]
    for i, number in enumerate(numbers):
        if events_of(machine)[number].holds_mode and len(numbers) > 1:
            off[number] = _turned_over(plan, arrival, happens & ~turns[number], number, before)
        due[i] = jnp.where(off[number], 1.0, due[i]) if number in off else due[i]
    last = off.get(section_number(machine))
    if last is not None:
        arrival = arrival._replace(completed=arrival.completed | last)
    return _Instant(arrival, tuple(due), near)


def with_outcome(
    machine: AbstractMachine, event: AbstractEvent, arrival: Arrival, here: Flag
) -> Arrival:
    """The arrival, its lane ended where an event happened that ends the motion."""
    if not event.ends:
        return arrival
    outcome = results.with_outcome(machine.outcomes.index(event.ends))
    return ended(arrival, here, jnp.ones_like(here), outcome)


def _listed(
    plan: Plan, arrival: Arrival, when: Flag, clock: Scalar, turns: dict[int, Flag]
) -> Arrival:
    """The arrival with an event listed as an impact is, and so counted.

    **Arguments:** `when`, whether it happened; `turns`, of each event whether it was that one.
    """
    zero, before, number = jnp.zeros_like(clock), arrival.tally, jnp.zeros_like(clock)
    for its_number, turn in turns.items():
        number = jnp.where(turn, float(its_number), number)
    log = logged(before.log, when, before.impacts, clock, zero, number)
    return arrival.counting(log=log, impacts=before.impacts + jnp.where(when, 1.0, 0.0))


def _turned_over(
    plan: Plan, arrival: Arrival, when: Flag, number: int, before: tuple[State, Scalars]
) -> Flag:
    """Whether the guard of a switch has jumped above zero, as that of friction does that held a
    pull which is another one now: it has no place where it passes zero.

    **Arguments:** `when`, where state or modes jumped; `number`, the switch's; state and modes
    `before`.
    """
    contact, (old, modes_before) = arrival.contact or (), before
    was = guard_of(plan.machine, number, arrival.s, old, modes_before, contact)
    now = guard_of(plan.machine, number, arrival.s, arrival.state, arrival.modes, contact)
    was, now = stop_gradient((was, now))
    slack = JUMPED * (1 + jnp.abs(now))
    return when & (was <= slack) & (now > slack)


def let_go(
    plan: Plan, arrival: Arrival, taken: Flag, when: Flag,
    before: tuple[State, Scalars], resting: Scalars | None = None,
) -> Arrival:  # fmt: skip
    """With those bodies free that were pressed on their stops before an event, and are pulled away
    behind it: a force that jumps has no place where it passes zero.

    **Arguments:** whether the event happens; state and modes before it; what rested then, if that
    may be another than now (as in `Lane.contact`).
    """
    machine, contact, modes = plan.machine, arrival.contact, arrival.modes
    if contact is None:
        return arrival
    old, modes_before = before
    freed, direction, events = list(contact), list(arrival.direction), arrival.tally.events
    for k in sorted({stop.coordinate for stop in machine.stops}):

        def pressing(modes: Scalars, state: State, k: int = k) -> Scalar:
            free = holding(machine, modes, contact, but=k)
            return rates(free.field, machine.coordinates[k].position, arrival.s, state).a

        sign, _ = plan.wall(k, contact[k])
        pressed, pulled = sign * pressing(modes_before, old), sign * pressing(modes, arrival.state)
        goes = when & (contact[k] > 0) & stop_gradient((pressed >= 0) & (pulled < 0))
        if resting is not None:
            goes = goes & (resting[k] == contact[k])
        clock = clock_at(plan, arrival.s, arrival.state)
        events = noted(events, taken & goes, clock, LEAVES, contact[k] - to_event(0), jnp.nan)
        freed[k] = jnp.where(goes, 0.0, contact[k])
        direction[k] = jnp.where(goes, -sign, direction[k])
    arrival = arrival.going(contact=tuple(freed), direction=tuple(direction))
    return arrival.counting(events=events)


def _jumped(
    plan: Plan, arrival: Arrival, happens: Flag, jumps: Flag, old: State,
    behind: tuple[State, Scalars],
) -> Arrival:  # fmt: skip
    """The arrival behind an event: which way the motion goes on, by the modes that it has then, and
    which bodies still rest. A lane whose body was put beyond a stop ends.

    **Arguments:** whether an event `happens`, and whether one that may move the state, as it
    `jumps`; `old`, the state before; state and modes `behind`.
    """
    new, modes = behind
    arrival = arrival.going(modes=modes)
    if plan.machine.stops and plan.machine.others:
        beyond = beyond_a_stop(plan.machine, new)
        arrival = ended(arrival, jumps, beyond, results.BAD_RESET)
        arrival = arrival.going(contact=unheld(plan, arrival.contact, jumps, old, new))
    # A switch leaves velocities as they are; but of a state without them it changes the rate.
    when = jumps if plan.machine.has_velocity(new) else happens
    if plan.machine.others or when is happens:
        way = directions(plan, arrival.onward, when, old, new, arrival.s)
        arrival = arrival.going(direction=way)
    return arrival._replace(state=new)
