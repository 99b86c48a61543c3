"""Following a curve in two parameters: where it ends."""

from collections.abc import Callable, Iterator

import jax.numpy as jnp
import numpy as np

from ._closing import Closing
from ._crossing import BESIDE, MOST, crossing
from ._shooting import Shooting
from ._solve import advance, images_at, located
from ._special_condition import Special
from ._symmetry import ALIKE, ROUNDED, may_be_symmetric
from .curve import STALLED, Step, way
from .special import GRAZING, RESONANCE_1, RESONANCE_2, SYMMETRY, TORUS, TOUCHING

# What lies below zero by no more than this is zero to rounding: a choice, a hundred times the
# corrector's tolerance.
_NOISE = 1e-9

# Of the first and of the second parameter.
Intervals = tuple[tuple[float, float], tuple[float, float]]


class CurveMonitor:
    """Looks at each step of a walk along a curve of special motions and says when to end.

    **Arguments:** the equations of the motions, with two parameters as their last unknowns; the
    condition that makes them special; the size of each unknown; the parameters' intervals.
    """

    def __init__(self, problem: Shooting, condition: Special, scale: np.ndarray, bounds: Intervals):
        self.problem, self.condition, self.scale = problem, condition, scale
        self.bounds = bounds
        # Along a curve of symmetric motions the images are alike everywhere.
        self.symmetric = condition.kind != SYMMETRY and may_be_symmetric(
            problem, [problem.machine, *problem.corners(bounds)]
        )
        self.closing = Closing(problem, scale)

    def advance(self, x, tangent, length) -> Step:
        """The point at this length along the tangent."""
        return advance(self.problem, x, tangent, self.scale, length)

    def stop(self, here: Step, new: Step) -> tuple[Step, str] | None:
        """The last point of the curve, and why it ends between these two; `None` if it goes on."""
        last, reason = new, None
        if not self._inside(new):
            last, reason = self._cut(here, new), "bounds"
        found = [
            *self._grazings(here, last), *self._resonances(here, last), *self._mirror(here, last),
        ]  # fmt: skip
        if found:
            return min(found, key=lambda f: way(here, f[0], self.scale))
        if reason is None:
            last = self.closing.between(here, new, lambda test: self._where(here, new, test))
            reason = None if last is None else "closed"
        return None if reason is None or last is None else (last, reason)

    def refine(self, problem: Shooting) -> None:
        """Go on with the same equations in more steps."""
        self.problem = self.closing.problem = problem

    def stalled(self, steps: list[Step]) -> tuple[Step, str]:
        """The last point of a curve that the corrector follows no further, and why it ends."""
        last = steps[-1]
        if self.symmetric and np.linalg.norm(self._images(last)) < ALIKE:
            for here in reversed(steps):
                root = way(here, last, self.scale)
                if root > MOST * BESIDE:
                    at = self._symmetric(here, root, beyond=False)
                    return (last, STALLED) if at is None else (at, SYMMETRY)
        return last, STALLED

    def _where(self, here: Step, new: Step, test: Callable[[Step], float]) -> Step | None:
        return located(self.problem, here, new, self.scale, test)

    def _grazings(self, here: Step, last: Step) -> Iterator[tuple[Step, str]]:
        """Where an impact beside the one that grazes is lost, or a stop is touched."""
        # At a grazing the body turns on the stop, to rounding.
        if self.condition.kind not in TOUCHING or self.condition.impact is not None:
            yield from self._passed(here, last, room, None)
        for i in range(len(last.seen.approach)):
            # In a symmetric motion another impact grazes as well, to rounding.
            if i != self.condition.impact:
                yield from self._passed(here, last, lambda s, i=i: float(s.seen.approach[i]), i)

    def _passed(
        self, here: Step, last: Step, test: Callable[[Step], float], impact: int | None
    ) -> Iterator[tuple[Step, str]]:
        """Where a test falls through zero."""
        if not test(last) <= -_NOISE:
            return
        at = self._where(here, last, test) if test(here) > _NOISE else here
        if impact is not None and self.condition.kind not in TOUCHING and at is not here:
            at = self._singular(here, at or here, test)
        yield at or here, GRAZING

    def _singular(self, here: Step, at: Step, test: Callable[[Step], float]) -> Step:
        """The point at which an impact grazes, where the monodromy matrix has a pole."""
        root = way(here, at, self.scale)
        found = crossing(self.problem, self.advance, here, root, test)
        if found is None:
            return at
        gone = {"monodromy": found.seen.monodromy, "multipliers": found.seen.multipliers}
        gone = {name: np.nan * numbers for name, numbers in gone.items()}
        return found._replace(seen=found.seen._replace(**gone))

    def _resonances(self, here: Step, last: Step) -> Iterator[tuple[Step, str]]:
        """Where a pair of multipliers on the unit circle becomes real: beyond, the product of two
        is still 1, but none has the modulus 1."""
        if self.condition.kind != TORUS:
            return
        for kind, sign in ((RESONANCE_1, 1), (RESONANCE_2, -1)):

            def left(step: Step, sign=sign) -> float:
                return 1 - sign * cosine_of(step)

            if left(last) <= -_NOISE:
                at = self._where(here, last, left) if left(here) > _NOISE else here
                yield at or here, kind

    def _mirror(self, here: Step, last: Step) -> Iterator[tuple[Step, str]]:
        """Where the motion becomes symmetric: beyond, the same ones come again in the mirror, and
        what grazed on one side is passed through on the other."""
        if not self.symmetric:
            return
        begin = self._images(here)

        def along(step: Step) -> float:
            return float(np.dot(begin, self._images(step)))

        if np.linalg.norm(begin) < ROUNDED or along(last) >= 0:
            return
        at = self._where(here, last, along)
        if at is not None and np.linalg.norm(self._images(at)) < ALIKE:
            root = way(here, at, self.scale)
            yield self._symmetric(here, root) or at, SYMMETRY

    def _images(self, step: Step) -> np.ndarray:
        """How far the motion is from being its own image."""
        return np.asarray(images_at(self.problem, jnp.asarray(step.x)))

    def _symmetric(self, here: Step, root: float, *, beyond: bool = True) -> Step | None:
        """The point about so far ahead at which the motion is symmetric and the curve is crossed by
        that of the symmetric motions; `beyond`, whether this one can be followed further."""
        begin = self._images(here)

        def admits(step: Step, length: float) -> bool:
            other = np.linalg.norm(self._images(step)) < ALIKE * BESIDE
            return not other and (beyond or length < root)

        alike = lambda step: float(np.dot(begin, self._images(step)))
        return crossing(self.problem, self.advance, here, root, alike, admits)

    def _inside(self, step: Step) -> bool:
        pairs = zip(step.x[-2:], self.bounds, strict=True)
        return all(low <= x <= high for x, (low, high) in pairs)

    def _cut(self, here: Step, new: Step) -> Step:
        """The last point inside the bounds between two, found by halving the step."""
        low, high = 0.0, way(here, new, self.scale)
        last = here
        for _ in range(30):
            middle = 0.5 * (low + high)
            step = self.advance(here.x, here.tangent, middle)
            inside = bool(step.good) and self._inside(step)
            low, high = (middle, high) if inside else (low, middle)
            last = step if inside else last
        return last


def room(step: Step) -> float:
    """The clearance, of those without a turn 1."""
    return float(np.clip(step.seen.nearest.room, -1.0, 1.0))


def cosine_of(step: Step) -> float:
    """The cosine of the angle of the two multipliers whose product is nearest to 1: half their sum,
    beyond ±1 if they are real."""
    values = step.seen.multipliers
    first, second = np.triu_indices(len(values), 1)
    pair = int(np.argmin(np.abs(values[first] * values[second] - 1)))
    return float(0.5 * (values[first[pair]] + values[second[pair]]).real)
