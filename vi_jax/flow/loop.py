"""The loop around the hybrid step: forward, or so that it can be differentiated in reverse."""

from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool

from .hybrid import iterate
from .lane import Lane, Plan, Record


@jax.custom_batching.custom_vmap
def any_lane(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """Whether `flag` holds in any lane of any enclosing `vmap`: one number for all of them.

    A loop condition that stays unbatched spares `while_loop` a `where` over everything it carries.
    """
    return flag


@any_lane.def_vmap
def _(axis_size, in_batched, flag):
    return any_lane(jnp.any(flag)), False


def _active(plan: Plan, lane: Lane) -> Bool[Array, ""]:
    return (jax.lax.stop_gradient(lane.done) < plan.intervals) & (
        jax.lax.stop_gradient(lane.fault) == 0
    )


def run_forward(plan: Plan, lane: Lane) -> tuple[Lane, Any, Record]:
    """All lanes to their end, in one flat loop: no lane waits for another at a section.

    Steps are taken in blocks in which a lane completes at most one interval, so that results are
    stored once a block. Differentiable in forward mode.

    **Returns:** the final lane, and the states and records of the intervals kept, with leading
    axis `plan.kept + 1`: the first holds the state in which recording begins, and no record.
    """
    flat, unravel = ravel_pytree((lane.kept_state, lane.kept))
    store = jnp.full((plan.kept + 1, flat.size), jnp.nan, flat.dtype)
    store = store.at[place_of(plan, lane.done, True)].set(flat, mode="drop")

    def body(carry):
        lane, store = carry
        before = lane.done
        lane = jax.lax.fori_loop(0, plan.block, lambda _, x: iterate(plan, x), lane)
        kept, _ = ravel_pytree((lane.kept_state, lane.kept))
        place = place_of(plan, lane.done, lane.done > before)
        return lane, store.at[place].set(kept, mode="drop")

    def going(carry):
        return any_lane(_active(plan, carry[0]))

    lane, store = jax.lax.while_loop(going, body, (lane, store))
    state, record = jax.vmap(unravel)(store)
    return lane, state, record


def place_of(plan: Plan, done: jax.Array, new: jax.Array | bool) -> jax.Array:
    """Where the interval just completed is stored; beyond the end if nowhere."""
    place = jax.lax.stop_gradient(done) - plan.skipped
    return jnp.where(new & (place >= 0), place, float(plan.kept + 1)).astype(jnp.int32)


def run_reverse(plan: Plan, lane: Lane) -> tuple[Lane, Any, Record]:
    """As `run_forward`, by a scan over intervals with a checkpointed loop in each.

    Differentiable in reverse mode, with memory that grows with the root of the number of steps.
    """

    def interval(lane, goal):
        def going(lane):
            return any_lane(_active(plan, lane) & (jax.lax.stop_gradient(lane.done - goal) < 0))

        def body(lane):
            return _held(plan, goal, lane)

        lane = eqxi.while_loop(going, body, lane, kind="checkpointed", max_steps=plan.bound)
        return lane, (lane.kept_state, lane.kept, lane.done >= goal)

    goals = plan.skipped + jnp.arange(plan.kept + 1, dtype=lane.done.dtype)
    lane, (state, record, complete) = jax.lax.scan(interval, lane, goals)
    state, record = jtu.tree_map(
        lambda x: jax.vmap(jnp.where)(complete, x, jnp.full_like(x, jnp.nan)), (state, record)
    )
    return lane, state, record


def _held(plan: Plan, goal, lane: Lane) -> Lane:
    """One step of a lane that has not yet reached its goal."""
    new = iterate(plan, lane)
    waiting = lane.done >= goal
    return jtu.tree_map(lambda a, b: jnp.where(waiting, a, b), lane, new)
