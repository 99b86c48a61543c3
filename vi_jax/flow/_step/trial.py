"""A tried step, and the events in it."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from ..._types import Flag, Scalar, Scalars, State
from ...lanes import pin, pin_flag
from ...machine import at_stop, is_alive, limited_in, stops_of, stops_on, switches_of
from ..history import end_of_step, new_piece, piece_error
from ..lane import FREE, Lane, any_of, select, to_event, to_release, to_turn_of, total
from ..methods import Foreseen, stages_to_step_to
from ..plan import Plan
from ..smooth import Integrals, SmoothMachine, carried, elapsed, hold_contacts, stops_are_exact
from .event_derivatives import FlowToEvent
from .guards import (
    SHARES,
    Crossing,
    InnerGuards,
    Side,
    checks_within_step,
    crossings,
    guards_error,
    inner_guards,
    jump_share,
    landing_tolerance,
    may_turn_between,
    separate_stages,
    tolerance_factor,
    turn_tolerance,
)
from .roots import Rates, force_rate, rates, turns_within

# Attempts in a row at a release until its distance is halved: a choice, three or four are usual.
_PATIENCE = 8.0


class Release(NamedTuple):
    """The release of a resting body from its stop."""

    left: Flag
    """True if the body left the stop within the step."""
    landed: Flag
    """True if the step ended at the release."""
    place: Scalar
    """Length of the next step towards the release."""
    offset: Scalar
    """Offset from the step's end to the release."""
    at_start: Flag
    """True if the force has jumped where the step begins."""
    lost: Flag
    """True if it jumped within the step, so that the release's time has no derivative."""


def locate_release(
    plan: Plan, lane: Lane, k: int, ends: tuple[Rates, Rates], slopes: Scalars, good: Flag,
    h: Scalar,
) -> Release:  # fmt: skip
    """Return the release of coordinate number k, by its rates when free at both ends of the step,
    and the `slopes` of its force there. A body is held while it is pressed on. It leaves when the
    acceleration that a free body would have there changes sign. The drive goes on turning, with the
    reaction of a spring whose end is held."""
    assert lane.contact is not None
    # Steps approach the release from the pressed side. Each ends a share short of the last
    # estimate, until one is so short that the force is linear over it: choices.
    short, linear = (1e-3, 1e-5) if h.dtype == jnp.float64 else (1e-2, 1e-3)
    close, linear = plan.in_units(landing_tolerance(h)), plan.in_units(linear)
    away = plan.away(k, lane.contact[k])
    before, after = pin(tuple(away * x.a for x in ends))
    rise = stop_gradient(after - before)
    held = good & (away != 0)
    rising = held & (rise > 0)
    offset = -after * h / jnp.where(rising, rise, 1.0)
    near = jnp.abs(stop_gradient(offset)) <= close
    aimed = held & (lane.target == to_release(k))
    # A force that jumps does not pass through zero.
    least = jump_share(h) * plan.extent(k) / plan.unit**2
    at_start = held & (stop_gradient(before) > least) & plan.jump_at_start(lane.s)[0]
    met = rising & aimed & (h <= 2 * linear) & near & ~at_start
    # At the start of so short a step the force was all rounding, and may still be: for example that
    # of a stack released as one, whose bodies separate later.
    landed, may_dip = met | aimed & (h <= close), len(limited_in(plan.machine)) > 1
    dips = jnp.zeros_like(held)
    if may_dip:
        # A contact that takes over is pressed on from zero: the chord's root is where it begins.
        dips = (stop_gradient(before) > -least) & (away * slopes[0] * h < -least)
        landed = landed & ~dips
    left = (rising & (after > 0) | at_start) & ~landed
    steepest = stop_gradient(functools.reduce(jnp.maximum, map(jnp.abs, slopes)))
    lost = landed & ~at_start & (rise > _STEEP * steepest * h + least)
    place = stop_gradient(h + offset)
    # If the force is barely positive, but for long, chords hardly advance: bisect.
    share = jnp.where(lane.attempts >= _PATIENCE, 0.5, 1 - short)
    place = jnp.where(h > linear, share * place, place)
    place = jnp.where(dips, 0.5 * h, place) if may_dip else place
    # The step ends late by a rounding error, lest the body be pressed on again. No step towards
    # the release is too short to advance the clock.
    late = 8 * float(jnp.finfo(h.dtype).eps) * (plan.unit + stop_gradient(lane.s + h))
    place = jnp.where(at_start, 2 * late, jnp.maximum(place, 2 * late))
    landed, offset = pin_flag(landed, h), jnp.where(met, offset, 0.0)
    offset = jnp.where(landed, offset + late, 0.0)
    return Release(pin_flag(left, h), landed, place, offset, at_start, lost)


# A force jumps if it changes by more than this multiple of what its slopes allow: a choice.
_STEEP = 100.0

# A window of force shorter than this share of the longest step moves the body by its third power,
# 1e-9 of the motion in a whole step.
_SLIVER = 1e-3


class NearStop(NamedTuple):
    """The force during a step on a coordinate that rests on a stop, or is slow near one."""

    release: Release
    begin: Scalar
    """Rates of the force at both ends of the step; 0 elsewhere."""
    end: Scalar
    brief: Scalar
    """The length of the shortest step that is cut at an extremum of the force."""


class Path(NamedTuple):
    """One coordinate during a step."""

    begin: Rates
    end: Rates
    at_turn: Flag
    """True if the step was aimed at a turning point of the coordinate, and met it."""
    near: NearStop | None
    """The force on it near a stop; `None` if it cannot rest."""
    pull: Side | None
    """The force away from the stop on which the body rests, or its velocity against its direction
    while it is slow; `None` if it cannot rest."""


class Trial(NamedTuple):
    """A step of the method from the lane's state, before it is accepted."""

    h: Scalar
    """The step's length in `s`."""
    s: Scalar
    """Independent variable, state and integrals at the step's end."""
    state: State
    integrals: Integrals
    error: Scalar
    """Relative to the tolerance, from the method."""
    good: Flag
    """True if the end is finite, and the error small enough."""
    ends_interval: Flag
    """True if the step's end is that of an interval of `s`."""
    crossings: tuple[Crossing, ...]
    """The machine's events in the step."""
    paths: tuple[Path, ...]
    """The path of each coordinate; empty if none is needed."""
    below: Scalars
    """As `Lane.below`, at the step's end."""
    shares: tuple[float, ...]
    """The places within the step at which guards were evaluated, as shares of it; static."""
    smooth: SmoothMachine
    """The machine during the step: its resting bodies are held."""
    free_machines: tuple[SmoothMachine, ...]
    """For each coordinate, the machine with its body free and other resting bodies held."""
    clear: Flag | None
    """True if nothing can be met within the step; `None` if that is never known in advance."""
    piece: Array | None = None
    """The polynomial of what the step records, of a machine with delays."""


class AppliedStep(NamedTuple):
    """A tried step while its events are applied."""

    plan: Plan
    old: Lane
    """The lane before the step."""
    trial: Trial
    taken: Flag
    """True if the step is taken."""
    flow: FlowToEvent
    """The motion from the step's end on."""


def try_step(
    plan: Plan, lane: Lane, active: Flag, smooth: SmoothMachine, motion: Foreseen | None
) -> Trial:
    """Try the next step and find its events; a step of a lane that has ended has length zero.
    `motion` is the motion ahead, for a method that computes it in advance."""
    machine, method = plan.machine, plan.method
    free = lane.target == FREE
    bound = plan.end(lane.part)
    limit = method.longest(machine, lane.s, lane.state)
    h, clear = jnp.minimum(lane.attempt, limit), _clear_time(plan, lane)
    h = stop_gradient(jnp.where(free, h if clear is None else jnp.maximum(h, clear), lane.attempt))
    is_clear = None if clear is None else free & (h <= clear)
    s1, last, may_end = lane.s + h, jnp.zeros_like(free), free
    if plan.memory is not None:
        h, s1, may_end = end_of_step(plan, lane, free, h, bound)
    if plan.s_counts_cycles(lane.state):
        # The margin avoids an extra step for a remainder of rounding.
        last = may_end & (stop_gradient(bound - lane.s) <= h * (1 + 1e-6))
        s1 = jnp.where(last, bound, s1)
    s1 = jnp.where(active, s1, lane.s)
    s1 = pin(s1)
    h = s1 - lane.s

    old = lane.record.integrals
    integrals = carried(smooth, lane.s, lane.state, old)
    stages, checks = [], checks_within_step(plan, lane.state)
    if motion is not None:
        (new, integrals), error = motion.at(h), jnp.zeros_like(h)
        stages = stages_to_step_to(SHARES, lane.s, h) if checks else stages
    elif checks:
        step = lane.s, s1, lane.state
        new, integrals, error, stages = method.step_with_stages(smooth, *step, integrals)
        stages = stages if method.adaptive else separate_stages(stages)
    else:
        new, integrals, error = method.step(smooth, lane.s, s1, lane.state, integrals)
    stands = None if lane.contact is None or method.holds(machine) else lane.contact[0] > 0
    held = lambda new: new if stands is None else select(stands, lane.state, new)
    new = pin(held(new))
    bodies = range(len(machine.coordinates))
    free_machines = tuple(hold_contacts(machine, lane.modes, lane.contact, but=k) for k in bodies)
    ends: list[tuple[Rates, Rates]] = []
    if plan.records_motion or stops_of(machine):
        for free_k, body in zip(free_machines, machine.coordinates, strict=True):
            begin = rates(free_k.field, body, lane.s, lane.state)
            ends.append((begin, rates(free_k.field, body, s1, new)))
    ends = _without_rounding_while_held(plan, lane, ends)

    def at(share: Scalar) -> State:
        if motion is not None:
            return motion.at(share * h)[0]
        return held(method.step(smooth, lane.s, lane.s + share * h, lane.state, {})[0])

    longest = jnp.asarray(limit)
    inner = inner_guards(plan, lane, free_machines, ends, stages, at, h, longest)
    guard_error = guards_error(plan, lane, inner, stages, h, longest)
    error = error if guard_error is None else jnp.maximum(error, guard_error)
    piece = None
    if plan.memory is not None:
        piece = new_piece(plan, lane, smooth, s1, new, h)
        error = jnp.maximum(error, piece_error(plan, piece, h)) if method.adaptive else error
    good = jnp.isfinite(total(new, jnp.zeros_like(h)))
    alive = is_alive(machine, new)
    if alive is not None:
        good = good & alive
    if method.adaptive:
        error = pin(error)
        good = good & (error <= 1)
    good = pin_flag(good, h)

    interior = [n for n, stage in enumerate(stages) if 0 < stage.share < 1]
    inner, shares = inner.only(interior), tuple(stages[n].share for n in interior)
    paths = []
    for k, (free_k, both) in enumerate(zip(free_machines, ends, strict=False)):
        paths.append(_path(plan, lane, k, free_k, smooth, both, (s1, new, h, limit), good, inner))
    met, below = crossings(plan, lane, smooth, paths, (s1, h, new), (good, last), inner)
    return Trial(
        h, s1, new, elapsed(old, integrals, h), error, good, last, met, tuple(paths), below, shares,
        smooth, free_machines, is_clear, piece,
    )  # fmt: skip


# A body that friction holds moves by this many roundings of its usual speed: a choice. Of 768
# random chains of three blocks with a full mass matrix 169 turned without end, by 1 or 2 roundings.
_HELD = 64.0


def _without_rounding_while_held(
    plan: Plan, lane: Lane, ends: list[tuple[Rates, Rates]]
) -> list[tuple[Rates, Rates]]:
    """Return the rates at both ends of a step. While a body sticks, velocities that are rounding
    are zero, since they would show turning points."""
    dry = [i for i, x in enumerate(switches_of(plan.machine)) if x.is_dry]
    if not dry:
        return ends
    sticks = any_of(lane.modes[dry[0]] == 0, (lane.modes[i] == 0 for i in dry))

    def still(k: int, here: Rates) -> Rates:
        least = _HELD * float(jnp.finfo(here.v.dtype).eps) * plan.extent(k) / plan.unit
        return here._replace(v=jnp.where(sticks & (jnp.abs(here.v) <= least), 0.0, here.v))

    return [(still(k, begin), still(k, end)) for k, (begin, end) in enumerate(ends)]


def _clear_time(plan: Plan, lane: Lane) -> Scalar | None:
    """Return the time within which nothing can be met, so that only the end of a step counts; 0 if
    something can, `None` if that is never known."""
    if plan.averages or plan.meets_every_turn:
        return None
    clear = plan.method.clear(plan.machine, lane.s, lane.state)
    if clear is None:
        return None
    for contact in lane.contact or ():
        clear = jnp.where(contact > 0, 0.0, clear)
    return stop_gradient(jnp.where(plan.meets_turns(lane.done), 0.0, clear))


def _path(
    plan: Plan,
    lane: Lane,
    k: int,
    free: SmoothMachine,
    smooth: SmoothMachine,
    ends: tuple[Rates, Rates],
    at_end: tuple,
    good: Flag,
    inner: InnerGuards,
) -> Path:
    """Return the path of coordinate number k during a step. Its body is free in `free`, with rates
    `ends` there; `at_end` is s, state, the step's length and the longest length."""
    (begin, end), (s1, new, h, limit) = ends, at_end
    body = plan.machine.coordinates[k]
    if lane.contact is not None and not stops_are_exact(plan.machine, lane.state):
        # Position and velocity of a resting body are known more accurately than from the state, if
        # the coordinate is a difference. Its force is that on a free body.
        rests, contact = lane.contact[k] != 0, jnp.abs(lane.contact[k])
        place = at_stop(plan.machine, k, contact, lambda stop: stop.place, begin.x)
        begin, end = (
            Rates(jnp.where(rests, place, r.x), jnp.where(rests, 0.0, r.v), r.a)
            for r in (begin, end)
        )
    factor, aimed = tolerance_factor(plan, lane), lane.target == to_turn_of(k)
    met = turns_within(turn_tolerance(h) * factor, end)
    if len(plan.machine.coordinates) > 1:  # several may turn at once, but each when it turns
        at_once = turns_within(landing_tolerance(h) * factor, end)
        at_once = at_once | (lane.direction[k] * stop_gradient(end.v) < 0)
        for j in range(len(plan.machine.coordinates)):
            aimed = aimed if j == k else aimed | (lane.target == to_turn_of(j)) & at_once
    if plan.others(lane.state):
        # Such an event may be a turning point as well.
        aimed = aimed | (lane.target >= to_event(len(stops_of(plan.machine))))
    at_turn = good & aimed & met
    near, pull = None, None
    if lane.contact is not None and stops_on(plan.machine, k):
        at_rest = lane.contact[k] > 0
        brief = stop_gradient(_SLIVER * limit + jnp.zeros_like(h))

        def of_force(_: None) -> NearStop:
            places = (lane.s, lane.state), (s1, new)
            first, last = (force_rate(free, body, smooth, *place) for place in places)
            release = locate_release(plan, lane, k, (begin, end), (first, last), good, h)
            return NearStop(release, first, last, brief)

        def far(_: None) -> NearStop:
            no, zero = jnp.zeros_like(good), jnp.zeros_like(h)
            return NearStop(Release(no, no, h, zero, no, no), zero, zero, brief)

        asked = at_rest | may_turn_between(plan, lane, k, stop_gradient((begin, end)), h)
        near = jax.lax.cond(asked, of_force, far, None)
        if k in inner.forces:
            away, slow, along = plan.away(k, lane.contact[k]), inner.slow[k], -lane.direction[k]
            first, last = (
                Rates(
                    jnp.where(at_rest, away * r.a, jnp.where(slow, along * r.v, -1.0)),
                    jnp.where(at_rest, away * rate, jnp.where(slow, along * r.a, 0.0)),
                    r.a,
                )
                for r, rate in ((begin, near.begin), (end, near.end))
            )
            pull = Side(first, last, inner.forces[k], inner.slack[k], at_rest | slow)
    return Path(begin, end, at_turn, near, pull)
