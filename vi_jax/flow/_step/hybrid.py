"""The hybrid step: one flat loop in which every lane advances, aims or lands independently.

Each iteration tries one step of one lane:

- *advance*: the step contains no event and is taken;
- *aim*: it crosses a stop (or a section of the time clock, or a turning point that matters); it is
  not taken, and the next one is shortened to end there;
- *land*: the shortened step ends within 1e-9 of the event; the offset δ = t* - t of a second-order
  expansion moves the state to it, and the jump is applied. Otherwise it is aimed once more.

The length of an aimed step is a constant for differentiation, while δ carries dt*/dp. Therefore
forward and reverse derivatives through an impact are exact (the saltation matrix). After an impact
they are those at a fixed clock, so that later steps need no derivative of the clock.
"""

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars
from ...lanes import pin_flag
from ...machine import (
    DryFriction,
    SoftStop,
    constant_modes,
    counts_turns,
    frictions_in,
    is_alive,
    others_of,
    section_in,
    section_number,
    settled_modes,
    stops_of,
    struck_modes,
    switches_of,
    with_earlier_clock,
)
from ..history import extended, is_full, opened
from ..lane import FREE, Lane, Record, any_of, select, to_event, total
from ..noise import with_impulse
from ..plan import Plan
from ..results import code
from ..smooth import TIME, carried, hold_contacts, stops_are_exact
from .aim import aim_ahead, aim_at
from .arrive import after_jump, arrive, contacts_after_jump, release_pulled
from .guards import MOST_ATTEMPTS
from .impact import on_its_stops
from .trial import Trial, try_step

# A lane that fails with this many impacts in one interval was chattering: a choice.
_MOST_IMPACTS = 16.0

# No motion needs this many steps in one interval; a power of two, by choice.
_MOST_STEPS = 65536.0

# A slip jumps if it changes by more than this share of itself, and than rounding: a choice.
_JUMPS = 1e-6

# A step of this share of a cycle is long enough to show whether anything moves: a choice, below the
# step by which a motion leaves an event that it does not meet.
_LONG = 5e-4


def iterate(plan: Plan, lane: Lane) -> tuple[Lane, Flag, Record]:
    """Take one step of one lane: advance, aim or land. A lane that has ended is unchanged. Returns
    the lane; whether an interval ended; the record of that interval."""
    active = (lane.done < plan.intervals) & (lane.fault == 0)
    history = lane.history
    if history is not None:
        plan, lane = opened(plan, lane)
    smooth = hold_contacts(plan.machine, lane.modes, lane.contact)
    integrals = carried(smooth, lane.s, lane.state, lane.record.integrals)
    motion = plan.method.foresee(smooth, lane.s, lane.state, integrals)
    if motion is not None:
        lane = aim_ahead(plan, lane, motion)
    trial = try_step(plan, lane, active, smooth, motion)
    aim, goal, target = aim_at(plan, lane, trial, foreseen=motion is not None)
    aim = pin_flag(active & aim, lane.s)
    taken = pin_flag(active & trial.good & ~aim, lane.s)
    rejected = active & ~trial.good
    length = _next_length(plan, lane, trial, taken, rejected)
    arrived, completed = arrive(plan, lane, trial, taken)
    if section_in(plan.machine, lane.state) is not None and not counts_turns(plan.machine):
        completed = completed | taken & _is_equilibrium_on_section(plan, lane, arrived)
    reached = completed = pin_flag(completed, lane.s)
    if arrived.contact is not None and not stops_are_exact(plan.machine, arrived.state):
        rests = reached & any_of(reached, (x > 0 for x in arrived.contact))
        put = lambda x: on_its_stops(plan, x.s, x.state, x.contact)
        arrived = arrived._replace(state=jax.lax.cond(rests, put, lambda x: x.state, arrived))
    if plan.noise is not None:
        completed = completed & plan.is_record_point(lane.part, lane.done)
    done = lane.done + jnp.where(completed, 1.0, 0.0)
    new = _next_interval(plan, arrived, reached, completed, done)._replace(
        length=length,
        attempt=jnp.where(aim, goal, _next_attempt(plan, lane, trial, taken, length)),
        target=jnp.where(aim, target, FREE),
        attempts=jnp.where(aim, lane.attempts + 1, 0.0),
        done=done,
        steps=lane.steps + jnp.where(active, 1.0, 0.0),
        # Counted anew in each interval: in single precision the total does not increase beyond 2²⁴.
        spent=jnp.where(reached, 0.0, lane.spent + 1.0),
        rejected=lane.rejected + jnp.where(rejected, 1.0, 0.0),
    )
    fault, ends = new.fault, _faults(plan, lane, trial, taken, rejected, new)
    if history is not None:
        step, jumps = (lane, trial, taken), _jumps(plan, trial)
        history = extended(plan, history, step, arrived, new.s, jumps)
        new = new._replace(history=history, slip=None)
        ends.append((is_full(plan, history), code("full_history")))
    for condition, reason in ends:
        stops_here = active & (fault == 0) & condition & (done < plan.intervals)
        fault = jnp.where(stops_here, reason, fault)
    return new._replace(fault=fault), completed, arrived.record


def _jumps(plan: Plan, trial: Trial) -> Flag:
    """Return whether a step ended at an event after which the motion is not smooth."""
    events = [c for c in trial.crossings if c.number != section_number(plan.machine)]
    released = [path.near.release.landed for path in trial.paths if path.near is not None]
    return any_of(trial.good, [*(c.landed for c in events), *released])


def _next_attempt(plan: Plan, lane: Lane, trial: Trial, taken: Flag, length: Scalar) -> Scalar:
    """Return the length of the next step without a target. After a step that was aimed at an event
    and fell short of it, it is at most as long: so the place where a guard jumps is bisected."""
    if not plan.others(lane.state):
        return length
    fell_short = taken & (lane.target >= to_event(len(stops_of(plan.machine))))
    for c in trial.crossings:
        if c.sudden is not None:
            fell_short = fell_short & ~c.landed
    return jnp.where(fell_short, jnp.minimum(stop_gradient(trial.h), length), length)


def _is_equilibrium_on_section(plan: Plan, lane: Lane, arrived: Lane) -> Flag:
    """Return whether a motion has died out, to rounding, in an equilibrium on the machine's
    section. Then a step changes nothing, and the cycle has lasted twice as long as expected. The
    motion would meet the section by rounding only, or never."""
    old, new = (jtu.tree_leaves(stop_gradient(x)) for x in (lane.state, arrived.state))
    sizes = [1.0] * len(old) if plan.sizes is None else jtu.tree_leaves(plan.sizes)
    slack, cycle = 8 * float(jnp.finfo(arrived.s.dtype).eps), plan.machine.cycle
    share = jnp.ones_like(arrived.s)
    # A step with a target may be so short that nothing has time to change.
    is_still = (arrived.s >= 2 * cycle) & (arrived.s - lane.s >= _LONG * cycle)
    for before, after, size in zip(old, new, sizes, strict=True):
        is_still = is_still & jnp.all(jnp.abs(after - before) <= slack * (size + jnp.abs(before)))
        share = share + jnp.max(jnp.abs(after) / size)
    guard = jnp.asarray(section_in(plan.machine, stop_gradient(arrived.state)))
    extent = plan.guard_extent(section_number(plan.machine), lane)
    return is_still & (jnp.abs(guard) <= slack * share * extent)


def _next_interval(plan: Plan, arrived: Lane, reached: Flag, completed: Flag, done: Scalar) -> Lane:
    """Return the lane at the start of its next interval, if one was `completed`; and of its next
    cycle, if that was the cycle's last. The step `reached` the end of a piece of its cycle."""
    cycle_ended, part, state = reached, arrived.part, arrived.state
    if plan.instants > 1:
        part = part + jnp.where(reached, 1.0, 0.0)
        cycle_ended = reached & (part >= plan.instants)
        part = jnp.where(cycle_ended, plan.first_part(done), part)
    if not plan.s_counts_cycles(state):
        state = select(cycle_ended, with_earlier_clock(plan.machine, state), state)
    lane = arrived._replace(s=jnp.where(cycle_ended, 0.0, arrived.s), state=state)
    renewed = plan.machine.renewed(state)
    if renewed is not state:
        lane = after_jump(plan, lane._replace(state=renewed), cycle_ended, state)
        lane = lane._replace(state=select(cycle_ended, renewed, state))
    lane = _update_frictions(plan, arrived, lane, cycle_ended)
    if plan.noise is not None:
        lane = after_impulse(plan, lane, reached, completed)
    record = select(completed, plan.empty_record(lane.state), lane.record)
    return lane._replace(part=part, record=record)


def _update_frictions(plan: Plan, old: Lane, new: Lane, cycle_ended: Flag) -> Lane:
    """Return the lane with its modes after a jump of a slip at the start of a cycle: by `renewed`,
    or since the clock of a moving surface begins anew."""
    machine, renewed = plan.machine, new.state is not old.state
    dry = [x for x in switches_of(machine) if isinstance(x, DryFriction)]
    if not any(renewed or x.slip_takes_time for x in dry):
        return new
    modes, any_jumps = list(new.modes), jnp.zeros((), bool)
    for i, friction in enumerate(switches_of(machine)):
        if isinstance(friction, DryFriction):
            before, after = (friction.speed_of_slip(machine, x.s, x.state) for x in (old, new))
            least = _JUMPS * (jnp.abs(after) + jnp.abs(before)) + plan.slip_rounding(i, new)
            jumps = stop_gradient(jnp.abs(after - before) > least)
            slips = friction.slip_sign(machine, new.s, new.state)
            modes[i], any_jumps = jnp.where(jumps, slips, modes[i]), any_jumps | jumps
    any_jumps = pin_flag(cycle_ended & any_jumps, new.s)

    def new_modes(new: Lane) -> Scalars:
        # A body that sticks, and whose surface did not jump, has no slip but rounding.
        settled = settled_modes(machine, new.s, new.state, tuple(modes), new.contact or (), {})
        return constant_modes(settled, new.s)

    # Rare: skipped if no lane of a group has such a jump.
    return new._replace(modes=jax.lax.cond(any_jumps, new_modes, lambda new: new.modes, new))


def _next_length(plan: Plan, lane: Lane, trial: Trial, taken: Flag, rejected: Flag) -> Scalar:
    """Return the length proposed for the next ordinary step. A step that is to be shortened to an
    event was neither `taken` nor `rejected`."""
    if not plan.method.adaptive:
        return lane.length
    h = stop_gradient(trial.h)
    factor = plan.method.resize(trial.error)
    # Choices: if its error is too large, a step shrinks to at most 0.7 of its length; if it was
    # rejected for another reason (NaN, for example), to 0.2. After a step cut short by an event,
    # the next is at least as long as was proposed before.
    grown = jnp.where(h < lane.length, jnp.maximum(lane.length, h * factor), h * factor)
    shrunk = h * jnp.where(trial.error > 1, jnp.minimum(factor, 0.7), 0.2)
    return jnp.where(taken, grown, jnp.where(rejected, shrunk, lane.length))


def after_impulse(plan: Plan, lane: Lane, reached: Flag, completed: Flag) -> Lane:
    """Return the lane after the impulse at the end of a piece of its cycle, if it is `reached`."""
    assert plan.noise is not None
    old, elapsed = lane, None
    if lane.last_impulse is not None:
        time = lane.record.integrals[TIME]
        elapsed, reading = time - lane.last_impulse, jnp.where(completed, 0.0, time)
        lane = lane._replace(last_impulse=jnp.where(reached, reading, lane.last_impulse))
    instant = stop_gradient((plan.cycle_of(lane.done), lane.part))
    lane = lane._replace(state=with_impulse(plan.noise, reached, *instant, old.state, elapsed))
    if _may_change_modes(plan):
        # A body that was moved does not rest any more, which affects friction on its stop.
        contact = contacts_after_jump(plan, lane, reached, old.state) or ()
        jumped = lane.s, lane.state, lane.modes
        modes = struck_modes(plan.machine, *jumped, contact=contact, before=old.state)
        lane = lane._replace(modes=select(reached, modes, old.modes))
    lane = after_jump(plan, lane, reached, old.state)
    freed = release_pulled(plan, lane, reached, reached, (old.state, old.modes))
    return freed._replace(record=lane.record)  # releases by impulses are not logged


def _may_change_modes(plan: Plan) -> bool:
    """Return whether a jump of velocities may change the mode of a switch. It may for all but
    adhesive soft stops, which depend on a body's position alone."""
    return any(not (isinstance(x, SoftStop) and x.adhesive) for x in switches_of(plan.machine))


def _faults(
    plan: Plan, lane: Lane, trial: Trial, taken: Flag, rejected: Flag, new: Lane
) -> list[tuple[Flag, Scalar | float]]:
    """Return conditions that end a lane, and the reasons' numbers; the first true one is the
    reason. `new` is the lane after the trial."""
    impacts, broken = new.record.impacts, code("not_finite")
    jams = [(jnp.isnan(new.modes[i]), code("jammed")) for i in frictions_in(plan.machine)]
    for i, x in enumerate(switches_of(plan.machine)):
        if isinstance(x, DryFriction) and x.may_be_negative:
            old, at = (lane.s, lane.state), (new.s, new.state)
            negative = x.is_negative(plan.machine, old, at, new.modes[i])
            jams.append((taken & negative, code("jammed")))
    many = impacts > _MOST_IMPACTS
    if is_alive(plan.machine, trial.state) is not None:
        # If a clock breaks down, the steps shrink to zero.
        broken = code("stalled")
    ends = [
        *jams,
        (impacts > plan.max_impacts, code("chatter")),
        (((new.attempts >= MOST_ATTEMPTS) | (new.spent >= _MOST_STEPS)) & many, code("chatter")),
        (new.attempts >= MOST_ATTEMPTS, _reason_for_giving_up(plan, lane, new.target)),
        (new.steps >= plan.max_steps, code("max_steps")),
        (new.spent >= _MOST_STEPS, code("max_steps")),
    ]
    if plan.method.may_be_unstable(plan.machine, lane.s, lane.state):
        ends = [(taken & (trial.error > 1), code("unstable")), *ends]
    if not plan.method.adaptive:
        return [(rejected, broken), *ends]
    eps = float(jnp.finfo(new.length.dtype).eps)
    too_short = rejected & (new.length < 4 * eps * jnp.maximum(plan.unit, plan.machine.cycle))
    is_finite = jnp.isfinite(total(trial.state, new.length))
    underflow = code("underflow") if broken == code("not_finite") else broken
    return [(too_short & ~is_finite, broken), (too_short, underflow), *ends]


def _reason_for_giving_up(plan: Plan, lane: Lane, target: Scalar) -> Scalar | float:
    machine, reason = plan.machine, code("unresolved")
    if plan.records_motion or stops_of(machine):
        reason = jnp.where(target < FREE, code("turn_unresolved"), reason)
    first = len(stops_of(machine))
    if switches_of(machine):
        others = target >= to_event(first)
        reason = jnp.where(others, code("switch_unresolved"), reason)
    if others_of(machine):
        others = target >= to_event(first + len(switches_of(machine)))
        reason = jnp.where(others, code("reset_unresolved"), reason)
    if not plan.s_counts_cycles(lane.state):
        ends = target == to_event(section_number(machine))
        reason = jnp.where(ends, code("section_unresolved"), reason)
    return reason
