"""A sliding bifurcation located on the motion without the part that vanishes there.

Close to it the equations of the motion with that part have a second solution, in which both events
that bound the part coincide, and a corrector finds the one or the other. Without the part they are
regular: what remains is a touch, or a guard that vanishes at an event.
"""

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ._corrector import Step, advance, observe, state_at
from ._fewer_events import without_events
from ._locate import NoValueError
from ._shooting import Shooting
from ._sliding import Change, holding_force

# Events that are closer than this where they vanish are located well enough: a choice.
_CLOSE = 1e-8


def refined(problem: Shooting, at: Step, change: Change) -> Step:
    """The special point at which a part of the motion vanishes, from one that is close to it; the
    same where it is close enough, or no other is found.

    **Arguments:** the equations of the motion with that part; what vanishes.
    """
    clock = np.asarray(problem.parts(jnp.asarray(at.x))[0])
    close = abs(float(at.seen.apart)) < _CLOSE * problem.radian
    if not change.there or problem.conditions or close:
        return at
    first = int(np.argmin(np.abs(clock - change.clock)))
    second, alike = (first + 1) % problem.legs, change.modes[0] == change.modes[2]
    if second <= first:  # the part lies across the begin of the period
        return at
    new, x = without_events(problem, np.asarray(at.x), [first, second] if alike else [first])
    sizes = new.scale(1.0)
    fixed = np.eye(x.size)[-1]
    found: list[Step] = []

    def test(parameter: float) -> float:
        start = np.append((found[-1].x if found else x)[:-1], parameter)
        step = advance(new, start, fixed, sizes, 0.0)
        if not bool(step.good):
            raise NoValueError  # else the secant goes on with NaN, fifty times
        found.append(step)
        if alike:
            return float(step.seen.nearest.room)
        place = float(np.asarray(new.parts(jnp.asarray(step.x))[0])[first])
        return holding_force(new, step, first, change.number, place)[0]

    from scipy.optimize import newton  # slow to load

    near, size = float(at.x[-1]), float(abs(at.x[-1])) or 1.0
    try:
        root, info = newton(
            test, near, x1=near + 1e-6 * size, tol=1e-14 * size, full_output=True, disp=False
        )
        if not info.converged or np.isnan(test(float(root))):
            return at
    except NoValueError:
        return at
    return _with_part(problem, at, new, found[-1], first, alike)


def _with_part(
    problem: Shooting, at: Step, new: Shooting, step: Step, first: int, alike: bool
) -> Step:
    """The solution of the equations with a part that has no length, from that of those without it.

    **Arguments:** `new` and `step`, the equations without it and their solution; `first`, the
    number of the event with which the part begins; `alike`, whether both its events were left out.
    """
    x = jnp.asarray(step.x)
    clock, states = (np.asarray(a) for a in new.parts(x))
    if not new.events:
        clock, states = np.zeros(0), np.zeros((0, problem.states))
    place, period = clock[first] if not alike else float(step.seen.nearest.clock), new.period(x)
    if alike:
        leg = max(0, first - 1)
        place = place + float(period) * np.round(
            (_crude(problem, at, first) - place) / float(period)
        )
        there = ravel_pytree(state_at(new, x, jnp.asarray(leg), jnp.asarray(place)))[0]
        extra = np.stack([np.asarray(there)] * 2)
    else:
        extra = states[first][None]
    clock = np.insert(clock, first, [place] * len(extra))
    states = np.insert(states, [first] * len(extra), extra, axis=0)
    whole = np.asarray(problem.pack(clock, states, step.x[-1:], period))
    return at._replace(x=whole, seen=observe(problem, whole))


def _crude(problem: Shooting, at: Step, first: int) -> float:
    return float(np.asarray(problem.parts(jnp.asarray(at.x))[0])[first])
