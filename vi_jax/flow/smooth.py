"""A machine as one step sees it: in its modes, with the bodies held that rest; and integrals along
its motion, on which nothing that moves depends."""

from collections.abc import Callable
from math import pi
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.core import Tracer
from jax.extend.core import Jaxpr
from jax.lax import stop_gradient

from .._types import Flag, Scalar, Scalars, State
from ..lanes import called, walked
from ..machine import (
    AbstractMachine,
    Coordinate,
    added,
    field_in,
    gained,
    has_contact_friction,
    held_flow,
    holds_anywhere,
    push_of,
    scales_known,
    shown_modes,
    stops_of,
)

# Thresholds in `s` are for cycles of about 2π, up to so many times shorter or longer: a choice.
_USUAL = 100.0


def unit_of(machine: AbstractMachine) -> Scalar | float:
    """A length of `s` by which short ones are judged: 1, or the 2π-th part of a cycle that is much
    shorter or much longer than that."""
    cycle = machine.cycle
    if scales_known(machine) or (isinstance(cycle, float | int) and 1 / _USUAL < cycle < _USUAL):
        return 1.0
    unit = stop_gradient(jnp.asarray(cycle)) / (2 * pi)
    return jnp.where((unit > 1 / _USUAL) & (unit < _USUAL), 1.0, unit)


def limited_of(machine: AbstractMachine) -> list[int]:
    """The numbers of the coordinates that stops limit."""
    return sorted({stop.coordinate for stop in stops_of(machine)})


class SmoothMachine(eqx.Module):
    """What a step asks of a machine: smooth, since its modes stay as they are and the bodies that
    rest are held."""

    machine: AbstractMachine
    modes: Scalars
    contact: Scalars
    """Of each coordinate, 1 + i while it rests on stop number i, else 0; or none at all."""

    def field(self, s: Scalar, state: State) -> State:
        """d(state)/ds, without motion of a body that is held."""
        traced = any(isinstance(x, Tracer) for x in jtu.tree_leaves((self, s, state)))
        field: Any = _traced_once if traced else SmoothMachine.held_field
        return field(self, s, state)

    def held_field(self, s: Scalar, state: State) -> State:
        """The same, traced anew."""
        machine = self.machine
        flow, dry = field_in(machine, s, state, self.modes), holds_anywhere(machine)
        if not self.contact and not dry:
            return flow
        limited = limited_of(machine) if self.contact else []
        several = len(limited) > 1 or has_contact_friction(machine)
        if several or dry:
            flow = held_flow(machine, flow, s, state, self.modes, self.contact)[0]
        for k in () if several else limited:  # without rounding where one body rests
            flow = _held_still(machine.coordinates[k], state, flow, self.contact[k] > 0)
        return flow


@eqx.filter_jit
def _traced_once(smooth: SmoothMachine, s: Scalar, state: State) -> State:
    # A step calls it about sixty times. Inlined, it would double a small machine's first call.
    return smooth.held_field(s, state)


def _held_still(coordinate: Coordinate, state: State, flow: State, rests: Flag) -> State:
    """The rate of a state along `flow` while this coordinate keeps its place and velocity, if it
    `rests`: without what its force takes, or the derivative of `placed`, which need not be
    linear."""
    if coordinate.push is not None:
        taken = jnp.where(rests, -gained(coordinate, state, flow), 0.0)
        return added(flow, (taken,), (push_of(coordinate, state),))
    place, velocity = coordinate.position(state), coordinate.velocity(state)
    zero = jnp.zeros_like(place)
    along = (state, place, velocity), (flow, zero, jnp.zeros_like(velocity))
    still = jax.jvp(coordinate.placed, *along)[1]
    return jtu.tree_map(lambda a, b: jnp.where(rests, a, b), still, flow)


def in_modes(machine: AbstractMachine, modes: Scalars) -> SmoothMachine:
    """The machine with its modes as they are and nothing held."""
    return SmoothMachine(machine, modes, ())


def holding(
    machine: AbstractMachine, modes: Scalars, contact: Scalars | None, but: int | None = None
) -> SmoothMachine:
    """The machine in its modes, with those bodies held that rest on a stop (see `Lane.contact`);
    that of coordinate number `but` is free."""
    if contact is None or (but is not None and len(contact) == 1):
        return in_modes(machine, modes)
    others = (x if j != but else jnp.zeros_like(x) for j, x in enumerate(contact))
    return SmoothMachine(machine, modes, tuple(others))


def exact(machine: AbstractMachine, state: State) -> bool:
    """Whether one number of the state is all that stops limit, so that it can be put on a stop
    without rounding; known while a step is traced."""
    place = machine.coordinates[0].position(state)
    own = any(place is x for x in jtu.tree_leaves(state))
    return own and len(machine.coordinates) == 1


# Primitives that are linear in all of their operands together, and in each of them.
_LINEAR = {
    "add", "add_any", "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "neg",
    "reduce_sum", "reshape", "slice", "squeeze", "stack", "sub", "transpose", "unstack",
}  # fmt: skip
_BILINEAR = {"dot_general", "mul"}


def is_affine(function: Callable[[State], Scalar], state: State) -> bool:
    """Return whether a function of the state is a sum of its numbers with constant factors, so that
    it is known as well as they are; found while a step is traced."""

    def moved(eqn: Any, moves: list[bool]) -> list[bool]:
        name, body = eqn.primitive.name, called(eqn)
        if body is not None:
            return walked(body if isinstance(body, Jaxpr) else body.jaxpr, moves, moved)
        linear = name in _LINEAR or (name in _BILINEAR and sum(moves) == 1)
        if not linear and (name != "div" or moves[1]):
            others.append(name)
        return [True] * len(eqn.outvars)

    others: list[str] = []
    jaxpr = jax.make_jaxpr(function)(state).jaxpr
    walked(jaxpr, [True] * len(jaxpr.invars), moved)
    return not others


def rounding(
    machine: AbstractMachine, k: int, state: State, least: Scalar | float = 1.0,
    unit: Scalar | float = 1.0,
) -> tuple[Scalar | float, Scalar | float]:  # fmt: skip
    """How far coordinate number k may be beyond its stop, and its velocity from zero, by rounding
    alone: not at all where the place is a number of the state itself. A place has the size `least`
    at least, in `unit`s of s."""
    if exact(machine, state):
        return 0.0, 0.0
    body = machine.coordinates[k]
    return _rounding(body.position, state, least), _rounding(body.velocity, state, least / unit)


def _rounding(part: Callable[[State], Scalar], state: State, least: Scalar | float) -> Scalar:
    state = stop_gradient(state)
    slopes = jax.grad(lambda x: jnp.sum(part(x)))(state)
    terms = jtu.tree_map(lambda slope, x: jnp.sum(jnp.abs(slope * x)), slopes, state)
    size = sum(jtu.tree_leaves(terms), start=jnp.asarray(least))
    return stop_gradient(16 * jnp.finfo(size.dtype).eps * size)


Integrals = dict[str, Scalar]
"""Integrals since the last record point: the elapsed time by the name `TIME`, where it is recorded;
of each average, by its name, the integral over time (over s if the machine has no `pace`)."""

TIME = "elapsed time"
"""The name of the elapsed time; no name of an average, since it is no identifier."""


def rate_of_integrals(
    smooth: SmoothMachine, s: Scalar, state: State, integrals: Integrals
) -> Integrals:
    """Return d/ds of the integrals of these names."""
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
    """Return those integrals that a method has to carry along: not a time that `s` measures."""
    paced = TIME in integrals and smooth.machine.pace(s, state) is not None
    return {name: x for name, x in integrals.items() if name != TIME or paced}


def elapsed(old: Integrals, new: Integrals, h: Scalar) -> Integrals:
    """Return the integrals after a step of length h, from those before it and those `carried`."""
    return {TIME: old[TIME] + h, **new} if TIME in old else new


def means(integrals: dict[str, Any], duration: object) -> dict[str, Any]:
    """Return the averages of integrals over this duration."""
    return {name: x / duration for name, x in integrals.items()}
