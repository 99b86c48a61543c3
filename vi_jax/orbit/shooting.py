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
from math import ceil
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Complex, Float

from .. import lanes
from ..flow import AbstractMethod, ExactFlight, FixedStep
from ..flow.choice import MethodLike, chosen
from ..flow.events import guard_rates
from ..flow.moving import in_modes
from ..scene import AbstractScene
from ..scene.numbers import with_leaf
from .floquet import multipliers_of

Vector = Float[Array, " _"]

# Newton's method has met a turn if it ends this close to it (as a share of the step).
_TURNED = 1e-3


class Event(NamedTuple):
    """What begins a flight: an impact, a switch, or a section that counts for the motion."""

    kind: str
    """"stop", "switch" or "section"."""
    number: int
    """Of the stop or switch; of the cycle that a section begins."""


def jump(scene: AbstractScene, event: Event, s: Any, state: Any, mode: Any) -> Any:
    """The state after an event, from that in which it is met."""
    if event.kind == "stop":
        stop = scene.stops[event.number]
        body = scene.coordinates[stop.coordinate]
        return body.placed(state, stop.place, stop.rebound(body.velocity(state)))
    if event.kind == "switch":
        return scene.switches[event.number].after(scene, s, state, mode)[0]
    return scene.renewed(state)


class Observed(NamedTuple):
    """What is said about a solution."""

    multipliers: Complex[Array, " states"]
    monodromy: Float[Array, "states states"]
    approach: Float[Array, " events"]
    """V⁻ at each impact, and how fast the guard rises at each other event; negative where it has
    become impossible."""
    y_min: Float[Array, ""]
    y_max: Float[Array, ""]
    clearance: Float[Array, ""]
    """Distance to the stop at the turn nearest to one, or of a switch's guard below zero where it
    is greatest; negative where it is passed through."""
    touch: Float[Array, ""]
    """Clock of that turn."""
    touched: Float[Array, ""]
    """The stop there, or the switch, counted after the stops."""
    order: Float[Array, ""]
    """1 where each switch goes into the mode that is its next one here, else -1."""
    duration: Float[Array, ""]


class Shooting(eqx.Module):
    """The equations of an orbit with given events.

    Unknowns, in one vector: the clock at each event, the state just before each, and then the
    parameters named. A motion without events has its state at the clock's zero instead. Of an
    autonomous machine the first event is a section, at the clock's zero; the period stands in the
    place of its clock.
    """

    scene: AbstractScene
    method: AbstractMethod
    like: Any
    """A state, for its structure."""
    cycles: int = eqx.field(static=True)
    events: tuple[Event, ...] = eqx.field(static=True)
    """In their order; each begins a flight."""
    modes: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    """Of the machine's switches, in each flight."""
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
        return self.scene.section(self.like) is not None

    @property
    def impacts(self) -> tuple[int, ...]:
        """Which of the events are impacts."""
        return tuple(i for i, event in enumerate(self.events) if event.kind == "stop")

    def at(self, x: Vector) -> AbstractScene:
        """The scene with the parameters of `x`."""
        scene = self.scene
        count = len(self.parameters)
        for i, name in enumerate(self.parameters):
            scene = with_leaf(scene, name, x[x.shape[0] - count + i])
        return scene

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

    def moving(self, scene: AbstractScene, leg: Any) -> AbstractScene:
        """The machine in the modes of a leg, whose number may be traced."""
        if not scene.switches:
            return scene
        modes = jnp.asarray(self.modes, jnp.result_type(float))[leg]
        return in_modes(scene, tuple(modes[j] for j in range(len(scene.switches))))

    def _each(self, leg: Any, of_event: Callable[[Event], Callable[..., Any]], *inputs: Any) -> Any:
        """A function that depends on the event of a leg, whose number may be traced."""
        kinds = sorted(set(self.events))
        which = jnp.asarray([kinds.index(event) for event in self.events])[leg]
        return jax.lax.switch(which, [of_event(kind) for kind in kinds], *inputs)

    def after(self, scene: AbstractScene, leg: Any, s: Any, u: Vector) -> Vector:
        """The state after the event that begins a leg."""
        if not self.events:
            return u

        def of(event: Event) -> Callable[..., Vector]:
            def new(s, u):
                mode = self._mode_before(leg, event, s)
                return ravel_pytree(jump(scene, event, s, self.unravel(u), mode))[0]

            return new

        return self._each(leg, of, s, u)

    def guard(self, scene: AbstractScene, leg: Any, s: Any, u: Vector) -> Array:
        """What is zero at the event that begins a leg, and rises there."""

        def of(event: Event) -> Callable[..., Array]:
            def value(s, u):
                state = self.unravel(u)
                if event.kind == "stop":
                    stop = scene.stops[event.number]
                    return stop.beyond(scene.coordinates[stop.coordinate].position(state))
                if event.kind == "switch":
                    mode = self._mode_before(leg, event, s)
                    return scene.switches[event.number].guard(scene, s, state, mode)
                if self.autonomous:
                    return jnp.asarray(scene.section(state))
                return s - jnp.asarray(scene.cycle, s.dtype) * event.number

            return value

        return self._each(leg, of, s, u)

    def _mode_before(self, leg: Any, event: Event, s: Any) -> Any:
        """The mode of a switch before the event that begins a leg."""
        if event.kind != "switch":
            return None
        return jnp.asarray([x[event.number] for x in self.modes], jnp.result_type(s))[leg - 1]

    def ends(self, clock: Float[Array, " legs"], period: Any) -> Float[Array, " legs"]:
        """Clock at the end of each leg."""
        return jnp.concatenate([clock[1:], clock[:1] + period])

    def flight(
        self, scene: AbstractScene, leg: Any, s0: Array, s1: Array, u: Vector
    ) -> tuple[Vector, Array, tuple[Array, Float[Array, "steps states"]]]:
        """State and elapsed time at the end of a flight, and clock and state along it."""
        return self.fly(self.moving(scene, leg), s0, s1, u)

    def fly(
        self, moving: AbstractScene, s0: Array, s1: Array, u: Vector
    ) -> tuple[Vector, Array, tuple[Array, Float[Array, "steps states"]]]:
        """A flight of the machine in its modes."""
        h = (s1 - s0) / self.steps

        def begin(inputs):
            s0, _, u = inputs
            zero = jnp.zeros_like(s0)
            return (u, zero, zero), lanes.Emitted(True, True, (s0, u))

        def step(inputs, carry):
            (s0, h, _), (u, time, i) = inputs, carry
            s = s0 + i * h
            u, time = self._step(moving, s, s + h, u, time)
            i = i + 1
            return (u, time, i), lanes.Emitted(i < self.steps, True, (s0 + i * h, u))

        def end(inputs, carry):
            return carry[0], carry[1]

        (u, time), path = lanes.run(begin, step, end, (s0, h, u), rows=self.steps)
        return u, time, path

    def _step(self, moving, s0, s1, u, time) -> tuple[Vector, Array]:
        """One step of the method."""
        state = self.unravel(u)
        paced = moving.pace(s0, state) is not None
        new, after, _ = self.method.step(moving, s0, s1, state, time if paced else None)
        return ravel_pytree(new)[0], time + (s1 - s0) if after is None else after

    def residual(self, x: Vector) -> Vector:
        """What the flights from event to event lack; zero for a periodic motion."""
        scene = self.at(x)
        clock, states = self.parts(x)

        def arrive(leg, s0, s1, u):
            end, _, _ = self.flight(scene, leg, s0, s1, self.after(scene, leg, s0, u))
            if not self.events:
                return end, jnp.zeros((0,), x.dtype)
            return end, self.guard(scene, leg, s0, u)[None]

        legs = jnp.arange(len(states))
        ends = self.ends(clock, self.period(x))
        arrived, away = jax.vmap(arrive)(legs, clock, ends, states)
        return jnp.concatenate([(arrived - jnp.roll(states, -1, axis=0)).ravel(), away.ravel()])

    def observe(self, x: Vector) -> Observed:
        """Multipliers, extremes and the distances to grazing of a solution."""
        scene = self.at(x)
        clock, states = self.parts(x)

        def follow(leg, s0, s1, u):
            def end(u):
                end, time, path = self.flight(scene, leg, s0, s1, u)
                return end, (time, path)

            carried, (time, path) = jax.jacfwd(end, has_aux=True)(self.after(scene, leg, s0, u))
            approach, order = jnp.zeros((0,), x.dtype), jnp.ones((), x.dtype)
            if self.events:
                saltation, rises = self._saltation(scene, leg, s0, u)
                carried, approach = carried @ saltation, rises[None]
                order = self._each(leg, lambda event: partial(self._next, scene, event, leg), s0, u)
            return carried, time, approach, order, self._turns(scene, leg, s1, path)

        legs = jnp.arange(len(states))
        ends = self.ends(clock, self.period(x))
        carried, time, approach, order, turns = jax.vmap(follow)(legs, clock, ends, states)
        monodromy = jnp.eye(self.states, dtype=x.dtype)
        for leg in range(len(states)):
            monodromy = carried[leg] @ monodromy
        low, high, room, touch, touched = turns
        Y = jax.vmap(lambda u: scene.position(self.unravel(u)))(states)
        nearest = jnp.argmin(room)
        timed = self.autonomous or scene.pace(clock[0], self.unravel(states[0])) is not None
        return Observed(
            multipliers=multipliers_of(monodromy),
            monodromy=monodromy,
            approach=approach.ravel(),
            y_min=jnp.minimum(jnp.min(Y), jnp.min(low)),
            y_max=jnp.maximum(jnp.max(Y), jnp.max(high)),
            clearance=room[nearest],
            touch=touch[nearest],
            touched=touched[nearest],
            order=jnp.min(order),
            duration=jnp.sum(time) if timed else jnp.asarray(scene.period, x.dtype) * self.cycles,
        )

    def _saltation(self, scene, leg, s, u):
        """How a perturbation passes an event, R + (f⁺ - R f⁻) ∇g / ġ, and how fast it is met.

        R is the jump as a function of the state; ġ counts what the guard gains by the clock.
        """
        old, new = self.moving(scene, leg - 1), self.moving(scene, leg)

        def field(scene, u):
            return ravel_pytree(scene.field(s, self.unravel(u)))[0]

        def reset(u):
            return self._crossed(scene, leg, s, u)

        jacobian = jax.jacfwd(reset)(u)
        before, after = field(old, u), field(new, reset(u))
        if self.autonomous:
            # From the section on the clock counts anew, so that what lies along the motion is gone.
            goes_on = [float(event.kind != "section") for event in self.events]
            after = jnp.asarray(goes_on, u.dtype)[leg] * after
        gained, slope = jax.grad(lambda s, u: self.guard(scene, leg, s, u), argnums=(0, 1))(s, u)
        rate = gained + jnp.dot(slope, before)
        approach = self._each(leg, lambda event: partial(self._met, scene, event), u, rate)
        return jacobian + jnp.outer(after - jacobian @ before, slope) / rate, approach

    def _crossed(self, scene, leg, s, u):
        """As `after`, with the position left as it is: the jump of states beside the event's."""

        def of(event: Event) -> Callable[..., Vector]:
            def new(u):
                state = self.unravel(u)
                if event.kind == "section":
                    return ravel_pytree(scene.renewed(state))[0]
                if event.kind == "stop":
                    stop = scene.stops[event.number]
                    body = scene.coordinates[stop.coordinate]
                    rebound = stop.rebound(body.velocity(state))
                    state = body.placed(state, body.position(state), rebound)
                return ravel_pytree(state)[0]

            return new

        return self._each(leg, of, u)

    def _met(self, scene, event: Event, u, rate):
        """V⁻ of an impact; of another event how fast its guard rises."""
        if event.kind == "stop":
            stop = scene.stops[event.number]
            return stop.approach(scene.coordinates[stop.coordinate].velocity(self.unravel(u)))
        return rate

    def _next(self, scene, event: Event, leg, s, u):
        """Whether a switch goes into the mode of the flight that begins with its event."""
        one = jnp.ones_like(s)
        if event.kind != "switch":
            return one
        j, before = event.number, self._mode_before(leg, event, s)
        mode = scene.switches[j].after(scene, s, self.unravel(u), before)[1]
        return jnp.where(mode == jnp.asarray([x[j] for x in self.modes], s.dtype)[leg], one, -one)

    def state_at(self, x: Vector, leg: Any, s: Array) -> Any:
        """The state at clock `s`, which lies in leg number `leg`."""
        scene = self.at(x)
        clock, states = self.parts(x)
        u = self.after(scene, leg, clock[leg], states[leg])
        return self.unravel(self.flight(scene, leg, clock[leg], s, u)[0])

    def _turns(self, scene, leg, s1, path):
        """Least and greatest Y at the turning points of a leg; the smallest room at one, where it
        is, and to what.

        Where the velocity changes sign within a step, Newton's method from the step's start.
        """
        places, states = path
        h = (s1 - places[0]) / self.steps
        moving = self.moving(scene, leg)
        # The end of the last step is the next event: its velocity is that of a further step.
        last, _ = lanes.once(
            lambda x: self._step(moving, *x),
            (places[-1], places[-1] + h, states[-1], jnp.zeros_like(h)),
        )

        def found(function, rate):
            """Turning points of a function of (s, state) with this rate, or of its sign."""

            def turn(s, u, v0, v1):
                # A turn may fall on the end of a step.
                turns = (v0 * v1 < 0) | ((v1 == 0) & (v0 != 0))

                def at(scene, s, u, length):
                    new, _ = self._step(scene, s, s + length, u, jnp.zeros_like(s))
                    return guard_rates(scene.field, function, s + length, self.unravel(new))

                held = jax.lax.stop_gradient((moving, s, u))
                limit = jax.lax.stop_gradient(h)

                def newton(_, length):
                    here = at(*held, length)
                    bend = jnp.where(here.a == 0, 1.0, here.a)
                    return jnp.clip(length - here.v / bend, 0.0, limit)

                share = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 0.5)
                length = jax.lax.fori_loop(0, 4, newton, jax.lax.stop_gradient(h * share))
                here = at(moving, s, u, length)
                bend = jnp.where(here.a == 0, 1.0, here.a)
                # A guard with a kink (as that of dry friction, where its force vanishes) may have
                # no turn there.
                found = jnp.abs(here.v) <= jnp.abs(_TURNED * limit * bend)
                shift = jnp.where(found, here.v, 0.0) / bend
                return turns, here.x - 0.5 * here.v * shift, s + length - shift, v0

            def velocity(s, u):
                return rate(s, self.unravel(u))

            v = jax.vmap(velocity)(places, states)
            v1 = jnp.concatenate([v[1:], velocity(places[-1] + h, last)[None]])
            return jax.vmap(lambda *x: lanes.once(lambda x: turn(*x), x))(places, states, v, v1)

        tops = [
            found(lambda _, x, c=body: c.position(x), lambda _, x, c=body: c.velocity(x))
            for body in scene.coordinates
        ]
        turns, height, _, _ = tops[0]
        low = jnp.min(jnp.where(turns, height, jnp.inf))
        high = jnp.max(jnp.where(turns, height, -jnp.inf))
        rooms = []
        for stop in scene.stops:
            turns, height, place, v0 = tops[stop.coordinate]
            facing = turns & (stop.sign * v0 > 0)
            rooms.append((jnp.where(facing, -stop.beyond(height), jnp.inf), place))
        for j, switch in enumerate(scene.switches):
            mode = jnp.asarray([x[j] for x in self.modes], h.dtype)[leg]

            def guard(s, state, switch=switch, mode=mode):
                return switch.guard(scene, s, state, mode)

            def rise(s, state, guard=guard):
                return guard_rates(moving.field, guard, s, state).v

            turns, height, place, v0 = found(guard, rise)
            # A body that friction lets go begins to slide with velocity and acceleration zero.
            away = place > places[0] + _TURNED * h
            rooms.append((jnp.where(turns & (v0 > 0) & away, -height, jnp.inf), place))
        room, touch = jnp.full((), jnp.inf, h.dtype), jnp.zeros((), h.dtype)
        touched = touch
        for i, (values, place) in enumerate(rooms):
            nearest = jnp.argmin(values)
            touch = jnp.where(values[nearest] < room, place[nearest], touch)
            touched = jnp.where(values[nearest] < room, float(i), touched)
            room = jnp.minimum(room, values[nearest])
        return low, high, room, touch, touched


def renews(scene: AbstractScene) -> bool:
    """Whether a machine begins each cycle with something set back."""
    return type(scene).renewed is not AbstractScene.renewed


def carrier(asked: MethodLike, found_with: AbstractMethod, scene: AbstractScene) -> AbstractMethod:
    """A method of fixed steps, which a smooth system of equations needs: the one asked for, else
    that of the orbit if it is one, else `ExactFlight` where it applies, else 32 steps of Dopri8 a
    cycle, whose error is 1e-13.

    **Raises:** `ValueError` if one is asked for that has no fixed steps.
    """
    if asked is not None:
        method = chosen(scene, asked)
        if not isinstance(method, FixedStep | ExactFlight):
            raise ValueError(
                "Argument `method` must be of fixed steps, `FixedStep(...)` or `ExactFlight()`, "
                f"to follow an orbit, but got {method!r}."
            )
        method.check(scene)
        return method
    if isinstance(found_with, FixedStep):
        return found_with
    return chosen(scene, None, FixedStep(diffrax.Dopri8(), 32))


def steps_of(method: AbstractMethod, scenes: list[AbstractScene], like: Any, cycles: int) -> int:
    """Steps that a flight over the whole period needs, in the most demanding of the scenes."""
    # Turning points are looked for between steps: more of them than flying needs.
    most = max(method.steps_per_cycle, 16)
    for scene in scenes:
        limit = method.longest(scene, jnp.zeros(()), like)
        most = max(most, ceil(1.02 * float(scene.cycle / limit)))
    return most * cycles
