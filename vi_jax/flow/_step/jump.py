"""How a motion goes on behind a state that was put in place of another."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from .._lane import Plan
from ..events import rates
from ..moving import Moving, in_modes, rounding

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]


class Onward(NamedTuple):
    """What a lane knows of its motion besides the state, as in `Lane`."""

    direction: tuple[Scalar, ...]
    contact: tuple[Scalar, ...] | None
    modes: tuple[Scalar, ...]


def moving_on(plan: Plan, onward: Onward) -> Any:
    """The machine in its modes, with the bodies held that rest."""
    scene = plan.scene
    if onward.contact is None:
        return in_modes(scene, onward.modes)
    rests = tuple(x > 0 for x in onward.contact)
    return Moving(scene=scene, modes=onward.modes, held=rests, stops=scene.stops)


def after_jump(plan: Plan, onward: Onward, when: Flag, old: Any, new: Any, s: Scalar) -> Onward:
    """Which way the motion goes on, where a state was put in place of another, and what of it still
    rests: only what was not moved."""
    directions, contacts = list(onward.direction), list(onward.contact or ())
    slack = rounding(plan.scene, new)
    for k, coordinate in enumerate(plan.scene.coordinates):
        (place, before), (there, after) = (
            (coordinate.position(x), coordinate.velocity(x)) for x in (old, new)
        )
        if contacts and not (there is place and after is before):
            moved = (jnp.abs(there - place) > slack) | (jnp.abs(after - before) > slack)
            contacts[k] = jnp.where(when & stop_gradient(moved), 0.0, contacts[k])
    if contacts:
        onward = onward._replace(contact=tuple(contacts))
    for k, coordinate in enumerate(plan.scene.coordinates):
        after = coordinate.velocity(new)
        if after is not coordinate.velocity(old):
            machine = moving_on(plan, onward)
            bend = rates(machine.field, coordinate.position, s, new).a
            after = stop_gradient(jnp.where(after == 0, bend, after))
            directions[k] = jnp.where(when & (after != 0), jnp.sign(after), directions[k])
    return onward._replace(direction=tuple(directions))
