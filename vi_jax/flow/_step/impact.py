"""The impacts of one instant: one impact on a stop, or a sequence between bodies that touch; and
the transition of a body to rest on a stop.

If a force presses the body on, small impacts follow each other ever faster. Their speeds are a
geometric series in k, and end in rest (chatter) after the time Σ 2 kⁿ V⁻/a = 2 k V⁻ / (a (1 - k)).
The series is completed at once when its remaining time is short.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from ..._types import Flag, Scalar, Scalars, State
from ...lanes import pin, pin_flag
from ...machine import (
    Impact,
    RigidStop,
    added,
    at_stop,
    chosen_stop,
    contact_constraints,
    forces,
    frictions_in,
    has_contact_friction,
    holds_anywhere,
    impact_on,
    limited_in,
    longest_step,
    on_held_surfaces,
    pressed_contacts,
    push_gains,
    row_of,
    stops_of,
    stops_on,
    strike,
    struck_modes,
    switches_of,
)
from ..lane import Lane, add_entry, any_of, select, to_event, with_item
from ..plan import Plan
from ..results import EventKind
from ..smooth import SmoothMachine, hold_contacts, in_modes, stops_are_exact
from .event_derivatives import FlowToEvent
from .roots import force_rate, force_rounding, rate_of_position, rates
from .trial import AppliedStep

# Number of roundings by which a rebound may be faster than the approach: a choice, a few more than
# the one or two of a law's own arithmetic.
_SPEED_ROUNDINGS = 16.0


class ImpactResult(NamedTuple):
    """The impacts of one instant on one coordinate."""

    contact: Scalar
    """1 + i if stop number i was struck last, 0 if none was."""
    approach: Scalar
    """The greatest speed of approach."""
    share: Scalar
    """The share of that speed that is left."""


def gains_speed(stop: RigidStop, approach: Scalar, rebound: Scalar) -> Flag | None:
    """Return whether an impact leaves faster than it came, or goes on into the stop; `None` if the
    law is one number, whose range is checked."""
    if stop.is_one_number:
        return None
    leaves = stop_gradient(-stop.sign * rebound)
    most = (1 + _SPEED_ROUNDINGS * float(jnp.finfo(leaves.dtype).eps)) * stop_gradient(approach)
    return ~((leaves >= 0) & (leaves <= most))


def log_impact(
    plan: Plan, lane: Lane, at_event: State, hit: Flag, number: int, approach: Scalar,
    impulses: Callable[[], tuple[Any, Any]],
) -> Lane:  # fmt: skip
    """Return the lane with an impact counted and logged, if a stop is `hit` by a step that is
    taken, in the state `at_event`. `impulses()` are those away from the stop and along it."""
    clock, record = plan.clock(lane.s, at_event), lane.record
    speed, log, impacts = record.impact_speed, record.log, record.impacts
    if speed is not None:
        speed = jnp.where(hit, jnp.maximum(speed, approach), speed)
    if log is not None:
        log = add_entry(log, hit, impacts, clock, approach, number, *impulses())
    impacts = impacts + jnp.where(hit, 1.0, 0.0)
    lane = lane.update_record(impact_speed=speed, log=log, impacts=impacts)
    return lane.log_event(hit, clock, EventKind.impact, number, approach)


def resolve_impact(
    plan: Plan, taken: Flag, lane: Lane, landed: dict[int, Flag], at_event: State
) -> tuple[Lane, dict[int, ImpactResult]]:
    """Return the lane after an impact, and its `ImpactResult` by the coordinate's number, if stops
    limit one coordinate and there is no contact friction. `landed`: for each stop, whether the step
    landed on it; `at_event`: the state there."""
    machine, k = plan.machine, stops_of(plan.machine)[0].coordinate
    body = machine.coordinates[k]
    result = ImpactResult(*(jnp.zeros_like(lane.s) for _ in range(3)))
    velocity = body.velocity(at_event)
    for number, met in landed.items():
        stop = stops_of(machine)[number]
        approach = jnp.maximum(stop.approach(velocity), 0.0)
        coefficient = stop.coefficient(approach)
        rebound = stop.velocity_after(stop.sign * approach, coefficient)
        lane = lane.end_if(met, gains_speed(stop, approach, rebound), "bad_impact")
        state = select(met, body.placed(at_event, stop.place, rebound), lane.state)
        is_one = isinstance(body.mass, float) and body.mass == 1.0
        mass = 1.0 if is_one else body.mass_at(lane.s, at_event)
        arguments = at_event, taken & met, number, approach
        impulses = lambda e=coefficient, V=approach, m=mass: ((1 + e) * m * V, 0.0)
        lane = log_impact(plan, lane._replace(state=state), *arguments, impulses)
        energy = lane.record.impact_energy
        if energy is not None:
            lost = stop.loss(approach, coefficient)
            lost = lost if is_one else mass * lost
            lane = lane.update_record(impact_energy=energy + jnp.where(taken & met, lost, 0.0))
        new = ImpactResult(jnp.where(met, to_event(number), 0.0), approach, coefficient)
        result = new if len(landed) == 1 else select(met, new, result)
    return lane, {k: result}


# Shares of the greatest speed of approach so far. Below the first a contact does not close: its
# speed is rounding of earlier impacts. At the second the sequence is replaced by its limit, in
# which those contacts come to rest that were struck and move no faster than `_STILL` times the
# fastest. All three are choices; docs/internals/step.md lists numbers of impacts in known cases.
_NO_SPEED, _WEAK, _STILL = 1e-12, 1e-7, 30.0

# Speeds whose relative difference is smaller are equal: a choice, far above rounding.
_EQUAL = 1e-9

# Contacts that close within this time (for a cycle of about 2π) of an impact close with it: a
# choice, below the accuracy of an event's time. A box that falls flat turned after 5 bounces.
_AT_ONCE = 1e-11

# Contacts that share less than this of each other's velocity are struck separately: a choice.
_UNCOUPLED = 1e-6

# A ball between a wall and a body 100 times heavier is struck 31 times, one of 10,000 times 314 (π
# times the root of the ratio): this is enough for a body 1.7 million times heavier.
_ROUNDS = 4096.0


class _Round(NamedTuple):
    """A sequence of impacts, between two of them; arrays have a number for each stop, then for each
    stop with friction, as in `machine.settle`."""

    lane: Lane
    velocity: Array
    impulse: Array
    """The sum of all impulses so far."""
    lost: Scalar
    """The energy lost so far."""
    struck: Array
    """For each stop, the number of the round in which it was struck last, or 0."""
    approach: Array
    """For each stop, its greatest speed of approach."""
    fastest: Scalar
    goes_on: Scalar
    retry: Scalar
    """1 if the impacts of a group had no solution: it is resolved without restitution."""
    rounds: Scalar


class _Instant(NamedTuple):
    """The data of an instant before its impacts; they stay the same in all of them."""

    plan: Plan
    taken: Flag
    met: Flag
    """True if the step landed on any stop."""
    impact: Impact
    landed: Array
    touches: Array
    """For each stop, true if its contact is closed."""
    coupled: Array
    """For each stop, true if an impact acts on it, through closed contacts."""
    slow: Array
    """Bounds of the rounding errors of the velocities."""


def resolve_impact_sequence(
    plan: Plan, taken: Flag, lane: Lane, landed: dict[int, Flag], at_event: State
) -> tuple[Lane, dict[int, ImpactResult]]:
    """Return the results of `resolve_impact` for stops on several coordinates or with friction.

    If bodies touch, an impact on one contact closes the next one at the same instant. The contact
    that closes fastest is struck first; contacts that close equally fast are struck together, which
    preserves symmetry; then the next, until none closes. A sequence that gets weaker without an end
    (several balls without restitution) is replaced by its limit: the contacts that are still being
    struck come to rest against each other.
    """
    machine, stops = plan.machine, stops_of(plan.machine)
    if lane.contact is not None and not stops_are_exact(machine, at_event):
        struck = [chosen_stop(machine, k, landed, x) for k, x in enumerate(lane.contact)]
        at_event = on_its_stops(plan, lane.s, at_event, tuple(struck), moves=True)
    instant = _before_impacts(plan, taken, lane, landed, at_event)
    zero, n = jnp.zeros_like(lane.s), len(stops)
    # A contact without any speed, as between bodies released together, may come to rest.
    struck = jnp.where(instant.landed, 0.5, zero)
    velocity = instant.impact.strike.velocity
    begin = _Round(
        lane, velocity, 0 * velocity, zero, struck, 0 * velocity[:n], zero,
        jnp.where(instant.met, 1.0, zero), zero, zero,
    )  # fmt: skip
    end = jax.lax.while_loop(
        lambda x: (x.goes_on > 0) & (x.rounds < _ROUNDS), lambda x: _next_impacts(instant, x), begin
    )
    lane = end.lane.end_if(instant.met, end.rounds >= _ROUNDS, "simultaneous")
    lane = lane.end_if(instant.met, end.retry > 1, "jammed")
    energy = lane.record.impact_energy
    if energy is not None:
        lost = jnp.where(taken & instant.met, end.lost, 0.0)
        lane = lane.update_record(impact_energy=energy + lost)
    state = select(instant.met, instant.impact.after(end.impulse), lane.state)
    results = {}
    for k in limited_in(machine):
        body, contact, fastest, latest = machine.coordinates[k], zero, zero, zero
        for i, stop in enumerate(stops):
            if stop.coordinate == k:
                last = end.struck[i] > latest
                moved = body.placed(state, stop.place, -stop.sign * end.velocity[i])
                state = select(last, moved, state)
                contact = jnp.where(last, to_event(i), contact)
                latest, fastest = (
                    jnp.maximum(latest, end.struck[i]),
                    jnp.maximum(fastest, end.approach[i]),
                )
        leaves = -plan.sign_and_gap(k, contact)[0] * body.velocity(state)
        share = leaves / jnp.where(fastest > 0, fastest, 1.0)
        results[k] = ImpactResult(contact, fastest, jnp.clip(share, 0.0, 1.0))
    return lane._replace(state=state), results


def _before_impacts(
    plan: Plan, taken: Flag, lane: Lane, landed: dict[int, Flag], at_event: State
) -> _Instant:
    machine, s, stops = plan.machine, lane.s, stops_of(plan.machine)
    impact = impact_on(machine, range(len(stops)), s, at_event)
    touches, slow = [], []
    for number, stop in enumerate(stops):
        k = stop.coordinate
        depth = stop_gradient(stop.beyond(machine.coordinates[k].position(at_event)))
        speed = jnp.abs(stop_gradient(machine.coordinates[k].velocity(at_event)))
        size = plan.extent(k) + jnp.abs(stop_gradient(stop.gap))
        near = 256 * float(jnp.finfo(depth.dtype).eps) * size + plan.in_units(_AT_ONCE) * speed
        closed = landed[number] | (jnp.abs(depth) <= near)
        if lane.contact is not None:
            closed = closed | (lane.contact[k] == to_event(number))
        touches.append(closed)
        slow.append(plan.rounding_bounds(k, at_event)[1] + jnp.zeros_like(s))
    landed_, touches = jnp.stack(list(landed.values())), jnp.stack(touches)
    coupled = _coupled(_acting(impact.strike.gains, impact.of), touches, landed_)
    return _Instant(
        plan, taken, jnp.any(landed_), impact, landed_, touches, coupled, jnp.stack(slow)
    )


def _acting(gains: Array, of: tuple[int, ...]) -> Array:
    """Return for each pair of stops whether impacts change each other's velocity, also by friction.
    Products of both changes, relative to their own, do not depend on units."""
    n = gains.shape[0] - len(of)
    own = jnp.sum(gains * np.eye(len(gains)), 1)
    both = jnp.abs(gains * gains.T) / (own[:, None] * own)
    acts = both[:n, :n]
    for row, stop in enumerate(of, start=n):
        here = np.arange(n) == stop
        dragged = jnp.where(here[:, None], both[row, :n], 0.0)
        acts = acts + dragged + dragged.T
    return stop_gradient(acts) > _UNCOUPLED**2


def _coupled(acts: Array, touches: Array, landed: Array) -> Array:
    """Return for each stop whether an impact on one of those `landed` acts on it through closed
    contacts."""
    coupled = landed
    for _ in range(acts.shape[0] - 1):
        coupled = coupled | touches & jnp.any(acts & coupled, 1)
    return coupled


def _next_impacts(instant: _Instant, sequence: _Round) -> _Round:
    """Return the sequence after its next impacts: those of the contacts that close fastest."""
    plan, lane, V = instant.plan, sequence.lane, sequence.velocity
    stops = stops_of(plan.machine)
    n = len(stops)
    closing = _closing(instant, sequence)
    fastest = stop_gradient(jnp.max(closing))
    most = jnp.maximum(sequence.fastest, fastest)
    goes_on = fastest > _NO_SPEED * most
    weak, retry = goes_on & (fastest <= _WEAK * most), sequence.retry > 0
    hits = goes_on & ~weak & (stop_gradient(closing) >= (1 - _EQUAL) * fastest)
    speed = jnp.where(hits, closing, 0.0)
    after_law = [stop.velocity_after(stop.sign * speed[i]) for i, stop in enumerate(stops)]
    rebounds = jnp.stack([-stop.sign * V for stop, V in zip(stops, after_law, strict=True)])
    share = jnp.where(weak | retry, 0.0, rebounds / jnp.where(speed > 0, speed, 1.0))
    # In the limit the contacts that are still being struck come to rest.
    slow = (sequence.struck > 0) | (closing > 0)
    slow = slow & (jnp.abs(stop_gradient(V[:n])) <= _STILL * fastest)
    group = jnp.where(retry, instant.touches, jnp.where(weak, slow, hits))
    tangential = jnp.where(weak | retry, 0.0, instant.impact.strike.tangential)
    blow = strike(
        instant.impact.strike._replace(
            velocity=V, restitution=share, tangential=tangential, struck=group
        ), instant.impact.of,
    )  # fmt: skip
    impulse = jnp.where(goes_on & ~blow.unsolved, blow.impulse, 0.0)
    after = V + instant.impact.strike.gains @ impulse
    # A struck contact leaves as its law says, without the rounding of the gains.
    alone = jnp.sum(jnp.where(group, 1.0, 0.0)) == 1
    exact = alone & hits & (blow.share == 1) & ~blow.unsolved
    after = after.at[:n].set(jnp.where(exact, share * speed, after[:n]))
    lost = sequence.lost - jnp.dot(impulse, 0.5 * (V + after))
    acted = goes_on & ~blow.unsolved
    total = sequence.impulse + impulse
    new = instant.impact.after(total) if any(x.modes is not None for x in stops) else None
    for i, stop in enumerate(stops):
        hit = hits[i] & acted
        lane = lane.end_if(hit, gains_speed(stop, speed[i], after_law[i]), "bad_impact")
        arguments = instant.impact.before, instant.taken & hit, i, speed[i]
        row = n + instant.impact.of.index(i) if i in instant.impact.of else None
        drag = 0.0 if row is None else blow.impulse[row]
        impulses = lambda i=i, drag=drag: (blow.impulse[i], drag)
        lane = log_impact(plan, lane, *arguments, impulses)
        if stop.modes is not None:
            given = plan.machine, lane.s, instant.impact.after(sequence.impulse), new, lane.modes
            lane = lane._replace(modes=select(hit, stop.modes_after(*given), lane.modes))
    reduced = lane.record.reduced
    if reduced is not None:
        count = jnp.sum(jnp.where(hits & acted & (blow.share < 1), 1.0, 0.0))
        lane = lane.update_record(reduced=reduced + jnp.where(instant.taken, count, 0.0))
    return _Round(
        lane, after, total, lost,
        jnp.where(hits & acted, sequence.rounds + 1.0, sequence.struck),
        jnp.where(hits & acted, jnp.maximum(sequence.approach, speed), sequence.approach),
        most,
        jnp.where(goes_on & jnp.where(blow.unsolved, ~retry, ~weak), 1.0, 0.0),
        jnp.where(goes_on & blow.unsolved, sequence.retry + 1.0, 0.0),
        sequence.rounds + 1.0,
    )  # fmt: skip


def _closing(instant: _Instant, x: _Round) -> Array:
    """Return for each stop the speed of approach, if it may be hit next; else a negative number.
    Impacts that coincide without acting on each other are two instants for derivatives. Therefore
    only contacts take part that an impact changed, or that act on those of `landed`."""
    n = instant.landed.shape[0]
    speed, before = -x.velocity[:n], -instant.impact.strike.velocity[:n]
    size = stop_gradient(speed)
    changed = jnp.abs(stop_gradient(speed - before)) > _NO_SPEED * x.fastest
    acts = instant.landed | ((changed | instant.coupled) & (size > instant.slow))
    return jnp.where(acts & instant.touches & (size > 0), speed, -1.0)


# Longest remaining chatter that is completed, as a share of the longest step, in double and in
# single precision. Choices: the error is of second order, 6e-11 of that step in double.
_BRIEF, _BRIEF_SINGLE = 8e-6, 8e-3

# A series of hops that is longer than so many times `_BRIEF` under the force before an impact is no
# brief one under the force at rest: a choice. A later impact is slower if it is.
_SURELY_LONGER = 30.0

# Hops no higher than this number of roundings of the motion's size cannot be resolved: choices. Two
# corners of a sliding block that strike in turn lost 2 % of the height in each round. At 66
# roundings they went on for ever.
_FLAT, _FLAT_IN_TURN = 16.0, 256.0

# A contact is nearly closed at this share of the motion's size: a choice, above the height of hops
# that take a brief time.
_NEAR = 1e-6

# A contact whose bodies separate with less than this share of their speed of approach stays closed
# while the forces on it are computed: a choice, far above rounding.
_CLOSED = 1e-9


def bring_to_rest(
    step: AppliedStep, lane: Lane, at_event: State, met: Flag, impacts: dict[int, ImpactResult]
) -> Lane:
    """Return the lane at rest on those stops whose impacts were the last ones. `lane` is after the
    impacts, `at_event` the state before them, `met` whether there were any."""
    if lane.contact is None:
        return lane
    plan, free = step.plan, step.trial.free_machines
    if len(impacts) > 1:
        lane = lane._replace(contact=_remaining_contacts(plan, lane, at_event, met, impacts))
    # At the event, not at the step's end: its derivatives include the event's time.
    speeds, slow = {}, jnp.zeros((), bool)
    for k, impact in impacts.items():
        sign, gap = plan.sign_and_gap(k, impact.contact)
        rate = rate_of_position(free[k].field, plan.machine.coordinates[k], lane.s, at_event)
        speeds[k] = impact.share * jnp.maximum(sign * rate, 0.0)
        size = stop_gradient(plan.extent(k) + jnp.abs(gap))
        force = jnp.abs(stop_gradient(step.trial.paths[k].end.a))
        slow = slow | (impact.contact > 0) & _may_be_last(plan, lane, speeds[k], force, size)

    def rest(lane: Lane) -> Lane:
        if len(impacts) == 1:
            ((k, impact),) = impacts.items()
            arguments = k, impact, speeds[k], lane._replace(state=at_event)
            ends, time = _remaining_chatter(plan, free[k], *arguments)
            rests = {k: pin_flag((impact.contact > 0) & ends, lane.s)}
            return _hold_resting(plan, step.taken, lane, at_event, rests, impacts, {k: time})[0]
        near, distances = _near_contacts(plan, lane, met, impacts)

        def hold(found: tuple[Lane, Scalar, Scalar]) -> tuple[Lane, Scalar, Scalar]:
            rests, times, modes = _resting_bodies(plan, lane, at_event, near, distances, found[1])
            return _hold_resting(plan, step.taken, lane, at_event, rests, near, times, modes)

        # If another body would reach one that rests, only those rest whose impacts are over first.
        begin = lane, lane.s + jnp.inf, jnp.ones_like(lane.s)
        return jax.lax.while_loop(lambda found: found[2] > 0, hold, begin)[0]

    # Rare: skipped if no lane of a group may come to rest.
    return jax.lax.cond(pin_flag(met & slow, lane.s), rest, lambda lane: lane, lane)


def _may_be_last(
    plan: Plan, lane: Lane, speed: Scalar, force: Scalar, size: Scalar | float
) -> Flag:
    """Return whether a rebound may be one of the last ones before rest, by a quick test: its hops
    are over within several times the time of `_remaining_chatter`, under the force before the
    impact or that of a motion of this size. An impact that it misses is followed by a slower one.
    """
    limit, share = _longest_chatter(plan, lane)
    return stop_gradient(speed) * limit <= _SURELY_LONGER * share * (force * limit * limit + size)


def _longest_chatter(plan: Plan, lane: Lane) -> tuple[Scalar, float]:
    """Return the longest step, and the share of it for which a remaining chatter is completed."""
    s = lane.s
    limit = stop_gradient(jnp.asarray(longest_step(plan.machine, s, lane.state), s.dtype))
    return limit, _BRIEF if s.dtype == jnp.float64 else _BRIEF_SINGLE


def _near_contacts(
    plan: Plan, lane: Lane, met: Flag, impacts: dict[int, ImpactResult]
) -> tuple[dict[int, ImpactResult], dict[int, Scalar]]:
    """Return the impacts of an instant with those contacts that are nearly closed, and the distance
    of each coordinate from its stop. Two corners of a body that comes to rest strike in turn, ever
    faster: at each instant one is struck, and the other is a little way off."""
    assert lane.contact is not None
    found, distances = dict(impacts), {}
    for k, impact in impacts.items():
        body, stops = plan.machine.coordinates[k], stops_of(plan.machine)
        place = body.position(lane.state)
        numbers = stops_on(plan.machine, k)
        distance = {i: stop_gradient(-stops[i].beyond(place)) for i in numbers}
        nearest = functools.reduce(jnp.minimum, distance.values())
        closest = {i: x == nearest for i, x in distance.items()}
        contact = chosen_stop(plan.machine, k, closest, jnp.zeros_like(lane.s))
        size = plan.extent(k) + jnp.abs(plan.sign_and_gap(k, contact)[1])
        is_near = met & (impact.contact == 0) & (lane.contact[k] == 0) & (nearest <= _NEAR * size)
        speed = jnp.abs(body.velocity(lane.state))
        at_stop = ImpactResult(contact, speed, jnp.zeros_like(lane.s))
        found[k] = select(is_near, at_stop, impact)
        distances[k] = jnp.where(is_near, jnp.maximum(nearest, 0.0), 0.0)
    return found, distances


def _hold_resting(
    plan: Plan, taken: Flag, lane: Lane, at_event: State, rests: dict[int, Flag],
    impacts: dict[int, ImpactResult], times: dict[int, Scalar], modes: Scalars | None = None,
) -> tuple[Lane, Scalar, Scalar]:  # fmt: skip
    """Return the lane after the infinitely many last impacts, with those bodies held that come to
    rest; the time that these impacts take; and 1 if none is held, since another body would reach
    one before. `at_event` is the state before the impacts; `modes` are those after them, if known.
    For each coordinate: `rests`, whether it comes to rest; `times`, the time until then (in s)."""
    s, state, contact = lane.s, lane.state, lane.contact
    assert contact is not None
    wait = blocked = jnp.zeros_like(s)
    for k, ends in rests.items():
        time = jnp.where(ends, times[k], 0.0)
        wait = time if len(rests) == 1 else jnp.maximum(wait, time)
        contact = with_item(contact, k, jnp.where(ends, impacts[k].contact, contact[k]))
    contacts = {k: impact.contact for k, impact in impacts.items()}
    if modes is None:
        modes = lane.modes
        if has_contact_friction(plan.machine):  # the direction of slip is known after the impact
            modes = struck_modes(plan.machine, s, state, modes, contact=contact, before=at_event)
    if has_contact_friction(plan.machine):
        slowed, rebound_energy = _without_rebounds(plan, s, state, modes, rests, contacts)
        still, lost = stop_bodies(plan, s, slowed, rests, contacts)
        lost = lost + rebound_energy
    else:
        still, lost = stop_bodies(plan, s, state, rests, contacts)
        if holds_anywhere(plan.machine):
            modes = struck_modes(plan.machine, s, still, modes, contact=contact, before=at_event)
            still, modes = _stuck_by_then(plan, s, still, modes, contact, wait)
    resting, integrals = hold_contacts(plan.machine, modes, contact), lane.record.integrals
    flow = FlowToEvent(plan, resting, lane.part, (s, still, integrals))
    # To first order, a body that hops at the same time would gain the height of a whole hop.
    advance = flow.extrapolate if len(rests) == 1 else flow.midpoint_step
    end, still, passed = advance(pin(wait))
    if has_contact_friction(plan.machine):
        # A body that sticks has no slip, not even one of second order in the wait.
        still = on_held_surfaces(plan.machine, end, still, modes, contact)
    if len(rests) > 1:  # another body may reach this one before its impacts are over
        clear = ~plan.beyond_a_stop(still, before=state)
        blocked = jnp.where(any_of(clear, rests.values()) & ~clear, 1.0, blocked)
        rests = {k: ends & clear for k, ends in rests.items()}
        contact = select(clear, contact, lane.contact)
    any_rests = any_of(taken, rests.values())
    s, state, integrals = select(any_rests, (end, still, passed), (s, state, integrals))
    lane = lane._replace(s=s, state=state, contact=contact).update_record(integrals=integrals)
    for k, ends in rests.items():
        here, impact, count = taken & ends, impacts[k], lane.record.rests
        number = impact.contact - 1.0
        lane = lane.log_event(here, plan.clock(s, state), EventKind.rest, number, impact.approach)
        if count is not None:
            lane = lane.update_record(rests=count + jnp.where(here, 1.0, 0.0))
    energy = lane.record.impact_energy
    if energy is not None:
        energy = energy + jnp.where(taken & any_rests, lost, 0.0)
        lane = lane.update_record(impact_energy=energy)
    return lane, wait, blocked


def _stuck_by_then(
    plan: Plan, s: Scalar, state: State, modes: Scalars, contact: Scalars, wait: Scalar
) -> tuple[State, Scalars]:
    """Return state and modes of bodies at rest, without slips that vanish before the last impact: a
    body that slides between impacts comes to rest with them."""
    machine, wait = plan.machine, stop_gradient(wait)
    flow = hold_contacts(machine, modes, contact).field(s, state)
    stuck, any_sticks = list(modes), jnp.zeros((), bool)
    for i, friction in enumerate(switches_of(machine)):
        if friction.is_dry:
            slip = stop_gradient(friction.speed_of_slip(machine, s, state))
            rate = stop_gradient(friction.slip_rate(machine, s, state, flow))
            ends = (jnp.abs(modes[i]) == 1) & (slip * rate < 0)
            ends = ends & (jnp.abs(slip) <= jnp.abs(rate) * wait)
            stuck[i], any_sticks = jnp.where(ends, 0.0, modes[i]), any_sticks | ends

    def stopped(_: None) -> tuple[State, Scalars]:
        still = on_held_surfaces(machine, s, state, tuple(stuck), contact)
        return still, struck_modes(machine, s, still, tuple(stuck), contact=contact, before=still)

    return jax.lax.cond(any_sticks, stopped, lambda _: (state, modes), None)


def _without_rebounds(
    plan: Plan, s: Scalar, state: State, modes: Scalars, rests: dict[int, Flag],
    contacts: dict[int, Scalar],
) -> tuple[State, Scalar]:  # fmt: skip
    """Return the state without the rebounds of bodies that come to rest, and the energy of these.
    The friction impulse of the rebounds is left out too: during the omitted hops friction acts on
    the held body instead. `modes` are those after the impacts."""
    machine, zero = plan.machine, jnp.zeros_like(modes[0])
    contact = [zero for _ in machine.coordinates]
    for k, ends in rests.items():
        contact[k] = jnp.where(ends, contacts[k], zero)
    held = contact_constraints(machine, s, state, modes, contact, with_dry=False)
    bodies = held.coordinates
    before = [body.velocity(state) for body in bodies]
    amounts = held.amounts(state, [-velocity for velocity in before])
    new, lost = added(state, amounts, held.pushes), zero
    for body, amount, V in zip(bodies, amounts, before, strict=True):
        lost = lost - body.mass_at(s, state) * amount * 0.5 * (V + body.velocity(new))
    return new, lost


def on_its_stops(
    plan: Plan, s: Scalar, state: State, contact: Scalars, *, moves: bool = False
) -> State:
    """Return the state with the bodies that rest exactly on their stops, at least one. While they
    are held, their positions are accurate to the method's error only. See `stop_bodies`."""
    codes = {k: contact[k] for k in limited_in(plan.machine)}
    on = {k: x > 0 for k, x in codes.items()}
    return stop_bodies(plan, s, state, on, codes, moves=moves)[0]


def stop_bodies(
    plan: Plan, s: Scalar, state: State, rests: dict[int, Flag], contacts: dict[int, Scalar],
    *, moves: bool = False,
) -> tuple[State, Scalar]:  # fmt: skip
    """Return the state with those coordinates that rest put on their stops (`contacts`, as in
    `Lane.contact`), without velocity, all at once; and the energy lost. If the body `moves`, its
    velocities stay."""
    bodies = {k: plan.machine.coordinates[k] for k in rests}
    velocities = [body.velocity(state) for body in bodies.values()]
    deltas, shifts = [(0.0 if moves else -1.0) * V for V in velocities], []
    for k, body in bodies.items():
        sign, gap = plan.sign_and_gap(k, contacts[k])
        shifts.append(sign * gap - body.position(state))
    if len(rests) > 1:
        coordinates, on = list(bodies.values()), list(rests.values())
        rows = [row_of(body, s, state) for body in coordinates]
        gains = push_gains(coordinates, rows, state, [row.push for row in rows])
        deltas, shifts = forces(gains, on, deltas), forces(gains, on, shifts)
    new, lost = state, jnp.zeros_like(deltas[0])
    for (k, body), change, shift, V in zip(bodies.items(), deltas, shifts, velocities, strict=True):
        place, speed = body.position(new) + shift, body.velocity(new) + change
        if len(rests) == 1:
            sign, gap = plan.sign_and_gap(k, contacts[k])
            place, speed = sign * gap, V if moves else jnp.zeros_like(V)
        moved = body.placed(new, place, speed)
        new = moved if len(rests) == 1 else select(rests[k], moved, new)
        lost = lost - body.mass_at(s, state) * change * 0.5 * V
    return new, lost


def _remaining_chatter(
    plan: Plan, free: SmoothMachine, k: int, impact: ImpactResult, speed: Scalar, lane: Lane,
    distance: Scalar | float = 0.0, least: Scalar | None = None,
) -> tuple[Flag, Scalar]:  # fmt: skip
    """Return whether an impact is one of the endless last ones before rest, and the time they take.
    `speed` is that of the rebound with respect to s; `distance` is that from the stop, if the
    contact is only nearly closed. Forces up to `least` are rounding."""
    s, state, body = lane.s, lane.state, plan.machine.coordinates[k]
    sign, gap = plan.sign_and_gap(k, impact.contact)
    # The force on a body at rest, which has no damping by its velocity.
    at_rest = body.placed(state, jnp.asarray(sign * gap), jnp.zeros_like(s))
    pressing = sign * rates(free.field, body, s, at_rest).a
    growth = sign * force_rate(free, body, free, s, at_rest)
    if least is not None:
        pressing = jnp.where(jnp.abs(pressing) > least, pressing, 0.0)
        growth = jnp.where(jnp.abs(growth) * plan.unit > least, growth, 0.0)
    force = pressing * (1 - impact.share)
    ends = force > 0
    time = jnp.where(ends, 2 * speed / jnp.where(ends, force, 1.0), jnp.inf)
    height = speed**2 / jnp.where(pressing > 0, 2 * pressing, 1.0)
    not_yet, hop, wait = _time_until_pressed(speed, pressing, growth)
    height = jnp.where(not_yet, speed * hop - 0.5 * pressing * hop * hop, height)
    size = plan.extent(k) + jnp.abs(gap)
    time = jnp.where(not_yet, wait, time)
    flat, longest, brief = _longest_wait(plan, lane, height, size)
    ends = stop_gradient(time) <= longest
    ends = ends & (flat | ~not_yet | (hop <= brief))
    ends = ends & (distance <= (0.5 * jnp.maximum(pressing, 0.0) * brief + speed) * brief)
    if plan.s_counts_cycles(lane.state):
        ends = ends & (stop_gradient(s + time) < stop_gradient(plan.end(lane.part)))
    return ends, time


def _longest_wait(
    plan: Plan, lane: Lane, height: Scalar, size: Scalar | float
) -> tuple[Flag, Scalar, Scalar]:
    """Return whether hops of this height, in a motion of this size, are flat; the longest series
    of them that is completed; and the longest one if they are not flat. Hops no higher than
    rounding cannot be resolved, however long they last."""
    limit, share = _longest_chatter(plan, lane)
    roundings = _FLAT if len(lane.contact or ()) == 1 else _FLAT_IN_TURN
    flat = stop_gradient(height) <= roundings * float(jnp.finfo(height.dtype).eps) * size
    brief = share * limit
    return flat, jnp.where(flat, 0.1 * limit, brief), brief


def _time_until_pressed(
    rebound: Scalar, pressing: Scalar, growth: Scalar
) -> tuple[Flag, Scalar, Scalar]:
    """Return whether a body is not pressed on yet but will be, since its force grows; then an upper
    bound of the time of its next hop, and the time until it is pressed on. A hop that begins
    against a force f, growing at the rate j, is over within 3 |f|/j + √(6 v/j)."""
    v, pull, grows = stop_gradient((rebound, -pressing, growth))
    not_yet = (pull >= 0) & (grows > 0)
    rate = jnp.where(not_yet, grows, 1.0)
    wait = jnp.where(not_yet, pull, 0.0) / rate
    return not_yet, 3 * wait + jnp.sqrt(6 * jnp.where(not_yet, v, 0.0) / rate), wait


def _remaining_contacts(
    plan: Plan, lane: Lane, at_event: State, met: Flag, impacts: dict[int, ImpactResult]
) -> Scalars:
    """Return `Lane.contact` without those contacts that the impacts struck or pulled apart;
    `at_event`: the state before them."""
    assert lane.contact is not None
    contact = list(lane.contact)
    for k, impact in impacts.items():
        body = plan.machine.coordinates[k]
        V, old = (stop_gradient(body.velocity(x)) for x in (lane.state, at_event))
        _, slow = plan.rounding_bounds(k, at_event)
        opened = met & ((impact.contact > 0) | (jnp.abs(V - old) > slow))
        contact[k] = jnp.where(opened, 0.0, contact[k])
    return tuple(contact)


def _resting_bodies(
    plan: Plan, lane: Lane, at_event: State, impacts: dict[int, ImpactResult],
    distances: dict[int, Scalar], before: Scalar,
) -> tuple[dict[int, Flag], dict[int, Scalar], Scalars | None]:  # fmt: skip
    """Return for each coordinate that was struck, or is nearly, whether it comes to rest in a
    shorter time than `before`, and that time; and the modes then, if there is contact friction.
    `at_event` is the state before the impacts, `distances` are those from the stops. A body may be
    pressed on by another that comes to rest at the same instant. Therefore each is tested while
    those of the others that rest so far and are pressed on are held, until none changes. Two of
    three feet may rest only while none is held: after some passes none is added any more.

    So may a body that sticks. An impact may give it a slip that friction stops in a shorter time
    than a series of impacts may take. Such a slip counts as stopped: else the contact that it opens
    closes at once, with another impact, in a series without an end."""
    s, state, contact = lane.s, lane.state, lane.contact
    assert contact is not None
    machine = plan.machine
    slips = _slips_after(plan, lane, at_event) if has_contact_friction(machine) else {}
    most = len(impacts) + len(slips)
    free = in_modes(plan.machine, lane.modes)
    speeds, least = {}, {}
    closed = list(contact)
    for k, hit in impacts.items():
        sign, _ = plan.sign_and_gap(k, hit.contact)
        least[k] = force_rounding(free.field, plan.machine.coordinates[k], s, state)
        rate = -sign * rates(free.field, plan.machine.coordinates[k], s, state).v
        speeds[k] = jnp.where(distances[k] > 0, jnp.abs(rate), jnp.maximum(rate, 0.0))
        stays = (hit.contact > 0) & (stop_gradient(hit.share) <= _CLOSED)
        closed[k] = jnp.where(stays, hit.contact, contact[k])

    def update(found):
        closed, _, moves, _, _, count = found
        new, times, given = list(contact), [], list(lane.modes)
        for i, moving in zip(slips, moves, strict=True):
            given[i] = moving * jnp.sign(slips[i])
        modes, held, rates_of_slips = pressed_contacts(machine, s, state, tuple(given), closed)
        for k, hit in impacts.items():
            free_k = hold_contacts(plan.machine, modes, held, but=k)
            # Of contacts struck in turn, each may leave faster than its law says, and all shrink.
            law = at_stop(
                plan.machine, k, hit.contact, lambda stop, V=hit.approach: stop.coefficient(V)
            )
            hit = hit._replace(share=jnp.minimum(hit.share, law))
            ends, time = _remaining_chatter(
                plan, free_k, k, hit, speeds[k], lane, distance=distances[k], least=least[k]
            )
            spare = held[k] < 0  # it rests when those rest that hold it
            time = jnp.where(spare, 0.0, time)
            ends = (hit.contact > 0) & (ends | spare) & (stop_gradient(time) < before)
            ends = ends & ((count < most) | (closed[k] == hit.contact))
            new[k] = jnp.where(ends, hit.contact, contact[k])
            times.append(jnp.where(ends, time, 0.0))
        still = []
        for (i, slip), rate, moving in zip(slips.items(), rates_of_slips, moves, strict=False):
            against = stop_gradient(slip * rate) < 0
            rate = stop_gradient(jnp.where(against, jnp.abs(rate), 1.0))
            along = getattr(switches_of(machine)[i], "along", None)
            size = 0.0 if along is None else plan.extent(along)
            _, longest, _ = _longest_wait(plan, lane, 0.5 * slip * slip / rate, size)
            stops = against & (jnp.abs(slip) <= rate * longest)
            still.append(jnp.where(stops, 0.0, moving))
        changed = jnp.zeros((), bool)
        for old, x in zip((*closed, *moves), (*new, *still), strict=True):
            changed = changed | (old != x)
        carried = tuple(new), tuple(times), tuple(still), modes
        return *carried, jnp.where(changed, 1.0, 0.0), count + 1.0

    zero = jnp.zeros_like(s)
    begin = tuple(closed), tuple(zero for _ in impacts), tuple(zero + 1.0 for _ in slips)
    begin = *begin, lane.modes, zero + 1.0, zero
    found, times, _, modes, _, _ = jax.lax.while_loop(lambda x: x[-2] > 0, update, begin)
    ends = {
        k: pin_flag((hit.contact > 0) & (found[k] == hit.contact), s) for k, hit in impacts.items()
    }
    return ends, dict(zip(impacts, times, strict=True)), modes if slips else None


def _slips_after(plan: Plan, lane: Lane, at_event: State) -> dict[int, Scalar]:
    """Return the slip of each friction after impacts, 0 if it is rounding, or if the body sticks
    and no impact changed its slip. `at_event` is the state before them."""
    found, machine = {}, plan.machine
    for i in frictions_in(machine):
        friction = switches_of(machine)[i]
        slip = stop_gradient(friction.speed_of_slip(machine, lane.s, lane.state))
        sticks = jnp.abs(lane.modes[i]) < 1
        sticks = sticks & ~friction.changes(machine, lane.s, at_event, lane.state)
        sticks = sticks | (jnp.abs(slip) <= plan.slip_rounding(i, lane))
        found[i] = jnp.where(sticks, 0.0, slip)
    return found
