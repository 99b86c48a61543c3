"""What an event that is no impact makes of a lane."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import after_event, guard_of, happens_at, mode_number, value_of
from .. import results
from .._arrival import Arrival, ended
from .._lane import CHANGES, LEAVES, RESETS, Plan, select, to_event
from .._log import clock_at, logged, noted
from ..events import rates
from ..smooth import beyond_a_stop, holding
from .faults import comes_back
from .guards import Crossing
from .jump import after_jump, disarmed, disarmed_itself

# A guard has jumped above zero by more than this, which is more than rounding leaves of one that
# was met.
_JUMPED = 1e-9


def happened(
    plan: Plan, taken: Flag, arrival: Arrival, c: Crossing, there: State
) -> tuple[Arrival, Flag]:
    """The arrival after an event that is no impact: a switch, a reset or another kind; and whether
    the event happens where its guard has risen.

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
    before = there, arrival.modes
    state = select(happens, new, select(c.landed, there, arrival.state))
    arrival = arrival._replace(state=state).going(modes=modes)
    arrival = _switched(plan, arrival, taken, happens, (c, *before))
    arrival = let_go(plan, arrival, taken, happens, before)
    if not event.holds_mode:
        arrival = disarmed(plan, arrival, happens, before)
    return disarmed_itself(plan, arrival, c), happens


def _switched(
    plan: Plan, arrival: Arrival, taken: Flag, when: Flag,
    before: tuple[Crossing, State, Scalars],
) -> Arrival:  # fmt: skip
    """With the modes of those switches changed whose guard has jumped above zero with an event, as
    that of friction does that held a pull which is another one now: it has no place where it
    passes zero.

    **Arguments:** the event that happened, and state and modes before it.
    """
    machine, contact, (c, old, modes_before) = plan.machine, arrival.contact or (), before
    first = len(machine.stops)
    for number in range(first, first + len(machine.switches)):
        if number == c.number:
            continue
        now = arrival.s, arrival.state, arrival.modes
        was = guard_of(machine, number, arrival.s, old, modes_before, contact)
        is_now = guard_of(machine, number, *now, contact)
        was, is_now = stop_gradient((was, is_now))
        slack = _JUMPED * (1 + jnp.abs(is_now))
        turns = when & (was <= slack) & (is_now > slack)
        new, modes = after_event(machine, number, *now, contact)
        state, modes = select(turns, (new, modes), (arrival.state, arrival.modes))
        value, clock = modes[mode_number(machine, number)], clock_at(plan, arrival.s, state)
        here = arrival.tally.events, taken & turns, clock
        events = noted(*here, CHANGES, number - first, value)
        arrival = arrival._replace(state=state).going(modes=modes).counting(events=events)
    return arrival


def let_go(
    plan: Plan, arrival: Arrival, taken: Flag, when: Flag,
    before: tuple[State, Scalars], resting: Scalars | None = None,
) -> Arrival:  # fmt: skip
    """With those bodies free that were pressed on their stops before an event, and are pulled away
    behind it: a force that jumps has no place where it passes zero.

    **Arguments:** whether the event happens; state and modes before it; what rested then, if that
    may be another than now (as in `Lane.contact`).
    """
    machine, contact, modes = plan.machine, arrival.contact, arrival.modes
    if contact is None:
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
        if resting is not None:
            goes = goes & (resting[k] == contact[k])
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
    if plan.machine.stops:
        beyond = beyond_a_stop(plan.machine, new)
        arrival = ended(arrival, c.landed, happens & beyond, results.BAD_RESET)
    direction, contact = after_jump(plan, arrival.onward, happens, there, new, arrival.s)
    assert arrival.before is not None  # as the machine has such events
    before = jnp.where(c.landed, plan.machine.position(there), arrival.before)
    return arrival._replace(before=before).going(direction=direction, contact=contact)
