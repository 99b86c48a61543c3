"""A walk along a curve, taken up again where its flights ask for more steps or it has stalled."""

from typing import Any, Protocol, runtime_checkable

from .._at_work import Tell
from .._numbers import warn
from ._past_section import past_section
from ._problem import finer, sized_by_motion
from ._shooting import Shooting
from ._solve import off_by
from .curve import STALLED, Step, walk

# Twice the steps change the states of a point by less than this: a choice, above the corrector's
# tolerance (`curve.corrected`) and below that to which special points are promised. Points of which
# no more steps than are allowed can bring them below the second are warned of: of a motor whose
# crank slowed to a fifth it was 0.07, with the steps of its first motion.
_COARSE, _WRONG = 1e-10, 1e-8

# Stands for the reason to end where flights ask for more steps.
_MORE_STEPS = "more steps"


@runtime_checkable
class Monitor(Protocol):
    """What looks at each step of a walk."""

    problem: Shooting
    scale: Any

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
    better: Shooting | None = None
    vain = worst = 0.0
    place = steps[-1]

    def stop(here: Step, new: Step) -> tuple[Step, str] | None:
        nonlocal better, vain, worst, place
        problem = monitor.problem
        if problem.follows_events and sized_by_motion(problem):
            off = off_by(problem, new.x)
            if off > max(_COARSE, 10 * vain):  # it is rounding what more steps do not change
                better = finer(problem, new.x)
                if better is not None:
                    return here, _MORE_STEPS
                vain = off
            if off > worst:
                worst, place = off, new
        return monitor.stop(here, new)

    while True:
        end = walk(monitor.advance, steps, stop=stop, tell=tell, **settings)
        if end == _MORE_STEPS and better is not None:
            monitor.refine(better)
            continue
        beyond = past_section(monitor.problem, steps[-1], monitor.scale) if end == STALLED else None
        if end == STALLED and beyond is None:
            last, end = monitor.stalled(steps)
            steps += [] if last is steps[-1] else [last]
        if beyond is None or len(steps) >= settings["max_points"]:
            break
        steps.append(beyond)
    if worst > _WRONG:
        name, value = monitor.problem.parameters[-1], float(place.x[-1])
        warn(
            f"The flights of this curve have {monitor.problem.steps} steps each, but at {name} = "
            f"{value:.6g} twice as many change its states by {worst:.1g}: follow it by a `method` "
            "of more steps a cycle."
        )
    return end
