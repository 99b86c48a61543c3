"""Points of codimension two: where something more happens on a curve of special motions."""

import dataclasses

import numpy as np

from ._conditions import alone
from ._corrector import Step
from ._shooting import Shooting
from ._words import DETAILS, grazing_in_words
from .results import InWords, Orbit
from .special import (
    DOUBLING,
    FLIP,
    FOLD,
    GRAZING,
    RESONANCE_1,
    RESONANCE_2,
    SYMMETRY,
    TORUS,
    SpecialPoint,
)

# What kind of curve leaves a point, by the kinds of the curve on which it lies and of the point.
_LEADS = {
    (FOLD, FLIP): DOUBLING,
    (FOLD, RESONANCE_1): TORUS,
    (FOLD, GRAZING): GRAZING,
    (DOUBLING, FLIP): FOLD,
    (DOUBLING, RESONANCE_2): TORUS,
    (DOUBLING, GRAZING): GRAZING,
    (TORUS, RESONANCE_1): FOLD,
    (TORUS, RESONANCE_2): DOUBLING,
    (TORUS, GRAZING): GRAZING,
    (GRAZING, FOLD): FOLD,
    (GRAZING, DOUBLING): DOUBLING,
    (GRAZING, SYMMETRY): SYMMETRY,
}


@dataclasses.dataclass(frozen=True, repr=False)
class CodimensionTwo(InWords):
    """A point of a `Boundary` at which something more happens."""

    kind: str
    """"cusp" (two curves of folds meet and end), "degenerate-doubling" or
    "degenerate-symmetry-breaking" (the motions that begin there do so on the other side beyond),
    "fold-flip" (multipliers 1 and -1), "resonance-1:1", "resonance-1:2" (a double multiplier 1 or
    -1, where a curve of Neimark–Sacker points begins), "resonance-1:3", "resonance-1:4" (the
    angle of a complex pair is 2π/3 or π/2), "grazing" (of a motion that is special by its
    multipliers); on a curve of grazings "fold" or "period-doubling" (of the motion that grazes),
    "resonant-grazing" (an entry eₙ of the local map vanishes, see `grazing`);
    "symmetry-breaking" (the motions become symmetric, and the curve ends; of grazings of
    symmetric motions, where these lose that)."""
    parameters: np.ndarray
    """Both parameters of the curve."""
    orbit: Orbit
    detail: str
    """What happens there, in words."""
    curve: str
    """The kind of the curve on which it lies."""
    problem: Shooting = dataclasses.field(repr=False)
    step: Step = dataclasses.field(repr=False)
    scale: np.ndarray = dataclasses.field(repr=False)
    impact: int | None = None
    """Of a grazing the impact that is lost; `None` where the body touches a stop."""

    def switch(self) -> SpecialPoint:
        """The same motion as a special point of another kind, of the curve that meets this one
        here: `boundary` follows it in the same two parameters.

        From a fold–flip that is the other curve; from a double multiplier 1 or -1 the curve of
        Neimark–Sacker points, or from that the curve of folds or doublings; from a fold or a
        doubling that grazes the curve of grazings, and back; where a motion that grazes becomes
        symmetric, the curve of symmetry breakings.

        **Raises:** `ValueError` for other kinds, from which none leaves, or none of this motion.
        """
        kind = _LEADS.get((self.curve, self.kind))
        if kind is None:
            raise ValueError(
                "`switch` needs a fold–flip, a resonance 1:1 or 1:2, or a fold, a doubling or a "
                f"symmetry breaking that grazes, but this point on a curve of {self.curve} is a "
                f"{self.kind}."
            )
        problem, step, scale = alone(self.problem, self.step, self.scale)
        grazes = kind == GRAZING
        detail = grazing_in_words(problem, step, self.impact) if grazes else DETAILS[kind]
        impact = self.impact if grazes else None
        return SpecialPoint(
            kind, float(step.x[-1]), self.orbit, detail, problem, step, scale, impact
        )  # fmt: skip

    def __str__(self) -> str:
        first, second = self.parameters
        return f"{self.kind} at ({first:.10g}, {second:.10g}): {self.detail}"
