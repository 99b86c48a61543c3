"""Whether a periodic motion rests on a stop, of which the equations of its impacts know nothing."""

import numpy as np

from ..flow import simulate
from .results import Orbit


def rests(orbit: Orbit) -> bool:
    """Whether a body rests on a stop in the course of a motion, or all the time."""
    return orbit.machine.may_rest() and _forgets(orbit) and (rests_now(orbit) or _comes_to(orbit))


def _forgets(orbit: Orbit) -> bool:
    """Whether a multiplier is 0, as it is after a rest: only then the motion need be looked at."""
    multipliers = np.abs(np.asarray(orbit.multipliers))
    return bool(multipliers.min() < np.sqrt(np.finfo(multipliers.dtype).eps))


def rests_now(orbit: Orbit) -> bool:
    """Whether a body lies still on a stop on the section."""
    bodies = ((stop, orbit.machine.coordinates[stop.coordinate]) for stop in orbit.machine.stops)
    x = orbit.state
    return any(stop.beyond(y.position(x)) >= 0 and y.velocity(x) == 0 for stop, y in bodies)


def _comes_to(orbit: Orbit) -> bool:
    """Whether a body comes to rest within the period."""
    run = simulate(orbit.machine, orbit.state, int(orbit.cycles), method=orbit.method)
    return run.rests is not None and bool(run.rests.sum() > 0)
