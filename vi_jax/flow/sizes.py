"""The sizes of numbers, relative to which errors and rounding are judged.

Each component of a state has a size of its own, in its own unit. The size of a function of the
state is the sum of its derivatives times these sizes. A function is known to some roundings of its
size. Thresholds in `s` are in a unit of `s` that follows the cycle.
"""

from collections.abc import Callable
from functools import partial
from math import pi
from typing import TYPE_CHECKING, Any

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
from .._types import Scalar, Scalars, State, Vector
from ..machine import (
    AbstractMachine,
    ContactFriction,
    angles_in,
    begin_modes,
    events_of,
    events_of_steps,
    guard_of,
    in_rows,
    longest_step,
    mode_number,
    modes_of,
    push_of,
    scales_known,
    size_by,
    size_of,
    stops_of,
    with_some_past,
    without_modes,
)
from .smooth import in_modes, stops_are_exact

if TYPE_CHECKING:
    from .plan import Plan

# Thresholds in `s` are for cycles of about 2π, and hold for cycles up to this factor shorter or
# longer: a choice.
_USUAL = 100.0


def unit_of(machine: AbstractMachine) -> Scalar | float:
    """Return the unit of `s` for thresholds: 1, or cycle/2π of a cycle that is much shorter or
    longer than 2π."""
    if scales_known(machine):
        return 1.0
    if isinstance(machine.cycle, float | int):
        unit = machine.cycle / (2 * pi)
        return 1.0 if 1 / _USUAL < unit < _USUAL else unit
    unit = stop_gradient(jnp.asarray(machine.cycle)) / (2 * pi)
    return jnp.where((unit > 1 / _USUAL) & (unit < _USUAL), 1.0, unit)


# A number of the state below this share of the change that the other numbers cause has still to
# grow. Rates are evaluated at this many instants of a cycle. Choices.
_GROWS, _INSTANTS = 1e-3, 7

# A number of this size or smaller counts as zero: it is rounding of numbers about 1. A choice.
_ZERO = 1e-15


def sizes_at_start(plan: "Plan", s: Scalar, start: State) -> tuple[Scalars, State, tuple[Any, ...]]:
    """Return the modes at the start, `Plan.sizes` and `Plan.extents`, by a kernel that all plans of
    a machine share."""
    given, find = stop_gradient((s, start, plan.start_modes)), partial(_sizes_at_start, plan.rests)
    return lanes.once_with(_constant(plan.machine), find, given, backend=plan.backend)


def _sizes_at_start(
    rests: bool, machine: AbstractMachine, inputs: tuple[Scalar, State, Any]
) -> tuple[Scalars, State, tuple[Any, ...]]:
    s, start, own = inputs
    modes = begin_modes(machine, s, start, own)
    sizes = sizes_of(machine, s, start, modes)
    extents = extents_of(machine, s, start, modes, sizes, rests=rests)
    return modes, jtu.tree_map(limited_size, sizes), extents


def sizes_of(machine: AbstractMachine, s: Scalar, start: State, modes: Scalars) -> State:
    """Return the expected size of each number of the state.

    The size is the greater of the value at the start and its change at the rates there, in 1/2π of
    a cycle or of a shorter natural period. If both are tiny, it is the change that the sizes of the
    other numbers cause. The size of a zero that nothing moves yet is unknown, and returned as 1.
    """
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
    angles = angles_in(machine, state)
    angles = jnp.zeros(row.shape, bool) if angles is None else angles
    values = unravel(jnp.where(angles, 1.0, jnp.abs(row)))
    given = stop_gradient((state, modes_of(start), values))
    sizes = lanes.once_with(_constant(machine), _row_sizes, given)
    if rows is not None:
        rows = stop_gradient(jnp.nan_to_num(jnp.abs(rows.reshape(-1, row.size)), posinf=0.0))
        sizes = jnp.maximum(sizes, jnp.max(rows, axis=0))
    return stop_gradient(jnp.where(angles | ~(sizes > _ZERO), 1.0, sizes))


def _constant(machine: AbstractMachine) -> AbstractMachine:
    """Return a machine whose numbers have no derivatives."""
    return jtu.tree_map(lambda x: stop_gradient(x) if eqx.is_array(x) else x, machine)


def _row_sizes(machine: AbstractMachine, inputs: tuple[State, Any, State]) -> Vector:
    state, own, values = inputs
    zero = jnp.zeros((), in_rows(values, 0).dtype)
    modes = begin_modes(machine, zero, state, own)
    return in_rows(_known_sizes(machine, zero, state, modes, values), 0)


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
    for friction in holding:
        if isinstance(friction, ContactFriction):
            sizes = _with_slip(machine, friction, start, sizes)
    # Different factors prevent a force that acts on a difference from cancelling.
    leaves, tree = jtu.tree_flatten(sizes)
    rng = np.random.default_rng(0)
    signs = [rng.choice([-1, 1], x.shape) * rng.uniform(0.7, 1.0, x.shape) for x in leaves]
    direction = tree.unflatten([x * sign for x, sign in zip(leaves, signs, strict=True)])
    change_of_rate = jax.jvp(lambda x: smooth.field(s, x), (start,), (direction,))[1]

    def size(x: Array, change: Array, rate: Array) -> Array:
        change = unit * jnp.abs(change)
        # The rounding of a body at rest, such as an angle of 1e-17, shows no size.
        rests = (jnp.max(jnp.abs(rate), axis=0) == 0) & (change == 0) & (x <= _ZERO)
        return jnp.where(rests, 0.0, jnp.where(x > _GROWS * change, x, change))

    return jtu.tree_map(size, sizes, change_of_rate, rates)


def _with_slip(
    machine: AbstractMachine, friction: ContactFriction, start: State, sizes: State
) -> State:
    """Return the sizes with those that friction gives the velocity along a stop: a body that stands
    on it may have no other."""
    body = machine.coordinates[stops_of(machine)[friction.stop].coordinate]
    caused = friction.level * size_of(body.velocity, start, sizes)
    push = push_of(machine.coordinates[friction.along], start)

    def size(x: Array, p: Any) -> Array:
        return jnp.where(x > _GROWS * jnp.abs(p) * caused, x, jnp.abs(p) * caused)

    return jtu.tree_map(size, sizes, push)


def extents_of(
    machine: AbstractMachine, s: Scalar, start: State, modes: Scalars, sizes: State, *, rests: bool
) -> tuple[Any, ...]:
    """Return `Plan.extents`: the `limited_size` of each coordinate, then the size of the guard of
    each event other than a stop. `sizes` are from `sizes_of`."""
    unit = unit_of(machine)
    contact = tuple(jnp.zeros_like(s) for _ in machine.coordinates) if rests else ()
    s, start = stop_gradient((s, start))

    def of_guard(number: int, modes: Scalars, contact: Scalars) -> Scalar:
        def guard(s: Scalar, x: State) -> Scalar:
            return jnp.asarray(guard_of(machine, number, s, x, modes, contact), s.dtype)

        value, (rate, slopes) = jax.value_and_grad(guard, (0, 1))(s, start)
        size = jnp.maximum(jnp.abs(value), unit * jnp.abs(rate))
        return _known_or_one(jnp.maximum(size, size_by(slopes, sizes)))

    of_coordinates = (size_of(x.position, start, sizes) for x in machine.coordinates)
    extents: list[Any] = [limited_size(_known_or_one(size)) for size in of_coordinates]
    for number in events_of_steps(machine, start):
        event, rest = events_of(machine)[number], contact
        if not event.holds_mode:
            extents.append(of_guard(number, modes, rest))
            continue
        if contact and isinstance(event, ContactFriction):  # it holds a resting body
            k = stops_of(machine)[event.stop].coordinate
            rest = (*contact[:k], jnp.full_like(s, 1.0 + event.stop), *contact[k + 1 :])
        mode, values = mode_number(machine, number), jnp.asarray(event.sized_in, s.dtype)
        by_mode = lambda x, n=number, m=mode, r=rest: of_guard(
            n, (*modes[:m], x, *modes[m + 1 :]), r
        )
        extents.append(tuple(jax.vmap(by_mode)(values)))  # traced once for both modes
    return stop_gradient(tuple(extents))


def _known_or_one(size: Array) -> Array:
    """Return a size; 1 if it is 0 or NaN, which is unknown."""
    return jnp.where(size > 0, size, 1.0)


def limited_size(size: Array) -> Array:
    """Return a size; 1 if it is larger, since the motion may become smaller. It is not below a
    large number of roundings of the size (a choice), which in single precision is the size."""
    rounding = min(1.0, 2.0**23 * float(jnp.finfo(size.dtype).eps))
    return jnp.minimum(size, jnp.maximum(rounding * size, 1.0))


def rounding_bounds(
    machine: AbstractMachine, k: int, state: State, least: Scalar | float = 1.0,
    unit: Scalar | float = 1.0,
) -> tuple[Scalar | float, Scalar | float]:  # fmt: skip
    """Return bounds of the rounding errors of position and velocity of coordinate number k at its
    stop: 0 if the position is itself a number of the state. A position counts as at least `least`
    large, a velocity as `least / unit`."""
    if stops_are_exact(machine, state):
        return 0.0, 0.0
    return _bounds(machine, k, state, jnp.asarray(least), jnp.asarray(least / unit))


@eqx.filter_jit  # a step calls it often, and derivatives of gaps are long
def _bounds(
    machine: AbstractMachine, k: int, state: State, place: Scalar, speed: Scalar
) -> tuple[Scalar, Scalar]:
    body, state = machine.coordinates[k], stop_gradient(state)

    def bound(part: Callable[[State], Scalar], least: Scalar) -> Scalar:
        slopes = jax.grad(lambda x: jnp.sum(part(x)))(state)
        terms = jtu.tree_map(lambda slope, x: jnp.sum(jnp.abs(slope * x)), slopes, state)
        size = sum(jtu.tree_leaves(terms), start=least)
        return stop_gradient(16 * jnp.finfo(size.dtype).eps * size)

    return bound(body.position, place), bound(body.velocity, speed)


def guard_rounding(size: Scalar) -> Scalar:
    """Return a bound of the rounding error of a guard whose terms have this size."""
    return 64 * float(jnp.finfo(size.dtype).eps) * size
