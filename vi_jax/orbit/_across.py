"""The motion on the other side of a place where the sequence of events changes: of a sliding
bifurcation, with a part more or less in which a switch is held, or of two events that fall
together."""

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from .._types import State
from ..flow import simulate
from ..machine import after_event, with_leaf
from ._corrector import Step, advance
from ._problem import events_in
from ._shooting import Shooting
from ._sliding import change_at, without_part
from ._solution import sections_of
from ._surgery import admissible_beside
from .find import find_orbit
from .results import Orbit

# Periods after which a stable motion near the point has settled: a choice.
_SETTLES = 100

# Impacts of a cycle that are listed: a choice.
_LISTED = 32

# Events that are closer than this (a cycle is 2π) fall together: a choice, above how close a place
# is located.
_TOGETHER = 1e-6


def past_part(
    problem: Shooting, step: Step, scale: np.ndarray, distance: float
) -> tuple[Shooting, Step] | None:
    """A motion without the part that vanishes at a sliding bifurcation, before and after which its
    switch has one mode: the equations without both events, and their solution; `None` if there is
    no such part, or no admissible motion.

    **Arguments:** as `across_sliding`.
    """
    change = change_at(problem, step)
    if change is None or not change.there or change.modes[0] != change.modes[2]:
        return None
    new, start, _ = without_part(problem, step, change)
    found = admissible_beside(new, start, new.scale(scale[-1:]), distance)
    return None if found is None else (new, found)


def across_sliding(
    problem: Shooting, step: Step, scale: np.ndarray, distance: float
) -> Orbit | None:
    """A motion beside a sliding bifurcation with another number of events than the branch has;
    `None` if none is found.

    **Arguments:** the equations of the branch and their solution at the point, with the tangent in
    the sense in which it ends; the size of each unknown; how far away, in the parameter's.
    """
    guesses = list(_guesses(problem, step, scale, distance))
    return _beside(
        problem, step, scale, distance, guesses,
        lambda orbit: len(events_in(orbit)) != len(problem.events),
    )  # fmt: skip


def across_rest(problem: Shooting, step: Step, scale: np.ndarray, distance: float) -> Orbit | None:
    """A motion with a rest more or less than the branch has, beside the place where that is lost or
    divided; `None` if none is found.

    **Arguments:** as `across_sliding`.
    """
    guesses, rests = list(_guesses(problem, step, scale, distance)), len(problem.landings)
    other = lambda orbit: int(orbit.rests) != rests
    return _beside(problem, step, scale, distance, guesses, other)


def across_order(problem: Shooting, step: Step, scale: np.ndarray, distance: float) -> Orbit | None:
    """A motion beside a place where two events fall together, with others or in another order;
    `None` if none is found.

    **Arguments:** as `across_sliding`.
    """
    both = [*_swapped(problem, step), *_guesses(problem, step, scale, distance)]
    here, begins = list(problem.events), range(len(problem.events))
    if all(event.cycle is None for event in here):
        # The same motion may be observed whole cycles later, not from any other of its events.
        cycle = float(problem.period(jnp.asarray(step.x))) / problem.cycles
        clock = np.asarray(problem.parts(jnp.asarray(step.x))[0])
        begins = [int(np.sum(clock < n * cycle)) for n in range(problem.cycles)]
    turned = [here[i:] + here[:i] for i in begins]
    other = lambda orbit: [event for _, event in events_in(orbit)] not in turned
    return _beside(problem, step, scale, distance, both, other)


def _beside(
    problem: Shooting, step: Step, scale: np.ndarray, distance: float, guesses: list[State],
    other: Callable[[Orbit], bool],
) -> Orbit | None:  # fmt: skip
    """A motion beside a place, with other events than the branch has.

    The map of the section has no jump there but where an impact falls on the section, so that the
    motion is looked for by its fixed points: from the guesses, and from where a simulation settles.
    Beyond the point is looked at first.

    **Arguments:** as `across_sliding`; states on the section; whether a motion is another than
    those of the branch.
    """
    sense = np.copysign(1.0, float(step.tangent[-1]))
    name = problem.parameters[-1]
    for side in (sense, -sense):
        value = float(step.x[-1]) + side * distance * float(scale[-1])
        machine = with_leaf(problem.machine, name, value)
        for guess in (*guesses, None):
            if guess is None:
                run = simulate(
                    machine, guesses[-1], problem.cycles, settle=_SETTLES * problem.cycles,
                    method=problem.method, record="sections",
                )  # fmt: skip
                guess = run.last
            found = find_orbit(
                machine, guess, problem.cycles, method=problem.method, impact_log=_LISTED
            )
            if bool(found.successful) and other(found):
                return found
    return None


def _guesses(problem: Shooting, step: Step, scale: np.ndarray, distance: float) -> Iterator[State]:
    """States on the section of motions close by."""
    beyond = advance(problem, step.x, step.tangent, scale, distance)
    for place in (beyond, step):
        if np.all(np.isfinite(place.x)):
            states, _ = sections_of(problem, place.x)
            yield jax.tree.map(lambda x: x[0], states)


def _swapped(problem: Shooting, step: Step) -> Iterator[State]:
    """The state on the section where an event that falls on it comes on the other side of it."""
    x = jnp.asarray(step.x)
    machine, clock, states = problem.at(x), *problem.parts(x)
    lengths = np.abs(problem.ends(clock, problem.period(x)) - clock) / problem.radian
    for i, event in enumerate(problem.events):
        j = (i + 1) % problem.legs
        after = problem.events[j]
        if 0 not in (event.cycle, after.cycle) or lengths[i] > _TOGETHER:
            continue
        state, modes = problem.unravel(states[i]), problem.modes_in(i - 1)
        # The section's state is that behind it.
        for each in (after, event) if event.cycle == 0 else (after,):
            state, modes = after_event(machine, each.number, clock[i], state, modes)
        yield state
