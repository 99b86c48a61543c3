"""A walk along a curve, taken up again where its flights ask for more steps or it has stalled."""

from typing import Any, Protocol, runtime_checkable

import numpy as np

from .._messages import Tell, warn
from ._past_section import past_section
from ._problem import finer, sized_by_motion
from ._shooting import Shooting
from ._solve import advance, off_by
from .curve import STALLED, Step, walk

# Twice the steps change the states of a point by less than this: a choice, above the corrector's
# tolerance (`curve.corrected`) and below that to which special points are promised. Points of which
# no more steps than are allowed can bring them below the second are warned of: of a motor whose
# crank slowed to a fifth it was 0.07, with the steps of its first motion.
_COARSE, _WRONG = 1e-10, 1e-8

# A walk that stalls this close to a bound (in the parameter's scale) is taken to it: a choice, a
# few times what the shortest of its steps leave.
_STALLED_AT = 1e-6

# Stands for the reason to end where flights ask for more steps.
_MORE_STEPS = "more steps"


@runtime_checkable
class Monitor(Protocol):
    """What looks at each step of a walk."""

    problem: Shooting
    scale: Any
    bounds: Any

    def advance(self, x: Any, tangent: Any, length: Any) -> Step: ...
    def stop(self, here: Step, new: Step) -> tuple[Step, str] | None: ...
    def stalled(self, steps: list[Step]) -> tuple[Step, str]: ...
    def refine(self, problem: Shooting) -> None: ...


def walked(monitor: Monitor, steps: list[Step], tell: Tell, settings: dict[str, Any]) -> str:
    """Walk from the last of these steps on, to which others are added; why it ended.

    Where the motion alone tells how many steps its flights need, they are looked at again with
    twice as many at each point. Where a motion that rests meets a stop on its section the walk is
    taken up beyond.
    """
    looked_at = monitor.problem.follows_events and sized_by_motion(monitor.problem)
    vain, worst = 0.0, (0.0, 0.0)  # how far off the states are, and where

    def stop(here: Step, new: Step) -> tuple[Step, str] | None:
        nonlocal vain, worst
        if looked_at:
            off = off_by(monitor.problem, new.x)
            if off > max(_COARSE, 10 * vain):  # it is rounding what more steps do not change
                better = finer(monitor.problem, new.x)
                if better is not None:
                    monitor.refine(better)
                    return here, _MORE_STEPS
                vain = off
            worst = max(worst, (off, float(new.x[-1])))
        return monitor.stop(here, new)

    while True:
        end = walk(monitor.advance, steps, stop=stop, tell=tell, **settings)
        if end == _MORE_STEPS:
            continue
        beyond = past_section(monitor.problem, steps[-1], monitor.scale) if end == STALLED else None
        if end == STALLED and beyond is None:
            at = _at_bound(monitor, steps[-1])
            last, end = monitor.stalled(steps) if at is None else (at, "bounds")
            steps += [] if last is steps[-1] else [last]
        if beyond is None or len(steps) >= settings["max_points"]:
            break
        steps.append(beyond)
    off, value = worst
    if off > _WRONG:
        problem = monitor.problem
        warn(
            f"The flights of this curve have {problem.steps} steps each, but at "
            f"{problem.parameters[-1]} = {value:.6g} twice as many change its states by {off:.1g}: "
            "follow it by a `method` of more steps a cycle."
        )
    return end


def _at_bound(monitor: Monitor, last: Step) -> Step | None:
    """The point at the bound of a parameter before which a walk has stalled: its machine has
    another form beyond, as with a restitution of 0 or 1. `None` if it has stalled elsewhere."""
    scale, axes = monitor.scale, np.eye(len(last.x))
    for i, ends in enumerate(monitor.bounds, -len(monitor.bounds)):
        for bound in ends:
            way = (bound - float(last.x[i])) / scale[i]
            if abs(way) < _STALLED_AT:
                at = advance(monitor.problem, last.x, axes[i], scale, way)
                return at if bool(at.good) else None
    return None
