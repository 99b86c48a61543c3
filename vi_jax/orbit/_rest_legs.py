"""The equations of a motion that rests, from event to event, made from one that was found."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._programs import compiled
from ..flow import EventKind, MethodLike, Run, RunOptions, simulate, simulate_pool
from ..machine import (
    AbstractMachine,
    after_event,
    bare,
    begin_modes,
    in_rows,
    is_autonomous,
    leaf,
    modes_of,
    raveled,
    renews,
    rubs,
    stops_of,
    with_leaf,
    with_modes,
)
from ._corrector import off_by
from ._flight import LANDS, LEAVES, Event
from ._problem import (
    COARSE,
    finer,
    fixed_step_method,
    logged_events,
    sized,
    sized_by_motion,
    steps_of,
)
from ._shooting import Shooting
from .distinct import unit_of
from .results import Orbit

# Events of a cycle that are looked at, and of a period that are followed: choices.
_LOGGED, _MOST = 512, 24

# The state before an event is taken so much earlier (as a share of a cycle): a choice, far above
# rounding, within what is corrected.
_EARLIER = 1e-7

# A hop longer than a fifth of a cycle, the longest step of a simulation, is no part of a chatter.
_SHORT = 5

_INSTEAD = (
    "Find such motions value by value: `find_orbit` with another parameter, from this motion."
)

# A body this close to its stop (relative to the motion, see `distance`) is on it: a choice.
_ON = 1e-9

Placed = tuple[float, Event]


def legs_of(
    orbit: Orbit, parameter: str, bounds: tuple[float, float], method: MethodLike
) -> tuple[Shooting, np.ndarray]:
    """The equations of a motion that rests on stops, and the unknowns that it gives.

    **Arguments:** as `problem_of`.

    **Raises:** `ValueError` of a machine with friction on a stop, or whose cycles an event ends or
    begin anew; where bodies chatter together, or a switch changes with each hop.
    """
    machine, state, cycles = orbit.machine, bare(orbit.state), int(orbit.cycles)
    flying = fixed_step_method(method, orbit.method, machine)
    if is_autonomous(machine, state) or renews(machine) or rubs(machine):
        raise ValueError(
            f"Argument `orbit` rests on a stop of a {type(machine).__name__}, which has a section, "
            f"`renewed` or friction on a stop, so that it cannot be followed. {_INSTEAD}"
        )
    run = simulate(machine, orbit.state, cycles, method=orbit.method, event_log=_LOGGED, rests=True)
    cycle = float(machine.cycle)
    log = [(n * cycle + s, kind, number) for n, s, kind, number in logged_events(machine, run)]
    events = _grouped(log, cycle, cycle * cycles)
    if events is None or len(events) > _MOST:
        raise ValueError(
            "Argument `orbit` must come to rest on its stops after chatters of one body at a time, "
            "in whose last hops no switch changes, but several bodies chatter together or a switch "
            f"changes. {_INSTEAD}"
        )
    corners = [with_leaf(machine, parameter, end) for end in bounds]
    problem = Shooting(
        machine, flying, state, cycles, tuple(event for _, event in events),
        ((),) * max(1, len(events)), steps_of(flying, corners, state, cycles), (parameter,),
    )  # fmt: skip
    problem = dataclasses.replace(problem, held=_contact(machine, state, problem.events))
    clock = np.array([place for place, _ in events])
    rows = _before(orbit, run, clock - _EARLIER * cycle)
    problem = dataclasses.replace(problem, modes=_modes(problem, orbit.state, clock, rows))
    rows = rows if events else np.asarray(raveled(orbit.state)[0])
    x = np.asarray(problem.pack(clock, rows, [leaf(machine, parameter)]))
    problem = sized(problem, x)
    off = off_by(problem, x) if sized_by_motion(problem) else 0.0
    if off > COARSE:
        problem = finer(problem, x, off) or problem
    return problem, x


def _before(orbit: Orbit, run: Run, clocks: np.ndarray) -> np.ndarray:
    """The states of a motion at some clocks since its section, (clocks, states)."""
    cycle, found = float(orbit.machine.cycle), []
    sections = np.asarray(in_rows(orbit.sections, 1))
    for clock in clocks:
        whole = int(np.floor(clock / cycle))
        n = whole % len(sections)
        row, own = jnp.asarray(sections[n]), tuple(mode[n] for mode in run.modes)
        place = jnp.asarray(clock - whole * cycle)
        found.append(_state_at(orbit.machine, orbit.method, bare(orbit.state), row, own, place))
    return np.reshape(found, (len(clocks), sections.shape[1]))


@compiled
def _state_at(machine, method, like, row, own, clock):
    """The state at a clock within the cycle that begins in the state of a row, in these modes of
    the machine's own."""
    unravel = ravel_pytree(like)[1]
    options = RunOptions(method=method, record="sections", rests=True, until=clock)
    start = lambda u: (machine, with_modes(unravel(u), own))
    return in_rows(simulate_pool(start, row[None], 1, options).sections, 2)[0, -1]


def _modes(
    problem: Shooting, state: Any, clocks: np.ndarray, rows: np.ndarray
) -> tuple[tuple[float, ...], ...]:
    """The machine's modes in each leg.

    **Arguments:** the equations; the state on the section; clock and state of each event.
    """
    machine, start = problem.machine, jnp.zeros(())
    modes = begin_modes(machine, start, bare(state), modes_of(state))
    found = [modes] * problem.legs
    first = int(np.searchsorted(clocks, float(problem.cycles * machine.cycle)))
    for i in [*range(first, len(clocks)), *range(first)]:
        event, before = problem.events[i], problem.unravel(jnp.asarray(rows[i]))
        if event.use != LEAVES:
            s, contact = jnp.asarray(clocks[i]), problem.flight(machine, i - 1).contact
            modes = after_event(machine, event.number, s, before, modes, contact)[1]
        found[i] = modes
    return tuple(tuple(float(mode) for mode in modes) for modes in found)


def _contact(machine: AbstractMachine, state: Any, events: tuple[Event, ...]) -> tuple[float, ...]:
    """Of each coordinate, 1 + i if it is on stop number i without landing or leaving, else 0."""
    contact, stops = [0.0] * len(machine.coordinates), stops_of(machine)
    moves = {stops[event.number].coordinate for event in events if event.use}
    unit = float(unit_of(ravel_pytree(state)[0]))
    for i, stop in enumerate(stops):
        place = machine.coordinates[stop.coordinate].position(state)
        on = abs(float(stop.beyond(place))) < _ON * (unit + abs(float(place)))
        if on and stop.coordinate not in moves:
            contact[stop.coordinate] = 1.0 + i
    return tuple(contact)


def _grouped(log: list[tuple[float, int, int]], cycle: float, period: float) -> list[Placed] | None:
    """The events of a period that begins with a release, if there is one, without the hops of its
    chatters; `None` where a rest has no impact before it.

    **Arguments:** clock since the section, kind and number of each event; the length of a cycle,
    and of the period.
    """
    for number in {n for *_, n in log}:
        # A body that its stop lets go of on the section itself begins the motion as one in flight.
        kinds = [kind for _, kind, n in log if n == number]
        rests = [kind for kind in kinds if kind != EventKind.impact]
        lands = kinds[0] == EventKind.impact and bool(rests)
        if lands and rests[0] == rests[-1] == EventKind.rest:
            log = [(0.0, int(EventKind.release), number), *log]
    first = next((i for i, (_, kind, _) in enumerate(log) if kind == EventKind.release), None)
    if first is None:
        rests = any(kind == EventKind.rest for _, kind, _ in log)
        return None if rests else [(clock, Event(number)) for clock, _, number in log]
    later = [(clock + period, kind, number) for clock, kind, number in log[:first]]
    log, found = log[first:] + later, []
    resting = {number for number in {n for *_, n in log} if _is_held(log, number)}
    for clock, kind, number in log:
        if kind not in (EventKind.rest, EventKind.release):
            found.append((clock, Event(number)))
        elif kind == EventKind.release:
            found.append((clock, Event(number, use=LEAVES)))
            resting.discard(number)
        elif number not in resting:  # else it begins on its stop in the section
            resting.add(number)
            begin = len(found)
            while begin and found[begin - 1][1] == Event(number):
                if begin < len(found) and found[begin][0] - found[begin - 1][0] > cycle / _SHORT:
                    break
                begin -= 1
            if begin == len(found):
                return None
            found[begin:] = [(found[begin][0], Event(number, use=LANDS))]
    return found


def _is_held(log: list[tuple[float, int, int]], number: int) -> bool:
    """Whether a body rests on a stop before the first of some events."""
    kinds = [kind for _, kind, n in log if n == number and kind != EventKind.impact]
    return bool(kinds) and kinds[0] == EventKind.release
