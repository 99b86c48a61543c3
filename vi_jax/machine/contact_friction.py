"""Dry friction on a stop: in its impacts, and while a body rests on it."""

import functools
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, SHARE, count, real, require_ranges
from .._types import Flag, Machine, Scalar, State
from .contacts import added, forces, gained, held_flow, push_of, shares, way_of
from .event import AbstractSwitch, Around
from .field import field_in


class ContactFriction(AbstractSwitch):
    """Coulomb friction between a body and a stop that it hits, or rests on.

    In an impact the body sticks or slips along the stop: it sticks, with its velocity along the
    stop reversed and scaled by `restitution`, if that takes an impulse of no more than `level`
    times the stop's, and slips against that much else. While it rests on the stop it slips forward
    or backward (mode +1, -1) against `level` times the force that presses it on, or sticks (mode
    0), which may jam it. That force follows from what else acts, other contacts included; the
    machine's field says nothing of it, and gets the mode like those of all switches.

    Newton's and Coulomb's laws together may gain energy where the velocities across and along a
    stop are coupled (T. R. Kane): an impact that would ends its lane as `RESULTS.bad_impact`.

    **Arguments:**

    - `level`: μ, not negative.
    - `stop`: the number of the stop among the machine's.
    - `along`: the number of the coordinate that the body slips along, with its `mass`: no stop need
      limit it, and of its position nothing is asked.
    - `restitution`: along the stop, in [0, 1].
    """

    level: Float[Array, "..."] = eqx.field(converter=real("level"))
    """μ, Coulomb's coefficient of friction (dimensionless)."""
    stop: int = eqx.field(static=True, kw_only=True)
    along: int = eqx.field(static=True, kw_only=True)
    restitution: Float[Array, "..."] = eqx.field(
        kw_only=True, default=0.0, converter=real("restitution")
    )
    """Coefficient of restitution along the stop (dimensionless)."""
    ranges: ClassVar = {"level": NOT_NEGATIVE, "restitution": SHARE}

    def __check_init__(self):
        require_ranges(self)
        count("stop", self.stop)
        count("along", self.along)

    @property
    def rubs_on(self) -> int:
        """The number of the stop that it is friction on."""
        return self.stop

    @property
    def sees_around(self) -> bool:
        """True: it acts while its body rests on the stop."""
        return True

    @property
    def may_slide(self) -> bool:
        """Never along its own surface: where both sides point at it, the body sticks."""
        return False

    def begin(self, machine, s, state):
        """The mode of a motion that begins: the sign of the velocity along the stop."""
        return self.way(machine, s, state)

    def struck(self, machine, s, state, mode, *, around: Around | None = None):
        """The mode after an impact or another jump: the way that the body slips, or would begin to.

        **Arguments:** as every event's, and `around`, what else acts; `None` if that is not known
        yet.
        """
        slips = self.way(machine, s, state)
        return jnp.where(slips == 0, self._from_rest(machine, s, state, around), slips)

    def guard(self, machine, s, state, mode, *, around: Around | None = None):
        """The velocity along the stop coming to zero; or the force coming to what friction can
        hold. Nothing happens where the body does not rest on the stop.

        **Arguments:** as every event's, and `around`, the other modes and who rests where.
        """
        return functools.reduce(jnp.maximum, self.sides(machine, s, state, mode, around=around))

    def sides(self, machine, s, state, mode, *, around: Around | None = None):
        """The guard for a force forward and for one backward.

        **Arguments:** as `guard`.
        """
        if around is None or not around.contact:
            return (jnp.full_like(s, -1.0),)
        drag, pressing = self._forces(machine, s, state, around, mode)
        slows = -mode * machine.coordinates[self.along].velocity(state)
        rests, holds = self._rests(machine, around), self.level * pressing
        return tuple(
            jnp.where(rests, jnp.where(mode == 0, way * drag - holds, slows), -1.0)
            for way in (1.0, -1.0)
        )

    def after(self, machine, s, state, mode, *, around: Around | None = None):
        """Sticking, or slipping the way the force pulls.

        **Arguments:** as every event's, and `around`, the other modes and who rests where.
        """
        # It vanishes to rounding; and with it what that would give to the velocity on the stop.
        stop, along = machine.stops[self.stop], machine.coordinates[self.along]
        both = (machine.coordinates[stop.coordinate], along)
        pushes = [push_of(body, state) for body in both]
        stops = [jnp.zeros((), bool) if around is None else self._rests(machine, around), mode != 0]
        wanted = [-body.velocity(state) for body in both]
        amounts = forces(shares(both, state, pushes), stops, wanted)
        state = added(state, amounts, pushes)
        return state, self._from_rest(machine, s, state, around, sticks=mode != 0)

    def _rests(self, machine: Machine, around: Around) -> Flag:
        if not around.contact:
            return jnp.zeros((), bool)
        return around.contact[machine.stops[self.stop].coordinate] == 1.0 + self.stop

    def way(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """The sign of the velocity along the stop; zero where that is rounding."""
        return way_of(machine.coordinates[self.along].velocity(state), state, roundings=16)

    def slip_rate(self, machine: Machine, s: Scalar, state: State, flow: State) -> Scalar:
        """d/ds of the velocity along the stop, along a flow."""
        return gained(machine.coordinates[self.along], state, flow)

    def held(self, machine, s, state, contact, found):
        """The force that holds a body, the largest that can, the mass that it acts on, and whether
        the body rests on the stop.

        **Arguments:** `contact` as in `Around`; `found`, of `held_flow`.
        """
        force, pressing = found
        here = contact[machine.stops[self.stop].coordinate] == 1.0 + self.stop
        mass = machine.coordinates[self.along].mass_at(s, state)
        return force, self.level * pressing, mass, here

    def push_in(self, machine, s, state, mode):
        """`None`: the force is found with that which presses on the stop (`held_flow`)."""
        return None

    def _from_rest(
        self, machine: Machine, s: Scalar, state: State, around: Around | None,
        sticks: Flag | bool = True,
    ) -> Scalar:  # fmt: skip
        """The mode of a body without velocity along the stop: sticking (0) where the force is not
        too large, else the way that it pulls.

        **Arguments:** `around`, the other modes and who rests where, `None` if that is not known;
        `sticks`, whether the body may stick at all.
        """
        if around is None or not around.contact:
            return jnp.zeros_like(s)
        drag, pressing = self._forces(machine, s, state, around, jnp.zeros_like(s))
        holds = sticks & (jnp.abs(drag) <= self.level * pressing)
        away = jnp.where(drag > 0, -1.0, 1.0)
        return jnp.where(holds | ~self._rests(machine, around), 0.0, away)

    def _forces(
        self, machine: Machine, s: Scalar, state: State, around: Around, mode: Scalar
    ) -> tuple[Scalar, Scalar]:
        """The force along the stop and that which presses on it.

        **Arguments:** `around`, the other modes and who rests where; `mode`, that of this friction.
        """
        modes = around.instead(mode)
        flow = field_in(machine, s, state, modes)
        return held_flow(machine, flow, s, state, modes, around.contact)[1][around.own]
