"""Dry friction, anywhere and on stops, with sticking as a mode."""

import abc
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from math import pi
from types import SimpleNamespace
from typing import Any, ClassVar, cast

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
    contact_constraints,
    field_in,
    forces,
    push_gains,
    rate_of,
    row_of,
    velocity_change,
)
from .coordinates import Row
from .event import AbstractSwitch, EventContext
from .leaves import size_of
from .overrides import hashable
from .parts import at_stop, limited_in, stops_of, switches_of
from .settle import Contacts, Settled, released_share, settle
from .state import with_components


class Friction(AbstractSwitch):
    """Coulomb friction: a body slides forward or backward (mode +1, -1), or sticks (mode 0).

    Of frictions that hold a body together, such as those of two corners on a floor, some keep their
    largest force (mode ±¾) or none (mode ±¼). The others have the rest, which is unique. When it
    gets too large, all are settled anew.
    """

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
    ) -> tuple[Any, Any]:
        """Return the force that holds a body, and the largest possible one. **Arguments:**
        `contact`, as in `EventContext`; `found`, from `_solve_forces`."""

    def touches(self, machine: Machine, contact: Scalars) -> Flag:
        """Return whether the body touches the surface; `contact` is as in `EventContext`."""
        return jnp.ones((), bool)

    def is_known(self, around: EventContext | None) -> bool:
        """Return whether the other forces on the body are known."""
        return around is not None

    def static_share(self, machine: Machine, s: Scalar, state: State) -> Any:
        """Return the largest force without slip divided by that of a slipping body."""
        return 1.0

    def slip_rate(self, machine: Machine, s: Scalar, state: State, flow: State) -> Scalar:
        """Return the rate of the slip, with respect to s, along a flow."""
        return rate_of(self.speed_of_slip, machine, s, state, flow)

    def largest_rate(self, machine: Machine, s: Scalar, state: State, flow: State) -> Scalar:
        """Return the size of the rate of the slip along a flow."""
        return jnp.abs(self.slip_rate(machine, s, state, flow))

    def slip_sign(
        self, machine: Machine, s: Scalar, state: State, flow: State | None = None
    ) -> Scalar:
        """Return the sign of the slip; zero if the slip is rounding. Its size is that of its terms,
        and its change by the rate `flow` in 1/2π of a cycle."""
        slip, size = self.speed_of_slip(machine, s, state), self._size(machine, s, state)
        if flow is not None:
            rate = self.largest_rate(machine, s, state, flow)
            size = size + jnp.asarray(machine.cycle) / (2 * pi) * rate
        return jnp.where(jnp.abs(slip) <= self._rounding(slip, size), 0.0, jnp.sign(slip))

    def changes(self, machine: Machine, s: Scalar, before: State, after: State) -> Flag:
        """Return whether a jump changes the slip, by more than rounding."""
        old, new = (stop_gradient(self.speed_of_slip(machine, s, x)) for x in (before, after))
        size = self._size(machine, s, before) + jnp.abs(new)
        return jnp.abs(new - old) > self._rounding(new, size)

    def _size(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """Return the size of the terms of the slip."""
        slip = lambda x: self.speed_of_slip(machine, s, x)
        return size_of(slip, state, jtu.tree_map(jnp.abs, state))

    def _rounding(self, slip: Scalar, size: Scalar) -> Scalar:
        """Return the rounding of a slip with terms of this size."""
        return stop_gradient(self.roundings * float(jnp.finfo(slip.dtype).eps) * size)

    def begin(self, machine, s, state):
        """Return the direction of slip: `settled_modes` decides which bodies stick."""
        return jnp.sign(self.speed_of_slip(machine, s, state))

    def struck(self, machine, s, state, mode, *, around: EventContext | None = None):
        return self.begin(machine, s, state)

    def after(self, machine, s, state, mode, *, around: EventContext | None = None):
        """Return the state without a slip that vanishes, and the mode unchanged: `settled_modes`
        decides."""
        return self.stopped(machine, s, state, mode, around), mode

    @abc.abstractmethod
    def stopped(
        self, machine: Machine, s: Scalar, state: State, mode: Scalar, around: EventContext | None
    ) -> State:
        """Return the state with a slip of zero, where it vanishes to rounding."""

    def guard(self, machine, s, state, mode, *, around: EventContext | None = None):
        """Return the guard of slip that vanishes, or of a force that exceeds friction. It is
        negative for a body that does not rest on the stop with this friction."""
        return functools.reduce(jnp.maximum, self.sides(machine, s, state, mode, around=around))

    def sides(self, machine, s, state, mode, *, around: EventContext | None = None):
        slip_guard = -mode * self.speed_of_slip(machine, s, state)
        slip_guard = jnp.where((mode != 0) & (jnp.abs(mode) < 1), -1.0, slip_guard)
        if around is None or not self.is_known(around):
            return (jnp.where((mode == 0) | (not self.is_dry), -1.0, slip_guard),)
        touches = self.touches(machine, around.contact)

        loads: Any = around.loads
        if loads is None:
            loads = shared_loads(machine, s, state, around.with_mode(mode), around.contact)
        force, largest = self.held(machine, s, state, around.contact, loads[around.mode_index])
        sticks, free = (mode == 0) & touches, jnp.where(touches, slip_guard, -1.0)
        return tuple(jnp.where(sticks, x - largest, free) for x in (-force, force))


@eqx.filter_jit
def _solve_forces(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars
) -> dict[int, tuple[Any, Any]]:
    """Return for each friction, by its index among the switches, the force along the surface and
    the normal force (0 without a stop); jitted: a step calls it often, and JAX differentiates it
    once."""
    flow, pace = field_in(machine, s, state, modes), machine.pace(s, state)
    _, held, amounts = constrained_rate(machine, flow, s, state, modes, contact)
    loads = [x * row.mass for x, row in zip(amounts, held.rows, strict=True)]
    first = len(loads) - len(held.dry)
    dry = [x if pace is None else x / pace for x in loads[first:]]
    found = {i: (x, jnp.zeros_like(x)) for i, x in zip(held.dry, dry, strict=True)}
    tangents = loads[first - len(held.stop_frictions) : first]
    for (i, friction, row, _), force in zip(held.stop_frictions, tangents, strict=True):
        found[i] = force, -stops_of(machine)[friction.friction_stop].sign * loads[row]
    return found


def shared_loads(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars
) -> dict[int, tuple[Any, Any]] | None:
    """Return `_solve_forces` for the guards of frictions, or zeros if none sticks; `None` without
    frictions that act."""
    switches, solve = switches_of(machine), cast(Any, _solve_forces)
    acting = [i for i in frictions_in(machine) if switches[i].is_dry or contact]
    if not acting:
        return None
    sticks = jnp.zeros((), bool)
    for i in acting:
        sticks = sticks | (modes[i] == 0) & switches[i].touches(machine, contact)
    none = {i: (jnp.zeros_like(s), jnp.zeros_like(s)) for i in acting}
    return jax.lax.cond(sticks, lambda: solve(machine, s, state, modes, contact), lambda: none)


class DryFriction(Friction):
    """Coulomb friction on a body: it slides against a force, or sticks.

    While the body slides, the friction force is `level`, against the motion. At zero slip the body
    sticks as long as the force that holds it is at most `static_ratio` times the level at zero
    speed. Otherwise it slides on, or begins to slide. The machine's field does not contain the
    friction. Several frictions are solved for together, also with contacts at rest. Those with the
    same `on` or `slip` are one friction with the sum of the forces.

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
      normal force N, if it varies; `level` is then μ. 1 by default. A lane in which it becomes
      negative ends as `RESULTS.jammed`; `jnp.maximum(N, 0)` is the load of a body that lifts off.
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

    word: ClassVar = "friction"
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

    def laws(self) -> dict[str, Any]:
        """Return what the user gives as functions of machine, time and state, by argument."""
        given = {"slip": self.slip, "load": self.load}
        found: dict[str, Any] = {
            name: functools.partial(call_law, f) for name, f in given.items() if f is not None
        }
        if self.slip is None:
            found["on"] = self.speed_of_slip
        if callable(self.level):
            found["level"] = lambda *here: self.level(self.speed_of_slip(*here))
        return found

    def row(self, machine: Machine, s: Scalar, state: State) -> Row:
        """Return the slip's row in the equations of contacts."""
        if self.push is None:
            row = row_of(machine._coordinate_on(self.on, self.mass), s, state)
            if self.slip is None:
                return row
            push = jtu.tree_map(lambda x: x / row.mass, row.push)
        else:
            none = jtu.tree_map(jnp.zeros_like, state)
            push = with_components(none, self.push, "`push` of a DryFriction", all_of_them=False)
        gain = velocity_change(self.as_velocity(machine, s), state, push)
        return Row(jtu.tree_map(lambda x: x / gain, push), 1 / gain)

    @property
    def slip_takes_time(self) -> bool:
        """True if the surface may move as a function of time; static."""
        return self.slip is not None and _argument_count(self.slip) > 1

    def as_velocity(self, machine: Machine, s: Scalar) -> Any:
        """Return an object with the slip as the velocity of a coordinate."""
        return SimpleNamespace(velocity=lambda state: self.speed_of_slip(machine, s, state))

    def held(self, machine, s, state, contact, found):
        return found[0], self.sticking(machine, s, state)

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

    @property
    def may_be_negative(self) -> bool:
        """True if the size of the force is computed by functions; static."""
        return callable(self.level) or self.load is not None

    def is_negative(
        self, machine: Machine, old: tuple[Any, State], new: tuple[Any, State], mode: Scalar
    ) -> Flag:
        """Return whether the size of the force, which was that of `old` a step ago, is negative by
        more than rounding of its terms. States are pairs of time and state."""
        old, (s, state), mode = stop_gradient((old, new, mode))
        force = lambda x: jnp.asarray(self.sliding(machine, s, x, mode))
        size = size_of(force, state, jtu.tree_map(jnp.abs, state))
        size = size + jnp.abs(self.sliding(machine, *old, mode))
        return stop_gradient(force(state) < -1e-9 * size)

    def static_share(self, machine, s, state):
        return self.static_ratio

    def surface(self, key_of: Callable[[Any], Any]) -> Any:
        """Return a key: frictions with the same one act on one velocity, so their forces add.
        **Arguments:** `key_of`, a key of a function."""
        is_plain = type(self) is DryFriction and self.push is None
        return key_of(self.on), key_of(self.slip), None if is_plain else id(self)

    def push_in(self, machine, s, state, mode):
        """Return the change of the slip by the force on a body that slides, and its push."""
        row = self.row(machine, s, state)
        return -jnp.round(mode) * self.sliding(machine, s, state, mode) / row.mass, row.push

    def stopped(self, machine, s, state, mode, around):
        if self.slip is None and self.push is None:
            body = machine._coordinate_on(self.on, self.mass)
            velocity = body.velocity(state)
            return body.placed(state, body.position(state), jnp.zeros_like(velocity))
        slip, row = self.speed_of_slip(machine, s, state), self.row(machine, s, state)
        return added(state, (-slip,), (row.push,))


class JointFriction(DryFriction):
    """Dry frictions on one velocity: their forces add."""

    parts: tuple[DryFriction, ...] = eqx.field(kw_only=True)

    def _total(self, of_part: Callable[[DryFriction], Any]) -> Any:
        """Return a sum of forces, each as one on the mass of the first."""
        one = self.parts[0].mass
        whole, ratios = (1.0 if one is None else one), []
        for part in self.parts:
            ratios.append(1.0 if part.mass is None else whole / part.mass)
        return sum(k * of_part(x) for k, x in zip(ratios, self.parts, strict=True))

    def sliding(self, machine, s, state, mode):
        return self._total(lambda x: x.sliding(machine, s, state, mode))

    def sticking(self, machine, s, state):
        return self._total(lambda x: x.sticking(machine, s, state))

    @property
    def may_be_negative(self):
        return any(x.may_be_negative for x in self.parts)

    def is_negative(self, machine, old, new, mode):
        parts = [x for x in self.parts if x.may_be_negative]
        return jnp.any(jnp.stack([x.is_negative(machine, old, new, mode) for x in parts]))

    def static_share(self, machine, s, state):
        kinetic = self.sliding(machine, s, state, jnp.zeros_like(s))
        share = self.sticking(machine, s, state) / jnp.where(kinetic > 0, kinetic, 1.0)
        return jnp.where(kinetic > 0, share, 1.0)


def joined(frictions: Sequence[DryFriction]) -> DryFriction:
    """Return one friction with the sum of these forces, all on one velocity."""
    first = frictions[0]
    if len(frictions) == 1:
        return first
    given = {"on": first.on, "mass": first.mass, "slip": first.slip, "push": first.push}
    return JointFriction(first.level, **given, acts=first.acts, parts=tuple(frictions))


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

    def largest_rate(self, machine, s, state, flow):
        # The stop's force resists the motion into it, and friction is in proportion to that. Terms
        # of bodies that fall together cancel, but not their rounding.
        body = machine.coordinates[stops_of(machine)[self.stop].coordinate]
        along, terms = machine.coordinates[self.along], jtu.tree_map(jnp.abs, flow)
        return size_of(body.velocity, state, terms) + size_of(along.velocity, state, terms)

    def stopped(self, machine, s, state, mode, around):
        # The correction must not change the velocity at the stop.
        stop, along = stops_of(machine)[self.stop], machine.coordinates[self.along]
        both = (machine.coordinates[stop.coordinate], along)
        rows = [row_of(body, s, state) for body in both]
        pushes = [row.push for row in rows]
        stops = [self.touches(machine, () if around is None else around.contact), mode != 0]
        wanted = [-body.velocity(state) for body in both]
        amounts = forces(push_gains(both, rows, state, pushes), stops, wanted)
        return added(state, amounts, pushes)

    def touches(self, machine, contact):
        if not contact:
            return jnp.zeros((), bool)
        return contact[stops_of(machine)[self.stop].coordinate] == 1.0 + self.stop

    def held(self, machine, s, state, contact, found):
        force, pressing = found
        # Without friction the force along the stop is rounding of that across it.
        level = self.level + 64 * float(jnp.finfo(pressing.dtype).eps)
        return force, level * pressing

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


def settled_modes(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars,
    released: dict[int, Flag] | None = None,
) -> Scalars:  # fmt: skip
    """Return the modes of `settled_contacts`."""
    return settled_contacts(machine, s, state, modes, contact, released)[0]


def settled_contacts(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars,
    released: dict[int, Flag] | None = None,
) -> tuple[Scalars, Scalars]:  # fmt: skip
    """Return the modes with those of all frictions after a jump, or after events of frictions, and
    the contacts as `pressed_contacts` does. Each body without slip sticks, or begins to slip; NaN
    if no motion fulfils the laws of friction.

    **Arguments:** `modes`, for a friction with slip its direction; `contact`, as in `EventContext`;
    `released`, after events of frictions: for each friction whether its force has just become too
    large.
    """
    begins = None
    if released is not None:
        none = jnp.zeros((), bool)
        begins = tuple(released.get(i, none) for i in frictions_in(machine))
    slip_of, solve = (cast(Any, x) for x in (_slips, _settled))
    given = slip_of(machine, s, state, modes, begins)
    return solve(machine, s, state, modes, contact, *given, contact, None)[:2]


def pressed_contacts(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars,
    opened: Scalars | None = None, touching: tuple[Flag, ...] | None = None,
) -> tuple[Scalars, Scalars, Scalars]:  # fmt: skip
    """Return the modes; the contacts (as in `EventContext`) without those that the forces of this
    state open; and the rate of each friction's slip, 0 where none touches. Of the contacts that are
    `opened`, the spare ones stay closed; of those that are only `touching`, those that are pressed
    on. Frictions that slip in `modes` go on."""
    indices, switches, solve = frictions_in(machine), switches_of(machine), cast(Any, _settled)
    slips = tuple(slip_in(modes[i]) for i in indices)
    ratios = (switches[i].static_share(machine, s, state) for i in indices)
    holds = tuple(ratio + jnp.zeros_like(s) for ratio in ratios)
    opened = contact if opened is None else opened
    return solve(machine, s, state, modes, contact, slips, holds, opened, touching)


@eqx.filter_jit
def _slips(
    machine: Machine, s: Scalar, state: State, modes: Scalars, begins: Sequence[Flag] | None
) -> tuple[Scalars, Scalars]:
    """Return for each friction its slip, and the greatest force without slip relative to that of a
    slipping body; jitted like `_solve_forces`. `begins`: after events of frictions, whether it
    begins to slip."""
    slips, holds, flow = [], [], field_in(machine, s, state, modes)
    any_begins = functools.reduce(jnp.logical_or, begins or (), jnp.zeros((), bool))
    for n, i in enumerate(frictions_in(machine)):
        friction = switches_of(machine)[i]
        ratio = friction.static_share(machine, s, state)
        slip = friction.slip_sign(machine, s, state, flow)
        if begins is not None:  # the slip of a sticking body is rounding
            slip = jnp.where(jnp.abs(modes[i]) < 1, 0.0, slip)
            # A redundant friction does not hold what another releases.
            is_spare = (modes[i] != 0) & (jnp.abs(modes[i]) < 1) & any_begins
            ratio = jnp.where(begins[n] | is_spare, 1 - released_share(slip), ratio)
        slips.append(slip)
        holds.append(ratio + jnp.zeros_like(s))
    return tuple(slips), tuple(holds)


@eqx.filter_jit
def _settled(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars,
    slips: Scalars, holds: Scalars, opened: Scalars, touching: tuple[Flag, ...] | None,
) -> tuple[Scalars, Scalars, Scalars]:  # fmt: skip
    """Return the modes with those of all frictions, by their slips; the contacts that stay closed,
    spare ones with a minus (see `Lane.contact`); and the rates of the slips; jitted like
    `_solve_forces`."""
    contact = tuple(jnp.abs(x) for x in contact) if len(limited_in(machine)) > 1 else contact
    new, kept, switches = list(modes), list(contact), switches_of(machine)
    for i, slip in zip(frictions_in(machine), slips, strict=True):
        new[i] = slip
    rates = {i: jnp.zeros_like(s) for i in frictions_in(machine)}
    if not contact and not any(x.is_dry for x in switches):
        return tuple(new), contact, tuple(rates.values())
    order, touches, answer = settled_forces(machine, s, state, modes, contact, slips, holds)
    pace = machine.pace(s, state)
    for n, i in enumerate(order):
        mode = jnp.where(answer.unsolved, jnp.nan, answer.mode[n])
        new[i] = jnp.where(touches[n], mode, new[i])
        rate = answer.rate[len(answer.rate) - len(order) + n]
        rates[i] = jnp.where(touches[n], rate if pace is None else rate * pace, 0.0)
    for row, k in enumerate(limited_in(machine) if contact else ()):
        stays = answer.kept[row] | answer.unsolved
        if touching is not None:
            stays = stays & (~touching[k] | (answer.force[row] > 0))
        kept[k] = jnp.where(stays, contact[k], 0.0)
        if len(kept) > 1:
            spare = answer.spare[row] & ~answer.unsolved
            kept[k] = jnp.where(spare, -jnp.abs(opened[k]), kept[k])
    return tuple(new), tuple(kept), tuple(rates.values())


def settled_forces(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Scalars,
    slips: Scalars, holds: Scalars,
) -> tuple[list[int], list[Flag], Settled]:  # fmt: skip
    """Return the frictions that act, by their indices, those on stops first; whether each touches
    its surface; and the forces and modes. **Arguments:** `contact`, as in `EventContext`; `slips`
    and `holds`, a number for each friction, as in `machine.settle`."""
    indices, switches = frictions_in(machine), switches_of(machine)
    order = [i for i in indices if switches[i].is_dry or contact]
    order.sort(key=lambda i: switches[i].is_dry)
    slip_of = dict(zip(indices, slips, strict=True))
    hold_of = dict(zip(indices, holds, strict=True))
    free = tuple(0.0 * x if i in indices else x for i, x in enumerate(modes))
    held = contact_constraints(machine, s, state, free, contact)
    touches = [switches[i].touches(machine, contact) for i in order]
    slip = [jnp.where(x, slip_of[i], 0.0) for i, x in zip(order, touches, strict=True)]
    level = [switches[i].sliding(machine, s, state, slip_of[i]) for i in held.dry]
    none = jnp.zeros((0,), s.dtype)
    question, of = _question(machine, s, state, free, contact, held)
    question = question._replace(
        level=jnp.stack([x + 0 * s for x in level]) if level else none,
        slip=jnp.stack(slip) if slip else none,
        hold=jnp.stack([hold_of[i] for i in order]) if order else none,
        touches=jnp.stack(touches[: len(of)]) if of else None,
    )
    return order, touches, settle(question, of, has_ratios=bool(held.dry))


def _question(
    machine: Machine, s: Scalar, state: State, modes: Sequence[Scalar], contact: Scalars, held: Any
) -> tuple[Contacts, tuple[int, ...]]:
    """Return gains and rates of the `held` rows of a state, and each tangent's contact. In `modes`
    frictions are in mode 0, without a force."""
    flow, pace = field_in(machine, s, state, tuple(modes)), machine.pace(s, state)
    switches, one = switches_of(machine), jnp.ones_like(s)
    of = tuple(stop for _, _, stop, _ in held.stop_frictions)
    first = len(held.rows) - len(held.dry)
    n = first - len(of)
    outward, closed = [one] * len(held.rows), []
    for row, k in enumerate(limited_in(machine) if contact else ()):
        outward[row] = at_stop(machine, k, contact[k], lambda stop: -float(stop.sign), one)
        closed.append(contact[k] > 0)
    rates = [velocity_change(body, state, flow) for body in held.coordinates[:first]]
    rates += [switches[i].slip_rate(machine, s, state, flow) for i in held.dry]
    gains = push_gains(held.coordinates, held.rows, state, held.pushes)
    masses = [row.mass for row in held.rows]
    sign = jnp.stack(outward)
    matrix = jnp.stack([
        jnp.stack([jnp.asarray(x / mass, s.dtype) for x, mass in zip(row, masses, strict=True)])
        for row in gains
    ])  # fmt: skip
    rate = sign * jnp.stack(rates)
    nothing = jnp.zeros((0,), s.dtype)
    question = Contacts(
        sign[:, None] * matrix * sign,
        rate if pace is None else rate / pace,
        jnp.stack([x.level + 0 * s for _, x, _, _ in held.stop_frictions]) if of else nothing,
        jnp.stack(closed) if n else jnp.zeros((0,), bool),
        nothing, nothing, nothing,
    )  # fmt: skip
    return question, of


def slip_in(mode: Scalar) -> Scalar:
    """Return the direction in which a friction slips, 0 if it sticks: see `Friction`."""
    return jnp.where(jnp.abs(mode) < 1, 0.0, mode)


def held_alone(mode: Scalar) -> Scalar:
    """Return the mode of a friction that held its body with others, if it were alone. One that had
    no force sticks: see `Friction`."""
    return jnp.where(jnp.abs(mode) == 0.25, 0.0, mode)


def frictions_in(machine: Machine) -> list[int]:
    """Return the indices of the frictions among a machine's switches."""
    switches = enumerate(switches_of(machine))
    return [i for i, x in switches if x.is_dry or x.friction_stop is not None]
