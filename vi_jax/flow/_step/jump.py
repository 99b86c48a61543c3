"""How a motion goes on behind a state that was put in place of another."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from .._arrival import Arrival, Onward
from .._lane import Plan, in_place
from ..events import rates
from ..smooth import holding, rounding
from .guards import Crossing


def after_jump(
    plan: Plan, onward: Onward, when: Flag, old: State, new: State, s: Scalar
) -> tuple[Scalars, Scalars | None]:
    """The directions of all coordinates, and the stops rested on, after the state was replaced by
    another one.

    **Arguments:** `onward`, how the motion went on before; `when`, where the state is replaced;
    `old` and `new`, the states before and after.
    """
    contact = unheld(plan, onward.contact, when, old, new)
    return directions(plan, onward._replace(contact=contact), when, old, new, s), contact


def unheld(
    plan: Plan, contact: Scalars | None, when: Flag, old: State, new: State
) -> Scalars | None:
    """The stops rested on after the state was replaced by another one: what was moved rests no
    longer.

    **Arguments:** `contact`, those before; `when`, where the state is replaced; `old` and `new`,
    the states before and after.
    """
    if contact is None:
        return None
    contacts, slack = list(contact), rounding(plan.machine, new)
    for k, coordinate in enumerate(plan.machine.coordinates):
        (place, before), (there, after) = (
            (coordinate.position(x), coordinate.velocity(x)) for x in (old, new)
        )
        if not (there is place and after is before):
            moved = (jnp.abs(there - place) > slack) | (jnp.abs(after - before) > slack)
            contacts[k] = jnp.where(when & stop_gradient(moved), 0.0, contacts[k])
    return tuple(contacts)


def directions(
    plan: Plan, onward: Onward, when: Flag, old: State, new: State, s: Scalar
) -> Scalars:
    """The directions of all coordinates behind an event.

    **Arguments:** `onward`, how the motion goes on, in the modes behind the event; `when`, where it
    happens; `old` and `new`, the states before and after.
    """
    found: list[Scalar] = list(onward.direction)
    smooth = holding(plan.machine, onward.modes, onward.contact)
    for k, coordinate in enumerate(plan.machine.coordinates):
        after, known = coordinate.velocity(new), plan.machine.has_velocity(new)
        if not known or after is not coordinate.velocity(old):
            here = rates(smooth.field, coordinate.position, s, new)
            # The second number of a state without velocities may be anything.
            after = after if known else here.v
            after = stop_gradient(jnp.where(after == 0, here.a, after))
            found[k] = jnp.where(when & (after != 0), jnp.sign(after), found[k])
    return tuple(found)


def disarmed_itself(plan: Plan, arrival: Arrival, c: Crossing) -> Arrival:
    """With the guard of an event that was met to come from below anew."""
    numbers = plan.from_below(arrival.state)
    if c.number not in numbers:
        return arrival
    below, i = arrival.onward.below, numbers.index(c.number)
    return arrival.going(below=in_place(below, i, jnp.where(c.landed, 0.0, below[i])))
