"""What an event that is no impact makes of a lane, what it sets off, and how a motion goes on
behind a state that was put in place of another."""

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
    has_velocity,
    mode_number,
    others_of,
    outcomes_of,
    section_number,
    stops_of,
    switches_of,
    value_of,
)
from .. import results
from .._lane import Lane, Plan, in_place, select, to_event
from ..events import rates
from ..labelled import EventKind
from ..smooth import holding
from .faults import comes_back
from .guards import JUMPED, Crossing

# Events of one instant that set each other off for ever happen so often each, by choice, before the
# lane ends.
_ROUNDS = 4


class _Instant(NamedTuple):
    """What happens at one instant, between two of its events."""

    lane: Lane
    due: Scalars
    """Of each event that is no impact, 1 while it is still to happen."""
    near: Scalars
    """Of each of those that happen from below, 1 if its guard is at zero too, and it has not
    happened."""


def happened(
    plan: Plan, taken: Flag, lane: Lane, due: dict[int, Flag], near: dict[int, Flag]
) -> Lane:
    """The lane after those events that are no impacts, and what they set off.

    Of events at one instant the first listed comes first. What a jump does to a guard decides what
    happens next: one that it takes from below zero to above happens, and so does one that was at
    zero as well and is not any more. An event does not set off itself.

    **Arguments:** `taken`, whether the step is taken; of the events by their numbers, which are
    `due`, and which are `near`: their guards are at zero to rounding.
    """
    zero = jnp.zeros_like(lane.s)
    due_, near_ = (tuple(jnp.where(x, 1.0, zero) for x in y.values()) for y in (due, near))
    begin = _Instant(lane, due_, near_)
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
        return end.lane.ended(endless, endless, "simultaneous")
    return end.lane


def set_off(
    plan: Plan, lane: Lane, when: Flag, before: tuple[State, Scalars],
    turns: dict[int, Flag], near: Scalars,
) -> tuple[Lane, dict[int, Flag], Scalars]:  # fmt: skip
    """The lane with those guards to come from below anew (see `Lane.below`) that a jump has put
    on their surface or beyond, and of what happened; which events the jump sets off; and what is
    left of those near.

    **Arguments:** `when`, where state or modes jumped; state and modes `before`; `turns`, of each
    event whether it was its turn; `near`, as in `_Instant`.
    """
    (old, modes), contact, machine = before, lane.contact or (), plan.machine
    below, nearby, off = [], [], {}
    moving = holding(machine, lane.modes, lane.contact)
    along = jnp.ones_like(lane.s), moving.field(lane.s, lane.state)
    numbers = plan.from_below(lane.state)
    for number, armed, close in zip(numbers, lane.below, near, strict=True):

        def guard(s: Scalar, state: State, number: int = number) -> Scalar:
            return jnp.asarray(guard_of(machine, number, s, state, lane.modes, contact))

        was = stop_gradient(guard_of(machine, number, lane.s, old, modes, contact))
        now, rate = jax.jvp(guard, *stop_gradient(((lane.s, lane.state), along)))
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
    return lane._replace(below=tuple(below)), off, tuple(nearby)


def _next(plan: Plan, taken: Flag, numbers: tuple[int, ...], x: _Instant) -> _Instant:
    """The instant after the first listed of the events that are due."""
    machine, lane, old = plan.machine, x.lane, x.lane.state
    modes_before, contact = lane.modes, lane.contact or ()
    none = jnp.zeros_like(taken)
    new, modes, any_turn, happens, jumps = old, modes_before, none, none, none
    kind, listed, value, turns = EventKind.mode, 0.0, jnp.nan, {}
    for number, due in zip(numbers, x.due, strict=True):
        event, met = events_of(machine)[number], (machine, number, lane.s, old, modes_before)
        turns[number], any_turn = (due > 0) & ~any_turn, any_turn | (due > 0)
        when = happens_at(*met)
        here = turns[number] if when is None else turns[number] & when
        its_state, its_modes = after_event(*met, contact)
        its_modes = select(here, its_modes, modes_before)
        its_number = number - len(stops_of(machine))
        if event.holds_mode:
            slides = comes_back(machine, number, its_modes, lane.s, its_state)
            lane = lane.ended(turns[number], slides, "sliding")
            its_kind, its_value = EventKind.mode, its_modes[mode_number(machine, number)]
        else:
            jumps = jumps | here
            its_kind, its_value = EventKind.reset, value_of(*met)
            its_number = its_number - len(switches_of(machine))
        if event.ends_cycle:
            lane = lane.completing(here)
        lane = with_outcome(machine, event, lane, here)
        new, modes = select(here, (its_state, its_modes), (new, modes))
        its_own = its_kind, its_number, its_value
        if len(numbers) > 1:
            its_own = select(here, its_own, (kind, listed, value))
        (kind, listed, value), happens = its_own, happens | here
    clock = plan.clock(lane.s, old)
    lane = lane.noting(taken & happens, clock, kind, listed, value)
    lane = _jumped(plan, lane._replace(state=new, modes=modes), happens, jumps, old)
    lane = release_pulled(plan, lane, taken, happens, (old, modes_before))
    off, near, before = {}, x.near, (old, modes_before)
    if others_of(machine):
        lane, off, near = set_off(plan, lane, happens, before, turns, near)
    due = [jnp.where(turns[n], 0.0, due) for n, due in zip(numbers, x.due, strict=True)]
    for i, number in enumerate(numbers):
        if events_of(machine)[number].holds_mode and len(numbers) > 1:
            off[number] = _turned_over(plan, lane, happens & ~turns[number], number, before)
        due[i] = jnp.where(off[number], 1.0, due[i]) if number in off else due[i]
    last = off.get(section_number(machine))
    if last is not None:
        lane = lane.completing(last)
    return _Instant(lane, tuple(due), near)


def with_outcome(machine: AbstractMachine, event: AbstractEvent, lane: Lane, here: Flag) -> Lane:
    """The lane, its lane ended where an event happened that ends the motion."""
    if not event.ends:
        return lane
    outcome = results.with_outcome(outcomes_of(machine).index(event.ends))
    return lane.ended(here, jnp.ones_like(here), outcome)


def _turned_over(
    plan: Plan, lane: Lane, when: Flag, number: int, before: tuple[State, Scalars]
) -> Flag:
    """Whether the guard of a switch has jumped above zero, as that of friction does that held a
    pull which is another one now: it has no place where it passes zero.

    **Arguments:** `when`, where state or modes jumped; `number`, the switch's; state and modes
    `before`.
    """
    contact, (old, modes_before) = lane.contact or (), before
    was = guard_of(plan.machine, number, lane.s, old, modes_before, contact)
    now = guard_of(plan.machine, number, lane.s, lane.state, lane.modes, contact)
    was, now = stop_gradient((was, now))
    slack = JUMPED * (1 + jnp.abs(now))
    return when & (was <= slack) & (now > slack)


def release_pulled(
    plan: Plan, lane: Lane, taken: Flag, when: Flag,
    before: tuple[State, Scalars], resting: Scalars | None = None,
) -> Lane:  # fmt: skip
    """With those bodies free that were pressed on their stops before an event, and are pulled away
    behind it: a force that jumps has no place where it passes zero.

    **Arguments:** whether the event happens; state and modes before it; what rested then, if that
    may be another than now (as in `Lane.contact`).
    """
    machine, contact, modes, s = plan.machine, lane.contact, lane.modes, lane.s
    if contact is None:
        return lane
    old, modes_before = before
    freed, direction = list(contact), list(lane.direction)
    for k in sorted({stop.coordinate for stop in stops_of(machine)}):

        def pressing(modes: Scalars, state: State, k: int = k) -> Scalar:
            free = holding(machine, modes, contact, but=k)
            return rates(free.field, machine.coordinates[k].position, s, state).a

        sign, _ = plan.wall(k, contact[k])
        pressed, pulled = sign * pressing(modes_before, old), sign * pressing(modes, lane.state)
        goes = when & (contact[k] > 0) & stop_gradient((pressed >= 0) & (pulled < 0))
        if resting is not None:
            goes = goes & (resting[k] == contact[k])
        clock, stop = plan.clock(lane.s, lane.state), contact[k] - to_event(0)
        lane = lane.noting(taken & goes, clock, EventKind.release, stop, jnp.nan)
        freed[k] = jnp.where(goes, 0.0, contact[k])
        direction[k] = jnp.where(goes, -sign, direction[k])
    return lane._replace(contact=tuple(freed), direction=tuple(direction))


def _jumped(plan: Plan, lane: Lane, happens: Flag, jumps: Flag, old: State) -> Lane:
    """The lane behind an event: which way the motion goes on, by the modes that it has then, and
    which bodies still rest. A lane whose body was put beyond a stop ends.

    **Arguments:** `lane`, with state and modes behind the event; whether an event `happens`, and
    whether one that may move the state, as it `jumps`; `old`, the state before.
    """
    if stops_of(plan.machine) and others_of(plan.machine):
        lane = lane.ended(jumps, plan.beyond_a_stop(lane.state), "bad_reset")
        lane = lane._replace(contact=contacts_after_jump(plan, lane, jumps, old))
    # A switch leaves velocities as they are; but of a state without them it changes the rate.
    when = jumps if has_velocity(plan.machine, lane.state) else happens
    if others_of(plan.machine) or when is happens:
        lane = lane._replace(direction=_directions(plan, lane, when, old))
    return lane


def after_jump(plan: Plan, lane: Lane, when: Flag, old: State) -> Lane:
    """The lane with the directions of all coordinates, and the stops rested on, after its state was
    put in place of another one.

    **Arguments:** `when`, where the state was replaced; `old`, the state before.
    """
    lane = lane._replace(contact=contacts_after_jump(plan, lane, when, old))
    return lane._replace(direction=_directions(plan, lane, when, old))


def contacts_after_jump(plan: Plan, lane: Lane, when: Flag, old: State) -> Scalars | None:
    """The stops rested on after the state was replaced: what was moved rests no longer.

    **Arguments:** as `after_jump`.
    """
    if lane.contact is None:
        return None
    contacts = list(lane.contact)
    for k, coordinate in enumerate(plan.machine.coordinates):
        (place, before), (there, after) = (
            (coordinate.position(x), coordinate.velocity(x)) for x in (old, lane.state)
        )
        if not (there is place and after is before):
            slack, slow = plan.rounding(k, lane.state)
            moved = (jnp.abs(there - place) > slack) | (jnp.abs(after - before) > slow)
            contacts[k] = jnp.where(when & stop_gradient(moved), 0.0, contacts[k])
    return tuple(contacts)


def _directions(plan: Plan, lane: Lane, when: Flag, old: State) -> Scalars:
    """The directions of all coordinates behind an event, in the modes that the lane has then.

    **Arguments:** as `after_jump`.
    """
    found, new = list(lane.direction), lane.state
    smooth = holding(plan.machine, lane.modes, lane.contact)
    for k, coordinate in enumerate(plan.machine.coordinates):
        after, known = coordinate.velocity(new), has_velocity(plan.machine, new)
        if not known or after is not coordinate.velocity(old):
            here = rates(smooth.field, coordinate.position, lane.s, new)
            # The second number of a state without velocities may be anything.
            after = after if known else here.v
            after = stop_gradient(jnp.where(after == 0, here.a, after))
            found[k] = jnp.where(when & (after != 0), jnp.sign(after), found[k])
    return tuple(found)


def disarmed_itself(plan: Plan, lane: Lane, c: Crossing) -> Lane:
    """With the guard of an event that was met to come from below anew."""
    numbers = plan.from_below(lane.state)
    if c.number not in numbers:
        return lane
    i = numbers.index(c.number)
    return lane._replace(below=in_place(lane.below, i, jnp.where(c.landed, 0.0, lane.below[i])))
