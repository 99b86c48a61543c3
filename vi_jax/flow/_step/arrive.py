"""The end of a step: impacts, rest, changes of mode and resets, and the record of the interval."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import (
    AbstractEvent,
    AbstractMachine,
    after_event,
    chosen_stop,
    constant_modes,
    event_of,
    events_of,
    frictions_in,
    guard_of,
    has_contact_friction,
    has_velocity,
    holds_anywhere,
    is_compound,
    limited_in,
    on_held_surfaces,
    others_of,
    outcomes_of,
    pressed_contacts,
    section_number,
    settled_contacts,
    slip_in,
    stops_of,
    stops_on,
    struck_modes,
    switches_of,
)
from ..lane import Lane, any_of, select, to_event, to_turn_of, with_item
from ..plan import Plan
from ..results import EventKind, code_of_outcome
from ..sizes import guard_rounding
from ..smooth import hold_contacts, in_modes, is_affine, stops_are_exact
from .event_derivatives import FlowToEvent
from .guards import Crossing, furthest_landing, jump_share
from .impact import (
    bring_to_rest,
    on_its_stops,
    resolve_impact,
    resolve_impact_sequence,
)
from .roots import Rates, guard_rates, offset_to_turn, rates
from .trial import AppliedStep, Release, Trial

# Each event of one instant may happen this often, by choice, before the lane ends: some trigger
# each other for ever.
_ROUNDS = 4


# Which contacts take over from one that opens is seen this much later (for a cycle of about 2π): a
# choice, so that forces differ from those at the event by more than the share that opens a contact.
_SOON = 1e-6


class _DueEvents(NamedTuple):
    """The state of one instant between two of its events, and the events that are due."""

    lane: Lane
    due: Scalars
    """For each event that is no impact, 1 while it is due, else 0."""
    near: Scalars
    """For each event that happens from below, 1 if its guard is zero and it has not happened."""


def apply_events(
    plan: Plan, taken: Flag, lane: Lane, due: dict[int, Flag], near: dict[int, Flag]
) -> Lane:
    """Return the lane after the events that are no impacts, and after all that they trigger.

    Simultaneous events (`due`) happen in the order of the machine's list. The jumps of guards
    trigger others: an event happens next if its guard jumps from below zero to above, or was zero
    to rounding (`near`) and jumps away from it. No event triggers itself.
    """
    zero = jnp.zeros_like(lane.s)
    due_, near_ = (tuple(jnp.where(x, 1.0, zero) for x in y.values()) for y in (due, near))
    begin = _DueEvents(lane, due_, near_)
    if len(due) == 1:
        end = _apply_next(plan, taken, tuple(due), begin)
    else:

        def apply_next(x: _DueEvents, _: None) -> tuple[_DueEvents, None]:
            any_due = sum(x.due, start=zero) > 0
            return jax.lax.cond(
                any_due, lambda x: _apply_next(plan, taken, tuple(due), x), lambda x: x, x
            ), None

        # The number of iterations is constant, since a loop of varying length has no transpose.
        end, _ = jax.lax.scan(apply_next, begin, None, length=_ROUNDS * len(due))
        endless = sum(end.due, start=zero) > 0
        return end.lane.end_if(endless, endless, "simultaneous")
    return end.lane


def trigger_events(
    plan: Plan, lane: Lane, when: Flag, before: tuple[State, Scalars],
    causes: dict[int, Flag], near: Scalars,
) -> tuple[Lane, dict[int, Flag], Scalars]:  # fmt: skip
    """Return the lane after a jump, the events that the jump triggers, and the remaining `near`. In
    the new `Lane.below`, guards that happened, or that the jump moved to or above zero, are 0."""
    (old, modes), contact, machine = before, lane.contact or (), plan.machine
    below, nearby, triggered = [], [], {}
    held = hold_contacts(machine, lane.modes, lane.contact)
    along = jnp.ones_like(lane.s), held.field(lane.s, lane.state)
    numbers = plan.from_below(lane.state)
    for number, was_below, close in zip(numbers, lane.below, near, strict=True):

        def guard(s: Scalar, state: State, number: int = number) -> Scalar:
            return jnp.asarray(guard_of(machine, number, s, state, lane.modes, contact))

        was = stop_gradient(guard_of(machine, number, lane.s, old, modes, contact))
        now, rate = jax.jvp(guard, *stop_gradient(((lane.s, lane.state), along)))
        slack = guard_rounding(plan.guard_extent(number, lane) + jnp.abs(now))
        moved, caused = jnp.abs(now - was) > slack, causes.get(number, jnp.zeros_like(when))
        rises = when & (was < -slack) & (now > slack)
        if number == section_number(machine):
            rises = jnp.zeros_like(when)  # no cycle ends if a jump passes over the section
        # If its guard did not jump and still rises, a near event happens by itself later.
        missed = when & (close > 0) & (moved | (rate <= 0))
        triggered[number] = (rises | missed) & ~caused
        nearby.append(jnp.where(caused | missed, 0.0, close))
        below.append(jnp.where(caused | (when & (now >= -slack) & moved), 0.0, was_below))
    return lane._replace(below=tuple(below)), triggered, tuple(nearby)


def _apply_next(plan: Plan, taken: Flag, numbers: tuple[int, ...], x: _DueEvents) -> _DueEvents:
    """Return the instant after the first listed of the events that are due."""
    machine, lane, old = plan.machine, x.lane, x.lane.state
    modes_before, contact = lane.modes, lane.contact or ()
    none = jnp.zeros_like(taken)
    new, modes, any_chosen, happens, jumps = old, modes_before, none, none, none
    kind, logged_number, value, chosen = EventKind.mode, 0.0, jnp.nan, {}
    frictions, released = frictions_in(machine), {}
    for number, due in zip(numbers, x.due, strict=True):
        event, part, _ = event_of(machine, number, modes_before, ())
        before = machine, lane.s, old, *modes_before[part]
        chosen[number], any_chosen = (due > 0) & ~any_chosen, any_chosen | (due > 0)
        when = event.happens(*before)
        here = chosen[number] if when is None else chosen[number] & when
        given = machine, number, lane.s, old, modes_before, contact
        its_state, its_modes = after_event(*given, alone=False)
        its_modes = select(here, its_modes, modes_before)
        its_number = number - len(stops_of(machine))
        if event.holds_mode:
            slides = _must_slide(plan, number, lane._replace(state=its_state, modes=its_modes))
            lane = lane.end_if(chosen[number], slides, "sliding")
            its_kind, its_value = EventKind.mode, its_modes[part.start]
            if part.start in frictions:
                released[part.start] = here & (modes_before[part.start] == 0), here
        else:
            jumps = jumps | here
            its_kind, its_value = EventKind.reset, event.value(*before)
            its_number = its_number - len(switches_of(machine))
        if event.ends_cycle:
            lane = lane.complete_interval(here)
        lane = with_outcome(machine, event, lane, here)
        new, modes = select(here, (its_state, its_modes), (new, modes))
        its_entry = its_kind, its_number, its_value
        if len(numbers) > 1:
            its_entry = select(here, its_entry, (kind, logged_number, value))
        (kind, logged_number, value), happens = its_entry, happens | here
    settled, logged = None, happens
    if released:
        given = lane._replace(state=new, modes=modes)
        new, modes, (any_event, kept) = _after_friction(plan, given, released)
        for i, (_, here) in released.items():
            mode, old_mode = slip_in(modes[i]), slip_in(modes_before[i])
            value = jnp.where(here, mode, value)
            # A force that jumps within a step may seem to pass its bound before the jump.
            logged = logged & ~(here & (mode == old_mode))
        only_frictions = len(released) == len(numbers)
        settled = (None if only_frictions else any_event), kept
    clock = plan.clock(lane.s, old)
    lane = lane.log_event(taken & logged, clock, kind, logged_number, value)
    lane = _update_after(plan, lane._replace(state=new, modes=modes), happens, jumps, old)
    lane = release_pulled(plan, lane, taken, happens, (old, modes_before), settled=settled)
    triggered, near, before = {}, x.near, (old, modes_before)
    if others_of(machine):
        lane, triggered, near = trigger_events(plan, lane, happens, before, chosen, near)
    due = [jnp.where(chosen[n], 0.0, due) for n, due in zip(numbers, x.due, strict=True)]
    for i, number in enumerate(numbers):
        if events_of(machine)[number].holds_mode and len(numbers) > 1:
            triggered[number] = _guard_jumped(plan, lane, happens & ~chosen[number], number, before)
        due[i] = jnp.where(triggered[number], 1.0, due[i]) if number in triggered else due[i]
    section = triggered.get(section_number(machine))
    if section is not None:
        lane = lane.complete_interval(section)
    return _DueEvents(lane, tuple(due), near)


def _after_friction(
    plan: Plan, lane: Lane, events: dict[int, tuple[Flag, Flag]]
) -> tuple[State, Scalars, tuple[Flag, Scalars]]:
    """Return state and modes after an event of a friction, and whether one happened and the
    contacts then; without one those of the lane. `events`: for each friction's mode, whether its
    force became too large, and whether its event happened."""
    any_event = any_of(jnp.zeros((), bool), (here for _, here in events.values()))
    released = {i: when for i, (when, _) in events.items()}

    contact = lane.contact or ()

    def settled() -> tuple[State, Scalars, Scalars]:
        # A slip whose event happened is zero now, to the rounding of a surface's speed.
        stopped = {i: jnp.where(here, 0.0, lane.modes[i]) for i, (_, here) in events.items()}
        modes, state = tuple(stopped.get(i, mode) for i, mode in enumerate(lane.modes)), lane.state
        if has_contact_friction(plan.machine):
            # A body that begins to slip has no acceleration yet. The error of steps with which it
            # stuck would count as another slip that vanishes.
            state = on_held_surfaces(plan.machine, lane.s, state, modes, contact)
        modes, kept = settled_contacts(plan.machine, lane.s, state, modes, contact, released)
        return state, constant_modes(modes, lane.s), kept

    old = lane.state, lane.modes, tuple(map(jnp.abs, contact))
    state, modes, kept = jax.lax.cond(any_event, settled, lambda: old)
    return state, modes, (any_event, kept)


def with_outcome(machine: AbstractMachine, event: AbstractEvent, lane: Lane, here: Flag) -> Lane:
    """Return the lane, ended if an event happened that ends the motion."""
    if not event.ends:
        return lane
    outcome = code_of_outcome(outcomes_of(machine).index(event.ends))
    return lane.end_if(here, jnp.ones_like(here), outcome)


def _must_slide(plan: Plan, i: int, lane: Lane) -> Flag | None:
    """Return whether the field behind a switch, event number i, points back at its surface, like
    the field before it: the motion would slide along it. `None` for switches that cannot slide."""
    machine = plan.machine
    if not events_of(machine)[i].may_slide:
        return None
    smooth = in_modes(machine, lane.modes)

    def guard(s: Scalar, state: State) -> Scalar:
        return guard_of(machine, i, s, state, lane.modes)

    here = stop_gradient(guard_rates(smooth.field, guard, lane.s, lane.state))
    speed = plan.in_units(here.v)
    slack = 1e4 * float(jnp.finfo(speed.dtype).eps) * (plan.guard_extent(i, lane) + jnp.abs(speed))
    return (jnp.abs(here.x) <= slack) & (speed > slack)


def _guard_jumped(
    plan: Plan, lane: Lane, when: Flag, number: int, before: tuple[State, Scalars]
) -> Flag:
    """Return whether the guard of a switch has jumped above zero with state or modes, for example
    of friction whose pull has changed. Such a guard does not pass through zero."""
    contact, (old, modes_before) = lane.contact or (), before
    was = guard_of(plan.machine, number, lane.s, old, modes_before, contact)
    now = guard_of(plan.machine, number, lane.s, lane.state, lane.modes, contact)
    was, now = stop_gradient((was, now))
    slack = jump_share(now) * (plan.guard_extent(number, lane) + jnp.abs(now))
    return when & (was <= slack) & (now > slack)


def release_pulled(
    plan: Plan, lane: Lane, taken: Flag, when: Flag,
    before: tuple[State, Scalars], contact_before: Scalars | None = None,
    settled: tuple[Flag | None, Scalars] | None = None,
) -> Lane:  # fmt: skip
    """Return the lane with those bodies free that were pressed on their stops before an event, and
    are pulled away after it: a force that jumps does not pass through zero. **Arguments:**
    `contact_before`, if contacts may have changed; `settled`, whether an event of a friction has
    settled the contacts (`None` if no other event is possible), and these. Asked anew without its
    event, frictions at their bounds would hold a contact that is pressed on."""
    machine, contact, modes, s = plan.machine, lane.contact, lane.modes, lane.s
    if contact is None:
        return lane
    old, modes_before = before
    contacts, direction = list(contact), list(lane.direction)
    together = is_compound(machine)
    any_settled, kept = settled or (None, contact)
    if together and (settled is None or any_settled is not None):
        closed = contact if contact_before is None else _with_touching(plan, lane, contact)
        asked = pressed_contacts(machine, s, lane.state, modes, contact, opened=closed)[1]
        kept = asked if any_settled is None else select(any_settled, kept, asked)
    for k in limited_in(machine):

        def pressing(modes: Scalars, state: State, k: int = k) -> Scalar:
            free = hold_contacts(machine, modes, contact, but=k)
            return rates(free.field, machine.coordinates[k], s, state).a

        sign, _ = plan.sign_and_gap(k, jnp.abs(contact[k]))
        if together:
            leaves = kept[k] == 0
            contacts[k] = jnp.where(when & ~leaves, kept[k], contact[k])
        else:
            pressed, pulled = sign * pressing(modes_before, old), sign * pressing(modes, lane.state)
            leaves = stop_gradient((pressed >= 0) & (pulled < 0))
        leaves = when & (contact[k] != 0) & leaves
        if contact_before is not None:
            leaves = leaves & (jnp.abs(contact_before[k]) == jnp.abs(contact[k]))
        clock, stop = plan.clock(lane.s, lane.state), jnp.abs(contact[k]) - to_event(0)
        lane = lane.log_event(taken & leaves, clock, EventKind.release, stop, jnp.nan)
        contacts[k] = jnp.where(leaves, 0.0, contacts[k])
        direction[k] = jnp.where(leaves, -sign, direction[k])
    return lane._replace(contact=tuple(contacts), direction=tuple(direction))


def _with_touching(plan: Plan, lane: Lane, contact: Scalars) -> Scalars:
    """Return the contacts with those of bodies that touch a stop and move with it, to rounding."""
    found, stops = list(contact), stops_of(plan.machine)
    for k in limited_in(plan.machine):
        body, (slack, slow) = plan.machine.coordinates[k], plan.rounding_bounds(k, lane.state)
        place, still = body.position(lane.state), jnp.abs(body.velocity(lane.state)) <= slow
        near = {i: still & (stops[i].beyond(place) >= -slack) for i in stops_on(plan.machine, k)}
        touching = chosen_stop(plan.machine, k, near, jnp.zeros_like(lane.s))
        found[k] = jnp.where(contact[k] == 0, stop_gradient(touching), contact[k])
    return tuple(found)


def _update_after(plan: Plan, lane: Lane, happens: Flag, jumps: Flag, old: State) -> Lane:
    """Return the lane after an event that `happens` and may change the state if it `jumps`: with
    the directions of motion in its new modes, and the bodies that still rest. A lane with a body
    beyond a stop ends."""
    if stops_of(plan.machine) and others_of(plan.machine):
        # A resting body may be a little beyond its stop, by the error of steps.
        moved = plan.beyond_a_stop(lane.state) & ~plan.beyond_a_stop(old)
        lane = lane.end_if(jumps, moved, "bad_reset")
        lane = lane._replace(contact=contacts_after_jump(plan, lane, jumps, old))
    # A switch does not change velocities; but it changes the rate of a state without velocities.
    when = jumps if has_velocity(plan.machine, lane.state) else happens
    if others_of(plan.machine) or when is happens:
        lane = lane._replace(direction=_directions_after_event(plan, lane, when, old))
    if is_compound(plan.machine) and switches_of(plan.machine):
        # In the new modes a body may go on that was about to turn.
        lane = lane._replace(direction=_along_velocities(plan, lane, happens))
    return lane


def _along_velocities(plan: Plan, lane: Lane, when: Flag) -> Scalars:
    direction = list(lane.direction)
    for k, body in enumerate(plan.machine.coordinates):
        v, (_, slow) = body.velocity(lane.state), plan.rounding_bounds(k, lane.state)
        v, moves = stop_gradient(v), when
        if lane.contact is not None:
            moves = when & (lane.contact[k] == 0)
        direction[k] = jnp.where(moves & (jnp.abs(v) > slow), jnp.sign(v), direction[k])
    return tuple(direction)


def after_jump(plan: Plan, lane: Lane, when: Flag, old: State) -> Lane:
    """Return the lane with the directions of all coordinates and the contacts after its state
    replaced the `old` one, if `when` is true."""
    lane = lane._replace(contact=contacts_after_jump(plan, lane, when, old))
    return lane._replace(direction=_directions_after_event(plan, lane, when, old))


def contacts_after_jump(plan: Plan, lane: Lane, when: Flag, old: State) -> Scalars | None:
    """Return the contacts after the state was replaced: bodies that were moved rest no longer."""
    if lane.contact is None:
        return None
    contacts = list(lane.contact)
    for k, coordinate in enumerate(plan.machine.coordinates):
        (place, before), (moved_to, after) = (
            (coordinate.position(x), coordinate.velocity(x)) for x in (old, lane.state)
        )
        if not (moved_to is place and after is before):
            slack, slow = plan.rounding_bounds(k, lane.state)
            has_moved = (jnp.abs(moved_to - place) > slack) | (jnp.abs(after - before) > slow)
            contacts[k] = jnp.where(when & stop_gradient(has_moved), 0.0, contacts[k])
    return tuple(contacts)


def _directions_after_event(plan: Plan, lane: Lane, when: Flag, old: State) -> Scalars:
    found, new = list(lane.direction), lane.state
    smooth = hold_contacts(plan.machine, lane.modes, lane.contact)
    for k, coordinate in enumerate(plan.machine.coordinates):
        after, known = coordinate.velocity(new), has_velocity(plan.machine, new)
        if not known or after is not coordinate.velocity(old):
            here = rates(smooth.field, coordinate, lane.s, new)
            # The second number of a state without velocities may be anything.
            after = after if known else here.v
            after = stop_gradient(jnp.where(after == 0, here.a, after))
            found[k] = jnp.where(when & (after != 0), jnp.sign(after), found[k])
    return tuple(found)


def disarm(plan: Plan, lane: Lane, c: Crossing) -> Lane:
    """Return the lane with `below` = 0 for an event that was met."""
    numbers = plan.from_below(lane.state)
    if c.number not in numbers:
        return lane
    i = numbers.index(c.number)
    return lane._replace(below=with_item(lane.below, i, jnp.where(c.landed, 0.0, lane.below[i])))


def arrive(plan: Plan, lane: Lane, trial: Trial, taken: Flag) -> tuple[Lane, Flag]:
    """Return the lane after a step, with its events applied and recorded, and whether the interval
    is complete. If the step is not `taken`, the lane is unchanged."""
    position = plan.machine.position
    arrived = lane._replace(
        s=trial.s, state=trial.state, direction=_directions_at_end(plan, lane, trial),
        below=trial.below, completed=trial.ends_interval,
    ).update_record(integrals=trial.integrals)  # fmt: skip
    # Y at the step's end, and Y before the state jumps there, if an event may change it.
    Y = position(trial.state)
    places = (Y, Y) if others_of(plan.machine) else (Y,)
    flow = FlowToEvent(plan, trial.smooth, lane.part, (trial.s, trial.state, trial.integrals))
    step = AppliedStep(plan, lane, trial, taken, flow)
    if trial.crossings:
        released = [path.near.release.landed for path in trial.paths if path.near is not None]
        met = any_of(taken, [*(c.landed for c in trial.crossings), *released])
        # Rare: skipped if no lane of a group has met anything.
        arrived, places = jax.lax.cond(
            met, lambda x: _land(step, *x), lambda x: x, (arrived, places)
        )
    arrived = arrived.update_record(**_extremes(step, places))
    assert arrived.completed is not None
    completed = taken & arrived.completed
    arrived = lane._replace(
        s=jnp.where(taken, arrived.s, lane.s),
        fault=jnp.where(taken, arrived.fault, lane.fault) if _may_end(plan.machine) else lane.fault,
        record=arrived.record._replace(
            integrals=select(taken, arrived.record.integrals, lane.record.integrals)
        ),
        **{
            name: select(taken, getattr(arrived, name), getattr(lane, name))
            for name in ("state", "direction", "contact", "modes", "below", "slip")
        },
    )
    return arrived, completed


def _may_end(machine: AbstractMachine) -> bool:
    laws = any(not stop.is_one_number for stop in stops_of(machine))
    slides = any(event.may_slide for event in events_of(machine))
    several = bool(stops_of(machine)) and (len(machine.coordinates) > 1 or bool(others_of(machine)))
    chain = len(switches_of(machine)) + len(others_of(machine)) > 1
    return laws or slides or several or chain or bool(outcomes_of(machine))


def _directions_at_end(plan: Plan, lane: Lane, trial: Trial) -> Scalars:
    direction = []
    for k, along in enumerate(lane.direction):
        if trial.paths:
            v = stop_gradient(trial.paths[k].end.v)
            stands = v == 0
            if lane.contact is not None:  # at rest a velocity is the error of the landing
                stands = stands | (lane.contact[k] > 0)
            turned = jnp.where(stands, along, jnp.sign(v))
            # At a turning point the sign of the velocity is rounding.
            away = -along
            if plan.others(lane.state) or len(trial.paths) > 1:
                # If a turning point is also another event, it may have been met before.
                met_before = lane.target != to_turn_of(k)
                away = jnp.where(met_before, stop_gradient(jnp.sign(trial.paths[k].end.a)), away)
            along = jnp.where(trial.paths[k].at_turn, away, turned)
        direction.append(along)
    return tuple(direction)


def _land(step: AppliedStep, lane: Lane, places: Scalars) -> tuple[Lane, Scalars]:
    """Return the lane after the event on which the step landed, and Y there and before a jump. The
    motion first goes on to the event, then comes the jump. Another event at the same instant is met
    by the next step, which has length zero."""
    plan, trial, flow = step.plan, step.trial, step.flow
    landed = {c.number: c.landed for c in trial.crossings}
    before = places[1:]
    if landed:
        offset = jnp.zeros_like(lane.s)
        for c in trial.crossings:
            offset = jnp.where(c.landed, _event_offset(step, c), offset)
        _, at_event, integrals_at_event = flow.extrapolate(offset)
        met = any_of(step.taken, landed.values())
        integrals = select(met, integrals_at_event, lane.record.integrals)
        lane = lane._replace(s=lane.s + jnp.where(met, offset, 0.0))
        lane = lane.update_record(integrals=integrals)
        before = tuple(jnp.where(met, plan.machine.position(at_event), Y) for Y in before)
        lane = _apply_event(step, lane, at_event)
    releases = {k: x.near.release for k, x in enumerate(trial.paths) if x.near is not None}
    if releases:
        lane = _release_bodies(step, lane, releases)
    places = (plan.machine.position(lane.state), *before)
    # At a switch the field may have an infinite slope (Hertz's damper at first touch). Derivatives
    # are finite along with the event, but not at a fixed clock.
    if not plan.s_counts_cycles(lane.state) or switches_of(plan.machine):
        return lane, places
    fixed = _at_fixed_clock(step, lane)
    # No step follows an outcome: its derivatives stay those along with the event.
    return (select(lane.fault > 0, lane, fixed) if outcomes_of(plan.machine) else fixed), places


def _apply_event(step: AppliedStep, lane: Lane, at_event: State) -> Lane:
    """Return the lane after the event on which the step landed, and after all that it triggers;
    `at_event`: the state before it."""
    plan, machine, trial = step.plan, step.plan.machine, step.trial
    landed = {c.number: c.landed for c in trial.crossings}
    near = _near(step)
    triggered: dict[int, Flag] = {}
    if stops_of(machine):
        lane = _apply_impact(step, lane, landed, at_event)
        for number, stop in enumerate(stops_of(machine)):
            if stop.ends_cycle:
                lane = lane.complete_interval(landed[number])
            lane = with_outcome(machine, stop, lane, landed[number])
    if stops_of(machine) and others_of(machine):
        met = any_of(step.taken, (landed[n] for n in range(len(stops_of(machine)))))
        close = tuple(jnp.where(near[n], 1.0, 0.0) for n in near)
        # A stop may have changed the modes already.
        lane, triggered, _ = trigger_events(plan, lane, met, (at_event, step.old.modes), {}, close)
    due = {}
    for c in trial.crossings:
        if c.coordinate is None:
            lane = lane._replace(state=select(c.landed, at_event, lane.state))
            here = c.landed | triggered[c.number] if c.number in triggered else c.landed
            if c.number == section_number(machine):
                lane = disarm(plan, lane.complete_interval(here), c)
            else:
                due[c.number] = here
    return apply_events(plan, step.taken, lane, due, near) if due else lane


def _near(step: AppliedStep) -> dict[int, Flag]:
    """Return for each event that happens from below whether its guard is at zero to rounding at
    another event on which the step landed."""
    plan, trial = step.plan, step.trial
    numbers = plan.from_below(trial.state) if others_of(plan.machine) else []
    found = {}
    eps = float(jnp.finfo(trial.h.dtype).eps)
    for c in trial.crossings:
        if c.number in numbers:
            distance = jnp.full_like(trial.h, jnp.inf)
            for other in trial.crossings:
                if other.number != c.number:
                    distance = jnp.where(other.landed, jnp.abs(c.offset - other.offset), distance)
            slack = 64 * eps * (plan.unit + jnp.abs(trial.s))
            found[c.number] = c.near & (stop_gradient(distance) <= slack)
    return found


def _at_fixed_clock(step: AppliedStep, lane: Lane) -> Lane:
    """Return the lane with its derivatives at a fixed clock. After an event whose time depends on a
    parameter, s has a derivative. It is transferred to the state, so that later steps need no
    derivative with respect to `s`."""
    smooth = hold_contacts(step.plan.machine, lane.modes, lane.contact)
    bound = step.plan.end(lane.part)
    # The end of the interval may depend on a differentiated parameter.
    shift = jnp.where(step.trial.ends_interval, bound - stop_gradient(bound), 0.0)
    s = stop_gradient(lane.s) + shift
    moving = lane.s, lane.state, lane.record.integrals
    flow = FlowToEvent(step.plan, smooth, lane.part, moving)
    _, state, integrals = flow.with_flow_derivatives(s - lane.s)
    slip = None if lane.slip is None else lane.slip + (lane.s - s)
    return lane._replace(s=s, state=state, slip=slip).update_record(integrals=integrals)


def _release_bodies(step: AppliedStep, lane: Lane, releases: dict[int, Release]) -> Lane:
    """Return the lane after the bodies' releases on which the step landed."""
    plan, before = step.plan, lane.contact
    for k, release in releases.items():
        lane = _at_release(step, lane, k, release)
    contact = lane.contact
    assert contact is not None and before is not None
    if len(releases) > 1:  # a spare contact may take over
        moving = lane.s, lane.state, lane.record.integrals
        later = plan.in_units(_SOON + jnp.zeros_like(lane.s))
        s, soon, _ = step.flow.extrapolate(stop_gradient(later), moving)
        modes, kept, _ = pressed_contacts(plan.machine, s, soon, lane.modes, contact, opened=before)
        # Contacts that open next have releases of their own.
        pairs = zip(kept, contact, strict=True)
        kept = tuple(jnp.where(x == 0, jnp.abs(old), x) for x, old in pairs)
        new, old = (constant_modes(modes, lane.s), kept), (lane.modes, contact)
        met = any_of(step.taken, (x.landed for x in releases.values()))
        modes, contact = select(met, new, old)
        lane = lane._replace(modes=modes, contact=contact)
    direction, clock = list(lane.direction), plan.clock(lane.s, lane.state)
    for k, release in releases.items():
        free, stop = release.landed, before[k] - to_event(0)
        free = free & (contact[k] == 0) if len(releases) > 1 else free
        direction[k] = jnp.where(free, -step.old.direction[k], direction[k])
        lane = lane.log_event(step.taken & free, clock, EventKind.release, stop, jnp.nan)
    return lane._replace(direction=tuple(direction))


def _at_release(step: AppliedStep, lane: Lane, k: int, release: Release) -> Lane:
    """Return the lane at the release of coordinate number k."""
    plan, flow, contact = step.plan, step.flow, lane.contact
    assert contact is not None
    free, offset = release.landed, stop_gradient(release.offset)
    slip = plan.jump_at_start(step.old.s)[1]
    later = flow.event_offset(flow.force(k), offset, lost=release.lost)
    offset = jnp.where(release.at_start, offset + slip, later)
    moving = lane.s, lane.state, lane.record.integrals
    _, state, integrals = flow.extrapolate(offset, moving)
    if not stops_are_exact(plan.machine, state):
        on_stops = on_its_stops(plan, lane.s, state, contact)
        if not is_affine(plan.machine.coordinates[k].position, state):
            on_stops = _just_inside(plan, k, contact[k], on_stops)
        state = select(contact[k] > 0, on_stops, state)
    lane = lane.update_record(integrals=select(free, integrals, lane.record.integrals))
    return lane._replace(
        s=lane.s + jnp.where(free, offset, 0.0),
        state=select(free, state, lane.state),
        contact=with_item(contact, k, jnp.where(free, 0.0, contact[k])),
    )


def _just_inside(plan: Plan, k: int, contact: Scalar, state: State) -> State:
    """Return the state with coordinate number k within its gap and moving inward, by rounding: a
    curved gap that is evaluated within steps would else show an impact at once."""
    slack, slow = plan.rounding_bounds(k, state)
    sign, gap = plan.sign_and_gap(k, contact)
    return plan.machine.coordinates[k].placed(state, sign * (gap - slack), -sign * slow)


def _event_offset(step: AppliedStep, c: Crossing) -> Scalar:
    """Return the offset in s from the step's end to an event, with the derivatives of the event's
    time; its value is 0 if the step landed on another event."""
    plan, trial, flow = step.plan, step.trial, step.flow
    # If the motion is so flat that the event's place is uncertain, the event is here.
    near = c.landed & (jnp.abs(c.offset) <= plan.in_units(furthest_landing(trial.h)))
    offset = stop_gradient(jnp.where(near, c.offset, 0.0))
    if plan.s_counts_cycles(trial.state):
        # An event on the section is not beyond it.
        beyond = trial.s + offset - plan.end(step.old.part)
        offset = offset - jnp.maximum(stop_gradient(beyond), 0.0)
    # These derivatives have no meaning if the event was not met.
    if c.above is None or c.jumped is None:
        return flow.event_offset(flow.guard(c.number), offset, c.landed)
    # A guard that has jumped where the step begins is met at that instant.
    known, slip = plan.jump_at_start(step.old.s)
    at_start = c.landed & c.above
    lost = c.jumped & ~at_start | at_start & ~known
    later = flow.event_offset(flow.guard(c.number), offset, c.landed & ~at_start, lost)
    return jnp.where(at_start & known, offset + slip, later)


def _apply_impact(step: AppliedStep, lane: Lane, landed: dict[int, Flag], at_event: State) -> Lane:
    """Return the lane after the rebound from the stops in `landed`, or at rest on them; `at_event`:
    the state before the impact."""
    plan, machine, before = step.plan, step.plan.machine, step.old
    landed = {number: landed[number] for number in range(len(stops_of(machine)))}
    resolve = resolve_impact_sequence if is_compound(machine) else resolve_impact
    lane, impacts = resolve(plan, step.taken, lane, landed, at_event)
    met = any_of(step.taken, landed.values())
    jump = lane.s, lane.state  # a rest comes later, by the time of its last impacts
    lane = bring_to_rest(step, lane, at_event, met, impacts)
    # Coordinates may share a body with one that was hit.
    shared = is_compound(machine) or len(machine.coordinates) > 1
    direction = list(_along_velocities(plan, lane, met) if shared else lane.direction)
    for k in range(len(machine.coordinates)):
        if k in impacts:  # any remaining approach is rounding
            sign, _ = plan.sign_and_gap(k, impacts[k].contact)
            away = -sign
            if lane.contact is not None:
                away = jnp.where(lane.contact[k] > 0, sign, away)
            direction[k] = jnp.where(impacts[k].contact > 0, away, direction[k])
            if lane.contact is not None and len(impacts) > 1:  # it may rest without an impact
                toward, _ = plan.sign_and_gap(k, lane.contact[k])
                rests = met & (lane.contact[k] > 0)
                direction[k] = jnp.where(rests, toward, direction[k])
    modes, contact = lane.modes, lane.contact or ()
    if modes and not is_compound(machine):
        for number, here in landed.items():
            given = machine, lane.s, at_event, lane.state, modes, jump
            modes = select(here, stops_of(machine)[number].modes_after(*given), modes)
    if modes and (is_compound(machine) or (contact and holds_anywhere(machine))):
        # The force that friction has to hold depends on the bodies that rest now.
        released, asked = None, met
        if contact:
            # What friction leaves of a force may press a body on its stop by rounding only. If the
            # friction held the body instead, nothing would ever release it.
            rests = any_of(met, (x > 0 for x in contact))
            released = {i: rests & (jnp.abs(modes[i]) >= 1) for i in frictions_in(machine)}
            if not is_compound(machine):  # else the next guards show what begins to slip
                asked = met & (rests | _slips_change(machine, lane.s, at_event, lane.state))

        def struck(modes: Scalars) -> Scalars:
            return struck_modes(
                machine, lane.s, lane.state, modes, contact=contact, before=at_event,
                released=released, jump=jump,
            )  # fmt: skip

        modes = jax.lax.cond(asked, struck, lambda modes: modes, modes)
    lane = lane._replace(direction=tuple(direction), modes=modes)
    if lane.contact is None or len(impacts) == 1:
        return lane
    rested = () if lane.record.events is None else before.contact or ()
    for k in limited_in(machine) if rested else ():  # an impact on another stop lifts a body
        old, clock = jnp.abs(rested[k]), plan.clock(lane.s, lane.state)
        lifted = step.taken & met & (old != 0) & (contact[k] == 0)
        lane = lane.log_event(lifted, clock, EventKind.release, old - to_event(0), jnp.nan)
    # It may release bodies on other stops. A stop may have changed the modes already.
    return release_pulled(plan, lane, step.taken, met, (at_event, before.modes), before.contact)


def _slips_change(machine: AbstractMachine, s: Scalar, before: State, after: State) -> Flag:
    """Return whether an impact changes the slip of a friction at all."""
    frictions = [switches_of(machine)[i] for i in frictions_in(machine)]
    pairs = ([x.speed_of_slip(machine, s, state) for state in (before, after)] for x in frictions)
    return stop_gradient(any_of(jnp.zeros((), bool), (old != new for old, new in pairs)))


def _extremes(step: AppliedStep, places: Scalars) -> dict[str, Any]:
    """Return the extremes of Y in this interval so far, and the smallest distances to stops at
    turning points; `None` if not recorded. `places` are Y at the step's end and before a jump."""
    plan, lane, trial, taken = step.plan, step.old, step.trial, step.taken
    record = lane.record
    y_max, y_min, clearance = record.y_max, record.y_min, record.clearance
    if y_max is None or y_min is None or not trial.paths:
        return {"y_max": y_max, "y_min": y_min, "clearance": clearance}
    tops = [_height_at_turn(trial, k, step.flow) for k in range(len(trial.paths))]
    end_position = jnp.where(trial.paths[0].at_turn, tops[0], places[0])
    if clearance is not None:
        for stop in stops_of(plan.machine):
            k = stop.coordinate
            path = trial.paths[k]
            turns_short = taken & path.at_turn & (lane.direction[k] == stop.sign)
            # Friction reverses the direction where a body turns, so that it may seem to turn twice.
            turns_short = turns_short & (stop.sign * path.end.a <= 0)
            if lane.contact is not None:
                turns_short = turns_short & (lane.contact[k] == 0)
            distance = jnp.where(turns_short, -stop.beyond(tops[k]), jnp.inf)
            i = limited_in(plan.machine).index(k)
            clearance = with_item(clearance, i, jnp.minimum(clearance[i], distance))
    for place in (*places[1:], end_position):
        y_max = jnp.where(taken, jnp.maximum(y_max, place), y_max)
        y_min = jnp.where(taken, jnp.minimum(y_min, place), y_min)
    return {"y_max": y_max, "y_min": y_min, "clearance": clearance}


def _height_at_turn(trial: Trial, k: int, flow: FlowToEvent) -> Scalar:
    """Return the position of coordinate number k at the turning point that was the step's target;
    else at the step's end."""
    path = trial.paths[k]
    end: Rates = stop_gradient(path.end)
    bend = jnp.where(end.a == 0, 1.0, end.a)
    height = end.x - jnp.where(path.at_turn, 0.5 * end.v**2 / bend, 0.0)
    return flow.height_of_turn(k, height, path.at_turn, offset_to_turn(end))
