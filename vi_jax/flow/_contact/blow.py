"""What one blow on a stop is, and what is written down of it."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, State
from ...machine import RigidStop
from .._arrival import Arrival
from .._lane import HIT, Plan
from .._log import clock_at, logged, noted

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


def gains_speed(stop: RigidStop, approach: Scalar, rebound: Scalar) -> Flag | None:
    """Whether an impact leaves faster than it came, or goes on into the stop; `None` where the law
    is one number, whose range is known."""
    if stop.is_one_number:
        return None
    leaves = stop_gradient(-stop.sign * rebound)
    most = (1 + _FASTER * float(jnp.finfo(leaves.dtype).eps)) * stop_gradient(approach)
    return ~((leaves >= 0) & (leaves <= most))


def listed(
    plan: Plan, arrival: Arrival, there: State, hit: Flag, number: int, approach: Scalar
) -> Arrival:
    """The arrival with an impact counted and logged.

    **Arguments:** `there`, the state in which the stop is met; `hit`, whether it is, by a step that
    is taken; `number`, the stop's; `approach`, V⁻.
    """
    clock, speed = clock_at(plan, arrival.s, there), arrival.tally.speed
    return arrival.counting(
        impacts=arrival.tally.impacts + jnp.where(hit, 1.0, 0.0),
        speed=None if speed is None else jnp.where(hit, jnp.maximum(speed, approach), speed),
        log=logged(arrival.tally.log, hit, arrival.tally.impacts, clock, approach, number),
        events=noted(arrival.tally.events, hit, clock, HIT, number, approach),
    )
