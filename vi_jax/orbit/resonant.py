"""Resonant grazings: points of codimension two on a curve of grazings, where an entry vanishes."""

from typing import NamedTuple

import numpy as np

from .._checks import count, instance_of
from ._boundary import Boundary
from ._resonances import resonances
from .special import GRAZING


class ResonantGrazing(NamedTuple):
    """A point of a curve of grazings at which eₙ vanishes and e₁ … eₙ₋₁ are positive: from it a
    fold and a period doubling of the motion with one impact in n periods leave the curve."""

    period: int
    """n, in periods of the motion that grazes."""
    parameters: np.ndarray
    """Both parameters of the curve."""
    entries: np.ndarray
    """e₁ … eₙ there."""


def resonant_grazings(curve: Boundary, *, periods: int = 3) -> list[ResonantGrazing]:
    """Return the points of a curve of grazings where motions with one impact in n periods change.

    The entry eₙ = ∂h·Nⁿ·kick of the local map (see `grazing`) is the change of the distance n
    periods after an impact. At a change of its sign, the motion with one impact in n periods
    changes the side of the grazing on which it exists, and is stable close by. Each point is
    located along the curve to rounding. Host-side: not to be traced.

    **Arguments:** a `Boundary` of the kind "grazing"; `periods`, the greatest n.

    **Returns:** them in the order of the curve.

    **Raises:** `TypeError` or `ValueError` if this is no curve of grazings.
    """
    instance_of("curve", curve, Boundary, "a `Boundary`, from `boundary`")
    periods = count("periods", periods, least=1)
    if curve.kind != GRAZING:
        raise ValueError(f"Argument `curve` must be one of grazings, but is one of {curve.kind}.")
    found = resonances(curve.problem, curve.condition.impact, curve.steps, curve.scale, periods)
    return [
        ResonantGrazing(len(entries), np.asarray(step.x)[-2:], entries)
        for _, step, entries in found
    ]
