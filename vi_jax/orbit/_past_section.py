"""Where a walk along motions that rest stalls: an impact or a chatter comes upon their section, or
there is nothing beyond.

In the first case the motion goes on, but its state on the section jumps: it is that behind the
impact instead of that before it. So a branch of fixed points of the section map stalls, and is
taken up beyond.
"""

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ..machine import RigidStop
from ._shooting import Shooting
from ._solve import advance
from ._touched import touched_beside
from .curve import STALLED, Step
from .special import GRAZING

# A body this close to a stop on the section meets it there: a choice, far above how close to the
# place a walk comes before it stalls.
_MEETS = 1e-5

# How far beyond that place the motion is looked for (in the parameter's scale): choices.
_BEYOND = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)


def past_section(problem: Shooting, last: Step, scale: np.ndarray) -> Step | None:
    """The motion beyond a place where a branch of motions that rest has stalled, if there one of
    its impacts falls on the section, or its rest begins or ends there; else `None`."""
    if problem.follows_events or problem.conditions:
        return None
    machine, x = problem.at(jnp.asarray(last.x)), np.asarray(last.x)
    state, rests = problem.unravel(jnp.asarray(x[: problem.states])), int(last.seen.counted.rests)
    along = np.zeros(x.size)
    along[-1] = np.copysign(1.0, last.tangent[-1])
    for stop in machine.stops:
        body = machine.coordinates[stop.coordinate]
        if float(stop.beyond(body.position(state))) < -_MEETS:
            continue
        for V in _speeds(stop, float(body.velocity(state))):
            there = body.placed(state, stop.place, jnp.asarray(V))
            begin = np.append(np.asarray(ravel_pytree(there)[0]), x[-1])
            for length in _BEYOND:
                found = advance(problem, begin, along, scale, length)
                if bool(found.good) and int(found.seen.counted.rests) == rests:
                    return found
    return None


def why_stalled(problem: Shooting, last: Step, scale: np.ndarray) -> tuple[Step, str]:
    """The last point of a branch that the corrector follows no further, and why it ends: of motions
    that rest a grazing, perhaps, from which both of its branches lead back."""
    touch = None if problem.follows_events else touched_beside(problem, last, scale)
    return (last, STALLED) if touch is None else (touch, GRAZING)


def _speeds(stop: RigidStop, V: float) -> list[float]:
    """The velocities with which a body may be on a stop instead: behind an impact or before one,
    or at rest."""
    share = float(stop.share(jnp.asarray(abs(V))))
    if float(stop.sign) * V > 0:
        return [-share * V, 0.0]
    return [-V / share, 0.0] if share > 0 else [0.0]
