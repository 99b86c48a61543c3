"""The equations of a motion without some of its events, or over another number of its cycles.

The second half of a motion may equal the first, or its image under the machine's symmetry. A branch
may begin at a motion of half its period (`locate_origin`).
"""

import dataclasses
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from .._checks import on_host
from ..machine import AbstractMachine, in_rows, nearest_images, stops_of
from .corrector import Step, advance, host_program, observe, sections_at, state_at, tangent_at
from .equations import Shooting
from .flight import Event, section_of
from .locate import find_zero_near
from .tolerances import ROUNDING, SAME


def may_be_symmetric(problem: Shooting, machines: Iterable[AbstractMachine]) -> bool:
    """Return whether a motion with these events can be its own image, on each of these machines.

    A driven machine is its own image after half a drive cycle, so the number of cycles must be odd.
    """
    events, half = problem.events, len(problem.events) // 2
    if problem.cycles % 2 == 0 or len(events) % 2:
        return False
    if any(machine.mirrored(problem.like) is None for machine in machines):
        return False
    pairs = zip(events[:half], events[half:], strict=True)
    return all(_are_images(problem.machine, first, second) for first, second in pairs)


def _are_images(machine: AbstractMachine, first: Event, second: Event) -> bool:
    stops = stops_of(machine)
    if first.use != second.use:
        return False
    if max(first.number, second.number) < len(stops):  # stops come first among the events
        left, right = stops[first.number], stops[second.number]
        return left.coordinate == right.coordinate and left.sign == -right.sign
    return first.of(machine).holds_mode and second.of(machine).holds_mode


def repeats_from(problem: Shooting, first: int) -> bool:
    """Return whether the events and modes of a motion are the same from another event on, with
    cycles counted from there."""
    events = problem.events[first:] + problem.events[:first]
    modes = problem.modes[first:] + problem.modes[:first]
    begin, cycle = (
        next((event.cycle for event in row if event.cycle is not None), 0)
        for row in (problem.events, events)
    )
    events = (
        e if e.cycle is None else e._replace(cycle=(e.cycle - cycle + begin) % problem.cycles)
        for e in events
    )
    return (tuple(events), modes) == (problem.events, problem.modes)


def may_repeat(problem: Shooting) -> bool:
    """Return whether the second half of a period with these events can equal the first."""
    half, odd = divmod(len(problem.events), 2)
    return problem.cycles % 2 == 0 and not odd and repeats_from(problem, half)


@host_program
def _differences(
    problem: Shooting, x: Float[Array, " unknowns"], mirrored: bool
) -> Float[Array, " differences"]:
    """Return the difference of the second half of a period from the first, or from its image. It
    is smooth along a branch, as the events of both halves are compared."""
    half, half_period = len(problem.events) // 2, 0.5 * problem.period(x)

    def image(u):
        if not mirrored:
            return u
        return ravel_pytree(problem.machine.mirrored(problem.unravel(u)))[0]

    clock, states = problem.parts(x)
    if not half:
        return ravel_pytree(problem.state_at(x, 0, half_period))[0] - image(states[0])
    delays, images = clock[half:] - clock[:half] - half_period, jax.vmap(image)(states[:half])
    differences = nearest_images(problem.angles, states[half:], images) - images
    return jnp.concatenate([delays, differences.ravel()])


def half_difference(problem: Shooting, step: Step, *, mirrored: bool = False) -> np.ndarray:
    """Return the difference of the period's halves, or from the image, in the unknowns' sizes."""
    return _differences(problem, step.x, mirrored) / problem.half_scale()


def over_periods(old: Shooting, n: int) -> Shooting:
    events = tuple(event.shifted(i * old.cycles) for i in range(n) for event in old.events)
    # With events, `steps` counts those of one leg, which stays as long. Each hop of a chatter takes
    # a part of `steps / cycles`, so that with chatters the steps grow with the cycles.
    steps = old.steps if events and not old.landings else n * old.steps
    return dataclasses.replace(
        old, cycles=n * old.cycles, events=events, modes=old.modes * (n if events else 1),
        steps=steps,
    )  # fmt: skip


def repeated(problem: Shooting, x: np.ndarray | Array, new: Shooting) -> np.ndarray:
    (clock, states, period), n = problem.values(x), new.cycles // problem.cycles
    if problem.events:
        clock = (clock + period * np.arange(n)[:, None]).ravel()
        states = np.tile(states, (n, 1))
    return new.pack(clock, states, x, n * period)


def locate_origin(problem: Shooting, at: Step) -> tuple[Step, Shooting, Step]:
    """Return the point where a branch begins, and the equations of the motion of half the period
    with their solution, on which the point is located.

    Both branches cross there, so the equations of this one are singular close by. The mean of both
    halves is a motion of half the period up to a term of second order.
    """
    legs, (clock, states, period) = len(problem.events) // 2, problem.values(at.x)
    half_period = period / 2
    half = dataclasses.replace(
        problem, cycles=problem.cycles // 2, events=problem.events[:legs],
        modes=problem.modes[: max(1, legs)],
        steps=problem.steps if legs else problem.steps // 2,
    )  # fmt: skip
    if legs:
        clock = 0.5 * (clock[:legs] + clock[legs:] - half_period)
        first = states[:legs]
        states = 0.5 * (first + nearest_images(problem.angles, states[legs:], first))
    else:
        states = states + 0.5 * half_difference(problem, at) * problem.half_scale()
    mean = half.pack(clock, states, at.x, half_period)

    def doubling(step: Step) -> float:
        return float(np.linalg.det(step.observed.monodromy + np.eye(problem.states)))

    found = find_zero_near(half, mean, doubling)
    if found is None:
        return at, half, advance(half, mean, np.eye(mean.size)[-1], 0.0)
    x = repeated(half, found.x, problem)
    return at._replace(x=x, size=found.size, observed=observe(problem, x)), half, found


def admissible_near(problem: Shooting, x: np.ndarray, distance: float) -> Step | None:
    """Return the admissible motion at a distance from a solution, on either side, or `None`."""
    tangent = tangent_at(problem, x)
    for sense in (1.0, -1.0):
        found = advance(problem, x, sense * tangent, distance)
        data = found.observed
        inside = min(data.nearest.margin, data.pull.margin, *data.approach) > 0
        slack = ROUNDING * problem.radian
        if bool(found.good) and inside and min(data.modes_agree, data.order_margin + slack) > 0:
            return found
    return None


def with_sections(old: Shooting, x: np.ndarray) -> tuple[Shooting, np.ndarray]:
    """Return the equations of a motion with its sections among the events, and their unknowns."""
    if not old.omits_sections:
        return old, x
    (clock, states, period), (section_states, sections, _) = old.values(x), sections_at(old, x)
    ends = old.within_turn(1, in_rows(on_host(section_states)))
    states, (legs, section_clock) = old.within_turn(0, states), map(np.asarray, sections)
    clock = np.mod(np.concatenate([section_clock, clock]) - section_clock[0], period)
    clock[0], order = 0.0, np.argsort(clock, kind="stable")
    events = (*(section_of(old.machine, i) for i in range(old.cycles)), *old.events)
    modes = (*(old.modes[leg] for leg in legs), *old.modes)
    new = dataclasses.replace(
        old, events=tuple(events[i] for i in order), modes=tuple(modes[i] for i in order)
    )
    return new, new.pack(clock[order], np.concatenate([ends, states])[order], x, period)


def without_events(
    old: Shooting, x: np.ndarray, which: Sequence[int]
) -> tuple[Shooting, np.ndarray]:
    """Return the equations and unknowns of a motion without events that only graze."""
    if old.omits_sections and len(which) == old.legs:
        old, x = with_sections(old, x)
        which = [i for i, event in enumerate(old.events) if event.cycle is None]
    clock, states, period = old.values(x)
    keep = [i for i in range(old.legs) if i not in which]
    if keep:
        clock, states = clock[keep], states[keep]
    else:
        clock, states = np.zeros(0), state_at(old, x, np.asarray(0), period)[None]
    modes = tuple(old.modes[i] for i in keep) or (old.modes[which[-1]],)
    new = dataclasses.replace(old, events=tuple(old.events[i] for i in keep), modes=modes)
    return new, new.pack(clock, states, x, period)


def with_least_period(old: Shooting, x: np.ndarray) -> tuple[Shooting, np.ndarray]:
    rows = in_rows(on_host(sections_at(old, x)[0]))
    for cycles in range(1, old.cycles):
        repetitions, remainder = divmod(old.cycles, cycles)
        difference = np.abs(np.roll(rows, -cycles, axis=0) - rows) / np.asarray(old.sizes)[1:]
        if remainder or difference.max() >= SAME or len(old.events) % repetitions:
            continue
        if repeats_from(old, len(old.events) // repetitions):
            break
    else:
        return old, x
    legs = max(1, len(old.events) // repetitions)
    clock, states, period = old.values(x)
    events = tuple(
        e if e.cycle is None else e._replace(cycle=e.cycle % cycles) for e in old.events[:legs]
    )
    steps = old.steps if events else max(1, old.steps // repetitions)
    new = dataclasses.replace(
        old, cycles=cycles, events=events, modes=old.modes[:legs], steps=steps
    )
    return new, new.pack(clock[:legs], states[:legs], x, period / repetitions)
