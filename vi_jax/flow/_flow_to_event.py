"""The last part of a way to an event, as `drift` asks for it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Scalar
from ..machine import clock_of, guard_of, section_number
from ._lane import Plan
from .events import rates
from .integrals import rate_of_integrals
from .smooth import SmoothMachine, holding


class FlowToEvent:
    """The motion close to an event, as the functions that `drift` asks for: its rate, and guards,
    positions and forces along it.

    Each is a function of `(moving, fixed, rest)`: `moving` is s, the state, and the
    integrals beside it, `fixed` what may have a derivative besides, `rest` the arrays
    that have none. The functions close over no number, so that JAX can differentiate them again.

    **Arguments:** `smooth`, the machine in its modes; `part`, the index of the interval within its
    cycle; `moving`, where the motion begins.
    """

    def __init__(self, plan: Plan, smooth: SmoothMachine, part: Scalar, moving: tuple):
        self.moving = moving
        self._fixed, others = eqx.partition((smooth, plan.end(part)), eqx.is_inexact_array)
        self.rest, self._static = eqx.partition(others, eqx.is_array)
        self._around: list[Any] = []
        self.rate = self._pure(self._rate)

    @property
    def fixed(self) -> Any:
        """The numbers that may have a derivative: the machine's own, and those that its functions
        close over."""
        return self._fixed, tuple(self._around)

    def guard(self, number: int) -> Callable:
        """The guard of the machine's event of this number, as a function of where the motion is."""

        def event(moving, fixed, rest):
            (smooth, bound), (s, state, _) = self._whole(fixed, rest), moving
            machine = smooth.machine
            clocked = clock_of(machine, state) is not None
            if clocked and number == section_number(machine):
                return clock_of(machine, state) - bound  # which may be that of a part of a cycle
            return guard_of(machine, number, s, state, smooth.modes, smooth.contact)

        return self._pure(event)

    def place(self, k: int) -> Callable:
        """The position of coordinate number k, as a function of where the motion is."""

        def coordinate(moving, fixed, rest):
            smooth, _ = self._whole(fixed, rest)
            return smooth.machine.coordinates[k].position(moving[1])

        return self._pure(coordinate)

    def force(self, k: int) -> Callable:
        """The acceleration that coordinate number k would have if it were not held; the body is
        released where that turns away from the stop."""

        def acceleration(moving, fixed, rest):
            (smooth, _), (s, state, _) = self._whole(fixed, rest), moving
            free = holding(smooth.machine, smooth.modes, smooth.contact, but=k)
            return rates(free.field, smooth.machine.coordinates[k].position, s, state).a

        return self._pure(acceleration)

    def _rate(self, moving, fixed, rest):
        (smooth, _), (s, state, time) = self._whole(fixed, rest), moving
        return jnp.ones_like(s), smooth.field(s, state), rate_of_integrals(smooth, s, state, time)

    def _whole(self, fixed: object, rest: object) -> Any:
        return eqx.combine(fixed, rest, self._static)

    def _pure(self, function: Callable) -> Callable:
        # A machine may be written as a function of numbers around it.
        written, found = jax.closure_convert(function, self.moving, self._fixed, self.rest)
        here = slice(len(self._around), len(self._around) + len(found))
        self._around.extend(found)
        return lambda moving, fixed, rest: written(moving, fixed[0], rest, *fixed[1][here])
