"""How a body comes to rest on a stop.

With small impact speeds and a force that presses the body on, impacts follow each other ever
faster, their speeds a geometric series in k, and end in rest after a finite time (chatter):
Σ 2 kⁿ V⁻/a = 2 k V⁻ / (a (1 - k)). The series is completed at once where what is left of it is
brief.
"""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...lanes import pin, pin_flag
from ...machine import (
    added,
    forces,
    has_contact_friction,
    held_by,
    holds_anywhere,
    push_of,
    shares,
    struck_modes,
)
from .._lane import Lane, Plan, any_of, in_place, select
from ..drift import FlowToEvent
from ..events import force_rate, rates
from ..results import EventKind
from ..smooth import SmoothMachine, holding, in_modes
from .impact import Blow
from .trial import Situation

# How much of a chatter may be left when it is completed, as a share of the longest step, in double
# and in single precision. Choices: the error is of second order, 6e-11 of that step in the former.
_BRIEF, _BRIEF_SINGLE = 8e-6, 8e-3

# A contact whose bodies leave each other with less than this share of the speed with which they
# came stays closed while it is looked at what presses on it: a choice, far above rounding.
_CLOSED = 1e-9


def settle(at: Situation, lane: Lane, at_event: State, met: Flag, blows: dict[int, Blow]) -> Lane:
    """The lane at rest on those stops whose impacts were the last ones; `lane` is behind the
    impacts, `at_event` the state before them, `met` whether there were any."""
    if lane.contact is None:
        return lane
    if len(blows) == 1:
        ((k, blow),) = blows.items()
        sign, _ = at.plan.wall(k, blow.struck)
        path, alone = at.trial.paths[k], at.trial.alone[k]
        speed = blow.share * jnp.maximum(sign * path.end.v, 0.0)
        growth = None if path.surge is None else path.surge[1]
        known = k, blow, speed, lane._replace(state=at_event), growth
        ends, left = _ends(at.plan, alone, *known)
        rests = {k: pin_flag((blow.struck > 0) & ends, lane.s)}
        waits = {k: left}
    else:
        lane = lane._replace(contact=_broken(at.plan, lane, at_event, met, blows))
        rests, waits = _together(at.plan, lane, blows)
    return _held(at.plan, at.taken, lane, rests, blows, waits)


def _held(
    plan: Plan, taken: Flag, lane: Lane, rests: dict[int, Flag], blows: dict[int, Blow],
    waits: dict[int, Scalar],
) -> Lane:  # fmt: skip
    """The lane when the impacts that never end are over, with those bodies held that come to rest.
    Of each coordinate `rests` is whether it does, `waits` how long it takes (in s)."""
    s, state, contact = lane.s, lane.state, lane.contact
    assert contact is not None
    wait = jnp.zeros_like(s)
    for k, ends in rests.items():
        left = jnp.where(ends, waits[k], 0.0)
        wait = left if len(rests) == 1 else jnp.maximum(wait, left)
        contact = in_place(contact, k, jnp.where(ends, blows[k].struck, contact[k]))
    walls, modes = {k: blow.struck for k, blow in blows.items()}, lane.modes
    if has_contact_friction(plan.machine):
        # Which way a body slips is known behind its impact.
        modes = struck_modes(plan.machine, s, state, modes, contact=contact)
        slowed, rubbed_away = _without_rebounds(plan, s, state, modes, rests, walls)
        still, lost = stilled(plan, s, slowed, rests, walls)
        lost = lost + rubbed_away
    else:
        still, lost = stilled(plan, s, state, rests, walls)
        if holds_anywhere(plan.machine):
            modes = struck_modes(plan.machine, s, still, modes, contact=contact)
    resting, integrals = holding(plan.machine, modes, contact), lane.record.integrals
    flow = FlowToEvent(plan, resting, lane.part, (s, still, integrals))
    later, still, passed = flow.drifted(pin(wait))
    if len(rests) > 1:  # another body may come upon this one before its impacts are over
        clear = ~plan.beyond_a_stop(still)
        rests = {k: ends & clear for k, ends in rests.items()}
        contact = select(clear, contact, lane.contact)
    any_rests = any_of(taken, rests.values())
    s, state, integrals = select(any_rests, (later, still, passed), (s, state, integrals))
    lane = lane._replace(s=s, state=state, contact=contact).recording(integrals=integrals)
    for k, ends in rests.items():
        here, blow, count = taken & ends, blows[k], lane.record.rests
        number = blow.struck - 1.0
        lane = lane.noting(here, plan.clock(s, state), EventKind.rest, number, blow.approach)
        if count is not None:
            lane = lane.recording(rests=count + jnp.where(here, 1.0, 0.0))
    energy = lane.record.impact_energy
    if energy is not None:
        energy = energy + jnp.where(taken & any_rests, lost, 0.0)
        lane = lane.recording(impact_energy=energy)
    return lane


def _without_rebounds(
    plan: Plan, s: Scalar, state: State, modes: Scalars, rests: dict[int, Flag],
    walls: dict[int, Scalar],
) -> tuple[State, Scalar]:  # fmt: skip
    """The state without the rebounds of those bodies that come to rest, and without the friction
    that went with them: the weight of the hops that are left out rubs instead, while the body is
    held. And the energy that goes with the rebounds. `modes` are those behind the impacts."""
    machine, zero = plan.machine, jnp.zeros_like(modes[0])
    contact = [zero for _ in machine.coordinates]
    for k, ends in rests.items():
        contact[k] = jnp.where(ends, walls[k], zero)
    held = held_by(machine, s, state, modes, contact)
    bodies = held.coordinates
    before = [body.velocity(state) for body in bodies]
    amounts = forces(
        shares(bodies, state, held.pushes), held.acts, [-velocity for velocity in before]
    )
    new, pushed = added(state, amounts, held.pushes), list(amounts)
    for row, (_, _, at, drag) in enumerate(held.rubbing, start=len(bodies) - len(held.rubbing)):
        pushed[row] = pushed[row] + drag * amounts[at]
    lost = zero
    for body, amount, V in zip(bodies, pushed, before, strict=True):
        lost = lost - body.mass_at(s, state) * amount * 0.5 * (V + body.velocity(new))
    return new, lost


def stilled(
    plan: Plan, s: Scalar, state: State, rests: dict[int, Flag], walls: dict[int, Scalar]
) -> tuple[State, Scalar]:
    """The state with those coordinates put on their stops (`walls`, as in `Lane.contact`) that
    rest, without velocity, all at once; and the energy that goes with it."""
    bodies = {k: plan.machine.coordinates[k] for k in rests}
    velocities = [body.velocity(state) for body in bodies.values()]
    slower, shifts = [-V for V in velocities], []
    for k, body in bodies.items():
        sign, gap = plan.wall(k, walls[k])
        shifts.append(sign * gap - body.position(state))
    if len(rests) > 1:
        coordinates, on = list(bodies.values()), list(rests.values())
        gains = shares(coordinates, state, [push_of(body, state) for body in coordinates])
        slower, shifts = forces(gains, on, slower), forces(gains, on, shifts)
    new, lost = state, jnp.zeros_like(slower[0])
    for (k, body), change, shift, V in zip(bodies.items(), slower, shifts, velocities, strict=True):
        place, speed = body.position(new) + shift, body.velocity(new) + change
        if len(rests) == 1:
            sign, gap = plan.wall(k, walls[k])
            place, speed = sign * gap, jnp.zeros_like(V)
        moved = body.placed(new, place, speed)
        new = moved if len(rests) == 1 else select(rests[k], moved, new)
        lost = lost - body.mass_at(s, state) * change * 0.5 * V
    return new, lost


def _ends(
    plan: Plan, free: SmoothMachine, k: int, blow: Blow, speed: Scalar, lane: Lane,
    growth: Scalar | None = None,
) -> tuple[Flag, Scalar]:  # fmt: skip
    """Whether an impact is one of the endless last ones before rest, and the time they take.

    **Arguments:** `free`, the machine with this body free; `speed`, by s, of its rebound; `lane`,
    at the impact; `growth`, how fast the force on the body grows, where that is known.
    """
    s, state, body = lane.s, lane.state, plan.machine.coordinates[k]
    sign, gap = plan.wall(k, blow.struck)
    # What presses a body at rest on: with its velocity goes its damping.
    rested = body.placed(state, jnp.asarray(sign * gap), jnp.zeros_like(s))
    pressing = sign * rates(free.field, body.position, s, rested).a
    force = pressing * (1 - blow.share)
    ends = force > 0
    left = jnp.where(ends, 2 * speed / jnp.where(ends, force, 1.0), jnp.inf)
    limit = stop_gradient(jnp.asarray(plan.machine.step_limit(s, state), s.dtype))
    # Hops no higher than rounding cannot be followed, however long they last.
    height = speed**2 / jnp.where(pressing > 0, 2 * pressing, 1.0)
    if growth is None:  # another blow of this instant may have changed it
        growth = force_rate(free, body.position, free, s, rested)
    not_yet, hop, wait = _before_it_presses(speed, pressing, sign * growth)
    height = jnp.where(not_yet, speed * hop - 0.5 * pressing * hop * hop, height)
    size = plan.extent(k) + jnp.abs(gap)
    flat = stop_gradient(height) <= 16 * float(jnp.finfo(s.dtype).eps) * size
    left = jnp.where(not_yet, wait, left)
    brief = (_BRIEF if s.dtype == jnp.float64 else _BRIEF_SINGLE) * limit
    ends = stop_gradient(left) <= jnp.where(flat, 0.1 * limit, brief)
    ends = ends & (flat | ~not_yet | (hop <= brief))
    if plan.ticks(lane.state):
        ends = ends & (stop_gradient(s + left) < stop_gradient(plan.end(lane.part)))
    return ends, left


def _before_it_presses(
    rebound: Scalar, pressing: Scalar, growth: Scalar
) -> tuple[Flag, Scalar, Scalar]:
    """Whether a body is not pressed on yet but will be, since its force grows; then how long its
    next hop lasts at most, and the time until it is pressed on. A hop that begins against a force
    f, growing at the rate j, is over within 3 |f|/j + √(6 v/j)."""
    v, pull, grows = stop_gradient((rebound, -pressing, growth))
    not_yet = (pull >= 0) & (grows > 0)
    rate = jnp.where(not_yet, grows, 1.0)
    wait = jnp.where(not_yet, pull, 0.0) / rate
    return not_yet, 3 * wait + jnp.sqrt(6 * jnp.where(not_yet, v, 0.0) / rate), wait


def _broken(plan: Plan, lane: Lane, at_event: State, met: Flag, blows: dict[int, Blow]) -> Scalars:
    """`Lane.contact` without those contacts that were struck or pulled apart by the impacts;
    `at_event` is the state before them."""
    assert lane.contact is not None
    contact = list(lane.contact)
    for k, blow in blows.items():
        body = plan.machine.coordinates[k]
        V, old = (stop_gradient(body.velocity(x)) for x in (lane.state, at_event))
        _, slow = plan.rounding(k, at_event)
        apart = met & ((blow.struck > 0) | (jnp.abs(V - old) > slow))
        contact[k] = jnp.where(apart, 0.0, contact[k])
    return tuple(contact)


def _together(
    plan: Plan, lane: Lane, blows: dict[int, Blow]
) -> tuple[dict[int, Flag], dict[int, Scalar]]:
    """Of each coordinate that was struck, whether it comes to rest, and the time that takes. What
    presses on a body may be another one that comes to rest on it at the same instant: which of them
    do is found by trying, those that rest being held while the others are looked at."""
    s, state, contact = lane.s, lane.state, lane.contact
    assert contact is not None
    free = in_modes(plan.machine, lane.modes)
    speeds = {}
    closed = list(contact)
    for k, blow in blows.items():
        sign, _ = plan.wall(k, blow.struck)
        speeds[k] = jnp.maximum(
            -sign * rates(free.field, plan.machine.coordinates[k].position, s, state).v, 0.0
        )
        stays = (blow.struck > 0) & (stop_gradient(blow.share) <= _CLOSED)
        closed[k] = jnp.where(stays, blow.struck, contact[k])

    def tried(found):
        closed, _, _, count = found
        new, waits = list(contact), []
        for k, blow in blows.items():
            alone = holding(plan.machine, lane.modes, closed, but=k)
            ends, left = _ends(plan, alone, k, blow, speeds[k], lane)
            ends = (blow.struck > 0) & ends
            new[k] = jnp.where(ends, blow.struck, contact[k])
            waits.append(jnp.where(ends, left, 0.0))
        changed = jnp.zeros((), bool)
        for old, x in zip(closed, new, strict=True):
            changed = changed | (old != x)
        return tuple(new), tuple(waits), jnp.where(changed, 1.0, 0.0), count + 1.0

    zero = jnp.zeros_like(s)
    begin = tuple(closed), tuple(zero for _ in blows), zero + 1.0, zero
    found, waits, _, _ = jax.lax.while_loop(
        lambda x: (x[2] > 0) & (x[3] <= len(blows)), tried, begin
    )
    ends = {
        k: pin_flag((blow.struck > 0) & (found[k] == blow.struck), s) for k, blow in blows.items()
    }
    return ends, dict(zip(blows, waits, strict=True))
