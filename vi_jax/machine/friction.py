"""Dry friction, anywhere and on stops, with sticking as a mode."""

import abc
import functools
import inspect
import itertools
from collections.abc import Callable, Mapping
from math import pi
from types import SimpleNamespace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    Range,
    optional_real,
    real,
    real_or_law,
    require_ranges,
)
from .._types import Flag, Machine, Scalar, Scalars, State
from .contacts import (
    added,
    constrained_rate,
    field_in,
    forces,
    push_gains,
    push_of,
    rate_of,
    velocity_change,
)
from .declared import hashable, stops_of, switches_of
from .event import AbstractSwitch, EventContext
from .numbers import size_of
from .state import with_components

# In a tried set of modes, a force may have the wrong sign up to this share of the largest friction
# force: a choice, far above the accuracy of an event, at which the force equals the largest
# friction and the body does not accelerate yet.
_FORCE_TOLERANCE = 1e-6


class Friction(AbstractSwitch):
    """Coulomb friction: a body slides forward or backward (mode +1, -1), or sticks (mode 0)."""

    roundings: ClassVar[int]
    """A slip below this number of roundings of its size counts as zero."""

    word: ClassVar = "friction"
    needs_all_modes: ClassVar = True  # a holding force depends on all other forces
    may_slide: ClassVar = False  # there the body sticks

    @abc.abstractmethod
    def speed_of_slip(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """Return the velocity relative to the surface."""

    @abc.abstractmethod
    def held(
        self, machine: Machine, s: Scalar, state: State, contact: Scalars, found: Any
    ) -> tuple[Any, Any, Any]:
        """Return the force that holds a body, the largest possible one, and the effective mass.
        **Arguments:** `contact`, as in `EventContext`; `found`, from `constrained_rate`."""

    def touches(self, machine: Machine, contact: Scalars) -> Flag:
        """Return whether the body touches the surface; `contact` is as in `EventContext`."""
        return jnp.ones((), bool)

    def is_known(self, around: EventContext | None) -> bool:
        """Return whether the other forces on the body are known."""
        return around is not None

    def slip_rate(self, machine: Machine, s: Scalar, state: State, flow: State) -> Scalar:
        """Return the rate of the slip, with respect to s, along a flow."""
        return rate_of(self.speed_of_slip, machine, s, state, flow)

    def slip_sign(
        self, machine: Machine, s: Scalar, state: State, flow: State | None = None
    ) -> Scalar:
        """Return the sign of the slip; zero if the slip is rounding. Its size is that of its terms,
        and its change by the rate `flow` in 1/2π of a cycle."""
        slip, sizes = self.speed_of_slip(machine, s, state), jtu.tree_map(jnp.abs, state)
        size = size_of(lambda x: self.speed_of_slip(machine, s, x), state, sizes)
        if flow is not None:
            rate = jnp.abs(self.slip_rate(machine, s, state, flow))
            size = size + jnp.asarray(machine.cycle) / (2 * pi) * rate
        least = stop_gradient(self.roundings * float(jnp.finfo(slip.dtype).eps) * size)
        return jnp.where(jnp.abs(slip) <= least, 0.0, jnp.sign(slip))

    def begin(self, machine, s, state):
        return self.slip_sign(machine, s, state)

    def struck(self, machine, s, state, mode, *, around: EventContext | None = None):
        flow = None if around is None else field_in(machine, s, state, around.modes)
        slips = self.slip_sign(machine, s, state, flow)
        if not self.is_known(around):
            return slips
        return jnp.where(slips == 0, self._mode_at_rest(machine, s, state, around, True), slips)

    def guard(self, machine, s, state, mode, *, around: EventContext | None = None):
        """Return the guard of slip that vanishes, or of a force that exceeds friction. It is
        negative for a body that does not rest on the stop with this friction."""
        return functools.reduce(jnp.maximum, self.sides(machine, s, state, mode, around=around))

    def sides(self, machine, s, state, mode, *, around: EventContext | None = None):
        slip_guard = -mode * self.speed_of_slip(machine, s, state)
        if around is None or not self.is_known(around):
            return (jnp.where((mode == 0) | (not self.is_dry), -1.0, slip_guard),)
        touches = self.touches(machine, around.contact)

        def forces() -> tuple[Scalar, Scalar]:
            pull, largest = self._balanced_force(machine, s, state, around, mode)
            return pull - largest, -pull - largest

        # Without sticking, no force is computed.
        without_forces = jnp.where(touches, slip_guard, -1.0)
        return jax.lax.cond((mode == 0) & touches, forces, lambda: (without_forces, without_forces))

    def _balanced_force(
        self, machine: Machine, s: Scalar, state: State, around: Any, mode: Scalar
    ) -> tuple[Any, Any]:
        """Return the force that friction balances on a body that sticks, and the largest one."""
        solve: Any = _solve_forces
        _, found = solve(machine, s, state, around.with_mode(mode), around.contact)
        force, largest, _ = self.held(machine, s, state, around.contact, found[around.mode_index])
        return -force, largest

    def _mode_at_rest(
        self, machine: Machine, s: Scalar, state: State, around: Any, sticks: Flag | bool
    ) -> Scalar:
        """Return the mode of a body without slip: sticking if it may and the force is not too
        large, else the direction of the force."""
        if not self.is_known(around):
            return jnp.zeros_like(s)
        pull, largest = self._balanced_force(machine, s, state, around, jnp.zeros_like(s))
        holds = sticks & (jnp.abs(pull) <= largest) | ~self.touches(machine, around.contact)
        return jnp.where(holds, 0.0, jnp.where(pull < 0, -1.0, 1.0))


@eqx.filter_jit
def _solve_forces(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars
) -> tuple[State, dict[int, tuple[Any, Any, Any]]]:
    """Return `constrained_rate`, jitted: a step calls it often, and JAX differentiates it once."""
    return constrained_rate(machine, field_in(machine, s, state, modes), s, state, modes, contact)


class DryFriction(Friction):
    """Coulomb friction on a body: it slides against a force, or sticks.

    While the body slides, the friction force is `level`, against the motion. At zero slip the body
    sticks as long as the force that holds it is at most `static_ratio` times the level at zero
    speed. Otherwise it slides on, or begins to slide. The machine's field does not contain the
    friction. Several sticking frictions are solved for together, also with contacts at rest.

    **Arguments:**

    - `level`: μN in the machine's unit of force, or a function of the sliding speed (Stribeck's
      curve), smooth from a little below zero on. Its values must not be negative. A function with
      parameters is an `equinox.Module` with `__call__`.
    - `on`: the name of the velocity that it acts on, `"u"`; of a `Mechanical` a coordinate, or a
      function of its coordinates: `on=lambda q: q.b - q.a` is friction between two bodies.
    - `mass`: the mass of that body, 1 by default; a `Mechanical` computes it.
    - `slip(z)` or `slip(t, z)`: the velocity relative to a surface that moves, such as `slip=lambda
      z: z.u - belt`. It may jump where a cycle begins, not within one.
    - `push`: instead of `on` and `mass`, the change of the rate of each component by a unit of
      force, by name, if the friction acts on several.
    - `load(z)`, `load(t, z)` or `load(machine, t, z)`: a factor of the level, not negative: the
      normal force N, if it varies; `level` is then μ. 1 by default.
    - `static_ratio`: μ_s/μ, at least 1.
    """

    level: Any = eqx.field(converter=real_or_law("level"))
    on: Any = eqx.field(static=True, kw_only=True, default=None, converter=hashable)
    mass: Float[Array, "..."] | None = eqx.field(
        kw_only=True, default=None, converter=optional_real("mass")
    )
    slip: Callable[..., Any] | None = eqx.field(static=True, kw_only=True, default=None)
    push: Mapping[str, Any] | None = eqx.field(kw_only=True, default=None)
    static_ratio: Float[Array, "..."] = eqx.field(
        kw_only=True, default=1.0, converter=real("static_ratio")
    )
    load: Callable[..., Any] | None = eqx.field(static=True, kw_only=True, default=None)
    acts: bool = eqx.field(static=True, kw_only=True, default=True, repr=False)
    ranges: ClassVar = {
        "level": NOT_NEGATIVE, "mass": POSITIVE, "static_ratio": Range(1.0, float("inf")),
    }  # fmt: skip

    is_dry: ClassVar = True
    roundings: ClassVar = 4

    def __check_init__(self):
        require_ranges(self)
        if self.push is not None and self.slip is None:
            raise ValueError(
                "Argument `slip` must be given with `push`: the velocity that friction stops."
            )

    def speed_of_slip(self, machine, s, state):
        if self.slip is not None:
            return jnp.asarray(call_law(self.slip, machine, s, state))
        return machine._coordinate_on(self.on, self.mass).velocity(state)

    def row(self, machine: Machine, s: Scalar, state: State) -> tuple[State, Any]:
        """Return the change of the state by an impulse of unit slip, and the effective mass."""
        if self.push is None:
            body = machine._coordinate_on(self.on, self.mass)
            push, mass = push_of(body, state), body.mass_at(s, state)
            if self.slip is None:
                return push, mass
            push = jtu.tree_map(lambda x: x / mass, push)
        else:
            none = jtu.tree_map(jnp.zeros_like, state)
            push = with_components(none, self.push, "`push` of a DryFriction", all_of_them=False)
        gain = velocity_change(self.as_velocity(machine, s), state, push)
        return jtu.tree_map(lambda x: x / gain, push), 1 / gain

    @property
    def slip_takes_time(self) -> bool:
        """True if the surface may move as a function of time; static."""
        return self.slip is not None and _argument_count(self.slip) > 1

    def as_velocity(self, machine: Machine, s: Scalar) -> Any:
        """Return an object with the slip as the velocity of a coordinate."""
        return SimpleNamespace(velocity=lambda state: self.speed_of_slip(machine, s, state))

    def held(self, machine, s, state, contact, found):
        force, _, mass = found
        return force, self.sticking(machine, s, state), mass

    def sliding(self, machine: Machine, s: Scalar, state: State, mode: Scalar) -> Any:
        """Return the friction force on a body that slides forward or backward; in mode 0 on one
        that begins to slide."""
        level = self.level
        if callable(level):
            level = level(mode * self.speed_of_slip(machine, s, state))
        return level if self.load is None else level * call_law(self.load, machine, s, state)

    def sticking(self, machine: Machine, s: Scalar, state: State) -> Any:
        """Return the largest force that friction can balance on a body at rest."""
        return self.sliding(machine, s, state, jnp.zeros_like(s)) * self.static_ratio

    def push_in(self, machine, s, state, mode):
        """Return the change of the slip by the force on a body that slides, and its push."""
        push, mass = self.row(machine, s, state)
        return -mode * self.sliding(machine, s, state, mode) / mass, push

    def after(self, machine, s, state, mode, *, around: EventContext | None = None):
        new = self.stopped(machine, s, state)
        return new, self._mode_at_rest(machine, s, new, around, mode != 0)

    def stopped(self, machine: Machine, s: Scalar, state: State) -> State:
        """Return the state with a slip of zero, where it vanishes to rounding."""
        if self.slip is None and self.push is None:
            body = machine._coordinate_on(self.on, self.mass)
            velocity = body.velocity(state)
            return body.placed(state, body.position(state), jnp.zeros_like(velocity))
        slip, (push, _) = self.speed_of_slip(machine, s, state), self.row(machine, s, state)
        return added(state, (-slip,), (push,))


class ContactFriction(Friction):
    """Coulomb friction between a body and a stop that it hits, or rests on (see `RigidStop`)."""

    level: Any
    """μ, Coulomb's coefficient of friction (dimensionless)."""
    stop: int = eqx.field(static=True, kw_only=True)
    """The index of the stop among the machine's."""
    along: int = eqx.field(static=True, kw_only=True)
    """The index of the coordinate that the body slips along; its position is not used."""
    restitution: Any = eqx.field(kw_only=True)
    """Coefficient of restitution along the stop (dimensionless)."""
    roundings: ClassVar = 16

    @property
    def friction_stop(self) -> int:  # pyright: ignore
        return self.stop

    def is_known(self, around):
        return around is not None and bool(around.contact)

    def speed_of_slip(self, machine, s, state):
        return machine.coordinates[self.along].velocity(state)

    def after(self, machine, s, state, mode, *, around: EventContext | None = None):
        # The slip vanishes to rounding. Its correction must not change the velocity at the stop.
        stop, along = stops_of(machine)[self.stop], machine.coordinates[self.along]
        both = (machine.coordinates[stop.coordinate], along)
        pushes = [push_of(body, state) for body in both]
        stops = [self.touches(machine, () if around is None else around.contact), mode != 0]
        wanted = [-body.velocity(state) for body in both]
        amounts = forces(push_gains(both, state, pushes), stops, wanted)
        state = added(state, amounts, pushes)
        return state, self._mode_at_rest(machine, s, state, around, mode != 0)

    def touches(self, machine, contact):
        if not contact:
            return jnp.zeros((), bool)
        return contact[stops_of(machine)[self.stop].coordinate] == 1.0 + self.stop

    def held(self, machine, s, state, contact, found):
        force, pressing, mass = found
        return force, self.level * pressing, mass

    def push_in(self, machine, s, state, mode):
        """Return `None`: the force is solved for together with the stop's (`constrained_rate`)."""
        return None


def call_law(function: Callable[..., Any], machine: Machine, s: Scalar, state: State) -> Any:
    """Call a function of the state, of time and state, or of machine, time and state."""
    return function(*(machine, s, state)[3 - _argument_count(function) :])


def _argument_count(function: Callable[..., Any]) -> int:
    try:
        parameters = inspect.signature(function).parameters.values()
        count = sum(x.default is x.empty and x.kind < x.VAR_POSITIONAL for x in parameters)
    except (TypeError, ValueError):  # not a Python function
        count = 1
    return min(max(count, 1), 3)


def choose_modes(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars,
    released: tuple[int, Flag] | None = None,
) -> Scalars:  # fmt: skip
    """Return the modes of several frictions after one has changed: the first set that is consistent
    with all forces, in the order of decreasing numbers of sticking bodies. A friction with slip
    keeps its direction, and that in `released` (index and flag) does not stick. Each of the others
    sticks or slips either way."""
    indices = frictions_in(machine)
    switches = switches_of(machine)
    flow = field_in(machine, s, state, modes)
    signs = [switches[i].slip_sign(machine, s, state, flow) for i in indices]
    slips = [x != 0 for x in signs]
    if released is not None:  # the slip of a sticking body is rounding
        slips = [
            x & (modes[i] != 0) & (i != released[0]) if switches[i].is_dry else x
            for i, x in zip(indices, slips, strict=True)
        ]
    sets = itertools.product((0.0, 1.0, -1.0), repeat=len(indices))
    ordered = jnp.asarray(sorted(sets, key=lambda x: sum(map(abs, x))), jnp.result_type(s))

    def try_next(x: tuple[Any, ...]) -> tuple[Any, ...]:
        _, number, _ = x
        new, chosen = list(modes), ordered[number]
        for k, (i, slip_sign, slip) in enumerate(zip(indices, signs, slips, strict=True)):
            new[i] = jnp.where(slip, slip_sign, chosen[k])
        good = _is_consistent(machine, s, state, tuple(new), contact, indices, slips, released)
        return tuple(new), number + 1, jnp.where(good, 1.0, 0.0)

    zero = jnp.zeros_like(s)
    begin = tuple(modes), jnp.zeros((), int), zero
    found, _, good = jax.lax.while_loop(
        lambda x: (x[2] == 0) & (x[1] < len(ordered)), try_next, stop_gradient(begin)
    )
    return tuple(jnp.where(good > 0, new, old) for new, old in zip(found, modes, strict=True))


def frictions_in(machine: Machine) -> list[int]:
    """Return the indices of the frictions among a machine's switches."""
    switches = enumerate(switches_of(machine))
    return [i for i, x in switches if x.is_dry or x.friction_stop is not None]


def _is_consistent(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars,
    indices: list[int], slips: list[Flag], released: tuple[int, Flag] | None,
) -> Flag:  # fmt: skip
    """Return whether all forces agree with these modes: sticking bodies are held, and bodies that
    begin to slip are accelerated in that direction."""
    solve: Any = _solve_forces
    total, forces = solve(machine, s, state, modes, contact)
    good = jnp.ones((), bool)
    for i, slip in zip(indices, slips, strict=True):
        friction, mode = switches_of(machine)[i], modes[i]
        if i not in forces:  # on a stop without a resting body
            continue
        force, holds, mass = friction.held(machine, s, state, contact, forces[i])
        rate = friction.slip_rate(machine, s, state, total)
        sticks = jnp.abs(force) <= holds
        if released is not None and released[0] == i:
            sticks = sticks & ~released[1]
        slides = mode * rate * mass >= -_FORCE_TOLERANCE * holds
        touches = friction.touches(machine, contact)
        good = good & (slip | ~touches | jnp.where(mode == 0, sticks, slides))
    return good
