"""The loop around the hybrid step."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array

from .. import lanes
from .._types import Flag, Scalar, State
from ..machine import (
    begin_modes,
    outcomes_of,
    prepared,
    replaced,
    scales_known,
    without_modes,
)
from ._step.hybrid import iterate
from .begin import initial_lane
from .history import begun, with_sizes, with_view
from .lane import Lane, Record
from .machine_checks import (
    check_before_modes,
    check_events,
    check_field,
    check_laws,
    explain_errors,
)
from .noise import in_modes_of
from .plan import Plan
from .results import code
from .sizes import sizes_at_start


def _is_active(plan: Plan, lane: Lane) -> Flag:
    return (jax.lax.stop_gradient(lane.done) < plan.intervals) & (
        jax.lax.stop_gradient(lane.fault) == 0
    )


# The numbers of a plan, the start, and whether the lane is wanted.
_Inputs = tuple[Plan, State, Array]


class Ends(NamedTuple):
    """The values that are kept of a lane after its end."""

    fault: Scalar
    steps: Scalar
    rejected: Scalar
    at: tuple[Scalar, Scalar, State] | None
    """The cycle, the clock and the state at the end; `None` for a machine without outcomes."""
    history: Any = None
    """The history at the end, of a machine with delays."""


def run_lane(plan: Plan, start: State, wanted: Flag | bool = True) -> tuple[Ends, State, Record]:
    """Run a lane to its end in one flat loop; in a batch no lane waits for another at a section.
    Return states and records with leading axis `plan.recorded_intervals + 1`: first the state in
    which recording begins, and an empty record. With own modes the states are `HybridState`s."""
    form = prepared(plan.machine)
    is_unchanged = form.machine is plan.machine
    if not is_unchanged:
        if plan.noise is not None:
            plan = dataclasses.replace(plan, noise=in_modes_of(form, plan.noise, start))
        # The condition that ends a lane early is a function of the machine's own state.
        plan = dataclasses.replace(plan, machine=form.machine, stop=None)
        start = form.inward(start)
    with explain_errors(f"`contacts` of a {type(plan.machine).__name__}"):
        zero = jnp.zeros_like(plan.machine.position(start))
    s = zero if plan.begin is None else zero + plan.begin
    check_before_modes(plan.machine, s, start)
    modes = begin_modes(plan.machine, s, start, plan.start_modes, settles=False)
    check_field(plan.machine, s, start, modes)
    check_laws(plan.machine, zero)
    check_events(plan.machine, s, start, modes)
    if not scales_known(plan.machine):
        modes, sizes, extents = sizes_at_start(plan, s, start)
        method = plan.method.with_sizes(sizes)
        plan = dataclasses.replace(plan, method=method, sizes=sizes, extents=extents)
        if plan.memory is None:
            plan = dataclasses.replace(plan, first_modes=modes)
        else:
            plan = with_sizes(plan, s, start, modes)
    rows = plan.recorded_intervals + 1
    plan = dataclasses.replace(plan, cycles=jnp.asarray(plan.cycles, zero.dtype))
    numbers, rest = eqx.partition(plan, eqx.is_array)
    ends, (states, records) = lanes.run(
        partial(_begin, rest), partial(_step, rest), partial(_end, rest),
        (numbers, start, jnp.asarray(wanted)), rows=rows,
        backend=plan.backend,
    )  # fmt: skip
    if not is_unchanged:
        states = replaced(states, jax.vmap(form.outward)(without_modes(states)))
        if ends.at is not None:
            ends = ends._replace(at=(*ends.at[:2], form.outward(ends.at[2])))
    return ends, states, records


def _begin(rest: Plan, inputs: _Inputs) -> tuple[Lane, lanes.Emitted]:
    numbers, start, wanted = inputs
    plan = eqx.combine(numbers, rest)
    if plan.memory is None:
        lane = initial_lane(plan, start, wanted)
    else:
        lane = _with_history(plan, start, wanted)
    first, state = plan.settle <= 0, plan.recorded_state(start, lane.modes)
    return lane, lanes.Emitted(_is_active(plan, lane), first, (state, plan.empty_record(start)))


def _with_history(plan: Plan, start: State, wanted: Array) -> Lane:
    """Return the initial lane of a machine with delays."""
    zero = jnp.zeros_like(plan.machine.position(start))
    s = zero if plan.begin is None else zero + plan.begin
    history, covered = begun(plan, start, s)
    lane = initial_lane(with_view(plan, history, s), start, wanted)
    bad = (lane.fault == 0) & ~stop_gradient(covered)
    return lane._replace(history=history, fault=jnp.where(bad, code("bad_start"), lane.fault))


def _step(rest: Plan, inputs: _Inputs, lane: Lane) -> tuple[Lane, lanes.Emitted]:
    plan = eqx.combine(inputs[0], rest)
    lane, completed, record = iterate(plan, lane)
    if plan.constant_records:
        lane, record = lane._replace(record=stop_gradient(lane.record)), stop_gradient(record)
    is_recorded = completed & (lane.done >= plan.settle)
    active = _is_active(plan, lane)
    if plan.stop is not None:
        first = lane.done <= plan.settle
        should_stop = plan.stop(plan.machine, lane.state, record, first)
        active = active if should_stop is None else active & ~(is_recorded & should_stop)
    state = plan.recorded_state(lane.state, lane.modes)
    return lane, lanes.Emitted(active, is_recorded, (state, record))


def _end(rest: Plan, inputs: _Inputs, lane: Lane) -> Ends:
    plan, at = eqx.combine(inputs[0], rest), None
    if outcomes_of(plan.machine):
        at = plan.cycle_of(lane.done), plan.clock(lane.s, lane.state), lane.state
    return Ends(lane.fault, lane.steps, lane.rejected, at, lane.history)
