"""The last part of a way to an event: `drift` for a machine in its modes."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Flag, Scalar
from ..machine import clock_of, guard_of, section_number
from ._lane import Plan
from .drift import drifted, height_of_turn, met_after, unmoved
from .events import rates
from .integrals import rate_of_integrals
from .smooth import SmoothMachine, holding


class FlowToEvent:
    """The motion close to an event.

    Its rate, and guards, positions and forces along it, are functions of `(moving, fixed, rest)`:
    `moving` is s, the state, and the integrals beside it, `fixed` what may have a derivative
    besides, `rest` the arrays that have none. `drift` is given them as functions that close over no
    number, so that JAX can differentiate them again.

    **Arguments:** `smooth`, the machine in its modes; `part`, the index of the interval within its
    cycle; `moving`, where the motion begins.
    """

    def __init__(self, plan: Plan, smooth: SmoothMachine, part: Scalar, moving: tuple):
        self._moving = moving
        self._fixed, others = eqx.partition((smooth, plan.end(part)), eqx.is_inexact_array)
        self._rest, self._static = eqx.partition(others, eqx.is_array)
        # What the functions close over, which may have a derivative too.
        self._around: list[Any] = []
        self._pure_rate = self._pure(self._rate)

    def drifted(self, offset: Scalar, moving: tuple | None = None) -> Any:
        """s, state and integrals after a further `offset`, by default from where it begins."""
        return drifted(self._pure_rate, offset, *self._given(moving))

    def unmoved(self, offset: Scalar) -> Any:
        """The same for an offset that is zero in value, but has derivatives."""
        return unmoved(self._pure_rate, offset, *self._given())

    def met_after(self, guard: Callable, offset: Scalar) -> Scalar:
        """`offset`, to where a guard or a force is zero, with its derivatives."""
        guard = self._pure(guard)
        return met_after(self._pure_rate, guard, offset, *self._given())

    def height_of_turn(self, k: int, height: Scalar, turns: Flag, offset: Scalar) -> Scalar:
        """`height`, of coordinate number k, with its derivatives; see `drift.height_of_turn`."""
        place = self._pure(self._place(k))
        return height_of_turn(self._pure_rate, place, height, turns, offset, *self._given())

    def guard(self, number: int) -> Callable:
        """The guard of the machine's event of this number, as a function of where the motion is."""

        def event(moving, fixed, rest):
            (smooth, bound), (s, state, _) = self._whole(fixed, rest), moving
            machine = smooth.machine
            clocked = clock_of(machine, state) is not None
            if clocked and number == section_number(machine):
                return clock_of(machine, state) - bound  # which may be that of a part of a cycle
            return guard_of(machine, number, s, state, smooth.modes, smooth.contact)

        return event

    def _place(self, k: int) -> Callable:
        """The position of coordinate number k, as a function of where the motion is."""

        def coordinate(moving, fixed, rest):
            smooth, _ = self._whole(fixed, rest)
            return smooth.machine.coordinates[k].position(moving[1])

        return coordinate

    def force(self, k: int) -> Callable:
        """The acceleration that coordinate number k would have if it were not held; the body is
        released where that turns away from the stop."""

        def acceleration(moving, fixed, rest):
            (smooth, _), (s, state, _) = self._whole(fixed, rest), moving
            free = holding(smooth.machine, smooth.modes, smooth.contact, but=k)
            return rates(free.field, smooth.machine.coordinates[k].position, s, state).a

        return acceleration

    def _rate(self, moving, fixed, rest):
        (smooth, _), (s, state, time) = self._whole(fixed, rest), moving
        return jnp.ones_like(s), smooth.field(s, state), rate_of_integrals(smooth, s, state, time)

    def _given(self, moving: tuple | None = None) -> tuple[Any, Any, Any]:
        begin = self._moving if moving is None else moving
        return begin, (self._fixed, tuple(self._around)), self._rest

    def _whole(self, fixed: object, rest: object) -> Any:
        return eqx.combine(fixed, rest, self._static)

    def _pure(self, function: Callable) -> Callable:
        # A machine may be written as a function of numbers around it.
        written, found = jax.closure_convert(function, self._moving, self._fixed, self._rest)
        here = slice(len(self._around), len(self._around) + len(found))
        self._around.extend(found)
        return lambda moving, fixed, rest: written(moving, fixed[0], rest, *fixed[1][here])
