"""Periodic motions as smooth systems of equations, for a given order of their events.

The cycle map has no derivative at a grazing impact. With the order of impacts and switches given,
the equations from event to event have one. Their unknowns are the clock and the state at each
event; the flight from one event must lead to the next, and no event has to be detected. Solutions
pass smoothly through V⁻ = 0 and through a touch of the stop. On the far side the stop forbids the
motion; the sign of V⁻ or of the clearance shows this. (`hspo` of COCO has the same idea.)
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient
from jaxtyping import Array, Complex, Float, Int

from .._types import Scalar, State, Vector
from ..flow import TIME, AbstractMethod, average_names, means
from ..machine import (
    AbstractMachine,
    DryFriction,
    Turn,
    after_event,
    angles_in,
    component,
    components,
    counter_of,
    cycle_time,
    events_of,
    guard_of,
    jump_of,
    mode_number,
    nearest_images,
    section_number,
    states_from_rows,
    stops_of,
    switches_of,
    with_component,
    with_leaf,
)
from .flight import LANDS, LEAVES, Event, Flight, guard_at, on_stop
from .rest import Chatter, escape_margin, last_hop, remaining
from .results import multipliers_of
from .tolerances import LOCATED, ROUNDING
from .turns import Nearest, Path, pull_of, turns_of

# Newton steps from the begin of a step to the passage of an angle within it. Four reach rounding if
# the speed changes by less than half in a step.
_PASSING = 5


class Observed(NamedTuple):
    """Quantities observed of a solution of an orbit's equations, at one point of a branch."""

    multipliers: Complex[Array, " states"]
    """Eigenvalues of the monodromy matrix, the largest modulus first."""
    monodromy: Float[Array, "states states"]
    """Derivative of the state a period later with respect to the state just before the first event.
    """
    approach: Float[Array, " events"]
    """V⁻ at each impact, the rate of the guard at other events; negative beyond the event's loss.
    """
    units: Float[Array, " events"]
    """The sizes of these along the motion."""
    y_min: Scalar
    """Smallest position of the first coordinate over the period."""
    y_max: Scalar
    nearest: Nearest
    """Over all turning points; its `margin` is the clearance."""
    pull: Nearest
    """The least extremum of the force on a resting body; its `margin` is that force."""
    modes_agree: Scalar
    """1 if each event puts its switch into the mode of its leg, else -1."""
    least_load: Scalar
    """The least size of a dry friction's force at a step of a flight, as a share of its greatest; 1
    if none can be negative."""
    order_margin: Scalar
    """Margin until the order of events changes. It is the least time between consecutive events, or
    the least distance at an event to one that does not occur there. Negative if the machine does
    not have this motion."""
    duration: Scalar
    """The period in time."""
    averages: dict[str, Scalar]
    """The machine's averages over the period."""
    largest: Float[Array, " states"]
    """The largest modulus of each component of the state over the period; NaN if unknown."""
    escape_margin: Float[Array, " landings"] | None = None
    """χ of each chatter that ends in a rest; negative while the chatter ends before the release."""

    @property
    def length(self) -> float:
        """The extent of the motion, by which distances are judged; host-side."""
        y_min, y_max = float(self.y_min), float(self.y_max)
        return max(y_max - y_min, abs(y_min), abs(y_max))

    def admissible(self, events: Sequence[int]) -> bool:
        """Return whether it stays inside the stops and approaches these events; host-side."""
        inside = self.nearest.margin >= -ROUNDING * self.nearest.unit
        slowest = np.asarray(self.approach / self.units)[list(events)].min(initial=0.0)
        return bool(inside and slowest >= -ROUNDING)

    @property
    def lost(self) -> np.ndarray:
        """True for each event that grazes; host-side."""
        return np.abs(np.asarray(self.approach / self.units)) < LOCATED

    @property
    def touches(self) -> bool:
        """True if the motion turns on a stop that it does not hit; host-side."""
        return abs(self.relative_clearance) <= LOCATED

    @property
    def relative_clearance(self) -> float:
        """The clearance as a share of its size, within ±1; 1 for motions without a turn."""
        return float(np.clip(self.nearest.margin / self.nearest.unit, -1.0, 1.0))

    @property
    def least_hold_force(self) -> float:
        """The least force on a body within its rest, relative to the motion's; within ±1."""
        return float(np.clip(self.pull.margin / self.pull.unit, -1.0, 1.0))

    @property
    def fastest(self) -> float:
        """The scale of speeds of approach, by which they are judged; host-side."""
        usual = 2 * np.pi * self.length / float(self.duration)
        return max(usual, np.abs(np.asarray(self.approach)).max(initial=0.0))


# A hop has this share of a cycle's steps: the longest hop of a chatter (see `resting_problem_of`).
_HOP = 0.2

# The number of a leg; it may be traced.
Leg = int | Array

# The unknowns of an orbit, on the host or in a compiled program.
Unknowns = np.ndarray | Array


class Shooting(eqx.Module):
    """The equations of an orbit with given events: multiple shooting from each event to the next.

    A *leg* is the motion from just before event i to just before event i + 1: the event's jump Rᵢ,
    then the flight over the time in between. Let sᵢ be the clock at event i, uᵢ the state just
    before it, gᵢ its guard, φ the flow in the modes of the leg and p the parameters. The equations
    are

        φ(Rᵢ(uᵢ); sᵢ → sᵢ₊₁) - uᵢ₊₁ = 0,   gᵢ(sᵢ, uᵢ) = 0,   i = 1 … n, cyclically,

    and the event after the last is the first one, a period later. The unknowns, in one vector x,
    are (s₁ … sₙ, u₁ … uₙ, p). Without events there is one leg, from the state at clock zero, and x
    = (u, p). The first event of an autonomous machine is at clock zero; its period is an unknown
    and replaces s₁. Sections are among its events, unless turns end its cycles and there are other
    events. These may then pass a section along a branch.
    """

    machine: AbstractMachine
    method: AbstractMethod
    """The integrator; its steps are fixed, so that its result is smooth in its arguments."""
    like: State
    """A state, for its structure."""
    cycles: int = eqx.field(static=True)
    """The period, in cycles of the machine."""
    events: tuple[Event, ...] = eqx.field(static=True)
    """The events in their order; each begins a leg."""
    modes: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    """The machine's modes in each leg."""
    steps: int = eqx.field(static=True)
    """Number of steps of the flight of a leg."""
    parameters: tuple[str, ...] = eqx.field(static=True)
    """Names of the machine's parameters that are unknowns."""
    sizes: Any = None
    """Sizes of the clock and of each component of the state along the motion, (1 + states,): the
    scales of differences between motions (see `with_sizes`)."""
    widths: Any = ()
    """The sizes of the parameters, half the widths of their intervals."""
    held: tuple[float, ...] = eqx.field(static=True, default=())
    """`Flight.contact` of the coordinates that always rest, 0 for others; or empty."""
    conditions: tuple[Any, ...] = ()
    """Additional equations (`AbstractCondition`); on a curve one fewer than there are parameters.
    """
    autonomous: bool = eqx.field(static=True, kw_only=True)
    """True if the period is an unknown: `is_autonomous`, which takes 1 ms."""

    @property
    def legs(self) -> int:
        return max(1, len(self.events))

    @property
    def size(self) -> int:
        """Number of unknowns, parameters included."""
        return self.legs * self.states + len(self.events) + len(self.parameters)

    @property
    def states(self) -> int:
        """Number of components of the state, as unknowns."""
        return sum(jnp.size(x) for x in jtu.tree_leaves(self.like))

    @property
    def omits_sections(self) -> bool:
        """True if the sections of an autonomous machine are not among the events."""
        in_flight = all(event.cycle is None for event in self.events)
        return bool(self.events) and in_flight and self.autonomous

    @property
    def angles(self) -> np.ndarray | None:
        """Flags of the components of a state that are angles; `None` without any."""
        if not self.omits_sections:
            return angles_in(self.machine, self.like)
        return np.array([name == self.turn.name for name in components(self.like)])

    @property
    def turn(self) -> Turn:
        """The counter of turns of a machine whose sections are omitted."""
        counter = counter_of(self.machine)
        assert isinstance(counter, Turn)
        return counter

    def within_turn(self, number: int, states: np.ndarray) -> np.ndarray:
        """Return states, the last axis, with the angle that turns within turn number `number`."""
        begin, turns = float(self.turn.start), 2 * np.pi * number
        inside = begin + turns + np.mod(states - begin, 2 * np.pi)
        return np.where(np.asarray(self.angles), inside, states)

    @property
    def impacts(self) -> tuple[int, ...]:
        stops = len(stops_of(self.machine))
        events = enumerate(self.events)
        return tuple(i for i, event in events if event.number < stops and event.use != LEAVES)

    @property
    def landings(self) -> tuple[int, ...]:
        """Indices of the events that begin a chatter that ends in a rest."""
        return tuple(i for i, event in enumerate(self.events) if event.use == LANDS)

    @property
    def rests(self) -> bool:
        return bool(self.landings or self.held)

    @property
    def stuck(self) -> tuple[int, ...]:
        """Numbers of the events of dry frictions that hold their bodies all the time."""
        return tuple(
            number
            for number, event in enumerate(events_of(self.machine))
            if isinstance(event, DryFriction)
            and all(modes[mode_number(self.machine, number)] == 0 for modes in self.modes)
        )  # fmt: skip

    @property
    def contacts(self) -> tuple[tuple[float, ...], ...]:
        """`Flight.contact` of each coordinate in each leg; empty without rests."""
        if not self.landings:
            return (self.held,) * self.legs
        contact, found = list(self.held) or [0.0] * len(self.machine.coordinates), []
        for event in 2 * self.events:
            if event.use:
                stop = stops_of(self.machine)[event.number]
                contact[stop.coordinate] = 1.0 + event.number if event.use == LANDS else 0.0
            found.append(tuple(contact))
        return tuple(found[self.legs :])

    def at(self, x: Unknowns) -> AbstractMachine:
        x = x if isinstance(x, np.ndarray) else jnp.asarray(x)
        n = x.shape[0]
        return self._with_parameters([x[i] for i in range(n - len(self.parameters), n)])

    def _with_parameters(self, values: Sequence[Any]) -> AbstractMachine:
        machine = self.machine
        for name, value in zip(self.parameters, values, strict=True):
            machine = with_leaf(machine, name, value)
        return machine

    def motion_at(self, x: Unknowns) -> tuple["Shooting", Unknowns]:
        """Return the equations of the motion alone, without parameters among the unknowns, and a
        solution of them, from a solution `x`; host-side."""
        x = np.asarray(x)
        end = x.size - len(self.parameters)
        machine = self._with_parameters([np.asarray(value) for value in x[end:]])
        cleared: Any = {"parameters": (), "conditions": (), "widths": ()}
        return dataclasses.replace(self, machine=machine, **cleared), x[:end]

    def corners(self, intervals: Iterable[tuple[float, float]]) -> list[AbstractMachine]:
        return [self.at(np.asarray(ends)) for ends in itertools.product(*intervals)]

    def parts(self, x: Unknowns) -> tuple[Float[Array, " legs"], Float[Array, "legs states"]]:
        """Return clock and state at the start of each leg (before its event)."""
        return self._parts(jnp, jnp.asarray(x))

    def _parts(self, array: Any, x: Any) -> tuple[Any, Any]:
        legs = self.legs
        if not self.events:
            return array.zeros((1,), x.dtype), x[: self.states][None]
        end = legs * (1 + self.states)
        clock = x[:legs]
        if self.autonomous:
            clock = array.concatenate([array.zeros((1,), x.dtype), clock[1:]])
        return clock, x[legs:end].reshape(legs, self.states)

    def values(self, x: Unknowns) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the `parts` and the period of a solution; host-side."""
        x = np.asarray(x)
        period = x[0] if self.autonomous else float(self.at(x).cycle) * self.cycles
        return *self._parts(np, x), float(period)

    def lengths(self, x: Unknowns) -> np.ndarray:
        """Return the duration of each leg by the clock; host-side."""
        clock, _, period = self.values(x)
        return np.diff(clock, append=clock[:1] + period)

    def period(self, x: Unknowns) -> Any:
        array = np if isinstance(x, np.ndarray) else jnp
        if self.autonomous:
            return array.asarray(x[0])
        return array.asarray(self.at(x).cycle, x.dtype) * self.cycles

    def pack(self, clock: Any, states: Any, x: Any, period: Any = None) -> Any:
        """Pack `parts`, the parameters of other unknowns `x` and perhaps a period into unknowns: a
        NumPy array if `x` is known."""
        array = jnp if isinstance(x, Tracer) else np
        clock = array.asarray(clock) if self.events else np.zeros(0)
        if self.autonomous:
            clock = array.append(period, clock[1:] - clock[0])
        parameters = array.asarray(x)[len(x) - len(self.parameters) :]
        return array.concatenate([clock, array.ravel(states), parameters])

    @property
    def scale(self) -> np.ndarray:
        """The size of each unknown; host-side."""
        sizes = np.asarray(self.sizes)
        clocks = np.full(len(self.events), sizes[0])
        return np.concatenate([clocks, np.tile(sizes[1:], self.legs), np.asarray(self.widths)])

    @property
    def radian(self) -> float:
        """The size of the clock, a cycle through 2π; host-side."""
        return float(np.asarray(self.sizes)[0])

    def half_scale(self) -> np.ndarray:
        """Return the sizes of the clocks and states of half a period; host-side."""
        half, scale = len(self.events) // 2, self.scale
        end = len(self.events) + max(1, half) * self.states
        return np.concatenate([scale[:half], scale[len(self.events) : end]])

    def unravel(self, u: Any) -> State:
        """Return a row as a state; of a NumPy array host-side, also several rows."""
        if isinstance(u, np.ndarray):
            return states_from_rows(self.like, u)
        return ravel_pytree(self.like)[1](u)

    def modes_in(self, leg: Leg) -> tuple[Array, ...]:
        if not self.modes[0]:
            return ()
        modes = jnp.asarray(self.modes, jnp.result_type(float))[leg]
        return tuple(modes[j] for j in range(len(self.modes[0])))

    def _for_event(self, leg: Leg, function: Callable[..., Any], *inputs: Any) -> Any:
        """Return `function(event, *inputs)` for the event that begins a leg, maybe traced."""
        kinds = sorted(set(self.events))
        which = jnp.asarray([kinds.index(event) for event in self.events])[leg]
        return jax.lax.switch(which, [partial(function, kind) for kind in kinds], *inputs)

    def after(self, machine: AbstractMachine, leg: Leg, s: Scalar, u: Vector) -> Vector:
        """Return R(u), the state after the event that begins a leg."""

        def jumped(event, s, u):
            if event.use == LEAVES:
                return u
            before, state = self.flight(machine, leg - 1), self.unravel(u)
            given = machine, event.number, s, state, before.modes, before.contact
            jumped = after_event(*given, alone=False)[0]
            return ravel_pytree(jumped)[0]

        return self._for_event(leg, jumped, s, u) if self.events else u

    def guard(self, machine: AbstractMachine, leg: Leg, s: Scalar, u: Vector) -> Scalar:
        """Return g(s, u), which is zero and rising at the event that begins a leg."""

        before, modes = self.flight(machine, leg - 1), self.modes_in(leg)

        def value(event, s, u):
            return guard_at(before, event, s, self.unravel(u), modes)

        return self._for_event(leg, value, s, u)

    def ends(
        self, clock: Float[Array, " legs"], period: Scalar, next_clock: Array | None = None
    ) -> Float[Array, " legs"]:
        """Return the clock at the end of each leg. The last one ends at the first event a period
        later, whose clock is `next_clock` if the motion does not repeat."""
        following = clock if next_clock is None else next_clock
        return jnp.concatenate([clock[1:], following[:1] + period])

    def leg_at(self, x: Unknowns, s: Any) -> tuple[Array, Array]:
        """Return the leg that contains a clock, modulo the period, and the clock there."""
        clock, _ = self.parts(x)
        place = clock[0] + jnp.mod(s - clock[0], self.period(x))
        return jnp.maximum(jnp.searchsorted(clock, place, side="right") - 1, 0), place

    def sections(self, x: Vector) -> tuple[Int[Array, " cycles"], Float[Array, " cycles"]]:
        """Return the leg in which each section lies, and the clock of each section."""
        begins = [i for i, event in enumerate(self.events) if event.cycle is not None]
        if begins:
            return jnp.asarray(begins), self.parts(x)[0][jnp.asarray(begins)]
        if self.omits_sections:
            return self._ends_of_turns(x)
        return self.leg_at(x, self.at(x).cycle * jnp.arange(self.cycles, dtype=x.dtype))

    def _ends_of_turns(self, x: Vector) -> tuple[Int[Array, " cycles"], Float[Array, " cycles"]]:
        """Return the `sections` that are not among the events, by Newton's method from the step in
        which the angle passes. The first is the one before an orbit's first event, along a whole
        branch."""
        machine, turn, (clock, states) = self.at(x), self.turn, self.parts(x)
        angle = lambda u: component(turn.name, self.unravel(u))

        def follow(leg, s0, s1, u):
            begin = self.chatter_end(machine, leg, s0, s1, self.after(machine, leg, s0, u))
            end, _, (s, path) = self.fly_leg(machine, leg, begin, s1, rows=self.steps)
            return angle(end), jnp.append(s0, s), jax.vmap(angle)(jnp.concatenate([u[None], path]))

        ends = self.ends(clock, self.period(x))
        final, s, angles = jax.vmap(follow)(jnp.arange(self.legs), clock, ends, states)
        turns = jnp.round((final - jnp.roll(angles[:, 0], -1)) / (2 * np.pi))  # less at the next
        turns = jnp.cumsum(turns) - turns
        all_angles = (angles + 2 * np.pi * turns[:, None]).ravel()
        first = jnp.ceil((angles[0, 0] - turn.start) / (2 * np.pi))

        def section_passage(number):
            goal = turn.start + 2 * np.pi * number
            row = jnp.maximum(jnp.sum(all_angles <= goal) - 1, 0)
            leg = row // s.shape[1]

            def newton(_, place):
                place = stop_gradient(place)  # the last step has the derivative
                state = self.state_at(x, leg, place)
                rate = component(turn.name, self.flight(machine, leg).smooth.field(place, state))
                return place + (goal - 2 * np.pi * turns[leg] - component(turn.name, state)) / rate

            return leg, jax.lax.fori_loop(0, _PASSING, newton, s.ravel()[row])

        numbers = jnp.arange(self.cycles, dtype=x.dtype)
        return jax.vmap(section_passage)(first + jnp.mod(numbers - first, self.cycles))

    def on_sections(self, x: Vector, sections: tuple[Array, Array]) -> State:
        """Return the states on the `sections`, leaves (cycles,)."""
        states = jax.vmap(partial(self.state_at, x))(*sections)
        if not self.omits_sections:
            return states
        name, start = self.turn.name, self.turn.start
        return with_component(name, states, jnp.full_like(component(name, states), start))

    def flight(self, machine: AbstractMachine, leg: Leg) -> Flight:
        """Return the flight of a leg; after the hops of the chatter, if the leg begins with one."""
        flight = Flight(machine, self.modes_in(leg), self.method, self.like)
        return flight.with_contact(self._contact(self.contacts, leg)) if self.rests else flight

    def flight_after_event(self, machine: AbstractMachine, leg: Leg) -> Flight:
        if not self.landings:
            return self.flight(machine, leg)
        first = [self.contacts[i - (i in self.landings)] for i in range(self.legs)]
        return self.flight(machine, leg).with_contact(self._contact(first, leg))

    def _contact(self, contacts: Sequence[tuple[float, ...]], leg: Leg) -> tuple[Array, ...]:
        return tuple(jnp.asarray(contacts, jnp.result_type(float))[leg])

    def fly_leg(
        self, machine: AbstractMachine, leg: Leg, begin: Chatter, s: Scalar,
        averages: tuple[str, ...] = (), *, steps: int | Scalar | None = None, rows: int = 0,
    ) -> Any:  # fmt: skip
        """Integrate the flight of a leg after its chatter, to clock `s`; see `Flight.fly`."""
        steps = self.steps if steps is None else steps
        flight, u = self.flight(machine, leg), begin.u
        for number, lands in self._landing(leg):
            state_on_stop = ravel_pytree(on_stop(machine, number, self.unravel(u)))[0]
            u = jnp.where(lands, state_on_stop, u)
        for number in self.stuck:  # else any slip would stay as it is
            friction = events_of(machine)[number]
            assert isinstance(friction, DryFriction)
            state, mode = self.unravel(u), jnp.zeros_like(begin.s)
            u = ravel_pytree(friction.stopped(machine, begin.s, state, mode, None))[0]
        end, integrals, path = flight.fly(begin.s, s, u, steps, averages, rows=rows)
        if self.landings:
            integrals = {name: x + begin.integrals[name] for name, x in integrals.items()}
        return end, integrals, path

    def _landing(self, leg: Leg) -> list[tuple[int, Array]]:
        """Return the stops on which bodies come to rest, and whether one does in a leg."""
        numbers = [event.number if event.use == LANDS else -1 for event in self.events]
        numbers = numbers or [int(x) - 1 for x in self.held]
        return [(n, jnp.asarray(numbers)[leg] == n) for n in sorted(set(numbers) - {-1})]

    def chatter_end(
        self, machine: AbstractMachine, leg: Leg, s: Scalar, until: Scalar, u: Vector,
        averages: tuple[str, ...] = (), *, steps: int | Scalar | None = None,
    ) -> Chatter:  # fmt: skip
        """Return the last impact before `until` of the chatter that begins a leg, or the begin."""
        hops = Chatter(s, u, dict.fromkeys((TIME, *averages), jnp.zeros_like(s)), s > until)
        for number, lands in self._landing(leg) if self.events else ():
            free, begin = (
                self.flight_after_event(machine, leg),
                hops._replace(is_over=~lands | hops.is_over),
            )
            share = _HOP * (self.steps if steps is None else steps) / self.cycles
            each = jnp.maximum(2.0, jnp.ceil(share))
            last = last_hop(free, number, begin, until=until, steps=each)
            hops = last._replace(is_over=jnp.where(lands, last.is_over, hops.is_over))
        return hops

    def residual(self, x: Vector) -> Vector:
        """Return the left sides of the motion's equations, then those of the conditions."""
        residual, chatters = self._shoot(x)
        if not self.conditions:
            return residual
        observed = self.observe(x) if any(c.observes for c in self.conditions) else None
        for condition in self.conditions:
            residual = condition.replace_equations(self, x, residual)
        added = [condition.residual(self, x, observed, chatters) for condition in self.conditions]
        return jnp.concatenate([residual, jnp.stack(added)])

    def motion_residual(
        self, x: Vector, steps: Scalar | None = None, following: Vector | None = None
    ) -> Vector:
        """Return the left sides of the motion's own equations, zero for a periodic motion: end of
        each leg minus begin of the next, then the guards. `steps` is the number of steps of a
        flight, by default `self.steps`. The last leg leads to the first event of `following`, the
        unknowns a period later, by default `x`."""
        return self._shoot(x, steps, following)[0]

    def _shoot(
        self, x: Vector, steps: Scalar | None = None, following: Vector | None = None
    ) -> tuple[Vector, Chatter]:
        """Return the `motion_residual`, and the end of the chatter that begins each leg."""
        machine = self.at(x)
        clock, states = self.parts(x)
        next_clock, next_states = self.parts(x if following is None else following)

        def end_of_leg(leg, s0, s1, u):
            after = self.after(machine, leg, s0, u)
            begin = self.chatter_end(machine, leg, s0, s1, after, steps=steps)
            end, _, _ = self.fly_leg(machine, leg, begin, s1, steps=steps)
            if not self.events:
                return end, jnp.zeros((0,), x.dtype), begin
            return end, self.guard(machine, leg, s0, u)[None], begin

        legs = jnp.arange(len(states))
        ends = self.ends(clock, self.period(x), next_clock)
        ends_of_legs, guards, chatters = jax.vmap(end_of_leg)(legs, clock, ends, states)
        next_states = jnp.concatenate([states[1:], next_states[:1]])
        ends_of_legs = nearest_images(self.angles, ends_of_legs, next_states)
        return jnp.concatenate([(ends_of_legs - next_states).ravel(), guards.ravel()]), chatters

    def observe(self, x: Vector, following: Vector | None = None) -> Observed:
        """Compute multipliers, extremes and the distances to grazing of a solution `x` (for
        `following` see `motion_residual`).

        The monodromy matrix is the product over the legs of the flight's derivative times the
        saltation matrix of the event that begins the leg.
        """
        machine = self.at(x)
        clock, states = self.parts(x)
        names = average_names(machine, self.unravel(states[0]))

        def follow(leg, s0, s1, u):
            def end(u):
                begin = self.chatter_end(machine, leg, s0, s1, u, names)
                end, integrals, path = self.fly_leg(machine, leg, begin, s1, names, rows=self.steps)
                return end, (integrals, path, begin)

            after = self.after(machine, leg, s0, u)
            matrix, (integrals, path, begin) = jax.jacfwd(end, has_aux=True)(after)
            approach, agree = jnp.zeros((2, 0), x.dtype), jnp.ones((), x.dtype)
            if self.events:
                saltation, *rises = self.saltation(machine, leg, s0, u)
                matrix, approach = matrix @ saltation, jnp.stack(rises)[:, None]
                agree = self._modes_agree(machine, leg, s0, u)
            positions = [machine.position(self.unravel(x)) for x in (u, after)]
            h = (s1 - begin.s) / self.steps
            flight = self.flight(machine, leg)
            sizes = self.guard_sizes(flight, s0, after)
            load = self._least_load(flight, path)
            turns = turns_of(Path(flight, path[0], path[1], h, not self.events), sizes)
            largest = jnp.max(jnp.abs(path[1]), axis=0)
            margins = agree, load
            return matrix, integrals, approach, margins, turns, positions, largest, begin, sizes

        legs = jnp.arange(len(states))
        next_clock, _ = self.parts(x if following is None else following)
        ends = self.ends(clock, self.period(x), next_clock)
        found = jax.vmap(follow)(legs, clock, ends, states)
        matrix, integrals, approach, margins, turns, positions, largest, begin, sizes = found
        agree, load = map(jnp.min, margins)
        monodromy = jnp.eye(self.states, dtype=x.dtype)
        for leg in range(len(states)):
            monodromy = matrix[leg] @ monodromy
        period = ends[-1] - clock[0]
        last = {i: jax.tree.map(lambda a, i=i: a[i], begin) for i in self.landings}
        escapes = (self._escape_margin(machine, i, last[i], clock, states, period) for i in last)
        times_left = (self._time_left(machine, i, last[i], ends[i]) for i in last)
        Y = jnp.concatenate(positions)
        low, high, nearest, pull = turns
        i, j = jnp.argmin(nearest.share), jnp.argmin(pull.share)
        nearest, pull = (jax.tree.map(lambda x, k=k: x[k], a) for a, k in ((nearest, i), (pull, j)))
        margins = self.order_margins(machine, clock, ends - clock, states, sizes)
        order_of_events = reduce(
            jnp.minimum, (x[0] for x in margins), jnp.full_like(period, jnp.inf)
        )
        totals = jax.tree.map(jnp.sum, integrals)
        time = totals.pop(TIME)
        timed = self.autonomous or machine.pace(clock[0], self.unravel(states[0])) is not None
        return Observed(
            multipliers=multipliers_of(monodromy),
            monodromy=monodromy,
            approach=approach[:, 0].ravel(),
            units=approach[:, 1].ravel(),
            y_min=jnp.minimum(jnp.min(Y), jnp.min(low)),
            y_max=jnp.maximum(jnp.max(Y), jnp.max(high)),
            nearest=nearest,
            pull=pull._replace(unit=pull.unit / self.sizes[0] ** 2),
            modes_agree=agree,
            least_load=load,
            order_margin=reduce(jnp.minimum, times_left, order_of_events),
            duration=time if timed else jnp.asarray(cycle_time(machine), x.dtype) * self.cycles,
            averages=means(totals, time),
            largest=jnp.max(largest, axis=0),
            escape_margin=jnp.stack([jnp.zeros((), x.dtype), *escapes])[1:],
        )

    def guard_sizes(self, flight: Flight, s: Scalar, u: Vector) -> Vector:
        """Return the change of each event's guard over the sizes of state and clock, or 1. One more
        entry belongs to no event."""

        def guards(s, u):
            arguments = s, self.unravel(u), flight.modes, flight.contact
            numbers = range(len(events_of(flight.machine)))
            return jnp.stack([*(guard_of(flight.machine, n, *arguments) for n in numbers), u[0]])

        s_slope, slopes = jax.jacrev(guards, argnums=(0, 1))(s, u)
        sizes = jnp.abs(slopes) @ self.sizes[1:] + jnp.abs(s_slope) * self.sizes[0]
        return stop_gradient(jnp.where((sizes > 0) & jnp.isfinite(sizes), sizes, 1.0))

    def order_margins(
        self, machine: AbstractMachine, clock: Array, lengths: Any, states: Array, sizes: Any
    ) -> Iterator[tuple[Scalar, int, int]]:
        """Yield margins (see `order_margin`), each with the index of an event in the motion and the
        number of the other one. `sizes` are `guard_sizes` after each event."""
        for i, event in enumerate(self.events):
            yield lengths[i], i, self.events[(i + 1) % self.legs].number
            state = self.unravel(states[i])
            before, contact = (
                tuple(jnp.asarray(mode, clock.dtype) for mode in per_leg[i - 1])
                for per_leg in (self.modes, self.contacts)
            )
            for number, other in enumerate(events_of(machine)):
                is_excluded = number in (event.number, section_number(machine))
                if is_excluded or 1.0 + number in self.contacts[i - 1]:
                    continue
                margin = -guard_of(machine, number, clock[i], state, before, contact)
                margin = margin / sizes[i - 1][number] * self.sizes[0]
                if other.from_below:  # if it is beyond zero, it must come from below again first
                    margin = jnp.where(margin > 0, margin, jnp.inf)
                yield margin, i, number

    def _time_left(self, machine: AbstractMachine, i: int, last: Chatter, until: Scalar) -> Scalar:
        """Return the time from the end of a chatter to the next event other than its release."""
        landing = self.events[i]
        if self.events[(i + 1) % self.legs] == landing._replace(use=LEAVES):
            return jnp.full_like(until, jnp.inf)
        return until - last.s - remaining(self.flight_after_event(machine, i), landing.number, last)

    def _escape_margin(
        self, machine: AbstractMachine, i: int, last: Chatter, clock: Array, states: Array,
        period: Scalar,
    ) -> Scalar:  # fmt: skip
        """Return χ of the chatter that begins with event number i; see `escape_margin`."""
        landing, later = self.events[i], (*range(i + 1, self.legs), *range(i))
        j = next(j for j in later if self.events[j] == landing._replace(use=LEAVES))
        s = clock[j] + (period if j < i else 0.0)
        if j != (i + 1) % self.legs:  # another event comes before the chatter is over
            last = last._replace(is_over=jnp.zeros_like(last.is_over))
        return escape_margin(self.flight(machine, j - 1), landing.number, last, s, states[j])

    def rest_margin(self, x: Vector, landing: int | None, chatters: Chatter) -> Scalar:
        """Return χ of the chatter that begins with the event `landing`. If that is `None`, return
        the least force on a body within its rest, as a share of a size. Both are zero where a rest
        is lost. `chatters` holds the last impact of the chatter of each leg."""
        machine, (clock, states), period = self.at(x), self.parts(x), self.period(x)
        ends, least = self.ends(clock, period), jnp.asarray(jnp.inf, x.dtype)
        last = lambda i: jax.tree.map(lambda a: a[i], chatters)
        if landing is not None:
            return self._escape_margin(machine, landing, last(landing), clock, states, period)
        for i, contact in enumerate(self.contacts):
            if any(contact):
                begin = last(i)
                path = self.fly_leg(machine, i, begin, ends[i], rows=self.steps)[2]
                h, flight = (ends[i] - begin.s) / self.steps, self.flight(machine, i)
                sizes = self.guard_sizes(flight, begin.s, begin.u)
                pull = pull_of(Path(flight, path[0], path[1], h, not self.events), sizes)
                least = jnp.minimum(least, pull.share)
        return least

    def saltation(
        self, machine: AbstractMachine, leg: Leg, s: Scalar, u: Vector
    ) -> tuple[Float[Array, "states states"], Scalar, Scalar]:
        """Return the saltation matrix of the event that begins a leg, the speed of approach and the
        size of such a speed.

        The matrix DR + (f⁺ - DR f⁻) ∇g / ġ, with ġ = ∇g·f⁻ + ∂g/∂s, maps perturbations across the
        event. The jump is differentiated where the body is, without moving it onto its stop
        (`jump_of`): ∇g accounts for the change of the event's time.
        """
        old, new = self.flight(machine, leg - 1), self.flight_after_event(machine, leg)

        def jumped(event, u):
            if event.use == LEAVES:
                return u
            state, modes = self.unravel(u), self.modes_in(leg - 1)
            return ravel_pytree(jump_of(machine, event.number, s, state, modes))[0]

        def reset(u):
            return self._for_event(leg, jumped, u)

        jacobian = jax.jacfwd(reset)(u)
        before, after = old.rate(s, u), new.rate(s, reset(u))
        if self.autonomous:
            # The clock restarts there, so a perturbation along the motion vanishes.
            clock_continues = [float(i > 0 and not event.of(machine).ends_cycle)
                               for i, event in enumerate(self.events)]  # fmt: skip
            after = jnp.asarray(clock_continues, u.dtype)[leg] * after
        s_slope, slope = jax.grad(lambda s, u: self.guard(machine, leg, s, u), argnums=(0, 1))(s, u)
        rate = s_slope + jnp.dot(slope, before)

        def approach_speed(event, u, rate):
            if event.use == LEAVES:
                return rate
            return event.of(machine).speed(machine, self.unravel(u), rate)

        approach = self._for_event(leg, approach_speed, u, rate)
        unit = (jnp.abs(slope) @ self.sizes[1:]) / self.sizes[0] + jnp.abs(s_slope)
        return jacobian + jnp.outer(after - jacobian @ before, slope) / rate, approach, unit

    def _least_load(self, flight: Flight, path: tuple[Array, Array]) -> Scalar:
        """Return `Observed.least_load` of a flight; `path`: clock and state at its steps."""
        least = jnp.ones((), path[1].dtype)
        for i, friction in enumerate(switches_of(flight.machine)):
            if isinstance(friction, DryFriction) and friction.may_be_negative:
                force = lambda s, u, i=i, x=friction: jnp.asarray(
                    x.sliding(flight.machine, s, flight.unravel(u), flight.modes[i])
                )
                forces = jax.vmap(force)(*path)
                largest = jnp.max(jnp.abs(forces))
                share = jnp.min(forces) / jnp.where(largest > 0, largest, 1.0)
                least = jnp.minimum(least, share)
        return least

    def _modes_agree(self, machine: AbstractMachine, leg: Leg, s: Scalar, u: Vector) -> Scalar:
        """Return 1 if the event that begins a leg puts its switch into the leg's mode, else -1."""

        def agrees(event, s, u):
            if not event.of(machine).holds_mode:
                return jnp.ones_like(s)
            j, before = mode_number(machine, event.number), self.flight(machine, leg - 1)
            modes, state = (before.modes, before.contact), self.unravel(u)
            mode = after_event(machine, event.number, s, state, *modes)[1][j]
            wanted = self.modes_in(leg)[j]
            return jnp.where(mode == wanted, 1.0, -1.0).astype(s.dtype)

        return self._for_event(leg, agrees, s, u)

    def state_at(self, x: Vector, leg: Leg, s: Scalar) -> State:
        machine = self.at(x)
        clock, states = self.parts(x)
        s0, s1 = clock[leg], self.ends(clock, self.period(x))[leg]
        u = self.after(machine, leg, s0, states[leg])
        begin = self.chatter_end(machine, leg, s0, s1, u)
        end = self.fly_leg(machine, leg, begin, s)[0]
        if self.landings:
            last = self.chatter_end(machine, leg, s0, s, u)
            in_chatter = self.flight_after_event(machine, leg).fly(last.s, s, last.u, self.steps)[0]
            end = jnp.where(s < begin.s, in_chatter, end)
        return self.unravel(end)
