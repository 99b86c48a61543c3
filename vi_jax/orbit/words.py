"""Places of special points, and what happens there, in words."""

import numpy as np

from ..machine import RigidStop, SoftStop, clock_in_words
from .corrector import Step, since_section
from .equations import Shooting
from .flight import Event
from .tolerances import LOCATED


def place_in_words(problem: Shooting, at: Step, clock: float) -> str:
    place = float(since_section(problem, at.x, clock))
    return f"at {clock_in_words(problem.machine, place, problem.cycles)}"


def coincidence_in_words(problem: Shooting, at: Step) -> str:
    lengths, place_of_both = problem.lengths(at.x), ""
    i = int(np.argmin(lengths))
    if lengths[i] < LOCATED * problem.radian:
        names = [problem.events[j % problem.legs].name_on(problem.machine) for j in (i, i + 1)]
        place = place_in_words(problem, at, float(problem.values(at.x)[0][i]))
        place_of_both = f" ({' and '.join(names)}, {place})"
    return f"two of its events coincide{place_of_both}, and change their order beyond"


def grazing_in_words(problem: Shooting, at: Step, impact: int | None) -> str:
    machine = problem.machine
    if impact is None:
        touched, clock = int(at.observed.nearest.event), float(at.observed.nearest.clock)
        event, called = Event(touched).of(machine), Event(touched).name_on(machine)
        what = f"touches the guard of {called}"
        if isinstance(event, RigidStop | SoftStop):
            what = "touches a stop" if isinstance(event, RigidStop) else f"grazes the {called}"
        return f"{what} {place_in_words(problem, at, clock)}"
    clock = float(problem.values(at.x)[0][impact])
    event, lost = problem.events[impact], problem.events[impact].of(machine)
    noun = lost.name or lost.word
    if lost.holds_mode:
        what = "contact with the" if isinstance(lost, SoftStop) else "change of"
        noun = f"{what} {event.name_on(machine)}"
    return f"the {noun} {place_in_words(problem, at, clock)} is lost"
