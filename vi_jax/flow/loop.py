"""The loop around the hybrid step."""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .. import lanes
from .._types import Flag, Scalar, State
from ..machine import bare, begin_modes, replaced
from ._lane import Lane, Plan, Record
from ._launch import launched
from ._own import check_field, check_laws
from ._own_parts import check_events
from ._sizes import extents_of, sizes_of
from ._step.hybrid import iterate
from .noise import in_modes_of


def _active(plan: Plan, lane: Lane) -> Flag:
    return (jax.lax.stop_gradient(lane.done) < plan.intervals) & (
        jax.lax.stop_gradient(lane.fault) == 0
    )


# The numbers of a plan, the start, and whether the lane is wanted.
_Inputs = tuple[Plan, State, Array]


class Ends(NamedTuple):
    """What is kept of a lane when it has ended."""

    done: Scalar
    fault: Scalar
    steps: Scalar
    rejected: Scalar

    @classmethod
    def of(cls, lane: Lane) -> "Ends":
        return cls(lane.done, lane.fault, lane.steps, lane.rejected)


def run_lane(plan: Plan, start: State, wanted: Flag | bool = True) -> tuple[Ends, State, Record]:
    """A lane to its end, in one flat loop: in a batch no lane waits for another at a section.

    **Returns:** how it ended, and the states and records of the intervals kept, with leading axis
    `plan.kept + 1`: the first holds the state in which recording begins, and no record. States of a
    machine with modes of its own are `HybridState`s.
    """
    way = plan.machine.prepared()
    own = way.machine is plan.machine
    if not own:
        if plan.noise is not None:
            plan = dataclasses.replace(plan, noise=in_modes_of(way, plan.noise, start))
        # What ends a lane early knows the machine's own state only.
        plan = dataclasses.replace(plan, machine=way.machine, stop=None)
        start = way.inward(start)
    zero = jnp.zeros_like(plan.machine.position(start))
    s = zero if plan.begin is None else zero + plan.begin
    modes = begin_modes(plan.machine, s, start, plan.own)
    check_field(plan.machine, s, start, modes)
    check_laws(plan.machine, zero)
    check_events(plan.machine, s, start, modes)
    sizes = sizes_of(plan.machine, s, start, modes)
    if sizes is not None:
        extents = extents_of(plan, s, start, modes, sizes)
        plan = dataclasses.replace(plan, method=plan.method.with_sizes(sizes), extents=extents)
    numbers, rest = eqx.partition(plan, eqx.is_array)
    ends, (states, records) = lanes.run(
        partial(_begin, rest), partial(_step, rest), _end, (numbers, start, jnp.asarray(wanted)),
        rows=plan.kept + 1, backend=plan.backend,
    )  # fmt: skip
    if not own:
        states = replaced(states, jax.vmap(way.outward)(bare(states)))
    return ends, states, records


def _begin(rest: Plan, inputs: _Inputs) -> tuple[Lane, lanes.Emitted]:
    numbers, start, wanted = inputs
    plan = eqx.combine(numbers, rest)
    lane = launched(plan, start, wanted)
    first, here = plan.settle <= 0, plan.point(start, lane.modes)
    return lane, lanes.Emitted(_active(plan, lane), first, (here, plan.fresh(start)))


def _step(rest: Plan, inputs: _Inputs, lane: Lane) -> tuple[Lane, lanes.Emitted]:
    plan = eqx.combine(inputs[0], rest)
    lane, completed, record = iterate(plan, lane)
    complete = completed & (lane.done >= plan.settle)
    active = _active(plan, lane)
    if plan.stop is not None:
        first = lane.done <= plan.settle
        left = plan.stop(plan.machine, lane.state, record, first)
        active = active if left is None else active & ~(complete & left)
    here = plan.point(lane.state, lane.modes)
    return lane, lanes.Emitted(active, complete, (here, record))


def _end(inputs: _Inputs, lane: Lane) -> Ends:
    return Ends.of(lane)
