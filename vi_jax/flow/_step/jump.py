"""How a motion goes on behind a state that was put in place of another."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from ...machine import guard_of
from .._arrival import Arrival, Onward
from .._lane import Plan, in_place
from ..events import rates
from ..smooth import holding, rounding
from .guards import Crossing


def after_jump(
    plan: Plan, onward: Onward, when: Flag, old: State, new: State, s: Scalar
) -> tuple[Scalars, Scalars | None]:
    """The directions of all coordinates, and the stops rested on, after the state was replaced by
    another one. What was moved rests no longer.

    **Arguments:** `onward`, how the motion went on before; `when`, where the state is replaced;
    `old` and `new`, the states before and after.
    """
    direction, contact, modes, _ = onward
    directions: list[Scalar] = list(direction)
    contacts: list[Scalar] = list(contact or ())
    slack = rounding(plan.machine, new)
    for k, coordinate in enumerate(plan.machine.coordinates):
        (place, before), (there, after) = (
            (coordinate.position(x), coordinate.velocity(x)) for x in (old, new)
        )
        if contacts and not (there is place and after is before):
            moved = (jnp.abs(there - place) > slack) | (jnp.abs(after - before) > slack)
            contacts[k] = jnp.where(when & stop_gradient(moved), 0.0, contacts[k])
    contact = None if contact is None else tuple(contacts)
    for k, coordinate in enumerate(plan.machine.coordinates):
        after, known = coordinate.velocity(new), plan.machine.has_velocity(new)
        if not known or after is not coordinate.velocity(old):
            smooth = holding(plan.machine, modes, contact)
            here = rates(smooth.field, coordinate.position, s, new)
            # The second number of a state without velocities may be anything.
            after = after if known else here.v
            after = stop_gradient(jnp.where(after == 0, here.a, after))
            directions[k] = jnp.where(when & (after != 0), jnp.sign(after), directions[k])
    return tuple(directions), contact


def disarmed(plan: Plan, arrival: Arrival, when: Flag, before: tuple[State, Scalars]) -> Arrival:
    """With those guards to come from below anew (see `Lane.below`) that a jump of the state has put
    on their surface or beyond. Those that it did not change stay as they are: what they belong to
    may happen at the same instant.

    **Arguments:** where the state jumped, and state and modes before.
    """
    if not plan.machine.events:
        return arrival
    (old, modes), contact, below = before, arrival.contact or (), []
    for number, armed in zip(plan.from_below(arrival.state), arrival.onward.below, strict=True):
        was = guard_of(plan.machine, number, arrival.s, old, modes, contact)
        now = guard_of(plan.machine, number, arrival.s, arrival.state, arrival.modes, contact)
        was, now = stop_gradient((jnp.asarray(was), jnp.asarray(now)))
        slack = float(jnp.finfo(now.dtype).eps) ** 0.5 * (1 + jnp.abs(now))
        put = when & (now >= -slack) & (jnp.abs(now - was) > slack)
        below.append(jnp.where(put, 0.0, armed))
    return arrival.going(below=tuple(below))


def disarmed_itself(plan: Plan, arrival: Arrival, c: Crossing) -> Arrival:
    """With the guard of an event that was met to come from below anew."""
    numbers = plan.from_below(arrival.state)
    if c.number not in numbers:
        return arrival
    below, i = arrival.onward.below, numbers.index(c.number)
    return arrival.going(below=in_place(below, i, jnp.where(c.landed, 0.0, below[i])))
