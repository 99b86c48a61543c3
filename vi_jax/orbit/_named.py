"""The kind of a special point at which the sequence of a motion's events ends, and what is said of
it."""

import jax.numpy as jnp
import numpy as np

from ._events import Event
from ._shooting import Shooting
from ._sliding import SLIDING, Change
from ._words import DETAILS, RESTS
from .curve import Step
from .special import GRAZING, HOPF


def named(
    problem: Shooting, at: Step, impact: int | None, change: Change | None
) -> tuple[str, str]:
    """Kind and description.

    **Arguments:** the equations and their solution there; the number of the event that is lost,
    `None` where something is touched, or what stands for it in `DETAILS`; what changes there in
    the sequence of sticking and sliding.
    """
    if impact == RESTS:
        return HOPF, "the motion shrinks to rest"
    if change is not None and change.kind is not None:
        words = SLIDING[change.kind][change.there]
        name = Event(change.number).called(problem.machine)
        return change.kind, words.format(name=name, place=f"at {_place(problem, at, change.clock)}")
    if impact in DETAILS:
        return GRAZING, DETAILS[impact]
    machine = problem.machine
    if impact is None:
        touched = int(at.seen.nearest.event)
        guard = f"the guard of {Event(touched).called(machine)}"
        what = "a stop" if touched < len(machine.stops) else guard
        return GRAZING, f"touches {what} at {_place(problem, at, float(at.seen.nearest.clock))}"
    clock = float(np.asarray(problem.parts(jnp.asarray(at.x))[0])[impact])
    lost = problem.events[impact].of(machine)
    return GRAZING, f"the {lost.name or lost.word} at {_place(problem, at, clock)} is lost"


def _place(problem: Shooting, at: Step, clock: float) -> str:
    """A reading of the clock of impacts, in words, within one period from the section on."""
    period = float(problem.period(jnp.asarray(at.x)))
    return problem.machine.place_of(clock % period, problem.cycles)
