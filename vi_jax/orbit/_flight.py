"""The events of a periodic motion, in their order, and the flights between them."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .. import lanes
from .._types import Scalar, Scalars, State, Vector
from ..flow import TIME, AbstractMethod, Integrals, SmoothMachine, carried, elapsed, in_modes
from ..machine import (
    AbstractEvent,
    AbstractMachine,
    SoftStop,
    events_of,
    guard_of,
    prepared,
    section_number,
)


class Event(NamedTuple):
    """One of the machine's events, met in the course of a periodic motion."""

    number: int
    """Its place among the machine's events, in the order of `events_of(machine)`."""
    cycle: int | None = None
    """The number, from 0, of the cycle of the period that begins with it; `None` if none does."""

    def called(self, machine: AbstractMachine) -> str:
        """What messages call it: its name, or its kind and place among the machine's events of
        that kind."""
        event, events = self.of(machine), events_of(machine)
        if isinstance(event, SoftStop):
            return event.name or f"{event.side} soft stop"
        place = sum(other.word == event.word for other in events[: self.number])
        return event.name or f"{event.word} {place}"

    def later(self, cycles: int) -> "Event":
        """The same event so many cycles later in the motion."""
        return self if self.cycle is None else self._replace(cycle=self.cycle + cycles)

    def of(self, machine: AbstractMachine) -> AbstractEvent:
        """The machine's event of this number."""
        return events_of(machine)[self.number]


def section_of(machine: AbstractMachine, cycle: int) -> Event:
    """The section with which a cycle begins."""
    return Event(section_number(machine), cycle)


def guard_at(
    machine: AbstractMachine, event: Event, s: Scalar, state: State, modes: tuple[Array, ...]
) -> Scalar:
    """The guard of an event in the course of a motion, zero there and rising.

    **Arguments:** `s`, the clock since the beginning of the period; `state` and `modes`, those
    before the event.
    """
    if event.cycle is not None:
        s = s - jnp.asarray(machine.cycle, s.dtype) * (event.cycle - 1)
    return guard_of(machine, event.number, s, state, modes)


class Flight(eqx.Module):
    """The motion between two events: du/ds = f(s, u), the machine's field in its modes, which stay
    as they are; solved with steps of one length by a method of fixed steps."""

    machine: AbstractMachine
    modes: Scalars
    method: AbstractMethod
    like: State
    """A state, for its structure."""

    @property
    def smooth(self) -> SmoothMachine:
        """The machine in its modes."""
        return in_modes(self.machine, self.modes)

    def unravel(self, u: Vector) -> State:
        """A state from its vector."""
        return ravel_pytree(self.like)[1](u)

    def step(
        self, s0: Scalar, s1: Scalar, u: Vector, passed: Integrals
    ) -> tuple[Vector, Integrals]:
        """The state, and the time and integrals beside it, after one step of the method from `s0`
        to `s1`."""
        smooth, state = self.smooth, self.unravel(u)
        beside = carried(smooth, s0, state, passed)
        new, after, _ = self.method.step(smooth, s0, s1, state, beside)
        return ravel_pytree(new)[0], elapsed(passed, after, s1 - s0)

    def once(self, function: Callable[["Flight", Any], Any], inputs: object) -> Any:
        """A function of the flight and of one lane's numbers, evaluated as vector code (see
        `lanes.once`)."""
        numbers, rest = eqx.partition(self, eqx.is_array)
        return lanes.once(partial(_of_flight, rest, function), (numbers, inputs))

    def fly(
        self, s0: Scalar, s1: Scalar, u: Vector, steps: int, averages: tuple[str, ...] = ()
    ) -> tuple[Vector, Integrals, tuple[Float[Array, " steps"], Float[Array, "steps states"]]]:
        """The flight from the state `u` at clock `s0` to clock `s1`, in equal steps.

        **Arguments:** `averages`, the names of the machine's averages to integrate.

        **Returns:** the state at s1; the time that passed and the integrals; clock and state before
        each of the steps.
        """
        way = prepared(self.machine)
        if way.machine is not self.machine:
            inner = Flight(way.machine, self.modes, self.method, way.inward(self.like))

            def outward(u: Vector) -> Vector:
                return ravel_pytree(way.outward(inner.unravel(u)))[0]

            start = ravel_pytree(way.inward(self.unravel(u)))[0]
            u, passed, (clock, states) = inner.fly(s0, s1, start, steps, averages)
            return outward(u), passed, (clock, jax.vmap(outward)(states))
        numbers, rest = eqx.partition(self, eqx.is_array)
        (u, passed), path = lanes.run(
            partial(_begin, averages), partial(_step, rest, steps), _end,
            (numbers, s0, (s1 - s0) / steps, u), rows=steps,
        )  # fmt: skip
        return u, passed, path


def _of_flight(rest: Flight, function: Callable[[Flight, Any], Any], inputs: Any) -> Any:
    return function(eqx.combine(inputs[0], rest), inputs[1])


def _begin(averages: tuple[str, ...], inputs: Any) -> tuple[Any, lanes.Emitted]:
    _, s0, _, u = inputs
    zero = jnp.zeros_like(s0)
    return (u, {name: zero for name in (TIME, *averages)}, zero), lanes.Emitted(True, True, (s0, u))


def _step(rest: Flight, steps: int, inputs: Any, carry: Any) -> tuple[Any, lanes.Emitted]:
    (numbers, s0, h, _), (u, passed, i) = inputs, carry
    s = s0 + i * h
    u, passed = eqx.combine(numbers, rest).step(s, s + h, u, passed)
    i = i + 1
    return (u, passed, i), lanes.Emitted(i < steps, True, (s0 + i * h, u))


def _end(inputs: Any, carry: Any) -> Any:
    return carry[0], carry[1]
