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
from ..flow import TIME, AbstractMethod, Integrals, SmoothMachine, carried, elapsed, guard_rates
from ..machine import (
    AbstractEvent,
    AbstractMachine,
    RigidStop,
    SoftStop,
    events_of,
    guard_of,
    prepared,
    section_number,
    stop_in_words,
    stops_of,
)

LANDS, LEAVES = "lands", "leaves"

# Clocks (rows,) and states (rows, states) before steps of a flight.
Rows = tuple[Float[Array, " rows"], Float[Array, "rows states"]]


class Event(NamedTuple):
    number: int
    """Its index among the machine's events, in the order of `events_of(machine)`."""
    cycle: int | None = None
    """The number, from 0, of the cycle of the period that begins with it, or `None`."""
    use: str = ""
    """For a stop: `LANDS` at the first impact of a chatter into rest, `LEAVES` at a rest's end."""

    def name_on(self, machine: AbstractMachine) -> str:
        event, events = self.of(machine), events_of(machine)
        if isinstance(event, RigidStop | SoftStop):
            return stop_in_words(machine, event)
        index = sum(other.word == event.word for other in events[: self.number])
        return event.name or f"{event.word} {index}"

    def shifted(self, cycles: int) -> "Event":
        return self if self.cycle is None else self._replace(cycle=self.cycle + cycles)

    def of(self, machine: AbstractMachine) -> AbstractEvent:
        return events_of(machine)[self.number]


def section_of(machine: AbstractMachine, cycle: int) -> Event:
    return Event(section_number(machine), cycle)


def guard_at(
    before: "Flight", event: Event, s: Scalar, state: State, new: Scalars | None = None
) -> Scalar:
    """Return the guard of an event that ends the flight `before`; it is zero and rising there. `s`
    counts from the begin of the period. The guard of a release is the force off the stop. `new` are
    the modes after the event, if known."""
    if event.use == LEAVES:
        return -force_on(before, event.number, s, state)
    if event.cycle is not None:
        s = s - jnp.asarray(before.machine.cycle, s.dtype) * (event.cycle - 1)
    given = before.machine, event.number, s, state, before.modes, before.contact
    return guard_of(*given, new=new)


def force_on(flight: "Flight", number: int, s: Scalar, state: State) -> Scalar:
    """Return the acceleration d²/ds² of the resting body towards its stop, if it were free."""
    stop = stops_of(flight.machine)[number]
    field = flight.with_released(stop.coordinate).smooth.field
    return guard_rates(field, partial(stop.guard, flight.machine), s, state).a


def on_stop(machine: AbstractMachine, number: int, state: State) -> State:
    stop = stops_of(machine)[number]
    body = machine.coordinates[stop.coordinate]
    return body.placed(state, stop.place, jnp.zeros_like(body.velocity(state)))


class Flight(eqx.Module):
    """The motion between two events: du/ds = f(s, u), the machine's field in constant modes, solved
    in equal steps by a method of fixed steps."""

    machine: AbstractMachine
    modes: Scalars
    method: AbstractMethod
    like: State
    """A state, for its structure."""
    contact: Scalars = ()
    """1 + i for each coordinate that rests on stop number i, else 0; empty if none rests."""

    @property
    def smooth(self) -> SmoothMachine:
        """The machine in its modes, with its resting bodies held."""
        return SmoothMachine(self.machine, self.modes, self.contact)

    def with_contact(self, contact: Scalars) -> "Flight":
        return Flight(self.machine, self.modes, self.method, self.like, contact)

    def with_released(self, coordinate: int) -> "Flight":
        others = (0.0 * x if k == coordinate else x for k, x in enumerate(self.contact))
        return self.with_contact(tuple(others) if len(self.contact) > 1 else ())

    def unravel(self, u: Vector) -> State:
        return ravel_pytree(self.like)[1](u)

    def rate(self, s: Scalar, u: Vector) -> Vector:
        """Return du/ds, the rate of the state along this flight."""
        return ravel_pytree(self.smooth.field(s, self.unravel(u)))[0]

    def step(
        self, s0: Scalar, s1: Scalar, u: Vector, integrals: Integrals
    ) -> tuple[Vector, Integrals]:
        smooth, state = self.smooth, self.unravel(u)
        before = carried(smooth, s0, state, integrals)
        new, after = _take_step(self.method, smooth, s0, s1, state, before)
        for number, stop in enumerate(stops_of(self.machine) if self.contact else ()):
            # A closed form of the flight leaves out the force that holds the body.
            rests = self.contact[stop.coordinate] == 1.0 + number
            on_the_stop = on_stop(self.machine, number, new)
            new = jax.tree.map(partial(jnp.where, rests), on_the_stop, new)
        return ravel_pytree(new)[0], elapsed(integrals, after, s1 - s0)

    def once(self, function: Callable[["Flight", Any], Any], inputs: object) -> Any:
        """Compute a function of the flight and one lane's inputs as vector code."""
        return lanes.once_with(self, function, inputs)

    def fly(
        self, s0: Scalar, s1: Scalar, u: Vector, steps: int | Scalar,
        averages: tuple[str, ...] = (), *, rows: int = 0,
    ) -> tuple[Vector, Integrals, Rows]:  # fmt: skip
        """Integrate from `u` at clock `s0` to clock `s1` in equal steps. Return the final state;
        time and integrals of `averages`; clock and state before each of the first `rows` steps.
        Without rows one program serves any number of steps."""
        form = prepared(self.machine)
        if form.machine is not self.machine:
            inner_like = form.inward(self.like)
            inner = Flight(form.machine, self.modes, self.method, inner_like, self.contact)

            def outward(u: Vector) -> Vector:
                return ravel_pytree(form.outward(inner.unravel(u)))[0]

            start = ravel_pytree(form.inward(self.unravel(u)))[0]
            u, integrals, (clock, states) = inner.fly(s0, s1, start, steps, averages, rows=rows)
            return outward(u), integrals, (clock, jax.vmap(outward)(states))
        numbers, rest = eqx.partition(self, eqx.is_array)
        (u, integrals), path = lanes.run(
            partial(_begin, averages), partial(_step, rest), _end,
            (numbers, s0, (s1 - s0) / steps, u, jnp.asarray(steps, s0.dtype)), rows=rows,
        )  # fmt: skip
        return u, integrals, path


@eqx.filter_jit
def _take_step(
    method: AbstractMethod, smooth: SmoothMachine, s0: Scalar, s1: Scalar, state: State,
    before: Integrals,
) -> tuple[State, Integrals]:  # fmt: skip
    # Six programs of an orbit's equations take such steps: one trace saves a sixth of their time.
    return method.step(smooth, s0, s1, state, before)[:2]


def _begin(averages: tuple[str, ...], inputs: Any) -> tuple[Any, lanes.Emitted]:
    _, s0, _, u, _ = inputs
    zero = jnp.zeros_like(s0)
    return (u, {name: zero for name in (TIME, *averages)}, zero), lanes.Emitted(True, True, (s0, u))


def _step(rest: Flight, inputs: Any, carry: Any) -> tuple[Any, lanes.Emitted]:
    (numbers, s0, h, _, steps), (u, integrals, i) = inputs, carry
    s = s0 + i * h
    u, integrals = eqx.combine(numbers, rest).step(s, s + h, u, integrals)
    i = i + 1
    return (u, integrals, i), lanes.Emitted(i < steps, True, (s0 + i * h, u))


def _end(inputs: Any, carry: Any) -> Any:
    return carry[0], carry[1]
