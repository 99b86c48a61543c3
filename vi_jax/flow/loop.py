"""The loop around the hybrid step: forward, or so that it can be differentiated in reverse."""

from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool

from .. import lanes
from ._lane import Lane, Plan, Record
from ._step.aim import select
from ._step.hybrid import iterate


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


class Ends(NamedTuple):
    """How a lane ended."""

    done: Any
    fault: Any
    steps: Any
    rejected: Any

    @classmethod
    def of(cls, lane: Lane) -> "Ends":
        return cls(lane.done, lane.fault, lane.steps, lane.rejected)


def run_forward(plan: Plan, start: Any, wanted: Any = True) -> tuple[Ends, Any, Record]:
    """A lane to its end, in one flat loop: in a batch no lane waits for another at a section.

    Differentiable in forward mode.

    **Returns:** how it ended, and the states and records of the intervals kept, with leading axis
    `plan.kept + 1`: the first holds the state in which recording begins, and no record.
    """
    numbers, rest = eqx.partition(plan, eqx.is_array)

    def begin(inputs):
        numbers, start, wanted = inputs
        plan = eqx.combine(numbers, rest)
        lane = plan.launch(start, wanted)
        first = plan.skipped <= 0
        return lane, lanes.Emitted(_active(plan, lane), first, (start, plan.fresh(start)))

    def step(inputs, lane):
        plan = eqx.combine(inputs[0], rest)
        new = iterate(plan, lane)
        complete = new.completed & (new.lane.done >= plan.skipped)
        return new.lane, lanes.Emitted(_active(plan, new.lane), complete, (new.state, new.record))

    def end(inputs, lane):
        return Ends.of(lane)

    inputs = numbers, start, jnp.asarray(wanted)
    ends, (states, records) = lanes.run(
        begin, step, end, inputs, rows=plan.kept + 1, block=plan.block, road=plan.road
    )
    return ends, states, records


def run_reverse(plan: Plan, start: Any) -> tuple[Ends, Any, Record]:
    """As `run_forward`, by a scan over intervals with a checkpointed loop in each.

    Differentiable in reverse mode, with memory that grows with the root of the number of steps.
    """

    def interval(carry, goal):
        def going(carry):
            lane, *_ = carry
            return any_lane(_active(plan, lane) & (jax.lax.stop_gradient(lane.done - goal) < 0))

        def body(carry):
            return _held(plan, goal, *carry)

        carry = eqxi.while_loop(going, body, carry, kind="checkpointed", max_steps=plan.bound)
        lane, state, record = carry
        return carry, (state, record, lane.done >= goal)

    goals = plan.skipped + jnp.arange(plan.kept + 1, dtype=plan.settle.dtype)
    first = plan.launch(start), start, plan.fresh(start)
    (lane, *_), (state, record, complete) = jax.lax.scan(interval, first, goals)
    state, record = jtu.tree_map(
        lambda x: jax.vmap(jnp.where)(complete, x, jnp.full_like(x, jnp.nan)), (state, record)
    )
    return Ends.of(lane), state, record


def _held(plan: Plan, goal, lane: Lane, state: Any, record: Record) -> tuple[Lane, Any, Record]:
    """One step of a lane that has not yet reached its goal."""
    new = iterate(plan, lane)
    waiting = lane.done >= goal
    kept = select(new.completed & ~waiting, (new.state, new.record), (state, record))
    return select(waiting, lane, new.lane), *kept
