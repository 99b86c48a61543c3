"""The motion from a step's end to a nearby event: negligible in value, but not in its derivatives.

A step ends within 1e-9 of its event, so that the remaining motion hardly changes the state. But the
time of the event and the state there depend on all that came before. Their derivatives are those of
the flow and of the event's equation, and are defined here, to any order.

A rate is a function `(moving, fixed, rest)` that returns d(moving)/ds. `fixed` are numbers with
respect to which derivatives may be taken; `rest` has no derivatives. A guard is such a function
too, and is zero at the event.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.custom_derivatives import SymbolicZero

from ..._types import Flag, Scalar
from ...machine import clock_of, guard_of, section_number
from ..plan import Plan
from ..smooth import SmoothMachine, hold_contacts, rate_of_integrals
from .roots import rates


def _nonzero_tangents(tangents: Any) -> tuple[tuple[bool, ...], list[Any]]:
    """Return which leaves have a tangent, and those tangents."""
    slopes = jtu.tree_leaves(tangents, is_leaf=lambda x: isinstance(x, SymbolicZero))
    moves = tuple(not isinstance(x, SymbolicZero) for x in slopes)
    return moves, [x for x, m in zip(slopes, moves, strict=True) if m]


def _jvp(function: Callable, at: tuple, moves: tuple[bool, ...], slopes: list) -> tuple[Any, Any]:
    """Return value and derivative of a function of trees, along those of their leaves that move."""
    leaves, tree = jtu.tree_flatten(at)

    def of_changing(*changing):
        values = iter(changing)
        all_leaves = [next(values) if m else x for x, m in zip(leaves, moves, strict=True)]
        return function(*jtu.tree_unflatten(tree, all_leaves))

    return jax.jvp(of_changing, [x for x, m in zip(leaves, moves, strict=True) if m], slopes)


def _with_zeros(tangents: Any) -> Any:
    def number(x: Any) -> Any:
        aval: Any = getattr(x, "aval", None)
        return jnp.zeros(aval.shape, aval.dtype) if isinstance(x, SymbolicZero) else x

    return jtu.tree_map(number, tangents, is_leaf=lambda x: isinstance(x, SymbolicZero))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def extrapolate(rate: Callable, offset: Scalar, moving: Any, fixed: Any, rest: Any) -> Any:
    """Return `moving` after a further `offset` of s. The value is of first order, which is accurate
    enough for an offset of 1e-9; the derivatives are those of the exact flow."""
    return jtu.tree_map(lambda x, dx: x + offset * dx, moving, rate(moving, fixed, rest))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def with_flow_derivatives(
    rate: Callable, offset: Scalar, moving: Any, fixed: Any, rest: Any
) -> Any:
    """Return `moving` itself, with the derivatives of `extrapolate` for an offset that is zero in
    value but has derivatives."""
    return moving


def _flow_jvp(flow, rate, primals, tangents):
    offset, moving, fixed, rest = primals
    end = flow(rate, offset, moving, fixed, rest)
    slope = _with_zeros(tangents[1])
    moves, tangents_of_fixed = _nonzero_tangents(tangents[2])
    if any(moves) or any(_nonzero_tangents(tangents[1])[0]):
        # The same flow carries the derivative with respect to the start.
        all_move = (True,) * len(jtu.tree_leaves(moving)) + moves

        def both(pair, fixed_pair, rest):
            slopes = [*jtu.tree_leaves(pair[1]), *fixed_pair[1]]
            at = pair[0], fixed_pair[0]
            return _jvp(lambda x, p: rate(x, p, rest), at, all_move, slopes)

        slope = flow(both, offset, (moving, slope), (fixed, tangents_of_fixed), rest)[1]
    if not isinstance(tangents[0], SymbolicZero):
        rate_at_end = rate(end, fixed, rest)
        slope = jtu.tree_map(lambda dx, v: dx + tangents[0] * v, slope, rate_at_end)
    return end, slope


extrapolate.defjvp(partial(_flow_jvp, extrapolate), symbolic_zeros=True)
with_flow_derivatives.defjvp(partial(_flow_jvp, with_flow_derivatives), symbolic_zeros=True)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def event_offset(
    rate: Callable, guard: Callable, offset: Scalar, moving: Any, fixed: Any, rest: Any,
    lost: tuple[Flag, Flag],
) -> Scalar:  # fmt: skip
    """Return the offset in s to the zero of a guard: `offset` itself, which must be accurate to
    rounding, with the derivatives of the implicit function. They are NaN if the first flag in
    `lost` is true and the guard has no slope, or if the second is true."""
    return offset


def _event_offset_jvp(rate, guard, primals, tangents):
    _, moving, fixed, rest, (sloped, lost) = primals
    offset = event_offset(rate, guard, *primals)
    moves, slopes = _nonzero_tangents(tangents[1:3])
    if not any(moves):
        return offset, jnp.zeros_like(offset)

    def guard_at_end(moving, fixed):
        return guard(extrapolate(rate, offset, moving, fixed, rest), fixed, rest)

    change = _jvp(guard_at_end, (moving, fixed), moves, slopes)[1]
    end = extrapolate(rate, offset, moving, fixed, rest)
    rate_at_end = rate(end, fixed, rest)
    speed = jax.jvp(lambda x: guard(x, fixed, rest), (end,), (rate_at_end,))[1]
    speed = jnp.where(speed == 0, jnp.where(sloped, jnp.nan, 1.0), speed)
    return offset, -change / jnp.where(lost, jnp.nan, speed)


event_offset.defjvp(_event_offset_jvp, symbolic_zeros=True)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def height_of_turn(
    rate: Callable,
    position: Callable,
    height: Scalar,
    turns: Flag,
    offset: Scalar,
    moving: Any,
    fixed: Any,
    rest: Any,
) -> Scalar:
    """Return `height`, the height of a turning point of `position`, a function like the rate.
    If the motion `turns` after a further `offset` of s, its derivatives are those of the turning
    point; else those of the position in `moving`."""
    return height


def _height_of_turn_jvp(rate, position, primals, tangents):
    _, turns, offset, moving, fixed, rest = primals
    height = height_of_turn(rate, position, *primals)
    moves, slopes = _nonzero_tangents(tangents[3:5])
    if not any(moves):
        return height, jnp.zeros_like(height)

    def speed(moving, fixed, rest):
        flow = rate(moving, fixed, rest)
        return jax.jvp(lambda x: position(x, fixed, rest), (moving,), (flow,))[1]

    def height_at_turn(moving, fixed):
        no = jnp.zeros((), bool)
        to_turn = event_offset(rate, speed, offset, moving, fixed, rest, (no, no))
        return position(extrapolate(rate, to_turn, moving, fixed, rest), fixed, rest)

    def slope_of(function: Callable) -> Scalar:
        return _jvp(function, (moving, fixed), moves, slopes)[1]

    slope_here = slope_of(lambda x, p: position(x, p, rest))
    return height, jax.lax.cond(turns, lambda _: slope_of(height_at_turn), lambda x: x, slope_here)


height_of_turn.defjvp(_height_of_turn_jvp, symbolic_zeros=True)


class FlowToEvent:
    """The motion close to an event, from `moving` on.

    Its rate, and guards, positions and forces along it, are functions of `(moving, fixed, rest)`.
    `moving` is s, the state and the integrals; `fixed` are other numbers that may have a
    derivative; `rest` are arrays without. The functions close over no number, so that JAX can
    differentiate them again.

    **Arguments:** `smooth`, the machine in its modes; `part`, the index of the interval within its
    cycle.
    """

    def __init__(self, plan: Plan, smooth: SmoothMachine, part: Scalar, moving: tuple):
        self._moving = moving
        self._fixed, others = eqx.partition((smooth, plan.end(part)), eqx.is_inexact_array)
        self._rest, self._static = eqx.partition(others, eqx.is_array)
        # Numbers that the functions close over, which may have a derivative too.
        self._captured: list[Any] = []
        self._pure_rate = self._pure(self._rate)

    def extrapolate(self, offset: Scalar, moving: tuple | None = None) -> Any:
        """Return s, state and integrals after a further `offset`, by default from the start."""
        return extrapolate(self._pure_rate, offset, *self._arguments(moving))

    def midpoint_step(self, offset: Scalar) -> Any:
        """Return the same for a longer `offset`, of second order."""
        half, start = 0.5 * offset, self._moving
        middle = self.extrapolate(half)
        later = self.extrapolate(half, middle)
        return jtu.tree_map(lambda x, y, z: x + 2 * (z - y), start, middle, later)

    def with_flow_derivatives(self, offset: Scalar) -> Any:
        """Return the same for an offset that is zero in value, but has derivatives."""
        return with_flow_derivatives(self._pure_rate, offset, *self._arguments())

    def event_offset(
        self, guard: Callable, offset: Scalar, met: Flag | None = None, lost: Flag | None = None
    ) -> Scalar:
        """Return `offset`, to the zero of a guard or a force, with its derivatives. They are NaN if
        a guard that was `met` has no slope there, or if they are `lost`."""
        guard, no = self._pure(guard), jnp.zeros((), bool)
        flags = no if met is None else met, no if lost is None else lost
        return event_offset(self._pure_rate, guard, offset, *self._arguments(), flags)

    def height_of_turn(self, k: int, height: Scalar, turns: Flag, offset: Scalar) -> Scalar:
        """Return the `height` of coordinate number k with derivatives (`height_of_turn`)."""
        position = self._pure(self._position_of(k))
        return height_of_turn(self._pure_rate, position, height, turns, offset, *self._arguments())

    def guard(self, number: int) -> Callable:
        """Return the guard of the machine's event of this number, as a function of the motion."""

        def event(moving, fixed, rest):
            (smooth, bound), (s, state, _) = self._combined(fixed, rest), moving
            machine = smooth.machine
            clocked = clock_of(machine, state) is not None
            if clocked and number == section_number(machine):
                return clock_of(machine, state) - bound  # which may end a part of a cycle
            return guard_of(machine, number, s, state, smooth.modes, smooth.contact)

        return event

    def _position_of(self, k: int) -> Callable:
        def position(moving, fixed, rest):
            smooth, _ = self._combined(fixed, rest)
            return smooth.machine.coordinates[k].position(moving[1])

        return position

    def force(self, k: int) -> Callable:
        """Return the acceleration that coordinate number k would have if it were free; the body is
        released when that changes sign."""

        def acceleration(moving, fixed, rest):
            (smooth, _), (s, state, _) = self._combined(fixed, rest), moving
            free = hold_contacts(smooth.machine, smooth.modes, smooth.contact, but=k)
            return rates(free.field, smooth.machine.coordinates[k], s, state).a

        return acceleration

    def _rate(self, moving, fixed, rest):
        (smooth, _), (s, state, time) = self._combined(fixed, rest), moving
        return jnp.ones_like(s), smooth.field(s, state), rate_of_integrals(smooth, s, state, time)

    def _arguments(self, moving: tuple | None = None) -> tuple[Any, Any, Any]:
        begin = self._moving if moving is None else moving
        return begin, (self._fixed, tuple(self._captured)), self._rest

    def _combined(self, fixed: object, rest: object) -> Any:
        return eqx.combine(fixed, rest, self._static)

    def _pure(self, function: Callable) -> Callable:
        # A machine's functions may close over numbers.
        pure, captured = jax.closure_convert(function, self._moving, self._fixed, self._rest)
        place = slice(len(self._captured), len(self._captured) + len(captured))
        self._captured.extend(captured)
        return lambda moving, fixed, rest: pure(moving, fixed[0], rest, *fixed[1][place])
