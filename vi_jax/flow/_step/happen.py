"""What an event that is no impact makes of a lane."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import after_event, happens_at, mode_number, value_of
from .. import results
from .._arrival import Arrival, ended
from .._lane import CHANGES, LEAVES, RESETS, Plan, select, to_event
from .._log import clock_at, logged, noted
from ..events import rates
from ..smooth import holding, rounding
from .faults import comes_back
from .guards import Crossing
from .jump import after_jump


def happened(plan: Plan, taken: Flag, arrival: Arrival, c: Crossing, there: State) -> Arrival:
    """The arrival after an event that is no impact: a switch, a reset or another kind.

    **Arguments:** `taken`, whether the step is taken; `c`, the event; `there`, the state in which
    it is met.
    """
    machine, event = plan.machine, c.event
    met = machine, c.number, arrival.s, there, arrival.modes
    when = happens_at(*met)
    happens = c.landed if when is None else c.landed & when
    new, modes = after_event(*met, arrival.contact or ())
    modes = select(happens, modes, arrival.modes)
    clock = clock_at(plan, arrival.s, there)
    if event.holds_mode:
        slides = comes_back(machine, c.number, modes, arrival.s, new)
        arrival = ended(arrival, c.landed, slides, results.SLIDING)
        kind, number = CHANGES, c.number - len(machine.stops)
        value = modes[mode_number(machine, c.number)]
    else:
        kind, number = RESETS, c.number - len(machine.stops) - len(machine.switches)
        value = value_of(*met)
    events = noted(arrival.tally.events, taken & happens, clock, kind, number, value)
    arrival = arrival.counting(events=events)
    if plan.log_switches:
        zero = jnp.zeros_like(arrival.s)
        before, count = arrival.tally, jnp.where(taken & happens, 1.0, 0.0)
        # Listed as an impact is, and so counted.
        log = logged(before.log, taken & happens, before.impacts, clock, zero, c.number)
        arrival = arrival.counting(log=log, impacts=before.impacts + count)
    if not event.holds_mode:
        arrival = _jumped(plan, arrival, c, happens, there, new)
    modes_before = arrival.modes
    arrival = arrival._replace(state=select(happens, new, arrival.state)).going(modes=modes)
    return _let_go(plan, arrival, taken, happens, (there, modes_before))


def _let_go(
    plan: Plan, arrival: Arrival, taken: Flag, when: Flag, before: tuple[State, Scalars]
) -> Arrival:
    """The arrival without those bodies at rest that were pressed on their stops before an event and
    are pulled away behind it: a force that jumps has no zero to be released at.

    **Arguments:** `taken`, whether the step is taken; `when`, whether the event happened; `before`,
    the state and the modes before it.
    """
    machine, contact, modes = plan.machine, arrival.contact, arrival.modes
    if contact is None or not modes:
        return arrival
    old, modes_before = before
    freed, direction, events = list(contact), list(arrival.direction), arrival.tally.events
    for k in sorted({stop.coordinate for stop in machine.stops}):

        def pressing(modes: Scalars, state: State, k: int = k) -> Scalar:
            free = holding(machine, modes, contact, but=k)
            return rates(free.field, machine.coordinates[k].position, arrival.s, state).a

        sign, _ = plan.wall(k, contact[k])
        pressed, pulled = sign * pressing(modes_before, old), sign * pressing(modes, arrival.state)
        goes = when & (contact[k] > 0) & stop_gradient((pressed >= 0) & (pulled < 0))
        clock = clock_at(plan, arrival.s, arrival.state)
        events = noted(events, taken & goes, clock, LEAVES, contact[k] - to_event(0), jnp.nan)
        freed[k] = jnp.where(goes, 0.0, contact[k])
        direction[k] = jnp.where(goes, -sign, direction[k])
    arrival = arrival.going(contact=tuple(freed), direction=tuple(direction))
    return arrival.counting(events=events)


def _jumped(
    plan: Plan, arrival: Arrival, c: Crossing, happens: Flag, there: State, new: State
) -> Arrival:
    """The arrival after a jump of the state: which way the motion goes on, and which bodies still
    rest. A lane whose body was put beyond a stop ends.

    **Arguments:** `c`, the event; `happens`, whether it did; `there` and `new`, the states before
    and after it.
    """
    beyond = jnp.zeros_like(happens)
    for stop in plan.machine.stops:
        place = plan.machine.coordinates[stop.coordinate].position(new)
        beyond = beyond | (stop.beyond(place) > rounding(plan.machine, new))
    if plan.machine.stops:
        arrival = ended(arrival, c.landed, happens & beyond, results.BAD_RESET)
    direction, contact = after_jump(plan, arrival.onward, happens, there, new, arrival.s)
    assert arrival.before is not None  # as the machine has such events
    before = jnp.where(c.landed, plan.machine.position(there), arrival.before)
    return arrival._replace(before=before).going(direction=direction, contact=contact)
