"""How a motion goes on behind a state that was put in place of another."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, Scalars, State
from .._arrival import Onward
from .._lane import Plan
from ..events import rates
from ..smooth import holding, rounding


def after_jump(
    plan: Plan, onward: Onward, when: Flag, old: State, new: State, s: Scalar
) -> tuple[Scalars, Scalars | None]:
    """The directions of all coordinates, and the stops rested on, after the state was replaced by
    another one. What was moved rests no longer.

    **Arguments:** `onward`, how the motion went on before; `when`, where the state is replaced;
    `old` and `new`, the states before and after.
    """
    direction, contact, modes = onward
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
