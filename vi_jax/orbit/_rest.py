"""Whether a periodic motion rests on a stop, of which the equations of its impacts know nothing."""

from .results import Orbit, lies_on_a_stop


def rests(orbit: Orbit) -> bool:
    """Whether a body rests on a stop in the course of a motion, or all the time."""
    return bool(orbit.rests > 0) or (orbit.machine.may_rest() and lies_on_a_stop(orbit))
