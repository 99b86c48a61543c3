"""How small the numbers of a motion are, by which the errors of its steps are judged."""

import functools
from collections.abc import Callable
from math import pi

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient

from .._types import Scalar, Scalars, State
from ..machine import (
    AbstractMachine,
    Friction,
    events_of,
    guard_of,
    mode_number,
    scales_known,
)
from ._lane import Plan
from .smooth import in_modes

# A number of the state is small if it is below this; others are judged as if they were 1. One that
# is this share of what the others make of it has still to grow. In so many instants of a cycle the
# rates are asked for. Choices.
_SMALL, _GROWS, _INSTANTS = 1e-2, 1e-3, 7


def sizes_of(machine: AbstractMachine, s: Scalar, start: State, modes: Scalars) -> State | None:
    """About how large each number of the state will be, if that is much less than 1; else 1.
    `None` of a machine whose numbers are about 1 by definition.

    It is the value in the start, or what the rates there make of it in the 2π-th part of a cycle,
    or what the other numbers make of it. The numbers of an array have one size. Nothing is known
    of a number that is zero and that nothing moves yet.

    **Arguments:** `s`, `start` and `modes`, in which the motion begins.
    """
    if scales_known(machine):
        return None
    holding = [x for x in events_of(machine) if x.holds_mode]
    # While something sticks or slides along a surface, its rate tells nothing of its size.
    sticks = [getattr(x, "blends", False) or x.is_dry for x in holding] + [False] * len(modes)
    slips = (jnp.where(x == 0, 1.0, x) if y else x for x, y in zip(modes, sticks, strict=False))
    smooth = in_modes(machine, tuple(slips))
    s, start = stop_gradient((s, start))
    limit = 5 * jnp.asarray(machine.step_limit(s, start)) / (2 * pi)
    unit = stop_gradient(jnp.minimum(jnp.asarray(machine.cycle) / (2 * pi), limit))
    instants = s + jnp.asarray(machine.cycle) * np.arange(_INSTANTS) / _INSTANTS
    rates = jax.vmap(smooth.field, (0, None))(instants, start)
    sizes = jtu.tree_map(
        lambda x, v: jnp.maximum(jnp.abs(x), unit * jnp.max(jnp.abs(v), axis=0)), start, rates
    )
    # Factors that differ keep what acts on a difference from cancelling.
    leaves, tree = jtu.tree_flatten(sizes)
    draw = np.random.default_rng(0)
    signs = [draw.choice([-1, 1], x.shape) * draw.uniform(0.7, 1.0, x.shape) for x in leaves]
    along = tree.unflatten([x * sign for x, sign in zip(leaves, signs, strict=True)])
    moved = jax.jvp(lambda x: smooth.field(s, x), (start,), (along,))[1]

    def size(x: Scalar, change: Scalar) -> Scalar:
        x, change = jnp.max(x), unit * jnp.max(jnp.abs(change))
        return _small(jnp.where(x > _GROWS * change, x, change))

    return stop_gradient(jtu.tree_map(size, sizes, moved))


def extents_of(plan: Plan, s: Scalar, start: State, modes: Scalars, sizes: State) -> Scalars:
    """As `Plan.extents`: of each coordinate, then of the guard of each event that is no stop, how
    small it is, if it is much less than 1; else 1.

    **Arguments:** `sizes`, as from `sizes_of`; `s`, `start` and `modes`, in which the motion
    begins.
    """
    machine, unit = plan.machine, plan.unit
    contact = tuple(jnp.zeros_like(s) for _ in machine.coordinates) if plan.rests else ()
    s, start = stop_gradient((s, start))
    found = [_small(_spread(body.position, start, sizes)) for body in machine.coordinates]
    for number in plan.others(start):
        event = events_of(machine)[number]
        if isinstance(event, Friction):
            found.append(_small(_size_of_friction(plan, number, s, start, modes, contact, sizes)))
            continue
        if event.holds_mode:  # its guard is another quantity in each mode
            found.append(jnp.ones_like(s))
            continue

        def guard(s: Scalar, x: State, number: int = number) -> Scalar:
            return jnp.asarray(guard_of(machine, number, s, x, modes, contact), s.dtype)

        value, rate = jax.jvp(lambda s, guard=guard: guard(s, start), (s,), (jnp.ones_like(s),))
        own = jnp.maximum(jnp.abs(value), unit * jnp.abs(rate))
        spread = _spread(lambda x, guard=guard: guard(s, x), start, sizes)
        found.append(_small(jnp.maximum(own, spread)))
    return stop_gradient(tuple(found))


def _size_of_friction(
    plan: Plan, number: int, s: Scalar, start: State, modes: Scalars, contact: Scalars,
    sizes: State,
) -> Scalar:  # fmt: skip
    """The larger of the slip and of the force that holds a body, where each is a guard of friction.

    **Arguments:** as `extents_of`; `number`, that of the friction among the events; `contact`, of
    bodies of which none rests.
    """
    machine, event = plan.machine, events_of(plan.machine)[number]
    assert isinstance(event, Friction)
    own = mode_number(machine, number)
    held = (*modes[:own], jnp.zeros_like(s), *modes[own + 1 :])

    def force(x: State) -> Scalar:
        return guard_of(machine, number, s, x, held, contact)

    parts = force, lambda x: event.speed_of_slip(machine, s, x)
    each = (jnp.maximum(jnp.abs(x(start)), _spread(x, start, sizes)) for x in parts)
    return functools.reduce(jnp.maximum, each)


def _small(size: Scalar) -> Scalar:
    """A size, but 1 if it is not small, or unknown."""
    return jnp.where((size > 0) & (size < _SMALL), size, 1.0)


def _spread(part: Callable[[State], Scalar], state: State, sizes: State) -> Scalar:
    """The size of what a function of the state adds up where its numbers have these sizes."""
    slopes = jax.grad(lambda x: jnp.sum(part(x)))(state)
    each = jtu.tree_map(lambda slope, size: jnp.sum(jnp.abs(slope)) * size, slopes, sizes)
    return sum(jtu.tree_leaves(each), start=jnp.zeros(()))
