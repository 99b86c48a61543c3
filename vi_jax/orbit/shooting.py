"""A periodic motion as a smooth system of equations: its impacts in a given order.

The cycle map has no derivative where an impact grazes. From impact to impact it has: with the
order of the impacts given, the unknowns are the clock and the state at each of them, the equations
say that the flight from one leads to the next, and nothing has to be detected. Such a solution
passes smoothly through V⁻ = 0 and through a touch of the stop; on the far side it is a motion that
the stop forbids, and is told so by the sign of V⁻ or of the clearance. (The same idea carries
`hspo` of COCO.)
"""

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
from ..flow.events import rates
from ..scene import AbstractScene
from ..scene.leaves import with_leaf
from .floquet import multipliers_of

Vector = Float[Array, " _"]


class _Hit(NamedTuple):
    """What a stop asks of an impact, in numbers."""

    gap: Any
    restitution: Any
    sign: Any


class Observed(NamedTuple):
    """What is said about a solution."""

    multipliers: Complex[Array, " states"]
    monodromy: Float[Array, "states states"]
    approach: Float[Array, " impacts"]
    """V⁻ at each impact; negative where the impact has become impossible."""
    y_min: Float[Array, ""]
    y_max: Float[Array, ""]
    clearance: Float[Array, ""]
    """Distance to the stop at the turn nearest to one; negative where it is passed through."""
    touch: Float[Array, ""]
    """Clock of that turn."""
    duration: Float[Array, ""]


class Shooting(eqx.Module):
    """The equations of an orbit with given impacts.

    Unknowns, in one vector: the clock at each impact, the state just before each, and then the
    parameters named. A motion without impacts has its state at the clock's zero instead.
    """

    scene: AbstractScene
    method: AbstractMethod
    like: Any
    """A state, for its structure."""
    cycles: int = eqx.field(static=True)
    stops: tuple[int, ...] = eqx.field(static=True)
    """The stop of each impact, in their order."""
    steps: int = eqx.field(static=True)
    """Steps of a flight."""
    parameters: tuple[str, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of unknowns, parameters included."""
        legs = max(1, len(self.stops))
        return legs * self.states + len(self.stops) + len(self.parameters)

    @property
    def states(self) -> int:
        """Number of state components."""
        return len(jtu.tree_leaves(self.like))

    def at(self, x: Vector) -> AbstractScene:
        """The scene with the parameters of `x`."""
        scene = self.scene
        count = len(self.parameters)
        for i, name in enumerate(self.parameters):
            scene = with_leaf(scene, name, x[x.shape[0] - count + i])
        return scene

    def parts(self, x: Vector) -> tuple[Float[Array, " legs"], Float[Array, "legs states"]]:
        """Clock and state at the start of each leg (before its impact)."""
        legs = len(self.stops)
        if not legs:
            return jnp.zeros((1,), x.dtype), x[: self.states][None]
        end = legs * (1 + self.states)
        return x[:legs], x[legs:end].reshape(legs, self.states)

    def pack(self, clock: Any, states: Any, parameters: Any) -> Vector:
        """The vector of unknowns."""
        clock = jnp.asarray(clock) if self.stops else jnp.zeros((0,))
        return jnp.concatenate([clock, jnp.ravel(states), jnp.ravel(jnp.asarray(parameters))])

    def unravel(self, u: Vector) -> Any:
        """A state from its vector."""
        return ravel_pytree(self.like)[1](u)

    def hit(self, scene: AbstractScene, leg: Any) -> _Hit | None:
        """The stop of the impact that begins a leg, whose number may be traced."""
        if not self.stops:
            return None
        which = jnp.asarray(self.stops)[leg]
        gap, restitution, sign = (
            jnp.stack([jnp.asarray(value(stop)) for stop in scene.stops])[which]
            for value in (lambda x: x.gap, lambda x: x.restitution, lambda x: float(x.sign))
        )
        return _Hit(gap, restitution, sign)

    def bounced(self, scene: AbstractScene, leg: Any, u: Vector, *, keep: bool = False) -> Vector:
        """The state after the impact that begins a leg; `keep` leaves the position as it is."""
        stop = self.hit(scene, leg)
        if stop is None:
            return u
        state = self.unravel(u)
        Y = scene.position(state) if keep else stop.sign * stop.gap
        return ravel_pytree(scene.placed(state, Y, -stop.restitution * scene.velocity(state)))[0]

    def ends(self, clock: Float[Array, " legs"], scene: AbstractScene) -> Float[Array, " legs"]:
        """Clock at the end of each leg."""
        turn = jnp.asarray(scene.cycle, clock.dtype) * self.cycles
        return jnp.concatenate([clock[1:], clock[:1] + turn])

    def flight(
        self, scene: AbstractScene, s0: Array, s1: Array, u: Vector
    ) -> tuple[Vector, Array, tuple[Array, Float[Array, "steps states"]]]:
        """State and elapsed time at the end of a flight, and clock and state along it."""
        h = (s1 - s0) / self.steps

        def begin(inputs):
            s0, _, u = inputs
            zero = jnp.zeros_like(s0)
            return (u, zero, zero), lanes.Emitted(True, True, (s0, u))

        def step(inputs, carry):
            (s0, h, _), (u, time, i) = inputs, carry
            s = s0 + i * h
            u, time = self._step(scene, s, s + h, u, time)
            i = i + 1
            return (u, time, i), lanes.Emitted(i < self.steps, True, (s0 + i * h, u))

        def end(inputs, carry):
            return carry[0], carry[1]

        (u, time), path = lanes.run(begin, step, end, (s0, h, u), rows=self.steps)
        return u, time, path

    def _step(self, scene, s0, s1, u, time) -> tuple[Vector, Array]:
        """One step of the method."""
        state = self.unravel(u)
        paced = scene.pace(s0, state) is not None
        new, after, _ = self.method.step(scene, s0, s1, state, time if paced else None)
        return ravel_pytree(new)[0], time + (s1 - s0) if after is None else after

    def residual(self, x: Vector) -> Vector:
        """What the flights from impact to impact lack; zero for a periodic motion."""
        scene = self.at(x)
        clock, states = self.parts(x)

        def arrive(leg, s0, s1, u):
            end, _, _ = self.flight(scene, s0, s1, self.bounced(scene, leg, u))
            stop = self.hit(scene, leg)
            if stop is None:
                return end, jnp.zeros((0,), x.dtype)
            return end, (stop.sign * scene.position(self.unravel(u)) - stop.gap)[None]

        legs = jnp.arange(len(states))
        arrived, away = jax.vmap(arrive)(legs, clock, self.ends(clock, scene), states)
        return jnp.concatenate([(arrived - jnp.roll(states, -1, axis=0)).ravel(), away.ravel()])

    def observe(self, x: Vector) -> Observed:
        """Multipliers, extremes and the distances to grazing of a solution."""
        scene = self.at(x)
        clock, states = self.parts(x)

        def follow(leg, s0, s1, u):
            def end(u):
                end, time, path = self.flight(scene, s0, s1, u)
                return end, (time, path)

            carried, (time, path) = jax.jacfwd(end, has_aux=True)(self.bounced(scene, leg, u))
            if self.stops:
                carried = carried @ self._saltation(scene, leg, s0, u)
            return carried, time, self._turns(scene, s1, path)

        legs = jnp.arange(len(states))
        carried, time, turns = jax.vmap(follow)(legs, clock, self.ends(clock, scene), states)
        monodromy = jnp.eye(self.states, dtype=x.dtype)
        for leg in range(len(states)):
            monodromy = carried[leg] @ monodromy
        low, high, room, touch = turns
        Y = jax.vmap(lambda u: scene.position(self.unravel(u)))(states)
        approach = jnp.zeros((0,), x.dtype)
        if self.stops:
            V = jax.vmap(lambda u: scene.velocity(self.unravel(u)))(states)
            approach = jnp.array([scene.stops[i].sign for i in self.stops], x.dtype) * V
        nearest = jnp.argmin(room)
        return Observed(
            multipliers=multipliers_of(monodromy),
            monodromy=monodromy,
            approach=approach,
            y_min=jnp.minimum(jnp.min(Y), jnp.min(low)),
            y_max=jnp.maximum(jnp.max(Y), jnp.max(high)),
            clearance=room[nearest],
            touch=touch[nearest],
            duration=jnp.sum(time),
        )

    def _saltation(self, scene, leg, s, u):
        """How a perturbation passes an impact: R + (f⁺ - R f⁻) ∇g / (∇g·f⁻)."""

        def field(u):
            return ravel_pytree(scene.field(s, self.unravel(u)))[0]

        def reset(u):
            return self.bounced(scene, leg, u, keep=True)

        jacobian = jax.jacfwd(reset)(u)
        before, after = field(u), field(reset(u))
        slope = jax.grad(lambda u: scene.position(self.unravel(u)))(u)
        return jacobian + jnp.outer(after - jacobian @ before, slope) / jnp.dot(slope, before)

    def state_at(self, x: Vector, leg: Any, s: Array) -> Any:
        """The state at clock `s`, which lies in leg number `leg`."""
        scene = self.at(x)
        clock, states = self.parts(x)
        return self.unravel(
            self.flight(scene, clock[leg], s, self.bounced(scene, leg, states[leg]))[0]
        )

    def _turns(self, scene, s1, path):
        """Least and greatest Y at the turning points of a leg; the smallest room at one, and where.

        Where the velocity changes sign within a step, Newton's method from the step's start.
        """
        places, states = path
        h = (s1 - places[0]) / self.steps

        def velocity(u):
            return scene.velocity(self.unravel(u))

        def turn(s, u, v0, v1):
            turns = v0 * v1 < 0

            def at(scene, s, u, length):
                new, _ = self._step(scene, s, s + length, u, jnp.zeros_like(s))
                return rates(scene.field, scene.position, s + length, self.unravel(new))

            held = jax.lax.stop_gradient((scene, s, u))
            limit = jax.lax.stop_gradient(h)

            def newton(_, length):
                here = at(*held, length)
                bend = jnp.where(here.a == 0, 1.0, here.a)
                return jnp.clip(length - here.v / bend, 0.0, limit)

            share = jnp.where(turns, v0 / jnp.where(turns, v0 - v1, 1.0), 0.5)
            length = jax.lax.fori_loop(0, 4, newton, jax.lax.stop_gradient(h * share))
            here = at(scene, s, u, length)
            bend = jnp.where(here.a == 0, 1.0, here.a)
            return turns, here.x - 0.5 * here.v**2 / bend, s + length - here.v / bend, v0

        v = jax.vmap(velocity)(states)
        # The end of the last step is the next impact: its velocity is that of a further step.
        last, _ = lanes.once(
            lambda x: self._step(scene, *x),
            (places[-1], places[-1] + h, states[-1], jnp.zeros_like(h)),
        )
        v1 = jnp.concatenate([v[1:], velocity(last)[None]])
        turns, height, place, v0 = jax.vmap(lambda *x: lanes.once(lambda x: turn(*x), x))(
            places, states, v, v1
        )
        low = jnp.min(jnp.where(turns, height, jnp.inf))
        high = jnp.max(jnp.where(turns, height, -jnp.inf))
        room, touch = jnp.full((), jnp.inf, h.dtype), jnp.zeros((), h.dtype)
        for stop in scene.stops:
            rooms = jnp.where(turns & (stop.sign * v0 > 0), stop.gap - stop.sign * height, jnp.inf)
            nearest = jnp.argmin(rooms)
            touch = jnp.where(rooms[nearest] < room, place[nearest], touch)
            room = jnp.minimum(room, rooms[nearest])
        return low, high, room, touch


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
