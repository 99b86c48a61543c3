"""The last part of a way to an event, as `drift` asks for it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..scene.event import guard_of, section_number
from ._lane import Plan
from .beside import rate_beside
from .events import rates
from .moving import Moving, holding

Scalar = Float[Array, ""]


class Way:
    """The way that a machine goes on from `moving`: s, its state, and the time and the integrals
    where they are asked for.

    Its functions close over no number: everything that may have a derivative is an argument, in
    `fixed`.
    """

    def __init__(self, plan: Plan, machine: Any, part: Scalar, moving: tuple):
        self.moving = moving
        self._fixed, others = eqx.partition((machine, plan.end(part)), eqx.is_inexact_array)
        self.rest, self._static = eqx.partition(others, eqx.is_array)
        self._around: list[Any] = []
        self.rate = self._pure(self._rate)

    @property
    def fixed(self) -> Any:
        """The machine's numbers, and those around what it was written as."""
        return self._fixed, tuple(self._around)

    def guard(self, number: int) -> Callable:
        """Of one of the machine's events."""

        def event(moving, fixed, rest):
            (machine, bound), (s, state, _) = self._whole(fixed, rest), moving
            scene, modes, contact = _parts(machine)
            clocked = scene.clock(state) is not None
            if clocked and number == section_number(scene):
                return scene.clock(state) - bound  # which may be that of a part of a cycle
            return guard_of(scene, number, s, state, modes, contact)

        return self._pure(event)

    def place(self, k: int) -> Callable:
        """Of coordinate number k."""

        def coordinate(moving, fixed, rest):
            machine, _ = self._whole(fixed, rest)
            return _parts(machine)[0].coordinates[k].position(moving[1])

        return self._pure(coordinate)

    def force(self, k: int) -> Callable:
        """What coordinate number k would be accelerated by if it were not held."""

        def acceleration(moving, fixed, rest):
            (machine, _), (s, state, _) = self._whole(fixed, rest), moving
            free = holding(machine.scene, machine.modes, machine.contact, but=k)
            return rates(free.field, machine.scene.coordinates[k].position, s, state).a

        return self._pure(acceleration)

    def _rate(self, moving, fixed, rest):
        (machine, _), (s, state, time) = self._whole(fixed, rest), moving
        return jnp.ones_like(s), machine.field(s, state), rate_beside(machine, s, state, time)

    def _whole(self, fixed: Any, rest: Any) -> Any:
        return eqx.combine(fixed, rest, self._static)

    def _pure(self, function: Callable) -> Callable:
        # A scene may be written as a function of numbers around it.
        written, found = jax.closure_convert(function, self.moving, self._fixed, self.rest)
        here = slice(len(self._around), len(self._around) + len(found))
        self._around.extend(found)
        return lambda moving, fixed, rest: written(moving, fixed[0], rest, *fixed[1][here])


def _parts(machine: Any) -> tuple[Any, tuple[Scalar, ...], tuple[Scalar, ...]]:
    """The machine itself, its modes, and what of it rests on which stop."""
    if isinstance(machine, Moving):
        return machine.scene, machine.modes, machine.contact
    return machine, (), ()
