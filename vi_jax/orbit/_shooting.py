"""A periodic motion as a smooth system of equations: its events in a given order.

The cycle map has no derivative where an impact grazes. From event to event it has: with the order
of the impacts and switches given, the unknowns are the clock and the state at each of them, the
equations say that the flight from one leads to the next, and nothing has to be detected. Such a
solution passes smoothly through V⁻ = 0 and through a touch of the stop; on the far side it is a
motion that the stop forbids, as the sign of V⁻ or of the clearance says. (The same idea carries
`hspo` of COCO.)
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._types import Vector
from ..flow import AbstractMethod
from ..flow.beside import means
from ..flow.named import average_names
from ..machine import AbstractMachine
from ..machine.event import after_event, is_autonomous, jump_of, mode_number
from ..machine.numbers import with_leaf
from ._events import Event, guard_at
from ._flight import Flight
from ._observed import Observed, apart
from ._turns import Turns, turns_of
from .floquet import multipliers_of


class Shooting(eqx.Module):
    """The equations of an orbit with given events.

    Unknowns, in one vector: the clock at each event, the state just before each, and then the
    parameters named. A motion without events has its state at the clock's zero instead. Of an
    autonomous machine the first event is a section, at the clock's zero; the period stands in the
    place of its clock.
    """

    machine: AbstractMachine
    method: AbstractMethod
    like: Any
    """A state, for its structure."""
    cycles: int = eqx.field(static=True)
    events: tuple[Event, ...] = eqx.field(static=True)
    """In their order; each begins a flight."""
    modes: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    """Of the machine, in each flight."""
    steps: int = eqx.field(static=True)
    """Steps of a flight."""
    parameters: tuple[str, ...] = eqx.field(static=True)

    @property
    def legs(self) -> int:
        """Number of flights."""
        return max(1, len(self.events))

    @property
    def size(self) -> int:
        """Number of unknowns, parameters included."""
        return self.legs * self.states + len(self.events) + len(self.parameters)

    @property
    def states(self) -> int:
        """Number of state components."""
        return len(jtu.tree_leaves(self.like))

    @property
    def autonomous(self) -> bool:
        """Whether the period is an unknown."""
        return is_autonomous(self.machine, self.like)

    @property
    def impacts(self) -> tuple[int, ...]:
        """Which of the events are impacts."""
        stops = len(self.machine.stops)
        return tuple(i for i, event in enumerate(self.events) if event.number < stops)

    def at(self, x: Vector) -> AbstractMachine:
        """The machine with the parameters of `x`."""
        machine = self.machine
        count = len(self.parameters)
        for i, name in enumerate(self.parameters):
            machine = with_leaf(machine, name, x[x.shape[0] - count + i])
        return machine

    def parts(self, x: Vector) -> tuple[Float[Array, " legs"], Float[Array, "legs states"]]:
        """Clock and state at the start of each leg (before its event)."""
        legs = self.legs
        if not self.events:
            return jnp.zeros((1,), x.dtype), x[: self.states][None]
        end = legs * (1 + self.states)
        clock = x[:legs]
        if self.autonomous:
            clock = jnp.concatenate([jnp.zeros((1,), x.dtype), clock[1:]])
        return clock, x[legs:end].reshape(legs, self.states)

    def period(self, x: Vector) -> Array:
        """By the clock."""
        if self.autonomous:
            return x[0]
        return jnp.asarray(self.at(x).cycle, x.dtype) * self.cycles

    def pack(self, clock: Any, states: Any, parameters: Any, period: Any = None) -> Vector:
        """The vector of unknowns; of an autonomous machine with the period."""
        clock = jnp.asarray(clock) if self.events else jnp.zeros((0,))
        if self.autonomous:
            clock = clock.at[0].set(period)
        return jnp.concatenate([clock, jnp.ravel(states), jnp.ravel(jnp.asarray(parameters))])

    def unravel(self, u: Vector) -> Any:
        """A state from its vector."""
        return ravel_pytree(self.like)[1](u)

    def _modes_in(self, leg: Any) -> tuple[Array, ...]:
        """Of the machine, in a leg whose number may be traced."""
        if not self.modes[0]:
            return ()
        modes = jnp.asarray(self.modes, jnp.result_type(float))[leg]
        return tuple(modes[j] for j in range(len(self.modes[0])))

    def _each(self, leg: Any, of_event: Callable[[Event], Callable[..., Any]], *inputs: Any) -> Any:
        """A function that depends on the event of a leg, whose number may be traced."""
        kinds = sorted(set(self.events))
        which = jnp.asarray([kinds.index(event) for event in self.events])[leg]
        return jax.lax.switch(which, [of_event(kind) for kind in kinds], *inputs)

    def after(self, machine: AbstractMachine, leg: Any, s: Any, u: Vector) -> Vector:
        """The state after the event that begins a leg."""
        if not self.events:
            return u

        def of(event: Event) -> Callable[..., Vector]:
            def new(s, u):
                state, modes = self.unravel(u), self._modes_in(leg - 1)
                return ravel_pytree(after_event(machine, event.number, s, state, modes)[0])[0]

            return new

        return self._each(leg, of, s, u)

    def guard(self, machine: AbstractMachine, leg: Any, s: Any, u: Vector) -> Array:
        """What is zero at the event that begins a leg, and rises there."""

        def of(event: Event) -> Callable[..., Array]:
            def value(s, u):
                return guard_at(machine, event, s, self.unravel(u), self._modes_in(leg - 1))

            return value

        return self._each(leg, of, s, u)

    def ends(self, clock: Float[Array, " legs"], period: Any) -> Float[Array, " legs"]:
        """Clock at the end of each leg."""
        return jnp.concatenate([clock[1:], clock[:1] + period])

    def flight(self, machine: AbstractMachine, leg: Any) -> Flight:
        """The flight of a leg, whose number may be traced."""
        return Flight(machine, self._modes_in(leg), self.method, self.like)

    def residual(self, x: Vector) -> Vector:
        """What the flights from event to event lack; zero for a periodic motion."""
        machine = self.at(x)
        clock, states = self.parts(x)

        def arrive(leg, s0, s1, u):
            after = self.after(machine, leg, s0, u)
            end, _, _ = self.flight(machine, leg).fly(s0, s1, after, self.steps)
            if not self.events:
                return end, jnp.zeros((0,), x.dtype)
            return end, self.guard(machine, leg, s0, u)[None]

        legs = jnp.arange(len(states))
        ends = self.ends(clock, self.period(x))
        arrived, away = jax.vmap(arrive)(legs, clock, ends, states)
        return jnp.concatenate([(arrived - jnp.roll(states, -1, axis=0)).ravel(), away.ravel()])

    def observe(self, x: Vector) -> Observed:
        """Multipliers, extremes and the distances to grazing of a solution."""
        machine = self.at(x)
        clock, states = self.parts(x)
        averages = average_names(machine, self.unravel(states[0]))

        def follow(leg, s0, s1, u):
            def end(u):
                flight = self.flight(machine, leg)
                end, passed, path = flight.fly(s0, s1, u, self.steps, averages)
                return end, (passed, path)

            after = self.after(machine, leg, s0, u)
            carried, (passed, path) = jax.jacfwd(end, has_aux=True)(after)
            approach, order = jnp.zeros((0,), x.dtype), jnp.ones((), x.dtype)
            if self.events:
                saltation, rises = self._saltation(machine, leg, s0, u)
                carried, approach = carried @ saltation, rises[None]
                order = self._each(leg, partial(self._order, machine, leg), s0, u)
            places = [machine.position(self.unravel(x)) for x in (u, after)]
            return carried, passed, approach, order, self._turns(machine, leg, s1, path), places

        legs = jnp.arange(len(states))
        ends = self.ends(clock, self.period(x))
        found = jax.vmap(follow)(legs, clock, ends, states)
        carried, passed, approach, order, turns, places = found
        monodromy = jnp.eye(self.states, dtype=x.dtype)
        for leg in range(len(states)):
            monodromy = carried[leg] @ monodromy
        Y = jnp.concatenate(places)
        nearest = jnp.argmin(turns.room)
        time, integrals = jax.tree.map(jnp.sum, passed)
        timed = self.autonomous or machine.pace(clock[0], self.unravel(states[0])) is not None
        return Observed(
            multipliers=multipliers_of(monodromy),
            monodromy=monodromy,
            approach=approach.ravel(),
            y_min=jnp.minimum(jnp.min(Y), jnp.min(turns.low)),
            y_max=jnp.maximum(jnp.max(Y), jnp.max(turns.high)),
            clearance=turns.room[nearest],
            touch=turns.touch[nearest],
            touched=turns.touched[nearest],
            order=jnp.min(order),
            apart=apart(
                machine,
                self.events,
                self.modes,
                clock,
                ends - clock,
                [self.unravel(u) for u in states],
            ),
            duration=time if timed else jnp.asarray(machine.period, x.dtype) * self.cycles,
            averages=means(integrals, time),
        )

    def _saltation(self, machine, leg, s, u):
        """How a perturbation passes an event, R + (f⁺ - R f⁻) ∇g / ġ, and how fast it is met.

        R is the jump as a function of the state; ġ counts what the guard gains by the clock.
        """
        old, new = (self.flight(machine, x).smooth for x in (leg - 1, leg))

        def field(machine, u):
            return ravel_pytree(machine.field(s, self.unravel(u)))[0]

        def reset(u):
            def of(event: Event) -> Callable[..., Vector]:
                modes = self._modes_in(leg - 1)
                return lambda u: ravel_pytree(
                    jump_of(machine, event.number, s, self.unravel(u), modes)
                )[0]

            return self._each(leg, of, u)

        jacobian = jax.jacfwd(reset)(u)
        before, after = field(old, u), field(new, reset(u))
        if self.autonomous:
            # From the section on the clock counts anew, so that what lies along the motion is gone.
            goes_on = [float(not event.of(machine).ends_cycle) for event in self.events]
            after = jnp.asarray(goes_on, u.dtype)[leg] * after
        gained, slope = jax.grad(lambda s, u: self.guard(machine, leg, s, u), argnums=(0, 1))(s, u)
        rate = gained + jnp.dot(slope, before)

        def met(event: Event) -> Callable[..., Array]:
            return lambda u, rate: event.of(machine).speed(machine, self.unravel(u), rate)

        approach = self._each(leg, met, u, rate)
        return jacobian + jnp.outer(after - jacobian @ before, slope) / rate, approach

    def _turns(self, machine: AbstractMachine, leg: Any, s1: Array, path: Any) -> Turns:
        """The turning points of a leg."""
        places, states = path
        h = (s1 - places[0]) / self.steps
        return turns_of(self.flight(machine, leg), places, states, h)

    def _order(self, machine: AbstractMachine, leg: Any, event: Event) -> Callable[..., Array]:
        """Whether a switch goes into the mode of the flight that begins with its event: 1 or -1."""

        def order(s, u):
            if not event.of(machine).holds_mode:
                return jnp.ones_like(s)
            j, before = mode_number(machine, event.number), self._modes_in(leg - 1)
            mode = after_event(machine, event.number, s, self.unravel(u), before)[1][j]
            wanted = self._modes_in(leg)[j]
            return jnp.where(mode == wanted, 1.0, -1.0).astype(s.dtype)

        return order

    def state_at(self, x: Vector, leg: Any, s: Array) -> Any:
        """The state at clock `s`, which lies in leg number `leg`."""
        machine = self.at(x)
        clock, states = self.parts(x)
        u = self.after(machine, leg, clock[leg], states[leg])
        return self.unravel(self.flight(machine, leg).fly(clock[leg], s, u, self.steps)[0])
