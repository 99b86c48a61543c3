"""The loop around the hybrid step, and the sizes of the state's numbers, relative to which errors
of steps are judged."""

import dataclasses
from functools import partial
from math import pi
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array

from .. import lanes
from .._programs import compiled
from .._types import Flag, Scalar, Scalars, State, Vector
from ..machine import (
    AbstractMachine,
    ContactFriction,
    angles_in,
    begin_modes,
    events_of,
    guard_of,
    has_contact_friction,
    holds_anywhere,
    in_rows,
    is_in_range,
    longest_step,
    mode_number,
    modes_of,
    on_held_surfaces,
    outcomes_of,
    prepared,
    replaced,
    scales_known,
    size_of,
    stops_of,
    struck_modes,
    switches_of,
    without_modes,
)
from ._lane import Lane, Plan, Record, to_event, total
from ._machine_checks import (
    check_before_modes,
    check_events,
    check_field,
    check_laws,
    explain_errors,
)
from ._step.hybrid import iterate
from .events import Rates, force_rate, rates
from .history import begun, is_covered, with_sizes, with_some_past, with_view
from .noise import in_modes_of
from .results import code
from .smooth import hold_contacts, in_modes, limited_of, stops_are_exact

# A number of the state below this share of the change that the other numbers cause has still to
# grow. Rates are evaluated at this many instants of a cycle. Choices.
_GROWS, _INSTANTS = 1e-3, 7

# A number of this size or smaller counts as zero: it is rounding of numbers about 1. A choice.
_ZERO = 1e-15


def sizes_of(machine: AbstractMachine, s: Scalar, start: State, modes: Scalars) -> State | None:
    """Return the expected size of each number of the state. `None` for a machine whose numbers are
    about 1 by definition.

    The size is the greater of the value at the start and its change at the rates there, in 1/2π of
    a cycle or of a shorter natural period. If both are tiny, it is the change that the sizes of the
    other numbers cause. The size of a zero that nothing moves yet is unknown, and returned as 1.
    """
    if scales_known(machine):
        return None
    known = _known_sizes(machine, s, start, modes, jtu.tree_map(jnp.abs, start))
    return stop_gradient(jtu.tree_map(_known_or_one, known))


def row_sizes(machine: AbstractMachine, start: State, rows: Array | None = None) -> Vector:
    """Return the size of each number of a state, in the order of `in_rows`: its expected magnitude
    along a motion, from `start` and `rows` (..., states). It is 1 for an angle, for a number that
    is zero to rounding, and for a machine whose numbers are about 1 by definition. States are
    compared relative to these sizes."""
    state = jtu.tree_map(lambda x: 1.0 * jnp.asarray(x), without_modes(start))  # integers too
    machine = with_some_past(machine, state)
    row, unravel = ravel_pytree(stop_gradient(state))
    if scales_known(machine):
        return jnp.ones_like(row)
    zero, angles = jnp.zeros((), row.dtype), angles_in(machine, state)
    angles = jnp.zeros(row.shape, bool) if angles is None else angles
    modes = begin_modes(machine, zero, state, modes_of(start))
    values = unravel(jnp.where(angles, 1.0, jnp.abs(row)))
    sizes = in_rows(_known_sizes(machine, zero, state, modes, values), 0)
    if rows is not None:
        rows = stop_gradient(jnp.nan_to_num(jnp.abs(rows.reshape(-1, row.size)), posinf=0.0))
        sizes = jnp.maximum(sizes, jnp.max(rows, axis=0))
    return stop_gradient(jnp.where(angles | ~(sizes > _ZERO), 1.0, sizes))


_compiled_sizes = compiled(row_sizes)


def sizes_on_host(machine: AbstractMachine, start: State, rows: np.ndarray) -> np.ndarray:
    """Return `row_sizes` as a NumPy array, compiled once for any number of `rows`."""
    largest = np.abs(rows.reshape(-1, rows.shape[-1])).max(axis=0)
    return np.asarray(_compiled_sizes(machine, start, jnp.asarray(largest)))


def _known_sizes(
    machine: AbstractMachine, s: Scalar, start: State, modes: Scalars, values: State
) -> State:
    """Return `sizes_of`, but 0 if unknown; `values`: moduli in `start`."""
    holding = [x for x in events_of(machine) if x.holds_mode]
    # While something sticks or slides along a surface, its rate does not show its size.
    sticks = [getattr(x, "blends", False) or x.is_dry for x in holding] + [False] * len(modes)
    slips = (jnp.where(x == 0, 1.0, x) if y else x for x, y in zip(modes, sticks, strict=False))
    smooth = in_modes(machine, tuple(slips))
    s, start = stop_gradient((s, start))
    longest = 5 * jnp.asarray(longest_step(machine, s, start)) / (2 * pi)
    unit = stop_gradient(jnp.minimum(jnp.asarray(machine.cycle) / (2 * pi), longest))
    instants = s + jnp.asarray(machine.cycle) * np.arange(_INSTANTS) / _INSTANTS
    rates = jax.vmap(smooth.field, (0, None))(instants, start)
    sizes = jtu.tree_map(
        lambda x, v: jnp.maximum(x, unit * jnp.max(jnp.abs(v), axis=0)), values, rates
    )
    # Different factors prevent a force that acts on a difference from cancelling.
    leaves, tree = jtu.tree_flatten(sizes)
    rng = np.random.default_rng(0)
    signs = [rng.choice([-1, 1], x.shape) * rng.uniform(0.7, 1.0, x.shape) for x in leaves]
    direction = tree.unflatten([x * sign for x, sign in zip(leaves, signs, strict=True)])
    change_of_rate = jax.jvp(lambda x: smooth.field(s, x), (start,), (direction,))[1]

    def size(x: Scalar, change: Scalar) -> Scalar:
        change = unit * jnp.abs(change)
        return jnp.where(x > _GROWS * change, x, change)

    return jtu.tree_map(size, sizes, change_of_rate)


def extents_of(
    plan: Plan, s: Scalar, start: State, modes: Scalars, sizes: State
) -> tuple[Any, ...]:
    """Return `Plan.extents`: the size, at most 1, of each coordinate, then the size of the guard of
    each event other than a stop. `sizes` are from `sizes_of`."""
    machine, unit = plan.machine, plan.unit
    contact = tuple(jnp.zeros_like(s) for _ in machine.coordinates) if plan.rests else ()
    s, start = stop_gradient((s, start))

    def of_guard(number: int, modes: Scalars, contact: Scalars) -> Scalar:
        def guard(s: Scalar, x: State) -> Scalar:
            return jnp.asarray(guard_of(machine, number, s, x, modes, contact), s.dtype)

        value, rate = jax.jvp(lambda s: guard(s, start), (s,), (jnp.ones_like(s),))
        size = jnp.maximum(jnp.abs(value), unit * jnp.abs(rate))
        return _known_or_one(jnp.maximum(size, size_of(lambda x: guard(s, x), start, sizes)))

    of_coordinates = (size_of(x.position, start, sizes) for x in machine.coordinates)
    extents: list[Any] = [_at_most_one(_known_or_one(size)) for size in of_coordinates]
    for number in plan.others(start):
        event, rest = events_of(machine)[number], contact
        if not event.holds_mode:
            extents.append(of_guard(number, modes, rest))
            continue
        if contact and isinstance(event, ContactFriction):  # it holds a resting body
            k = stops_of(machine)[event.stop].coordinate
            rest = (*contact[:k], jnp.full_like(s, to_event(event.stop)), *contact[k + 1 :])
        mode = mode_number(machine, number)
        both_modes = ((*modes[:mode], jnp.full_like(s, x), *modes[mode + 1 :]) for x in (1.0, 0.0))
        extents.append(tuple(of_guard(number, x, rest) for x in both_modes))
    return stop_gradient(tuple(extents))


def _known_or_one(size: Array) -> Array:
    """Return a size; 1 if it is 0 or NaN, which is unknown."""
    return jnp.where(size > 0, size, 1.0)


def _at_most_one(size: Array) -> Array:
    """Return a size; 1 if it is larger, since the motion may become smaller."""
    return jnp.minimum(size, 1.0)


def initial_lane(plan: Plan, start: State, wanted: Flag | bool = True) -> Lane:
    """Return the lane at the first step of its loop, in the state `start`. A lane that cannot be
    simulated, or is not `wanted`, has ended already."""
    machine = plan.machine
    Y = machine.position(start)
    bad = ~jnp.isfinite(total((start, machine.cycle), plan.settle)) | ~jnp.asarray(wanted)
    bad = bad | ~is_in_range(machine, start)
    for number in jtu.tree_leaves(eqx.filter(machine, eqx.is_inexact_array)):
        bad = bad | jnp.any(jnp.isnan(number))  # infinite is allowed: no limit
    bad = bad | plan.beyond_a_stop(start)
    bad = jax.lax.stop_gradient(bad)
    zero = jnp.zeros_like(Y)
    s = zero if plan.begin is None else zero + plan.begin
    modes = begin_modes(machine, s, start, plan.start_modes)
    free = in_modes(machine, modes)
    current = [rates(free.field, x.position, s, start) for x in machine.coordinates]
    # At rest the sign of the acceleration is the direction of motion.
    direction = tuple(jnp.where(x.v == 0, jnp.sign(x.a), jnp.sign(x.v)) for x in current)
    contact = None
    if plan.rests:
        jerks = [force_rate(free, x.position, free, s, start) for x in machine.coordinates]
        contact = _contacts_at(plan, start, current, jerks)
        if len(limited_of(machine)) > 1:
            contact = _pressed_together(plan, s, start, modes, contact)
        direction = tuple(
            jnp.where((x.v == 0) & (x.a == 0), jnp.sign(j), sign)
            for x, j, sign in zip(current, jerks, direction, strict=True)
        )
        for i, stop in enumerate(stops_of(machine)):
            # From slightly off the stop it would come to rest there too: no derivatives.
            on_stop = machine.coordinates[stop.coordinate].placed(start, stop.place, zero)
            rests = contact[stop.coordinate] == to_event(i)
            start = jtu.tree_map(lambda a, b, rests=rests: jnp.where(rests, a, b), on_stop, start)
        if has_contact_friction(machine) or (stops_of(machine) and holds_anywhere(machine)):
            modes = struck_modes(machine, s, start, modes, contact=contact)
    slides = any(x.blends for x in switches_of(machine))
    if slides or holds_anywhere(machine) or has_contact_friction(machine):
        start = on_held_surfaces(machine, s, start, modes, contact or ())
    length = zero + jax.lax.stop_gradient(machine.cycle) / plan.method.steps_per_cycle
    if plan.method.adaptive:
        length = length / 8
    return Lane(
        s=s,
        state=start,
        record=plan.empty_record(start),
        direction=jax.lax.stop_gradient(direction),
        contact=contact,
        modes=modes,
        below=tuple(zero - 1 for _ in plan.from_below(start)),
        length=length,
        attempt=length,
        target=zero,
        attempts=zero,
        part=plan.first_part(zero) if plan.instants > 1 else zero,
        done=zero,
        fault=jnp.where(bad, code("bad_start"), zero),
        steps=zero,
        spent=zero,
        rejected=zero,
        last_impulse=zero if plan.noise is not None and plan.noise.measures_time else None,
    )


def _contacts_at(plan: Plan, start: State, current: list[Rates], jerks: list[Scalar]) -> Scalars:
    """Return the stops on which the coordinates rest, by their rates and those of the forces."""
    found = []
    for k, (body, rate) in enumerate(zip(current, jerks, strict=True)):
        slack, slow = plan.rounding_bounds(k, start)
        if not stops_are_exact(plan.machine, start):
            # A resting body gathers the rounding of the force on it: a woodpecker 0.03 of this.
            share = 4 * float(jnp.finfo(body.x.dtype).eps)
            slow = jnp.maximum(slow, share * plan.machine.cycle * jnp.abs(body.a))
        found.append(_rests_on(plan, k, body, rate, slack, slow))
    return tuple(found)


def _pressed_together(
    plan: Plan, s: Scalar, start: State, modes: Scalars, contact: Scalars
) -> Scalars:
    """Return the contacts with those that press on only since others hold: a body lies on another
    that would fall faster than it."""
    bodies = plan.machine.coordinates

    def add_contacts(contact: Scalars, _: None) -> tuple[Scalars, None]:
        held = stop_gradient(hold_contacts(plan.machine, modes, contact))
        current = [rates(held.field, x.position, s, start) for x in bodies]
        jerks = [force_rate(held, x.position, held, s, start) for x in bodies]
        more = _contacts_at(plan, start, current, jerks)
        return tuple(jnp.where(x > 0, x, y) for x, y in zip(contact, more, strict=True)), None

    return jax.lax.scan(add_contacts, contact, None, length=len(limited_of(plan.machine)) - 1)[0]


def _rests_on(
    plan: Plan, k: int, current: Rates, jerk: Scalar, slack: Scalar | float, slow: Scalar | float
) -> Scalar:
    """Return the stop on which coordinate number k rests at the start, or 0: it is pressed on, or
    about to be by a force that grows. Its position is known to within `slack`, its velocity to
    `slow`, and both to the rounding of a search that ends there."""
    contact, least = jnp.zeros_like(current.x), 4 * jnp.finfo(current.x.dtype).eps * plan.extent(k)
    slack, slow = jnp.maximum(slack, least), jnp.maximum(slow, least / plan.unit)
    for i, stop in enumerate(stops_of(plan.machine)):
        if stop.coordinate == k:
            pressed = (stop.sign * current.a > 0) | (current.a == 0) & (stop.sign * jerk > 0)
            rests = (stop.beyond(current.x) >= -slack) & (jnp.abs(current.v) <= slow) & pressed
            contact = jnp.where(rests, to_event(i), contact)
    return contact


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
    modes = begin_modes(plan.machine, s, start, plan.start_modes)
    check_field(plan.machine, s, start, modes)
    check_laws(plan.machine, zero)
    check_events(plan.machine, s, start, modes)
    sizes = sizes_of(plan.machine, s, start, modes)
    if sizes is not None:
        extents = extents_of(plan, s, start, modes, sizes)
        sizes = jtu.tree_map(_at_most_one, sizes)
        method = plan.method.with_sizes(sizes)
        plan = dataclasses.replace(plan, method=method, sizes=sizes, extents=extents)
        if plan.memory is not None:
            plan = with_sizes(plan, s, start, modes)
    numbers, rest = eqx.partition(plan, eqx.is_array)
    ends, (states, records) = lanes.run(
        partial(_begin, rest), partial(_step, rest), partial(_end, rest),
        (numbers, start, jnp.asarray(wanted)), rows=plan.recorded_intervals + 1,
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
    history = begun(plan, start, s)
    lane = initial_lane(with_view(plan, history, s), start, wanted)
    bad = (lane.fault == 0) & ~stop_gradient(is_covered(plan, history, s))
    return lane._replace(history=history, fault=jnp.where(bad, code("bad_start"), lane.fault))


def _step(rest: Plan, inputs: _Inputs, lane: Lane) -> tuple[Lane, lanes.Emitted]:
    plan = eqx.combine(inputs[0], rest)
    lane, completed, record = iterate(plan, lane)
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
