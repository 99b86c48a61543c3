"""How large the numbers of a motion are, found where it begins: in other units of length and time
the same motion is judged alike."""

from functools import partial

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from .._types import Scalar, Scalars, State
from ..machine import guard_of
from ._lane import Plan, unit_of
from .smooth import SmoothMachine, spread

# Of what it says about the size of a number, this share counts for the tolerance at once, the rest
# once the motion has been so large; and so many roundings of it. Choices.
_AT_ONCE, _ROUNDINGS = 1e-3, 16.0


def sizes_of(plan: Plan, smooth: SmoothMachine, s: Scalar, start: State) -> State:
    """About how large each number of the state may become: its value in the start, what its rate
    there makes of it in a unit of time, and what the clock and the other numbers do to that. The
    numbers of an array have one size. It is zero for numbers that nothing moves.

    **Arguments:** `smooth`, the machine in its modes with nothing held; `s` and `start`, where the
    motion begins.
    """
    machine = plan.machine
    s, start = stop_gradient((s, start))
    limit = 5 * jnp.asarray(machine.step_limit(s, start)) / (2 * jnp.pi)
    unit = stop_gradient(jnp.minimum(unit_of(machine), limit))
    rate, signs = smooth.field(s, start), _signs(start)

    def pushes(along: State) -> State:
        """What the field makes of such changes of the state in a unit of time."""
        changes = jax.jvp(smooth.field, (s, start), (jnp.ones_like(s) * unit, along))[1]
        return jtu.tree_map(lambda a: jnp.where(jnp.isfinite(a), unit * jnp.abs(a), 0.0), changes)

    # Signs that differ keep what acts on a difference from cancelling.
    along = jtu.tree_map(lambda x, v, sign: unit * v + sign * jnp.abs(x), start, rate, signs)
    sizes = jtu.tree_map(
        lambda x, v, a: _of_all(jnp.maximum(jnp.abs(x), jnp.maximum(unit * jnp.abs(v), a))),
        start, rate, pushes(along),
    )  # fmt: skip
    known = lambda size, x: jnp.where(jnp.isfinite(size), size, jnp.abs(x))
    sizes = stop_gradient(jtu.tree_map(known, sizes, start))
    leaves = len(jtu.tree_leaves(start))
    if leaves <= 2:
        return sizes

    def reach(_, sizes: State) -> State:
        """Sizes of those numbers, too, that only the others move."""
        along = jtu.tree_map(jnp.multiply, sizes, signs)
        more = lambda size, a: jnp.where(size > 0, size, _of_all(a))
        return jtu.tree_map(more, sizes, pushes(along))

    return stop_gradient(jax.lax.fori_loop(0, leaves, reach, sizes))


def _of_all(sizes: Array) -> Array:
    """The greatest of the sizes in an array, whose numbers have one unit."""
    return jnp.full_like(sizes, jnp.max(sizes)) if sizes.ndim else sizes


def known_at_once(plan: Plan, start: State, sizes: State) -> State:
    """`Lane.sizes` where a motion begins.

    **Arguments:** `sizes`, as from `sizes_of`.
    """
    dtype = plan.machine.position(start).dtype
    rtol = jnp.asarray(plan.method.wander, dtype)
    least = _ROUNDINGS * jnp.finfo(dtype).eps / jnp.where(rtol > 0, rtol, 1.0)
    share = jnp.maximum(_AT_ONCE, least)
    return stop_gradient(
        jtu.tree_map(lambda x, y: jnp.maximum(jnp.abs(x), share * y), start, sizes)
    )


def extents_of(plan: Plan, s: Scalar, start: State, modes: Scalars, sizes: State) -> Scalars:
    """`Lane.extents`: of each coordinate, then of each event that is no stop its guard's.

    **Arguments:** `sizes`, as from `sizes_of`.
    """
    machine, found = plan.machine, []
    contact = tuple(jnp.zeros_like(s) for _ in machine.coordinates) if plan.rests else ()
    for k, body in enumerate(machine.coordinates):
        most = spread(body.position, stop_gradient(start), sizes)
        for stop in machine.stops:
            if stop.coordinate == k:
                most = jnp.maximum(most, jnp.abs(stop.gap))
        found.append(most)
    for number in plan.others(start):

        def guard(s: Scalar, state: State, number: int = number) -> Scalar:
            return jnp.asarray(guard_of(machine, number, s, state, modes, contact), s.dtype)

        at = stop_gradient((s, start))
        value, rate = jax.jvp(guard, at, (jnp.ones_like(s), jtu.tree_map(jnp.zeros_like, start)))
        most = spread(partial(guard, at[0]), at[1], sizes)
        own = jnp.maximum(jnp.abs(value), unit_of(machine) * jnp.abs(rate))
        found.append(jnp.maximum(own, most))
    # Of what stands still in zero nothing is known.
    return stop_gradient(tuple(jnp.where((x > 0) & jnp.isfinite(x), x, 1.0) for x in found))


def grown(sizes: State, state: State) -> State:
    """`Lane.sizes` in a later state."""
    return stop_gradient(jtu.tree_map(lambda a, x: jnp.maximum(a, jnp.abs(x)), sizes, state))


def _signs(start: State) -> State:
    """Numbers of either sign, without an order that a machine may have."""
    leaves, tree = jtu.tree_flatten(start)
    draw = np.random.default_rng(0)
    return tree.unflatten([jnp.asarray(draw.choice([-1.0, 1.0], x.shape), x.dtype) for x in leaves])
