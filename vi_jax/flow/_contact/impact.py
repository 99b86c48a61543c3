"""The impacts of one instant: one blow on a stop, or a sequence between bodies that touch."""

import jax.numpy as jnp

from ..._types import Flag, State
from ...machine import AbstractMachine, rubs
from .. import results
from .._arrival import Arrival, ended
from .._lane import Plan, select, to_event
from .blow import Blow, gains_speed, listed
from .sequence import strike_in_turn


def strike(
    plan: Plan, taken: Flag, arrival: Arrival, landed: dict[int, Flag], there: State
) -> tuple[Arrival, dict[int, Blow]]:
    """The arrival after the impacts of one instant, and what they were to each coordinate, by its
    number.

    **Arguments:** `taken`, whether the step is taken; `landed`, of each stop, by its number,
    whether the step landed on it; `there`, the state in which it did.
    """
    limited = sorted({stop.coordinate for stop in plan.machine.stops})
    if not is_compound(plan.machine):
        return _one_blow(plan, taken, arrival, landed, there, limited[0])
    return strike_in_turn(plan, taken, arrival, landed, there, limited)


def is_compound(machine: AbstractMachine) -> bool:
    """Whether several velocities change in an impact, across stops or along them; static."""
    return len({stop.coordinate for stop in machine.stops}) > 1 or rubs(machine)


def _one_blow(
    plan: Plan, taken: Flag, arrival: Arrival, landed: dict[int, Flag], there: State, k: int
) -> tuple[Arrival, dict[int, Blow]]:
    """As `strike`, where stops limit one coordinate and nothing rubs.

    **Arguments:** as `strike`; `k`, the number of that coordinate.
    """
    machine, body = plan.machine, plan.machine.coordinates[k]
    blow = Blow(*(jnp.zeros_like(arrival.s) for _ in range(3)))
    velocity = body.velocity(there)
    for number, met in landed.items():
        stop = machine.stops[number]
        approach = jnp.maximum(stop.approach(velocity), 0.0)
        rebound, share = stop.rebound_and_share(approach)
        arrival = ended(arrival, met, gains_speed(stop, approach, rebound), results.BAD_IMPACT)
        state = select(met, body.placed(there, stop.place, rebound), arrival.state)
        arrival = listed(plan, arrival._replace(state=state), there, taken & met, number, approach)
        if arrival.tally.loss is not None:
            lost = stop.loss(approach, share)
            lost = lost if _is_one(body.mass) else body.mass_at(arrival.s, there) * lost
            arrival = arrival.counting(loss=arrival.tally.loss + jnp.where(taken & met, lost, 0.0))
        new = Blow(jnp.where(met, to_event(number), 0.0), approach, share)
        blow = new if len(landed) == 1 else select(met, new, blow)
    return arrival, {k: blow}


def _is_one(mass: object) -> bool:
    return isinstance(mass, float) and mass == 1.0
