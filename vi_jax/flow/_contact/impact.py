"""The impacts of one instant: one blow on a stop, or a sequence between bodies that touch."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, State
from ...machine import AbstractMachine, RigidStop, rubs, stops_of
from .._lane import Lane, Plan, select, to_event, written
from ..labelled import EventKind

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
