"""Resonant grazings: points of codimension two on a curve of grazings, where an entry vanishes."""

import dataclasses
import itertools
from typing import Any, NamedTuple

import numpy as np

from .._checks import count, instance_of
from ..machine import with_leaf
from ._boundary import Boundary
from ._local_map import graze_at
from ._solve import advance
from .curve import Step
from .special import GRAZING, SpecialPoint

# An entry that changes its sign without coming this near to zero (as a share of its neighbours) has
# a pole or a jump, and one that is as small vanishes as well: a choice.
_ZERO = 1e-4


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
    """The points of a curve of grazings at which the motions with one impact in n periods change.

    The entry eₙ = ∂h·Nⁿ·kick of the local map (see `grazing`) is what an impact adds to the
    distance n periods later. Where it changes its sign, the motion with one impact in n periods
    changes the side of the grazing on which it exists, and is stable close by. Each is located
    along the curve to rounding. Host-side: not to be traced.

    **Arguments:** a `Boundary` of the kind "grazing"; `periods`, the greatest n.

    **Returns:** them in the order of the curve.

    **Raises:** `TypeError` or `ValueError` if this is no curve of grazings.
    """
    instance_of("curve", curve, Boundary, "a `Boundary`, from `boundary`")
    periods = count("periods", periods, least=1)
    if curve.kind != GRAZING:
        raise ValueError(f"Argument `curve` must be one of grazings, but is one of {curve.kind}.")
    entries = [_entries(curve, step, periods) for step in curve.steps]
    found = []
    for i, (before, after) in enumerate(itertools.pairwise(entries)):
        here = []
        for n in range(periods):
            if before[n] * after[n] < 0:
                step = _between(curve, curve.steps[i], curve.steps[i + 1], n)
                if step is None:
                    continue
                at, size = _entries(curve, step, n + 1), max(abs(before[n]), abs(after[n]))
                if abs(at[n]) > _ZERO * size or (at[:n] < _ZERO * size).any():
                    continue
                here.append(ResonantGrazing(n + 1, np.asarray(step.x)[-2:], at))
        way = curve.parameters[i + 1] - curve.parameters[i]
        found += sorted(here, key=lambda point: float(way @ point.parameters))
    return found


def _entries(curve: Boundary, step: Step, number: int) -> np.ndarray:
    """The first entries at a point of the curve."""
    problem, x = curve.problem, np.asarray(step.x)
    first, second = problem.parameters
    machine = with_leaf(problem.machine, second, x[-1])
    machine = with_leaf(machine, first, x[-2])
    one = dataclasses.replace(problem, machine=machine, parameters=(first,), conditions=())
    point = SpecialPoint(
        GRAZING, float(x[-2]), curve.orbit(0), "", one, step._replace(x=x[:-1]),
        curve.scale[:-1], curve.condition.impact,
    )  # fmt: skip
    return graze_at(point).map.entries(number)


def _between(curve: Boundary, here: Step, new: Step, n: int) -> Step | None:
    """The point between two at which entry number n (from 0) vanishes; `None` if there is none."""
    from scipy.optimize import brentq  # slow to load

    # Steps follow the curve's sense, except in its backward half, which is turned.
    if float(np.dot(here.tangent, (new.x - here.x) / curve.scale)) < 0:
        here, new = new, here
    length = float(np.dot(here.tangent, (new.x - here.x) / curve.scale))

    def at(s: float) -> Step:
        return advance(curve.problem, here.x, here.tangent, curve.scale, s)

    def entry(s: float) -> float:
        return float(_entries(curve, at(s), n + 1)[n])

    if entry(0.0) * entry(length) > 0:
        return None
    options: Any = {"xtol": 1e-14, "rtol": 1e-14, "full_output": True, "disp": False}
    step = at(float(brentq(entry, 0.0, length, **options)[0]))
    return step if bool(step.good) else None
