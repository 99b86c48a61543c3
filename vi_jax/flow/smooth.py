"""The smooth machine of one step, with fixed modes and held bodies; and integrals along its motion,
on which the motion does not depend."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import Jaxpr
from jax.lax import stop_gradient

from .._checks import is_traced
from .._types import Flag, Scalar, Scalars, State
from ..lanes import called, propagate_marks
from ..machine import (
    AbstractMachine,
    Coordinate,
    added,
    constrained_rate,
    field_in,
    frictions_in,
    has_contact_friction,
    held_alone,
    holds_anywhere,
    limited_in,
    push_of,
    shown_modes,
    velocity_change,
)


def constant(tree: Any) -> Any:
    """Return a tree without derivatives. Its booleans, integers and texts stay what they are."""
    return jtu.tree_map(lambda x: stop_gradient(x) if eqx.is_inexact_array(x) else x, tree)


class SmoothMachine(eqx.Module):
    """A machine during one step: smooth, since its modes are fixed and resting bodies are held."""

    machine: AbstractMachine
    modes: Scalars
    contact: Scalars
    """For each coordinate, 1 + i while it rests on stop number i, else 0; or an empty tuple."""

    def field(self, s: Scalar, state: State) -> State:
        """Return d(state)/ds, without motion of held bodies."""
        if not is_traced(self, s, state):
            return self.held_field(s, state)
        if not self._holds_one or holds_anywhere(self.machine):
            return _traced_once(self, s, state)
        # Held outside of the part that is traced once, so that the free motion shares that part.
        return self._with_one_held(
            state, _traced_once(in_modes(self.machine, self.modes), s, state)
        )

    def held_field(self, s: Scalar, state: State) -> State:
        """Return the same as `field`, traced inline."""
        machine, flow = self.machine, field_in(self.machine, s, state, self.modes)
        if holds_anywhere(machine) or (self.contact and not self._holds_one):
            flow = constrained_rate(machine, flow, s, state, self.modes, self.contact)[0]
        return self._with_one_held(state, flow) if self._holds_one else flow

    @property
    def _holds_one(self) -> bool:
        """True if stops may hold one coordinate alone, without friction on them."""
        several = len(limited_in(self.machine)) > 1 or has_contact_friction(self.machine)
        return bool(self.contact) and not several

    def _with_one_held(self, state: State, flow: State) -> State:
        for k in limited_in(self.machine):  # without the rounding of `constrained_rate`
            coordinate, rests = self.machine.coordinates[k], self.contact[k] > 0
            flow = _without_motion(coordinate, state, flow, rests)
        return flow


@eqx.filter_jit
def _traced_once(smooth: SmoothMachine, s: Scalar, state: State) -> State:
    # A step calls it about sixty times. Inlined, it would double a small machine's first call.
    return smooth.held_field(s, state)


def _without_motion(coordinate: Coordinate, state: State, flow: State, rests: Flag) -> State:
    """Return the rate of a state along `flow` with this coordinate's position and velocity constant
    if it `rests`: without the part along `push`, else by the derivative of `placed`."""
    if coordinate.push is not None:
        amount = jnp.where(rests, -velocity_change(coordinate, state, flow), 0.0)
        return added(flow, (amount,), (push_of(coordinate, state),))
    place, velocity = coordinate.position(state), coordinate.velocity(state)
    zero = jnp.zeros_like(place)
    argument = (state, place, velocity), (flow, zero, jnp.zeros_like(velocity))
    still = jax.jvp(coordinate.placed, *argument)[1]
    return jtu.tree_map(lambda a, b: jnp.where(rests, a, b), still, flow)


def in_modes(machine: AbstractMachine, modes: Scalars) -> SmoothMachine:
    """Return the machine in these modes, with nothing held."""
    return SmoothMachine(machine, modes, ())


def hold_contacts(
    machine: AbstractMachine, modes: Scalars, contact: Scalars | None, but: int | None = None
) -> SmoothMachine:
    """Return the machine in these modes, with the bodies held that rest on a stop (see
    `Lane.contact`). The body of coordinate number `but` is free."""
    if contact is None or (but is not None and len(contact) == 1):
        return in_modes(machine, modes)
    others = (x if j != but else jnp.zeros_like(x) for j, x in enumerate(contact))
    frictions = frictions_in(machine)
    if but is not None and len(frictions) > 1:  # a redundant one may hold without it
        modes = tuple(held_alone(x) if i in frictions else x for i, x in enumerate(modes))
    return SmoothMachine(machine, modes, tuple(others))


def stops_are_exact(machine: AbstractMachine, state: State) -> bool:
    """Return whether stops limit only one number of the state itself, so that it can be put on a
    stop without rounding. The result is known at trace time."""
    return is_number_of(machine.coordinates[0], state) and len(machine.coordinates) == 1


def is_number_of(coordinate: Coordinate, state: State) -> bool:
    """Return whether the position of a coordinate is a number of the state itself; known at trace
    time."""
    position = coordinate.position(state)
    return any(position is x for x in jtu.tree_leaves(state))


# Primitives that are linear in all of their operands together, and in each of them.
_LINEAR = {
    "add", "add_any", "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "neg",
    "reduce_sum", "reshape", "slice", "squeeze", "stack", "sub", "transpose", "unstack",
}  # fmt: skip
_BILINEAR = {"dot_general", "mul"}


def is_affine(function: Callable[[State], Scalar], state: State) -> bool:
    """Return whether a function of the state is affine with constant factors, so that its value is
    as accurate as the state; found at trace time."""

    def mark(eqn: Any, depends: list[bool]) -> list[bool]:
        name, body = eqn.primitive.name, called(eqn)
        if body is not None:
            return propagate_marks(body if isinstance(body, Jaxpr) else body.jaxpr, depends, mark)
        linear = name in _LINEAR or (name in _BILINEAR and sum(depends) == 1)
        if not linear and (name != "div" or depends[1]):
            nonlinear.append(name)
        return [True] * len(eqn.outvars)

    nonlinear: list[str] = []
    jaxpr = jax.make_jaxpr(function)(state).jaxpr
    propagate_marks(jaxpr, [True] * len(jaxpr.invars), mark)
    return not nonlinear


Integrals = dict[str, Scalar]
"""Integrals since the last record point: the elapsed time by the name `TIME`, if it is recorded;
and each average's integral over time, by its name (over s if the machine has no `pace`)."""

TIME = "elapsed time"
"""The name of the elapsed time. No average has it, since it is no identifier."""


def rate_of_integrals(
    smooth: SmoothMachine, s: Scalar, state: State, integrals: Integrals
) -> Integrals:
    """Return d/ds of the integrals with these names."""
    if not integrals:
        return {}
    pace, rates = smooth.machine.pace(s, state), {}
    if set(integrals) - {TIME}:
        modes = shown_modes(smooth.machine, smooth.modes)
        for name, value in smooth.machine.averages(s, state, *modes).items():
            value = jnp.asarray(value, s.dtype)
            rates[name] = value if pace is None else pace * value
    if TIME in integrals:
        rates[TIME] = jnp.ones_like(s) if pace is None else pace
    return rates


def carried(smooth: SmoothMachine, s: Scalar, state: State, integrals: Integrals) -> Integrals:
    """Return the integrals that a method must carry: all but a time that `s` measures."""
    paced = TIME in integrals and smooth.machine.pace(s, state) is not None
    return {name: x for name, x in integrals.items() if name != TIME or paced}


def elapsed(old: Integrals, new: Integrals, h: Scalar) -> Integrals:
    """Return the integrals after a step of length h, from those before it and those `carried`."""
    return {TIME: old[TIME] + h, **new} if TIME in old else new


def means(integrals: dict[str, Any], duration: object) -> dict[str, Any]:
    return {name: x / duration for name, x in integrals.items()}
