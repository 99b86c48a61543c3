"""Many lanes through few places: a lane that is done makes room for the next."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree

from .aim import select
from .hybrid import iterate
from .lane import Lane, Plan, Record
from .loop import place_of


def run_pool(
    begin: Callable[[Any], tuple[Plan, Any]], values: Any, wanted: Any, places: int
) -> tuple[Lane, Any, Record]:
    """All lanes to their end, `places` of them at a time.

    A batch under `vmap` lasts as long as its slowest lane, and one that does not fit the
    processor's cache is slow. Here the places are few, and each takes up the next lane when its
    own has ended, so that a lane of ten times the steps holds up nobody.

    **Arguments:** `begin` makes a plan and a start of one lane's values; the values of all lanes,
    a pytree with one leading axis; whether each lane is wanted (others only fill up the arrays
    and come back as failed); the number of places.

    **Returns:** as `run_forward`, with a leading axis of lanes.
    """
    lanes = jtu.tree_leaves(values)[0].shape[0]

    def taken(index):
        return jtu.tree_map(lambda x: x[jnp.minimum(index, lanes - 1)], values)

    def launched(value, index):
        plan, start = begin(value)
        asked = wanted[jnp.minimum(index, lanes - 1)]
        return plan.launch(start, asked & (index < lanes))

    def advanced(value, lane):
        plan, _ = begin(value)
        before = lane.done
        lane = jax.lax.fori_loop(0, plan.block, lambda _, x: iterate(plan, x), lane)
        active = (lane.done < plan.intervals) & (lane.fault == 0)
        return lane, place_of(plan, lane.done, lane.done > before), active

    def flat(lane):
        return ravel_pytree((lane.kept_state, lane.kept))[0]

    index = jnp.arange(places)
    value = taken(index)
    lane = jax.vmap(launched)(value, index)
    first = jtu.tree_map(lambda x: x[0], lane)
    _, unravel = ravel_pytree((first.kept_state, first.kept))
    plan, _ = begin(jtu.tree_map(lambda x: x[0], values))
    begun = jax.vmap(launched)(values, jnp.arange(lanes))
    store = jnp.full((lanes, plan.kept + 1, flat(first).size), jnp.nan, first.s.dtype)
    place = jax.vmap(lambda lane: place_of(plan, lane.done, True))(begun)
    store = store.at[jnp.arange(lanes), place].set(jax.vmap(flat)(begun), mode="drop")

    def body(carry):
        lane, index, value, following, store, ends = carry
        lane, place, active = jax.vmap(advanced)(value, lane)
        store = jax.lax.cond(
            jnp.any(place <= plan.kept),
            lambda store: store.at[index, place].set(jax.vmap(flat)(lane), mode="drop"),
            lambda store: store,
            store,
        )
        over = ~active & (index < lanes)

        def replaced(lane, index, value, following, ends):
            mine = jnp.where(over, index, lanes)
            ends = ends.at[mine].set(
                jnp.stack([lane.done, lane.fault, lane.steps, lane.rejected], axis=1), mode="drop"
            )
            coming = jnp.minimum(following + jnp.cumsum(over) - 1, lanes)
            index = jnp.where(over, coming, index)
            fresh = taken(index)
            value = jax.vmap(select)(over, fresh, value)
            lane = jax.vmap(select)(over, jax.vmap(launched)(value, index), lane)
            return lane, index, value, following + jnp.sum(over), ends

        lane, index, value, following, ends = jax.lax.cond(
            jnp.any(over), replaced, lambda *same: same, lane, index, value, following, ends
        )
        return lane, index, value, following, store, ends

    ends = jnp.zeros((lanes, 4), first.s.dtype)
    index = jnp.minimum(index, lanes)
    following = jnp.asarray(places, index.dtype)
    carry = lane, index, value, following, store, ends
    *_, store, ends = jax.lax.while_loop(lambda carry: jnp.any(carry[1] < lanes), body, carry)
    state, record = jax.vmap(jax.vmap(unravel))(store)
    lane = eqx.tree_at(
        lambda lane: (lane.done, lane.fault, lane.steps, lane.rejected), begun, tuple(ends.T)
    )
    return lane, state, record
