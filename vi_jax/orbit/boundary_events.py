"""The table of a curve of special motions in two parameters.

| event | test, positive before it | end of the curve |
|---|---|---|
| a bound is reached | distance of the parameter | `bounds` |
| another impact is lost, a stop touched | V⁻, least distance at a turn | `grazing` |
| another chatter takes until the release | the time left | `rest` |
| a part with a mode of a switch vanishes | its length; 1 or -1 for another mode | sliding |
| a pair of multipliers becomes real | 1 ∓ the cosine of its angle | `resonance-1:1`, `-1:2` |
| the motion becomes its own image | its difference from that | `symmetry-breaking` |
| the curve closes | distance to the plane across an earlier point | `closed` |

Other points of codimension two are located on the finished curve (`codimension_two.py`).
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from .codimension_two import cosine_of
from .conditions import Special
from .corrector import Step, distance_along
from .edit_events import may_be_symmetric
from .equations import Shooting
from .kinds import (
    CROSSING_SLIDING,
    GRAZING,
    RESONANCE_1,
    RESONANCE_2,
    REST,
    SWITCHING_SLIDING,
    SYMMETRY,
    TORUS,
    TOUCHING,
)
from .locate import MOST_SAMPLES, SPACING, crossing
from .sliding import change_at_event, vanishing_part
from .tolerances import ALIKE, FAINT, ROUNDING, SAME
from .walk import Ending, Event, Table, common_rows

# The intervals of the first and of the second parameter.
Intervals = tuple[tuple[float, float], tuple[float, float]]


class SpecialTable(Table):
    def __init__(self, problem: Shooting, bounds: Intervals):
        super().__init__(problem, bounds)
        self.condition: Special = problem.conditions[0]
        # All motions of a symmetric curve are their own images.
        self.symmetric = self.condition.kind != SYMMETRY and may_be_symmetric(
            problem, [problem.machine, *problem.corners(bounds)]
        )

    def stall_end(self, steps: list[Step]) -> Ending:
        """Return the end of a stalled curve, perhaps where its motions become symmetric."""
        last = steps[-1]
        if self.symmetric and np.linalg.norm(self.image_difference(last)) < ALIKE:
            for here in reversed(steps):
                root = distance_along(self.problem, here, last)
                if root > MOST_SAMPLES * SPACING:
                    at = self._symmetric_point(here, root, beyond=False)
                    return super().stall_end(steps) if at is None else Ending(at, SYMMETRY)
        return super().stall_end(steps)

    def event_rows(self, here: Step, new: Step) -> list[Event]:
        return [
            *common_rows(self), *self._grazing_rows(here), *self._sliding_rows(),
            *self._resonance_rows(), *self._symmetry_rows(here), *self.closing.rows(here, new),
        ]  # fmt: skip

    def _grazing_rows(self, here: Step) -> Iterator[Event]:
        """Yield the rows of lost impacts other than the grazing one, and of touched stops."""
        kind, grazes = self.condition.kind, self.condition.impact
        if self.problem.rests and (kind != REST or grazes is not None):
            hold_force = lambda step: step.observed.least_hold_force
            yield Event(hold_force, lambda at: Ending(at, REST), noise=ROUNDING)
        for i, event in enumerate(self.problem.landings):
            if kind != REST or event != grazes:
                ending = lambda step, i=i: -float(step.observed.escape_margin[i])
                yield Event(ending, lambda at: Ending(at, REST), noise=ROUNDING)
        for i, is_lost in enumerate(here.observed.lost):
            # In a symmetric motion another impact grazes as well, on a soft stop the release.
            if kind == GRAZING and (is_lost or i == grazes):
                continue
            test = lambda step, i=i: float(step.observed.approach[i] / step.observed.units[i])
            ending = partial(self._grazing_ending, here, test)
            yield Event(test, ending, noise=ROUNDING)
        # At a grazing the body turns on the stop, to rounding. Close to a lost impact it turns at a
        # distance of v². This row would locate that end to the root of rounding, so it is the last.
        if kind not in TOUCHING or kind == REST or grazes is not None:
            # The turn of a grazing impact itself is at a distance of rounding.
            slack = 2 * ROUNDING if kind == GRAZING else 0.0
            clearance = lambda step: step.observed.relative_clearance + slack
            yield Event(clearance, lambda at: Ending(at, GRAZING), noise=ROUNDING)

    def _sliding_rows(self) -> Iterator[Event]:
        """Yield the rows of the order of events, but those of a grazing or of a rest coincide; and
        of a switch that goes into another mode, unless an event is at the limit of that."""
        kind, names = self.condition.kind, ["order_margin", "modes_agree"]
        if kind in (CROSSING_SLIDING, SWITCHING_SLIDING):
            names = names[:1]
        for name in () if kind in (GRAZING, REST) else names:
            test = lambda step, name=name: float(getattr(step.observed, name))
            yield Event(test, self._sliding_ending, noise=ROUNDING)

    def _sliding_ending(self, at: Step) -> Ending:
        change = vanishing_part(self.problem, at, FAINT) or change_at_event(self.problem, at)
        return Ending(at, (change and change.kind) or GRAZING)

    def _grazing_ending(self, here: Step, test: Callable[[Step], float], at: Step) -> Ending:
        """Return the end at a grazing impact, where the monodromy matrix has a pole."""
        if self.condition.kind in TOUCHING or at is here:
            return Ending(at, GRAZING)
        root = distance_along(self.problem, here, at)
        found = crossing(self.problem, self.advance, here, root, test) or at
        unknown = {"monodromy": found.observed.monodromy, "multipliers": found.observed.multipliers}
        unknown = {name: np.nan * numbers for name, numbers in unknown.items()}
        return Ending(found._replace(observed=found.observed._replace(**unknown)), GRAZING)

    def _resonance_rows(self) -> Iterator[Event]:
        """Yield the rows of places where a pair of multipliers on the unit circle becomes real.
        Beyond, the product of the two is still 1, but neither has modulus 1."""
        for kind, sign in ((RESONANCE_1, 1), (RESONANCE_2, -1)):
            if self.condition.kind == TORUS:
                margin = lambda step, sign=sign: 1 - sign * cosine_of(step)
                yield Event(margin, lambda at, kind=kind: Ending(at, kind), noise=ROUNDING)

    def _symmetry_rows(self, here: Step) -> Iterator[Event]:
        """Yield the row of a place where the motion becomes symmetric. Beyond, the same motions
        repeat mirrored, and a grazing of one side is passed through on the other."""
        begin = self.image_difference(here)
        if np.linalg.norm(begin) < SAME:
            return

        def ending(at: Step) -> Ending | None:
            if np.linalg.norm(self.image_difference(at)) >= ALIKE:
                return None
            return Ending(
                self._symmetric_point(here, distance_along(self.problem, here, at)) or at, SYMMETRY
            )

        yield Event(lambda step: float(np.dot(begin, self.image_difference(step))), ending)

    def _symmetric_point(self, here: Step, root: float, *, beyond: bool = True) -> Step | None:
        """Return the point about so far ahead where the motion is symmetric and the curve of
        symmetric motions crosses this one; `beyond` is true if this one can be followed further."""
        begin = self.image_difference(here)

        def admits(step: Step, length: float) -> bool:
            is_symmetric = np.linalg.norm(self.image_difference(step)) < ALIKE * SPACING
            return not is_symmetric and (beyond or length < root)

        overlap = lambda step: float(np.dot(begin, self.image_difference(step)))
        return crossing(self.problem, self.advance, here, root, overlap, admits)
