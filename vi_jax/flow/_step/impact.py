"""The impacts of one instant: one blow on a stop, or a sequence between bodies that touch."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import (
    AbstractMachine,
    Coordinate,
    RigidStop,
    forces,
    push_of,
    rubbed,
    rubbing_on,
    rubs,
    shares,
    stops_of,
)
from .._lane import Lane, Plan, select, to_event, written
from ..results import EventKind

# By so many roundings a rebound may be faster than the approach: a choice, a few more than the one
# or two that a law's own arithmetic makes.
_FASTER = 16.0


class Blow(NamedTuple):
    """What the impacts of one instant were to one coordinate."""

    struck: Scalar
    """1 + i if stop number i was struck last, 0 if none was."""
    approach: Scalar
    """The greatest speed of approach."""
    share: Scalar
    """What is left of that speed."""


def is_compound(machine: AbstractMachine) -> bool:
    """Whether several velocities change in an impact, across stops or along them; static."""
    return len({stop.coordinate for stop in stops_of(machine)}) > 1 or rubs(machine)


def gains_speed(stop: RigidStop, approach: Scalar, rebound: Scalar) -> Flag | None:
    """Whether an impact leaves faster than it came, or goes on into the stop; `None` where the law
    is one number, whose range is known."""
    if stop.is_one_number:
        return None
    leaves = stop_gradient(-stop.sign * rebound)
    most = (1 + _FASTER * float(jnp.finfo(leaves.dtype).eps)) * stop_gradient(approach)
    return ~((leaves >= 0) & (leaves <= most))


def recorded(
    plan: Plan, lane: Lane, there: State, hit: Flag, number: int, approach: Scalar
) -> Lane:
    """The lane with an impact counted and logged.

    **Arguments:** `there`, the state in which the stop is met; `hit`, whether it is, by a step that
    is taken; `number`, the stop's; `approach`, V⁻.
    """
    clock, record = plan.clock(lane.s, there), lane.record
    speed, log, impacts = record.impact_speed, record.log, record.impacts
    if speed is not None:
        speed = jnp.where(hit, jnp.maximum(speed, approach), speed)
    if log is not None:
        log = written(log, hit, impacts, clock, approach, number)
    impacts = impacts + jnp.where(hit, 1.0, 0.0)
    lane = lane.recording(impact_speed=speed, log=log, impacts=impacts)
    return lane.noting(hit, clock, EventKind.impact, number, approach)


def strike_once(
    plan: Plan, taken: Flag, lane: Lane, landed: dict[int, Flag], there: State
) -> tuple[Lane, dict[int, Blow]]:
    """The lane after an impact, and what it was to the coordinate, by its number, where stops limit
    one coordinate and nothing rubs.

    **Arguments:** `taken`, whether the step is taken; `landed`, of each stop, by its number,
    whether the step landed on it; `there`, the state in which it did.
    """
    machine, k = plan.machine, stops_of(plan.machine)[0].coordinate
    body = machine.coordinates[k]
    blow = Blow(*(jnp.zeros_like(lane.s) for _ in range(3)))
    velocity = body.velocity(there)
    for number, met in landed.items():
        stop = stops_of(machine)[number]
        approach = jnp.maximum(stop.approach(velocity), 0.0)
        rebound, share = stop.rebound_and_share(approach)
        lane = lane.ended(met, gains_speed(stop, approach, rebound), "bad_impact")
        state = select(met, body.placed(there, stop.place, rebound), lane.state)
        lane = recorded(plan, lane._replace(state=state), there, taken & met, number, approach)
        energy = lane.record.impact_energy
        if energy is not None:
            lost = stop.loss(approach, share)
            lost = lost if _is_one(body.mass) else body.mass_at(lane.s, there) * lost
            lane = lane.recording(impact_energy=energy + jnp.where(taken & met, lost, 0.0))
        new = Blow(jnp.where(met, to_event(number), 0.0), approach, share)
        blow = new if len(landed) == 1 else select(met, new, blow)
    return lane, {k: blow}


def _is_one(mass: object) -> bool:
    return isinstance(mass, float) and mass == 1.0


# Shares of the greatest speed of approach so far. Below the first a contact does not close: it is
# rounding of the blows before. At the second the sequence is replaced by its limit, in which those
# contacts come to rest that were struck and move no faster than `_ALIKE` times the fastest.
# All three are choices; how many blows they take in known cases is in docs/internals/step.md.
_NONE, _WEAK, _ALIKE = 1e-12, 1e-7, 30.0

# Speeds that differ by no more than this share are the same: a choice, far above rounding.
_EQUAL = 1e-9

# Contacts that share less than this of each other's velocity are struck each by itself: a choice.
_APART = 1e-6

# A ball between a wall and a body 100 times heavier is struck 31 times, one of 10,000 times 314
# (π times the root of the ratio): this is enough for a body 1.7 million times heavier.
_ROUNDS = 4096.0


class _Round(NamedTuple):
    """A sequence of impacts between two of them."""

    lane: Lane
    struck: Scalars
    """Of each coordinate, as in `Blow`."""
    approach: Scalars
    most: Scalar
    """The greatest speed of approach that there was."""
    goes_on: Scalar
    rounds: Scalar


class _Instant(NamedTuple):
    """What is known of an instant before its impacts, and stays the same in all of them."""

    plan: Plan
    taken: Flag
    s: Scalar
    met: Flag
    """Whether any stop is landed upon."""
    there: State
    """The state before."""
    limited: list[int]
    """The numbers of the coordinates that stops limit."""
    bodies: list[Coordinate]
    """The coordinates of these numbers."""
    before: list[Scalar]
    """Their velocities before."""
    gains: list[list[Scalar]]
    """What they gain by each other's force (see `machine.contacts`)."""
    landed: dict[int, Flag]
    touches: dict[int, Flag]
    """Of each stop, whether its contact is closed."""
    coupled: list[Flag]
    """Of each coordinate, whether one of those landed upon acts on it, through contacts that are
    closed."""
    slow: list[Scalar | float]
    """Of each coordinate, how much of its velocity is rounding."""


def strike_in_turn(
    plan: Plan, taken: Flag, lane: Lane, landed: dict[int, Flag], there: State
) -> tuple[Lane, dict[int, Blow]]:
    """As `strike_once`, where stops limit several coordinates, or something rubs.

    Where bodies touch, a blow on one contact brings the next one together at the same instant. The
    contact that closes fastest is struck first, those that close equally fast together, so that
    what is symmetrical stays so; then the next, until none closes. A sequence that gets weaker
    without an end (several balls without restitution) goes to its limit: the contacts that are
    still being struck come to rest against each other.
    """
    limited = sorted({stop.coordinate for stop in stops_of(plan.machine)})
    instant = _instant(plan, taken, lane, landed, there, limited)
    zero = jnp.zeros_like(lane.s)
    nothing = tuple(zero for _ in limited)
    # One that is landed upon without any speed, as of bodies let go of together, may come to rest.
    touched = list(nothing)
    for number, stop in enumerate(stops_of(plan.machine)):
        i = limited.index(stop.coordinate)
        touched[i] = jnp.where(landed[number], to_event(number), touched[i])
    first = select(instant.met, there, lane.state)
    begin = _Round(
        lane._replace(state=first), tuple(touched), nothing, zero,
        jnp.where(instant.met, 1.0, zero), zero,
    )  # fmt: skip
    end = jax.lax.while_loop(
        lambda x: (x.goes_on > 0) & (x.rounds < _ROUNDS), lambda x: _struck(instant, x), begin
    )
    endless = end.rounds >= _ROUNDS
    lane = end.lane.ended(instant.met, endless, "simultaneous")
    blows = {}
    for k, body, struck, fastest in zip(
        limited, instant.bodies, end.struck, end.approach, strict=True
    ):
        leaves = -plan.wall(k, struck)[0] * body.velocity(lane.state)
        share = leaves / jnp.where(fastest > 0, fastest, 1.0)
        blows[k] = Blow(struck, fastest, jnp.clip(share, 0.0, 1.0))
    return lane, blows


def _instant(
    plan: Plan, taken: Flag, lane: Lane, landed: dict[int, Flag], there: State,
    limited: list[int],
) -> _Instant:  # fmt: skip
    """What is known of an instant before its impacts.

    **Arguments:** as `strike_in_turn`.
    """
    bodies = [plan.machine.coordinates[k] for k in limited]
    gains_ = shares(bodies, there, [push_of(body, there) for body in bodies])
    met = jnp.zeros_like(taken)
    coupled = [met for _ in limited]
    touches = {}
    for number, stop in enumerate(stops_of(plan.machine)):
        at, here = limited.index(stop.coordinate), landed[number]
        met, coupled[at] = met | here, coupled[at] | here
        depth = stop_gradient(stop.beyond(bodies[at].position(there)))
        slack = (
            256
            * float(jnp.finfo(depth.dtype).eps)
            * (plan.extent(stop.coordinate) + jnp.abs(stop_gradient(stop.gap)))
        )
        closed = here | (jnp.abs(depth) <= slack)
        if lane.contact is not None:
            closed = closed | (lane.contact[stop.coordinate] == to_event(number))
        touches[number] = closed
    coupled = _coupled(plan, limited, gains_, touches, coupled)
    before = [body.velocity(there) for body in bodies]
    return _Instant(
        plan, taken, lane.s, met, there, limited, bodies, before, gains_, landed, touches,
        coupled, [plan.rounding(k, there)[1] for k in limited],
    )  # fmt: skip


def _coupled(
    plan: Plan, limited: list[int], gains: list[list[Scalar]], touches: dict[int, Flag],
    coupled: list[Flag],
) -> list[Flag]:  # fmt: skip
    """Of each coordinate, whether a blow on one of those marked is felt by it through closed
    contacts.

    **Arguments:** `limited`, the numbers of the coordinates; `gains` as from `shares`; `touches`,
    of each stop whether its contact is closed; `coupled`, the marks.
    """
    closed = [jnp.zeros((), bool) for _ in limited]
    for number, stop in enumerate(stops_of(plan.machine)):
        i = limited.index(stop.coordinate)
        closed[i] = closed[i] | touches[number]
    size, coupled = len(limited), list(coupled)
    # There and back takes each mark two contacts further, whatever their numbers.
    for _ in range(max(1, size // 2)):
        for i in (*range(size), *reversed(range(size - 1))):
            for j in range(size):
                if j != i:
                    acts = jnp.abs(stop_gradient(gains[i][j])) > _APART
                    coupled[i] = coupled[i] | (closed[i] & coupled[j] & acts)
    return coupled


def _struck(instant: _Instant, x: _Round) -> _Round:
    """The sequence after its next impacts: those of the contacts that close fastest."""
    plan, lane = instant.plan, x.lane
    stops, state = stops_of(plan.machine), lane.state
    velocities = [body.velocity(state) for body in instant.bodies]
    closing = _closing(instant, x, velocities)
    fastest = stop_gradient(jnp.max(jnp.stack(list(closing.values()))))
    most = jnp.maximum(x.most, fastest)
    goes_on = fastest > _NONE * most
    weak = goes_on & (fastest <= _WEAK * most)

    hits, rebounds = {}, {}
    for number, stop in enumerate(stops):
        hit = goes_on & ~weak & (stop_gradient(closing[number]) >= (1 - _EQUAL) * fastest)
        hits[number] = hit
        rebounds[number] = stop.leaving(stop.sign * jnp.where(hit, closing[number], 0.0))
    alone = _each_by_itself(instant, velocities, hits, rebounds)
    found = jnp.zeros_like(goes_on)
    for number, hit in hits.items():
        hits[number], found = hit & ~(alone & found), found | hit
    # In the limit what is still being struck comes to rest.
    slow = [
        weak & (struck > 0) & (jnp.abs(stop_gradient(V)) <= _ALIKE * fastest)
        for struck, V in zip(x.struck, velocities, strict=True)
    ]
    new, pushed = _pushed_state(instant, state, velocities, slow, hits, rebounds)
    lane = _with_losses(instant, lane._replace(state=new), state, pushed)
    struck, approaches = list(x.struck), list(x.approach)
    for number, hit in hits.items():
        stop, i = stops[number], instant.limited.index(stops[number].coordinate)
        speed = jnp.maximum(closing[number], 0.0)
        lane = lane.ended(hit, gains_speed(stop, speed, rebounds[number]), "bad_impact")
        lane = recorded(plan, lane, instant.there, instant.taken & hit, number, speed)
        if stop.modes is not None:
            given = plan.machine, lane.s, state, new, lane.modes
            lane = lane._replace(modes=select(hit, stop.modes_after(*given), lane.modes))
        struck[i] = jnp.where(hit, to_event(number), struck[i])
        approaches[i] = jnp.where(hit, jnp.maximum(approaches[i], speed), approaches[i])
    return _Round(
        lane, tuple(struck), tuple(approaches), most,
        jnp.where(goes_on & ~weak, 1.0, 0.0), x.rounds + 1.0,
    )  # fmt: skip


def _each_by_itself(
    instant: _Instant, velocities: list[Scalar], hits: dict[int, Flag], rebounds: dict[int, Scalar]
) -> Flag:
    """Whether contacts that close equally fast are struck one after the other all the same, in
    their order: with friction, where one would have to pull, and where laws that differ would gain
    energy together."""
    if rubs(instant.plan.machine):
        return jnp.ones((), bool)
    size = range(len(instant.bodies))
    on, wanted = [jnp.zeros((), bool) for _ in size], [jnp.zeros_like(V) for V in velocities]
    signs = list(wanted)
    for number, hit in hits.items():
        stop = stops_of(instant.plan.machine)[number]
        i = instant.limited.index(stop.coordinate)
        on[i] = on[i] | hit
        wanted[i] = jnp.where(hit, rebounds[number] - velocities[i], wanted[i])
        signs[i] = jnp.where(hit, float(stop.sign), signs[i])
    amounts = stop_gradient(forces(instant.gains, on, wanted))
    gained, size_of, pulls = jnp.zeros(()), jnp.zeros(()), jnp.zeros((), bool)
    for i, body in enumerate(instant.bodies):
        work = (
            body.mass_at(instant.s, instant.there) * amounts[i] * (velocities[i] + 0.5 * wanted[i])
        )
        gained, size_of = gained + work, size_of + jnp.abs(work)
        pulls = pulls | (amounts[i] * signs[i] > _EQUAL * jnp.abs(wanted[i]))
    return stop_gradient(pulls | (gained > _EQUAL * size_of))


def _pushed_state(
    instant: _Instant, state: State, velocities: list[Scalar], slow: list[Flag],
    hits: dict[int, Flag], rebounds: dict[int, Scalar],
) -> tuple[State, list[tuple[Coordinate, Scalar]]]:  # fmt: skip
    """The state after the next impacts, and by how much each coordinate's velocity was pushed.

    **Arguments:** `state` and `velocities` before them; `slow`, which coordinates come to rest; of
    each stop, by its number, in `hits` whether it is hit, in `rebounds` the velocity after that.
    """
    machine = instant.plan.machine
    on, wanted, places = list(slow), [-V for V in velocities], []
    for i, body in enumerate(instant.bodies):
        place = body.position(state)
        for number, hit in hits.items():
            if stops_of(machine)[number].coordinate == instant.limited[i]:
                on[i], place = on[i] | hit, jnp.where(hit, stops_of(machine)[number].place, place)
                wanted[i] = jnp.where(hit, rebounds[number] - velocities[i], wanted[i])
        places.append(place)
    amounts = forces(instant.gains, on, wanted)
    new = state
    for i, body in enumerate(instant.bodies):
        moved = body.placed(state, places[i], velocities[i] + amounts[i])
        new = jtu.tree_map(
            lambda a, b, c, on=on[i]: a if c is b else a + jnp.where(on, c - b, 0.0),
            new, state, moved,
        )  # fmt: skip
    pushed = []
    for number, hit in hits.items():
        friction = rubbing_on(machine, number)
        if friction is not None:
            i = instant.limited.index(stops_of(machine)[number].coordinate)
            rough = rubbed(machine, number, friction, instant.s, state, new)
            new = select(hit, rough.state, new)
            amounts[i] = jnp.where(hit, rough.pushed, amounts[i])
            along = machine.coordinates[friction.along]
            pushed.append((along, jnp.where(hit, rough.dragged, 0.0)))
    return new, [*pushed, *zip(instant.bodies, amounts, strict=True)]


def _closing(instant: _Instant, x: _Round, velocities: list[Scalar]) -> dict[int, Scalar]:
    """Of each stop the speed of approach, if it may be hit next; else a negative number.

    Two bodies that meet their stops at one instant, of which neither feels the other, are two
    instants to derivatives: only what a blow brought together, or acts on what is landed upon,
    takes part.
    """
    found = {}
    for number, stop in enumerate(stops_of(instant.plan.machine)):
        i = instant.limited.index(stop.coordinate)
        speed = stop.approach(velocities[i])
        size = stop_gradient(speed)
        changed = jnp.abs(stop_gradient(velocities[i] - instant.before[i])) > _NONE * x.most
        mine = instant.landed[number] | ((changed | instant.coupled[i]) & (size > instant.slow[i]))
        found[number] = jnp.where(mine & instant.touches[number] & (size > 0), speed, -1.0)
    return found


def _with_losses(
    instant: _Instant, lane: Lane, before: State, pushed: list[tuple[Coordinate, Scalar]]
) -> Lane:
    """With the energy that the impacts have lost: the work of each force at the mean velocity of
    its contact. A law that gains some ends the lane."""
    lost, size = jnp.zeros_like(lane.s), jnp.zeros_like(lane.s)
    for body, amount in pushed:
        V, left = body.velocity(before), body.velocity(lane.state)
        mass = body.mass_at(instant.s, before)
        lost = lost - mass * amount * 0.5 * (V + left)
        size = size + mass * jnp.abs(amount) * (jnp.abs(V) + jnp.abs(left))
    energy = lane.record.impact_energy
    if energy is not None:
        hit = instant.taken & instant.met
        lane = lane.recording(impact_energy=energy + jnp.where(hit, lost, 0.0))
    wrong = stop_gradient(lost) < -1e-9 * stop_gradient(size)
    return lane.ended(instant.met, wrong, "bad_impact")
