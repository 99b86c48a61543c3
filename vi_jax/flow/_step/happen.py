"""What an event that is no impact makes of a lane."""

from typing import Any

import jax.numpy as jnp

from ..._types import Flag
from ...machine.event import after_event, happens_at, mode_number, value_of
from .. import results
from .._arrival import Arrival, ended
from .._lane import CHANGES, RESETS, Plan, select
from .._log import clock_at, logged, noted
from ..smooth import rounding
from .faults import comes_back
from .guards import Crossing
from .jump import after_jump


def happened(plan: Plan, taken: Flag, arrival: Arrival, c: Crossing, there: Any) -> Arrival:
    """State and modes after an event in the state `there` that is no impact."""
    machine, event = plan.machine, c.event
    met = machine, c.number, arrival.s, there, arrival.modes
    when = happens_at(*met)
    happens = c.landed if when is None else c.landed & when
    new, modes = after_event(*met, arrival.contact or ())
    modes = select(happens, modes, arrival.modes)
    log, clock = arrival.log, clock_at(plan, arrival.s, there)
    if event.holds_mode:
        slides = comes_back(machine, c.number, modes, arrival.s, new)
        arrival = ended(arrival, c.landed, slides, results.SLIDING)
        kind, number = CHANGES, c.number - len(machine.stops)
        value = modes[mode_number(machine, c.number)]
    else:
        kind, number = RESETS, c.number - len(machine.stops) - len(machine.switches)
        value = value_of(*met)
    events = noted(arrival.events, taken & happens, clock, kind, number, value)
    if plan.log_switches:
        zero = jnp.zeros_like(arrival.s)
        log = logged(log, taken & happens, arrival.impacts, clock, zero, c.number)
        # Listed as an impact is, and so counted.
        count = jnp.where(taken & happens, 1.0, 0.0)
        arrival = arrival._replace(impacts=arrival.impacts + count)
    if not event.holds_mode:
        arrival = _jumped(plan, arrival, c, happens, there, new)
    return arrival._replace(
        state=select(happens, new, arrival.state), modes=modes, log=log, events=events
    )


def _jumped(
    plan: Plan, arrival: Arrival, c: Crossing, happens: Flag, there: Any, new: Any
) -> Arrival:
    """Which way the motion goes on after a jump of the state, and what of it rests still; a lane
    that was put beyond a stop ends."""
    beyond = jnp.zeros_like(happens)
    for stop in plan.machine.stops:
        place = plan.machine.coordinates[stop.coordinate].position(new)
        beyond = beyond | (stop.beyond(place) > rounding(plan.machine, new))
    if plan.machine.stops:
        arrival = ended(arrival, c.landed, happens & beyond, results.BAD_RESET)
    onward = arrival.direction, arrival.contact, arrival.modes
    direction, contact = after_jump(plan, onward, happens, there, new, arrival.s)
    assert arrival.before is not None  # as the machine has such events
    before = jnp.where(c.landed, plan.machine.position(there), arrival.before)
    return arrival._replace(direction=direction, contact=contact, before=before)
