"""Where an entry of the local map vanishes along a curve of grazings."""

import itertools

import numpy as np

from ._conditions import alone
from ._local_map import graze_at
from ._shooting import Shooting
from ._solution import orbit_of
from ._solve import between
from .curve import Step
from .special import GRAZING, SpecialPoint

# An entry that changes its sign without coming this near to zero (as a share of its neighbours) has
# a pole or a jump, and one that is as small vanishes as well: a choice.
_ZERO = 1e-4


def resonances(
    problem: Shooting, impact: int | None, steps: list[Step], scale: np.ndarray, periods: int
) -> list[tuple[float, Step, np.ndarray]]:
    """The resonant grazings of a curve, at which an entry vanishes, in its order: after which step,
    with the fraction of the way to the next one, the point, and the entries up to that which
    vanishes.

    **Arguments:** the curve's equations, the impact that grazes on it, its points and the sizes of
    its unknowns; up to which entry.

    **Raises:** `ValueError` where the local map is not known.
    """
    orbit = orbit_of(problem, steps[0])

    def entries(step: Step, number: int) -> np.ndarray:
        one, there, sizes = alone(problem, step, scale, kept=-2)
        point = SpecialPoint(GRAZING, float(there.x[-1]), orbit, "", one, there, sizes, impact)
        return graze_at(point).map.entries(number)

    found, known = [], [entries(step, periods) for step in steps]
    for i, (here, new) in enumerate(itertools.pairwise(steps)):
        way = (new.x - here.x) / scale
        for n in range(periods):
            before, after = known[i][n], known[i + 1][n]
            if not before * after < 0:
                continue
            step = between(problem, here, new, scale, lambda s, n=n: float(entries(s, n + 1)[n]))
            if step is None or not bool(step.good):
                continue
            at, size = entries(step, n + 1), max(abs(before), abs(after))
            if abs(at[n]) > _ZERO * size or (at[:n] < _ZERO * size).any():
                continue
            share = float(way @ ((step.x - here.x) / scale) / (way @ way))
            found.append((i + share, step, at))
    return sorted(found, key=lambda f: f[0])
