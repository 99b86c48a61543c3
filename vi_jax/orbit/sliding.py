"""Sliding bifurcations: a motion gains or loses a part in which a body sticks, or slides along the
surface of a switch.

Such a part begins where the motion reaches the surface while the fields of both sides point at it,
and ends where one of them turns away. The modes before, in and after a brief part distinguish four
kinds (di Bernardo, Budd, Champneys and Kowalczyk, Piecewise-smooth Dynamical Systems, 2008, chapter
8).

These points are located on the motion without the vanishing part. Close to them the equations with
the part have a second solution, in which both events that bound the part coincide, and a corrector
may find either. The equations without the part are regular: the condition is a touch, or a guard
that vanishes at an event.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._types import Scalar, State
from ..flow import Rates, guard_rates
from ..machine import (
    AbstractEvent,
    AbstractMachine,
    DryFriction,
    after_event,
    guard_of,
    mode_number,
)
from .corrector import Step, host_program, observe, state_at
from .edit_events import without_events
from .equations import Leg, Shooting
from .flight import Event, Flight
from .kinds import ADDING_SLIDING, CROSSING_SLIDING, GRAZING_SLIDING, SWITCHING_SLIDING
from .locate import find_zero_near
from .tolerances import FAINT, LOCATED, NEARBY, ROUGHLY


class Change(NamedTuple):
    """A part of a motion that vanishes or appears at a special point."""

    number: int
    """The number of the switch."""
    clock: float
    modes: tuple[float, float, float]
    """Modes of the switch before, in and after that part."""
    exists: bool
    """True if the motion has that part on this side."""

    @property
    def kind(self) -> str | None:
        before, brief, after = self.modes
        if brief == 0 and before and after:
            return GRAZING_SLIDING if before == after else CROSSING_SLIDING
        if brief and before == after == 0:
            return ADDING_SLIDING
        return SWITCHING_SLIDING if before and brief == -before and after == 0 else None


def holds(event: AbstractEvent) -> bool:
    """Return whether a switch has a mode (0) in which the motion stays on its surface."""
    return event.holds_mode and (isinstance(event, DryFriction) or getattr(event, "blends", False))


def change_at(problem: Shooting, at: Step) -> Change | None:
    """Return the change of sticking or sliding at a special point; `None` if of no kind."""
    if not problem.modes[0]:
        return None
    found = (
        vanishing_part(problem, at, FAINT)
        or _touching_part(problem, at)
        or change_at_event(problem, at)
        or vanishing_part(problem, at, NEARBY)  # a corrector may not get closer
    )
    return found if found is not None and found.kind is not None else None


def _mode(problem: Shooting, leg: int, number: int) -> float:
    return float(problem.modes[leg % problem.legs][mode_number(problem.machine, number)])


def vanishing_part(problem: Shooting, at: Step, brief: float) -> Change | None:
    """Return the briefest part between two events of one switch, if shorter than this share."""
    (clock, _, period), lengths = problem.values(at.x), problem.lengths(at.x)
    events, found = problem.events, []
    for i, event in enumerate(events):
        if event != events[(i + 1) % len(events)] or not holds(event.of(problem.machine)):
            continue
        before, within, after = (_mode(problem, leg, event.number) for leg in (i - 1, i, i + 1))
        modes = before, within, after
        found.append((lengths[i], Change(event.number, float(clock[i]), modes, True)))
    length, change = min(found, key=lambda f: f[0], default=(np.inf, None))
    return change if length < brief * period else None


def _touching_part(problem: Shooting, at: Step) -> Change | None:
    """Return a flight's touch of a switch's surface, or a body at the limit of being held."""
    nearest, number = at.observed.nearest, int(at.observed.nearest.event)
    if not holds(Event(number).of(problem.machine)):
        return None
    leg, place = map(float, problem.leg_at(at.x, float(nearest.clock)))
    leg, mode = int(leg), _mode(problem, int(leg), number)
    if abs(float(nearest.margin)) > LOCATED * nearest.unit:
        return None
    excess, _, next_mode = excess_force(problem, at, leg, number, place)
    if not mode:  # to rounding it may still be held there
        return Change(number, place, (0.0, next_mode or 1.0, 0.0), False)
    # A surface holds a motion that touches it only if the field of the other side points to it.
    return Change(number, place, (mode, 0.0, mode), False) if excess < LOCATED else None


def change_at_event(problem: Shooting, at: Step) -> Change | None:
    """Return an event of a switch at the limit of being held there."""
    clock, found = problem.values(at.x)[0], []
    for i, event in enumerate(problem.events):
        if not holds(event.of(problem.machine)):
            continue
        before, after = (_mode(problem, leg, event.number) for leg in (i - 1, i))
        if before:
            excess, rate, _ = excess_force(problem, at, i, event.number, float(clock[i]))
            found.append((abs(excess), rate, event.number, float(clock[i]), before, after))
    if not found:
        return None
    share, rate, number, place, before, after = min(found)
    if share > LOCATED:
        return None
    if rate > 0:  # at the limit of release
        return Change(number, place, (before, 0.0, after or -before), False)
    return Change(number, place, (before, -before, 0.0), after != 0)


def excess_rates(
    problem: Shooting, machine: AbstractMachine, leg: Leg, number: int, s: Scalar, state: State
) -> Rates:
    """Return how far the driving force of a switch exceeds the holding force, with its rates."""
    held = _held(problem, machine, leg, number)

    def guard(s, state):
        return guard_of(machine, number, s, state, held.modes, held.contact)

    return guard_rates(held.smooth.field, guard, s, state)


def _held(problem: Shooting, machine: AbstractMachine, leg: Leg, number: int) -> Flight:
    """Return the flight of a leg with a switch that holds the motion on its surface."""
    j, modes = mode_number(machine, number), problem.modes_in(leg)
    modes = (*modes[:j], jnp.zeros_like(modes[j]), *modes[j + 1 :])
    contact = problem.flight(machine, leg).contact
    return Flight(machine, modes, problem.method, problem.like, contact)


@host_program
def _excess_at(problem: Shooting, x, leg, number: int, s, at_event: bool):
    machine, states = problem.at(x), problem.parts(x)[1]
    # At an event the state just before it; otherwise the leg is integrated.
    state = problem.unravel(states[leg]) if at_event else problem.state_at(x, leg, s)
    excess, modes = excess_rates(problem, machine, leg, number, s, state), problem.modes_in(leg)
    held, u = _held(problem, machine, leg, number), ravel_pytree(state)[0]
    size = problem.guard_sizes(held, jnp.asarray(s, u.dtype), u)[number]
    new = after_event(machine, number, s, state, modes, held.contact)[1]
    return excess.x / size, excess.v / size, new[mode_number(machine, number)]


def excess_force(
    problem: Shooting, at: Step, leg: int, number: int, s: float
) -> tuple[float, float, float]:
    """Return the excess force off a switch's surface and its rate, as shares of the size of such a
    force, and the switch's next mode."""
    at_event = bool(s == problem.values(at.x)[0][leg])
    excess, rate, mode = _excess_at(problem, at.x, np.asarray(leg), number, s, at_event)
    return float(excess), float(rate), float(mode)


def locate_change(problem: Shooting, at: Step, change: Change) -> Step:
    clock = problem.values(at.x)[0]
    is_close = abs(float(at.observed.order_margin)) < ROUGHLY * problem.radian
    if not change.exists or problem.conditions or is_close:
        return at
    first = int(np.argmin(np.abs(clock - change.clock)))
    if first + 1 == problem.legs:  # the part contains the begin of the period
        return at
    new, x, event = without_part(problem, at, change)

    def test(step: Step) -> float:
        if event is None:
            return float(step.observed.nearest.margin)
        place = float(new.values(step.x)[0][event])
        return excess_force(new, step, event, change.number, place)[0]

    found = find_zero_near(new, x, test)
    return at if found is None else _with_part(problem, at, new, found, first, event is None)


def without_part(
    problem: Shooting, at: Step, change: Change
) -> tuple[Shooting, np.ndarray, int | None]:
    """Return the equations and unknowns of a motion without the vanishing part, and its event at
    which the switch is at the limit of being held; `None` if its surface is touched."""
    first = int(np.argmin(np.abs(problem.values(at.x)[0] - change.clock)))
    same_mode = change.modes[0] == change.modes[2]
    if not change.exists:
        return problem, np.asarray(at.x), None if same_mode else first
    both = [first, (first + 1) % problem.legs]
    new, x = without_events(problem, np.asarray(at.x), both if same_mode else [first])
    return new, x, None if same_mode else first % new.legs


def _with_part(
    problem: Shooting, at: Step, new: Shooting, step: Step, first: int, same_mode: bool
) -> Step:
    """Insert a part of no length, from event `first` on, into the solution `step` of `new` without
    it. `same_mode` is true if both events of the part were left out."""
    clock, states, period = new.values(step.x)
    if not new.events:
        clock, states = np.zeros(0), np.zeros((0, problem.states))
    if same_mode:
        place, before = float(step.observed.nearest.clock), problem.values(at.x)[0][first]
        place = place + period * np.round((before - place) / period)
        state = state_at(new, step.x, np.asarray(max(0, first - 1)), place)
        extra = np.stack([state] * 2)
    else:
        place, extra = clock[first], states[first][None]
    clock = np.insert(clock, first, [place] * len(extra))
    states = np.insert(states, [first] * len(extra), extra, axis=0)
    x = problem.pack(clock, states, step.x, period)
    return at._replace(x=x, observed=observe(problem, x))
