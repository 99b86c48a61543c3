"""An impulse of white noise at an instant of a cycle, and how the motion goes on behind it."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import stop_gradient

from ..._types import Flag, Scalar, State
from ...machine import SoftStop, struck_modes
from .._arrival import Arrival, Onward, Tally
from .._lane import Lane, Plan, select
from ..noise import kicked
from .happen import let_go
from .jump import after_jump


class Instant(NamedTuple):
    """The end of a piece of a cycle, where an impulse acts."""

    reached: Flag
    """Whether it is reached."""
    completed: Flag
    """Whether an interval ends with it."""
    before: Scalar
    """How many were complete before."""
    part: Scalar
    """The number of the piece."""
    s: Scalar
    """The independent variable behind it."""


def shaken(plan: Plan, there: Lane, state: State, at: Instant) -> tuple[Lane, State]:
    """The lane and the state behind an impulse.

    **Arguments:** `there`, the lane as it gets to the instant; `state`, the state just before.
    """
    assert plan.noise is not None
    where = stop_gradient((plan.cycle_of(at.before), at.part))
    behind = kicked(plan.noise, at.reached, *where, state, _since(there))
    there = _timed_anew(there, at)
    when = at.reached
    onward = Onward(there.direction, there.contact, there.modes, there.below)
    if _may_change_modes(plan):
        # A body that was moved rests no longer, which friction on its stop has to know.
        _, contact = after_jump(plan, onward, when, state, behind, at.s)
        new = struck_modes(plan.machine, at.s, behind, there.modes, contact=contact or ())
        onward = onward._replace(modes=select(when, new, there.modes))
    direction, contact = after_jump(plan, onward, when, state, behind, at.s)
    onward = onward._replace(direction=direction, contact=contact)
    if contact is not None:
        arrival = _as_arrival(plan, behind, onward, at)
        onward = let_go(plan, arrival, when, when, (state, there.modes)).onward
    there = dataclasses.replace(
        there, direction=onward.direction, contact=onward.contact, modes=onward.modes
    )
    return there, behind


def _since(there: Lane) -> Scalar | None:
    """The time since the last impulse, where the loop has to measure it."""
    if there.shaken is None:
        return None
    assert there.record.time is not None and there.record.time.time is not None
    return there.record.time.time - there.shaken


def _timed_anew(there: Lane, at: Instant) -> Lane:
    """The lane with the time of its next impulse to be measured from here."""
    if there.shaken is None:
        return there
    assert there.record.time is not None and there.record.time.time is not None
    reading = jnp.where(at.completed, 0.0, there.record.time.time)
    return dataclasses.replace(there, shaken=jnp.where(at.reached, reading, there.shaken))


def _may_change_modes(plan: Plan) -> bool:
    """Whether a jump of velocities may put a switch into another mode: all but adhesive soft stops,
    which know a body's place alone."""
    return any(not (isinstance(x, SoftStop) and x.adhesive) for x in plan.machine.switches)


def _as_arrival(plan: Plan, state: State, onward: Onward, at: Instant) -> Arrival:
    """The state behind an impulse in the form that events are applied to; nothing is logged."""
    zero = jnp.zeros_like(at.s)
    tally = Tally(zero, None, None, None, None, None)
    place = plan.machine.position(state)
    return Arrival(at.s, state, None, place, None, onward, tally, at.completed, None)
