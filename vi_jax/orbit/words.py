"""Places of special points, and what happens there, in words."""

import jax.numpy as jnp

from ..machine import RigidStop, SoftStop, clock_in_words, stops_of
from .corrector import Step, since_section
from .equations import Shooting
from .flight import Event

# Events closer than this coincide (a cycle is 2π): a choice, above the errors of places.
TOGETHER = 1e-6


def place_in_words(problem: Shooting, at: Step, clock: float) -> str:
    place = float(since_section(problem, at.x, clock))
    return f"at {clock_in_words(problem.machine, place, problem.cycles)}"


def coincidence_in_words(problem: Shooting, at: Step) -> str:
    x, names = jnp.asarray(at.x), []
    machine, (clock, states) = problem.at(x), problem.parts(x)
    sizes = []
    for leg, (s, u) in enumerate(zip(clock, states, strict=True)):
        after = problem.after(machine, leg, s, u)
        sizes.append(problem.guard_sizes(problem.flight(machine, leg), s, after))
    margins = problem.order_margins(machine, clock, problem.lengths(x), states, sizes)
    pairs = ((i, n) for margin, i, n in margins if float(margin) < TOGETHER * problem.radian)
    i, other = next(pairs, (0, None))  # the first in the motion: the least is so by rounding
    if other is not None:
        names = [event.name_on(problem.machine) for event in (problem.events[i], Event(other))]
    elif len(problem.landings) == 1:  # the time that is left after its chatter
        landing, i = problem.landings[0], (problem.landings[0] + 1) % problem.legs
        stop, later = (problem.events[j].name_on(problem.machine) for j in (landing, i))
        names = [f"the end of the chatter on the {stop}", later]
    place = place_in_words(problem, at, float(clock[i]))
    place_of_both = f" ({' and '.join(names)}, {place})" if names else ""
    return f"two of its events coincide{place_of_both}, and change their order beyond"


def grazing_in_words(problem: Shooting, at: Step, impact: int | None) -> str:
    machine = problem.machine
    if impact is None:
        touched, clock = int(at.observed.nearest.event), float(at.observed.nearest.clock)
        event, called = Event(touched).of(machine), Event(touched).name_on(machine)
        on = f"the {called}" if len(stops_of(machine)) > 1 else "a stop"
        what = f"touches the guard of {called}"
        if isinstance(event, RigidStop | SoftStop):
            what = f"touches {on}" if isinstance(event, RigidStop) else f"grazes the {called}"
        return f"{what} {place_in_words(problem, at, clock)}"
    clock = float(problem.values(at.x)[0][impact])
    event, lost = problem.events[impact], problem.events[impact].of(machine)
    noun = lost.name or lost.word
    if isinstance(lost, RigidStop):
        noun = f"impact on the {event.name_on(machine)}" if len(stops_of(machine)) > 1 else "impact"
    if lost.holds_mode:
        what = "contact with the" if isinstance(lost, SoftStop) else "change of"
        noun = f"{what} {event.name_on(machine)}"
    return f"the {noun} {place_in_words(problem, at, clock)} is lost"
