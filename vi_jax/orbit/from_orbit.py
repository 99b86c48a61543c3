"""The equations from event to event of an orbit that was found: of a motion in flight
(`problem_of`), or of one that rests (`resting_problem_of`)."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from math import ceil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._checks import from_host, on_host
from .._programs import compiled
from .._types import Scalar, Scalars, State
from ..flow import (
    AbstractMethod,
    Adaptive,
    EventKind,
    FixedStep,
    ImplicitSteps,
    MethodLike,
    Run,
    RunOptions,
    SmoothMachine,
    check_parts,
    chosen,
    depends_on_time,
    simulate,
    simulate_pool,
    sizes_on_host,
)
from ..machine import (
    AbstractMachine,
    Turn,
    after_event,
    begin_modes,
    check_again,
    component,
    counter_of,
    counts_turns,
    events_of,
    guard_of,
    has_contact_friction,
    in_rows,
    is_autonomous,
    jumps_on_section,
    leaf,
    modes_of,
    others_of,
    phase_at,
    raveled,
    renews,
    section_in,
    section_number,
    size_of,
    states_from_rows,
    stops_of,
    switches_of,
    with_component,
    with_leaf,
    with_modes,
    without_modes,
)
from .corrector import fewest_steps, host_program, step_error, steps_depend_on_motion
from .equations import Shooting, Unknowns
from .flight import LANDS, LEAVES, Event, Flight, guard_at, section_of
from .results import Orbit
from .tolerances import CORRECTED, LISTED, LOCATED, ROUGHLY, ROUNDING


def has_fixed_steps(method: AbstractMethod) -> bool:
    """Return whether a method takes the same steps along the same motion, without a tolerance."""
    return not method.adaptive and not np.any(np.asarray(method.wander))


def fixed_step_method(
    given: MethodLike, orbit_method: AbstractMethod, machine: AbstractMachine
) -> AbstractMethod:
    """Choose a method of fixed steps for the branch of an orbit: the given one; else that of the
    orbit, if its steps are fixed; else `ExactFlight` where it applies; else 20 steps of `Verner9` a
    cycle, with error 1e-13. For an implicit solver, equal steps. With such a solver, or if the
    motion paces its own clock, the number of steps is found by refinement (see `problem_of`)."""
    method = orbit_method if given is None else given
    if isinstance(method, Adaptive) and method.solver.implicit:
        return ImplicitSteps(method.solver, 20)
    if given is not None:
        method = chosen(machine, given)
        if not has_fixed_steps(method):
            raise ValueError(
                "Argument `method` must be of fixed steps to follow an orbit, as `FixedStep(...)`, "
                "`ExactFlight()` or a `Taylor(...)` without `rtol`, since steps sized by a "
                f"tolerance do not depend smoothly on the motion, but got {method!r}."
            )
        method.check(machine)
        return method
    if has_fixed_steps(orbit_method):
        return orbit_method
    return chosen(machine, None, FixedStep(steps_per_cycle=20))


def steps_of(
    method: AbstractMethod, machines: list[AbstractMachine], like: State, cycles: int
) -> int:
    """Return the steps of a flight over so many cycles, for the most demanding of the machines."""
    # Turning points are sought between steps: this needs more steps than the flight itself.
    fewest = (ceil(1.02 * float(fewest_steps(method, machine, like))) for machine in machines)
    return max(method.steps_per_cycle, 16, *fewest) * cycles


def longest_leg(
    places: Sequence[float] | np.ndarray, events: Sequence[Event], period: float, cycles: int
) -> int:
    """Return the number of cycles for which each leg gets steps. It is that of the longest leg,
    rounded up, plus one, since legs grow along a branch. With a chatter it is the whole period."""
    if not events or any(event.use == LANDS for event in events):
        return cycles
    longest = float(np.diff([*places, places[0] + period]).max())
    return min(cycles, ceil(longest / period * cycles) + 1)


def cycles_to_fly(problem: Shooting, x: Unknowns) -> int:
    places, _, period = problem.values(x)
    return longest_leg(places, problem.events, period, problem.cycles)


def with_parameters(
    problem: Shooting, x: Unknowns, names: tuple[str, ...], ranges: Sequence[tuple[float, float]]
) -> Shooting:
    """Put these parameters before the equations' own, with steps for all their intervals."""
    new = dataclasses.replace(problem, parameters=(*names, *problem.parameters))
    steps = steps_of(problem.method, new.corners(ranges), problem.like, cycles_to_fly(problem, x))
    return with_widths(dataclasses.replace(new, steps=max(problem.steps, steps)), ranges)


def with_widths(problem: Shooting, ranges: Sequence[tuple[float, float]]) -> Shooting:
    """Set the sizes of the parameters, half the widths of their intervals."""
    widths = from_host(np.array([0.5 * (high - low) for low, high in ranges]))
    return dataclasses.replace(problem, widths=widths)


# Steps are doubled until the end of a flight changes by less than `CORRECTED`, or up to this
# number: a choice.
_MOST = 4096

# A component of the state below the first share of its expected size at events, or below the second
# along the whole motion, gets that size. Both are choices; the second is above the remainder of a
# component that decays to zero. If all are zero to rounding, at rest, the size is 1.
_SMALL, _NOTHING = 1e-3, 1e-10


# The clock of an event, counted from the section.
Placed = tuple[float, Event]

# The machine's modes in each flight.
Modes = tuple[tuple[float, ...], ...]


def check_parameter(
    machine: AbstractMachine, name: str, value: float, interval: tuple[float, float], owner: str,
    argument: str = "bounds",
) -> None:  # fmt: skip
    """Check that an interval contains `value`, and that the machine is valid at both ends."""
    low, high = interval
    if not low <= value <= high:
        raise ValueError(
            f"Argument `{argument}` must hold the {owner}'s {name} = {value:g}, but is "
            f"({low:g}, {high:g})."
        )
    for end in interval:
        changed = with_leaf(machine, name, end)
        try:
            check_again(changed)
            check_parts(changed)
        except ValueError as error:
            raise ValueError(
                f"Argument `{argument}` must leave the machine valid, but at {name} = {end:g}: "
                f"{error}"
            ) from None


def problem_of(
    orbit: Orbit, parameter: str, bounds: tuple[float, float], method: MethodLike
) -> tuple[Shooting, np.ndarray]:
    """Return the equations of an orbit from impact to impact, and its values of the unknowns."""
    machine = orbit.machine
    stepper = fixed_step_method(method, orbit.method, machine)
    corners = [with_leaf(machine, parameter, end) for end in bounds]
    cycles = int(orbit.cycles)
    if int(np.sum(np.asarray(orbit.impact_stop) >= 0)) != int(orbit.impacts):
        raise ValueError(
            f"Argument `orbit` must list all its {int(orbit.impacts)} impacts, but lists "
            f"{len(orbit.impact_stop)}: find it with a larger `impact_log`."
        )
    found, autonomous = events_in(orbit), is_autonomous(machine, without_modes(orbit.state))
    if autonomous and depends_on_time(_ends, machine, without_modes(orbit.state)):
        raise ValueError(
            "Argument `orbit` must not have cycles that end at a given time: leave out "
            "`ends_cycle` if it happens at `t - cycle`, or make the clock a component of the state."
        )
    period = float(orbit.duration) if autonomous else float(machine.cycle) * cycles
    return equations_along(
        machine, stepper, orbit.state, found, period, cycles, corners, (parameter,)
    )


def equations_along(
    machine: AbstractMachine, method: AbstractMethod, state: State, found: list[Placed],
    period: float, cycles: int, corners: list[AbstractMachine], parameters: tuple[str, ...] = (),
) -> tuple[Shooting, np.ndarray]:  # fmt: skip
    """Return the equations from event to event of a motion that begins in `state` on the section,
    and its values of the unknowns. The steps of a flight are enough for all `corners`."""
    clocks, events = [place for place, _ in found], tuple(event for _, event in found)
    cycles_needed = longest_leg(clocks, events, period, cycles)
    like = without_modes(state)
    steps = steps_of(method, corners, like, cycles_needed)
    blank = Shooting(
        machine, method, like, cycles, (), (), steps, parameters,
        autonomous=is_autonomous(machine, like),
    )  # fmt: skip
    states, modes = _follow_events(blank, state, found, period)
    _check_instants(blank, found, states, modes)
    while steps_depend_on_motion(blank) and 2 * blank.steps <= _MOST:
        before = states
        blank = dataclasses.replace(blank, steps=2 * blank.steps)
        states, modes = _follow_events(blank, state, found, period)
        if np.max(np.abs(states - before) / _sizes(blank, states)) < CORRECTED:
            break  # keep the finer one: flights may need more steps along the branch
        blank = dataclasses.replace(blank, method=blank.method.tighter())
    problem = dataclasses.replace(blank, events=events, modes=modes)
    states = states[:-1] if found else states
    values = np.array([leaf(machine, name) for name in parameters])
    x = problem.pack(np.asarray(clocks), states, values, period)
    return with_sizes(problem, x), np.asarray(x)


def _ends(machine: AbstractMachine, s: Scalar, state: State, modes: Scalars) -> list[Scalar]:
    """Return the guards of the events that end a cycle."""
    numbers = [n for n, event in enumerate(events_of(machine)[:-1]) if event.ends_cycle]
    return [guard_of(machine, n, s, state, modes) for n in numbers]


def with_sizes(problem: Shooting, x: Unknowns, largest: np.ndarray | None = None) -> Shooting:
    """Set the sizes of the clock (a cycle is 2π) and of the components of the state."""
    _, states, period = problem.values(x)
    sizes = _sizes(problem, states)
    if largest is not None and np.isfinite(largest).all():
        sizes = _sizes(problem, largest, _NOTHING)
    radian = period / problem.cycles / (2 * np.pi)
    return dataclasses.replace(problem, sizes=from_host(np.append(radian, sizes)))


def with_grown_sizes(problem: Shooting, largest: np.ndarray) -> Shooting | None:
    """Return the equations with the sizes of a motion that has doubled, else `None`."""
    before, now = np.asarray(problem.sizes), 0.5 * np.asarray(largest)
    if not (now > 2 * before[1:]).any():
        return None
    sizes = jnp.append(before[0], np.maximum(before[1:], now))
    return dataclasses.replace(problem, sizes=sizes)


def _sizes(problem: Shooting, states: np.ndarray, small: float = _SMALL) -> np.ndarray:
    """Return half the largest modulus of each component of some states, (…, states). A component
    that is small here may be larger elsewhere. Its size is then that which its rates determine,
    else that of the largest component, at most 1."""
    maxima = np.abs(np.atleast_2d(states)).max(axis=0)
    largest = maxima.max() if maxima.max() > ROUNDING else 1.0
    if (maxima > small * largest).all():
        return 0.5 * maxima
    expected = sizes_on_host(problem.machine, problem.like, states)
    expected = np.where(expected == 1, min(largest, 1.0), expected)
    return 0.5 * np.where(maxima > small * expected, maxima, expected)


def _check_instants(
    blank: Shooting, found: list[Placed], states: np.ndarray, in_flight: Modes
) -> None:
    """Raise `ValueError` for an event that another event or the restart of the clock triggers. Its
    guard is not zero there, so the equations cannot contain it."""
    machine, previous = blank.machine, 0.0
    span = max((abs(place) for place, _ in found), default=0.0)
    for i, (place, event) in enumerate(found):
        if abs(place - previous) <= ROUNDING * span and event.cycle is None:
            state, modes = blank.unravel(states[i]), in_flight[i - 1]
            modes = tuple(jnp.asarray(mode) for mode in modes)
            before = Flight(machine, modes, blank.method, blank.like)
            guard = partial(guard_at, before, event, jnp.asarray(place))
            sizes = blank.unravel(np.abs(states).max(axis=0))
            if abs(float(guard(state))) > LOCATED * (float(size_of(guard, state, sizes)) or 1.0):
                raise ValueError(
                    f"Argument `orbit` must have no event whose guard jumps, but that of "
                    f"{event.name_on(machine)} does, with another event or as a cycle begins. "
                    "Combine simultaneous events in one, and begin cycles where no guard jumps."
                )
        previous = place


def with_finer_steps(problem: Shooting, x: Unknowns, error: float) -> Shooting | None:
    """Return the equations with the steps and the tolerance that a solution with this `step_error`
    needs; `None` if more steps change nothing or are not allowed."""
    refined = None
    while 2 * problem.steps <= _MOST:
        method, steps = problem.method.tighter(), 2 * problem.steps
        problem = dataclasses.replace(problem, method=method, steps=steps)
        before, error = error, step_error(problem, x)
        if not error < 0.5 * before:  # rounding
            break
        refined = problem
        if error < CORRECTED:
            break
    return refined


def _follow_events(
    blank: Shooting, state: State, found: list[Placed], period: float
) -> tuple[np.ndarray, Modes]:
    """Return the states just before each event and at the end of one period, and the modes."""
    machine = blank.machine
    machine_modes, state = modes_of(state), without_modes(state)
    modes = begin_modes(machine, jnp.zeros(()), state, machine_modes)
    u, s = np.concatenate([*map(np.ravel, jax.tree.leaves(state))]), 0.0
    states, in_flight = [], []
    # With clocks and steps as arguments, all flights share one program.
    shared = dataclasses.replace(blank, steps=1)
    fly = partial(_fly, shared, float(blank.steps))
    for place, event in found:
        if place > s:
            u = fly(modes, s, place, u)
        states.append(np.asarray(u))
        if (place, event.cycle) != (0.0, 0):  # the orbit's state is after that one
            u, modes = _jump(shared, event.number, float(place), u, modes)
        in_flight.append(tuple(float(m) for m in modes))
        s = place
    states.append(np.asarray(fly(modes, s, period, u)))
    if found and begins_after_jump(machine, found[0][1]):
        states[0] = states[-1]
    return np.stack(states), tuple(in_flight) or (tuple(float(m) for m in modes),)


def begins_after_jump(machine: AbstractMachine, first: Event) -> bool:
    """Return whether the state on the section differs from that before the first event there."""
    jumps = jumps_on_section(machine) or first != section_of(machine, 0)
    return first.cycle == 0 and jumps


def events_in(orbit: Orbit) -> list[Placed]:
    """Return the events of a motion in order, with their clocks since the section."""
    machine, cycles = orbit.machine, int(orbit.cycles)
    autonomous = is_autonomous(machine, without_modes(orbit.state))
    clock = np.asarray(orbit.impact_phase) - float(phase_at(machine, 0.0))
    stops = np.asarray(orbit.impact_stop)
    found = [(float(s), Event(int(i))) for s, i in zip(clock, stops, strict=True) if i >= 0]
    begins = float(machine.cycle) * np.arange(cycles)
    ends = any(stop.ends_cycle for stop in stops_of(machine))
    has_other_events = bool(switches_of(machine) or others_of(machine) or ends)
    if has_other_events or (autonomous and cycles > 1):
        begins, other_events = _listed_events(orbit)
        found = other_events if has_other_events else found
    if counts_turns(machine) and found and not renews(machine) and _repeats_each_turn(orbit):
        return found  # these may pass sections, at which nothing happens
    return with_sections(machine, without_modes(orbit.state), begins, found, cycles)


# A machine is compared with itself a turn later and at another clock: at so many angles, after this
# share of the period. Choices.
_AROUND, _LATER = 7, 0.37


def _repeats_each_turn(orbit: Orbit) -> bool:
    """Return whether a machine with turns is the same a turn earlier and later, at any time."""
    angles = np.linspace(0.0, 2 * np.pi, _AROUND, endpoint=False)
    turns = 2 * np.pi * np.array([0.0, -1.0, 1.0, 0.0])[:, None]
    clocks = np.array([0.0, 0.0, 0.0, _LATER * float(orbit.duration)])[:, None]
    machine, state = orbit.machine, without_modes(orbit.state)
    values = _rates_at(machine, state, modes_of(orbit.state), clocks, angles + turns)
    here, *others = np.asarray(values)
    return bool((np.abs(others - here) <= ROUGHLY * np.abs(here).max(axis=0)).all())


@compiled
def _rates_at(machine: AbstractMachine, state: State, given: Any, clocks: Any, angles: Any) -> Any:
    """Return rates and guards of a machine at these clocks and angles beyond the state's."""
    turn = counter_of(machine)
    assert isinstance(turn, Turn)

    def at(s, angle):
        turned = with_component(turn.name, state, component(turn.name, state) + angle)
        modes = begin_modes(machine, s, turned, given)
        rates = SmoothMachine(machine, modes, ()).field(s, turned)
        guards = [guard_of(machine, n, s, turned, modes) for n in range(section_number(machine))]
        return jnp.stack([*raveled(rates)[0], *guards])

    return jnp.vectorize(at, signature="(),()->(n)")(clocks, angles)


def _listed_events(orbit: Orbit) -> tuple[np.ndarray, list[Placed]]:
    """Simulate a motion; return the begins of its cycles, and its impacts, switches and jumps."""
    cycles = int(orbit.cycles)
    run = simulate(orbit.machine, orbit.state, cycles, method=orbit.method, event_log=LISTED + 1)
    return placed_events(orbit.machine, run, "orbit")


def placed_events(
    machine: AbstractMachine, run: Run, argument: str
) -> tuple[np.ndarray, list[Placed]]:
    """Return the begins of a run's cycles, and its impacts, switches and jumps."""
    assert run.event_log is not None
    if (np.asarray(run.event_log.kind)[:, LISTED:] >= 0).any():
        raise ValueError(
            f"Argument `{argument}` must have at most {LISTED} events in a cycle, but has more."
        )
    begins = _cycle_begins(run, machine, is_autonomous(machine, without_modes(run.last)))
    found, events = [], events_of(machine)
    for n, s, kind, i in logged_events(machine, run):
        if kind in (EventKind.rest, EventKind.release):
            continue
        if events[i].ends_cycle:
            later = (n + 1) % (len(begins) - 1)
            found.append((float(begins[later]), Event(i, later)))
        else:
            found.append((float(begins[n] + s), Event(i)))
    return begins, found


def with_sections(
    machine: AbstractMachine, like: State, begins: np.ndarray, found: list[Placed], cycles: int
) -> list[Placed]:
    """Return events in order, with the sections if they change the state or the clock."""
    if section_in(machine, like) is not None or renews(machine):
        found = found + [(float(begins[n]), section_of(machine, n)) for n in range(cycles)]
    # An event that coincides with a section belongs to the cycle that ends there.
    return sorted(found, key=lambda f: (f[0], f[1].cycle is not None))


def logged_events(machine: AbstractMachine, run: Run) -> list[tuple[int, float, int, int]]:
    """Return the cycle, its clock, the `EventKind` and the number of each event of a run."""
    assert run.event_log is not None
    kind, number, clock = (
        np.asarray(a) for a in (run.event_log.kind, run.event_log.number, run.event_log.phase)
    )
    number = event_numbers(machine, kind, number)
    places = zip(*np.nonzero(kind >= 0), strict=True)
    return [(int(n), float(clock[n, j]), int(kind[n, j]), int(number[n, j])) for n, j in places]


def event_numbers(machine: AbstractMachine, kind: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Return the numbers among all events of the machine of those in an `EventLog`."""
    stops, switches = len(stops_of(machine)), len(switches_of(machine))
    others = [kind == EventKind.mode, kind == EventKind.reset]
    return number + np.select(others, [stops, stops + switches], 0)


@host_program
def _fly(blank: Shooting, steps, modes, s0, s1, u):
    return Flight(blank.machine, modes, blank.method, blank.like).fly(s0, s1, u, steps)[0]


@host_program
def _jump(blank: Shooting, number: int, s, u, modes):
    after, modes = after_event(blank.machine, number, s, blank.unravel(u), modes)
    return ravel_pytree(after)[0], modes


# Most events of a cycle that are logged, and of a period that are followed: choices.
_LOGGED, _FOLLOWED = 512, 64

# The state before an event is taken earlier by this share of a cycle: a choice, far above rounding
# and within the reach of the corrector.
_EARLIER = 1e-7

# A hop longer than a fifth of a cycle, the longest step of a simulation, is not part of a chatter.
_SHORT = 5

ADVICE = "Find such motions value by value: `find_orbit` with another parameter, from this motion."


def resting_problem_of(
    orbit: Orbit, parameter: str, bounds: tuple[float, float], method: MethodLike
) -> tuple[Shooting, np.ndarray]:
    """Return the equations of a motion that rests on stops, and its values of the unknowns. Bodies
    must chatter one at a time, and no switch may change with their hops."""
    machine, state, cycles = orbit.machine, without_modes(orbit.state), int(orbit.cycles)
    stepper = fixed_step_method(method, orbit.method, machine)
    autonomous = is_autonomous(machine, state)
    is_supported = not autonomous or (counts_turns(machine) and _repeats_each_turn(orbit))
    if not is_supported or renews(machine) or has_contact_friction(machine):
        raise ValueError(
            f"Argument `orbit` rests on a stop of a {type(machine).__name__}, which has `renewed`, "
            "friction on a stop or cycles that another event than a turn ends, and cannot be "
            f"followed. {ADVICE}"
        )
    run = simulate(machine, orbit.state, cycles, method=orbit.method, event_log=_LOGGED, rests=True)
    begins = _cycle_begins(run, machine, autonomous)
    log = [(begins[n] + s, kind, number) for n, s, kind, number in logged_events(machine, run)]
    events = _grouped(log, begins[-1] / cycles, begins[-1])
    if autonomous and events == []:
        events = [(float(begins[n]), section_of(machine, n)) for n in range(cycles)]
    if events is not None and len(events) > _FOLLOWED:
        raise ValueError(
            f"Argument `orbit` has {len(events)} events in a period, without the hops of its "
            f"chatters. A branch of motions that rest follows at most {_FOLLOWED}."
        )
    if events is None:
        raise ValueError(
            "Argument `orbit` must come to rest on its stops after chatters of one body at a time, "
            "in whose last hops no switch changes, but several bodies chatter together or a switch "
            f"changes. {ADVICE}"
        )
    corners = [with_leaf(machine, parameter, end) for end in bounds]
    order, steps = tuple(event for _, event in events), steps_of(stepper, corners, state, cycles)
    problem = Shooting(
        machine, stepper, state, cycles, order, ((),) * max(1, len(events)), steps, (parameter,),
        held=_contact(machine, state, order), autonomous=autonomous,
    )  # fmt: skip
    clock = np.array([place for place, _ in events])
    earlier = _EARLIER * begins[-1] / cycles
    rows = _states_at(problem, orbit, run, clock - earlier, begins)
    modes = _modes_in_legs(problem, orbit.state, clock, (rows, earlier), begins[-1])
    problem = dataclasses.replace(problem, modes=modes)
    rows = rows if events else np.asarray(raveled(orbit.state)[0])
    x = problem.pack(clock, rows, [leaf(machine, parameter)], begins[-1])
    problem = with_sizes(problem, x)
    error = step_error(problem, x) if steps_depend_on_motion(problem) else 0.0
    if error > 10 * CORRECTED:
        problem = with_finer_steps(problem, x, error) or problem
    return problem, x


def _cycle_begins(run: Run, machine: AbstractMachine, autonomous: bool) -> np.ndarray:
    """Return the clocks at which the cycles of a run begin, and that at its end."""
    n = len(np.asarray(run.impacts))
    if not autonomous:
        return float(machine.cycle) * np.arange(n + 1)
    assert run.duration is not None
    return np.concatenate([[0.0], np.cumsum(np.asarray(run.duration))])


def _states_at(
    problem: Shooting, orbit: Orbit, run: Run, clocks: np.ndarray, begins: np.ndarray
) -> np.ndarray:
    """Return the states of a motion at some clocks since its section, (clocks, states)."""
    sections, found = in_rows(on_host(orbit.sections), 1), []
    for clock in clocks % begins[-1]:
        n = int(np.searchsorted(begins, clock, side="right")) - 1
        row, modes = jnp.asarray(sections[n]), tuple(mode[n] for mode in run.modes)
        place = jnp.asarray(clock - begins[n])
        u = np.asarray(
            _state_at(orbit.machine, orbit.method, without_modes(orbit.state), row, modes, place)
        )
        if problem.omits_sections:
            u = problem.within_turn(n, u)
        found.append(u)
    return np.reshape(found, (len(clocks), sections.shape[1]))


@compiled
def _state_at(machine, method, like, row, modes, clock):
    unravel = ravel_pytree(like)[1]
    options = RunOptions(method=method, record="sections", rests=True)
    if counts_turns(machine):
        machine = machine.observed_every(clock)
    else:
        options = dataclasses.replace(options, until=clock)
    start = lambda u: (machine, with_modes(unravel(u), modes))
    return in_rows(simulate_pool(start, row[None], 1, options).sections, 2)[0, -1]


def _modes_in_legs(
    problem: Shooting, state: Any, clocks: np.ndarray, before: tuple[np.ndarray, float],
    period: float,
) -> Modes:  # fmt: skip
    """Return the machine's modes in each leg, from the first state, and the states this time
    `before` each event."""
    machine, start, (rows, earlier) = problem.machine, jnp.zeros(()), before
    modes = begin_modes(machine, start, without_modes(state), modes_of(state))
    found = [modes] * problem.legs
    first = int(np.searchsorted(clocks, period))
    for i in [*range(first, len(clocks)), *range(first)]:
        event, at_event = problem.events[i], problem.unravel(rows[i])
        if event.use != LEAVES:
            s, contact = jnp.asarray(clocks[i]), problem.flight(machine, i - 1).contact
            # A force that releases a body is not too large before.
            rate = SmoothMachine(machine, modes, contact).field(s, at_event)
            at_event = jax.tree.map(lambda x, v: x + earlier * v, at_event, rate)
            modes = after_event(machine, event.number, s, at_event, modes, contact)[1]
        found[i] = modes
    return tuple(tuple(float(mode) for mode in modes) for modes in found)


def _contact(machine: AbstractMachine, state: Any, events: tuple[Event, ...]) -> tuple[float, ...]:
    """Return, per coordinate, 1 + i if it always rests on stop number i, else 0."""
    contact, stops = [0.0] * len(machine.coordinates), stops_of(machine)
    moves = {stops[event.number].coordinate for event in events if event.use}
    row = in_rows(on_host(state), 0)
    sizes = states_from_rows(state, sizes_on_host(machine, state, row))
    for i, stop in enumerate(stops):
        position = machine.coordinates[stop.coordinate].position
        place, unit = position(state), float(size_of(position, state, sizes))
        on_stop = abs(float(stop.beyond(place))) < ROUNDING * (unit + abs(float(place)))
        if on_stop and stop.coordinate not in moves:
            contact[stop.coordinate] = 1.0 + i
    return tuple(contact)


def _grouped(log: list[tuple[float, int, int]], cycle: float, period: float) -> list[Placed] | None:
    """Return the events of a period without the hops of its chatters, from the clock, kind and
    number of each. It begins with a release, if any. `None` if a rest has no impact before it."""
    for number in {n for *_, n in log}:
        # A body released on the section itself begins the motion as one in flight.
        kinds = [kind for _, kind, n in log if n == number]
        rests = [kind for kind in kinds if kind != EventKind.impact]
        lands = kinds[0] == EventKind.impact and bool(rests)
        if lands and rests[0] == rests[-1] == EventKind.rest:
            log = [(0.0, int(EventKind.release), number), *log]
    first = next((i for i, (_, kind, _) in enumerate(log) if kind == EventKind.release), None)
    if first is None:
        rests = any(kind == EventKind.rest for _, kind, _ in log)
        return None if rests else [(clock, Event(number)) for clock, _, number in log]
    shifted = [(clock + period, kind, number) for clock, kind, number in log[:first]]
    log, found = log[first:] + shifted, []
    first_kinds = {n: kind for _, kind, n in reversed(log) if kind != EventKind.impact}
    resting = {n for n, kind in first_kinds.items() if kind == EventKind.release}
    for clock, kind, number in log:
        if kind not in (EventKind.rest, EventKind.release):
            found.append((clock, Event(number)))
        elif kind == EventKind.release:
            found.append((clock, Event(number, use=LEAVES)))
            resting.discard(number)
        elif number not in resting:  # else it begins on its stop at the section
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
