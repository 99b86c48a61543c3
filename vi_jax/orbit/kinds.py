"""The kinds of special points, and their descriptions in messages."""

import numpy as np

from ..machine import RigidStop, SoftStop, clock_in_words
from .corrector import Step, since_section
from .equations import Shooting
from .flight import Event
from .sliding import SLIDING

FOLD, DOUBLING, TORUS = "fold", "period-doubling", "neimark-sacker"
GRAZING, CROSSING, SYMMETRY = "grazing", "branch-point", "symmetry-breaking"
HOPF, REST, EXTREMUM, TURN, WATCHED = "hopf", "rest", "extremum", "turn", "watched"

# Kinds of points of codimension two.
CUSP, FLIP, RESONANT = "cusp", "fold-flip", "resonant-grazing"
DEGENERATE, DEGENERATE_SYMMETRY = "degenerate-doubling", "degenerate-symmetry-breaking"
RESONANCE_1, RESONANCE_2 = "resonance-1:1", "resonance-1:2"
RESONANCE_3, RESONANCE_4 = "resonance-1:3", "resonance-1:4"

# Kinds at which something is touched: by a flight, or by a body at the limit of being held.
TOUCHING = (GRAZING, REST, *SLIDING)

# A turn of a branch that begins at another branch and leaves it to both sides.
TURNS = "turns"

# Events closer than this coincide (a cycle is 2π): a choice, above the errors of places.
TOGETHER = 1e-6

# Descriptions of special points, by kind or one of these.
DETAILS = {
    FOLD: "a multiplier passes 1 and the branch turns back",
    DOUBLING: "a multiplier passes -1",
    CROSSING: "a multiplier passes 1 and another branch crosses",
    SYMMETRY: "a multiplier passes 1 and the motion loses its symmetry",
    TORUS: "a complex pair of multipliers leaves the unit circle",
    TURN: "the parameter turns back while other quantities are held",
    TURNS: "a multiplier touches 1: this branch begins at another one, on both sides",
    HOPF: "the motion shrinks to an equilibrium",
}

# Descriptions of points of codimension two.
AT_CODIMENSION_TWO = {
    CUSP: "two curves of folds meet and end",
    DEGENERATE: "beyond, the motions of twice the period begin on the other side",
    DEGENERATE_SYMMETRY: "beyond, the motions without symmetry begin on the other side",
    FLIP: "multipliers 1 and -1: a curve of folds meets one of period doublings",
    RESONANCE_1: "a double multiplier 1: a curve of Neimark–Sacker points begins",
    RESONANCE_2: "a double multiplier -1: a curve of Neimark–Sacker points begins",
    RESONANCE_3: "the angle of the multipliers is 2π/3",
    RESONANCE_4: "the angle of the multipliers is π/2",
    RESONANT: "a curve of folds and one of period doublings begin",
    FOLD: "the motion that grazes has a multiplier 1",
    DOUBLING: "the motion that grazes has a multiplier -1",
    SYMMETRY: "the motion loses or gains its symmetry: a curve of symmetry breakings comes here",
}


def with_article(kind: str) -> str:
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


def place_in_words(problem: Shooting, at: Step, clock: float) -> str:
    place = float(since_section(problem, at.x, clock))
    return f"at {clock_in_words(problem.machine, place, problem.cycles)}"


def coincidence_in_words(problem: Shooting, at: Step) -> str:
    lengths, place_of_both = problem.lengths(at.x), ""
    i = int(np.argmin(lengths))
    if lengths[i] < TOGETHER * problem.radian:
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
