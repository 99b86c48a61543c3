"""The kind of a special point at which the sequence of a motion's events ends, and what is said of
it."""

from ._events import Event
from ._shooting import Shooting
from ._sliding import SLIDING, Change
from ._words import DETAILS, RESTS, grazing_in_words, place_in_words
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
        return change.kind, words.format(name=name, place=place_in_words(problem, at, change.clock))
    if impact in DETAILS:
        return GRAZING, DETAILS[impact]
    return GRAZING, grazing_in_words(problem, at, impact)
