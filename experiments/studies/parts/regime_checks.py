"""What is checked of the maps of `regime_maps.py`."""

import itertools
from typing import NamedTuple

import numpy as np
import vi_jax as vi
import xarray as xr
from reproduction.boundaries import xi_per_c
from tools.ideal import closed_forms
from tools.study import QUICK, say
from tools.timing import Clock

from .regime_planes import SIDE, ZETA, Plane, settled

SAMPLE = 200 if QUICK else 2000
LATE, LOOKED_AT = (4000, 50) if QUICK else (20_000, 500)
_random = np.random.default_rng(0)


class Seen(NamedTuple):
    """A map."""

    plane: Plane
    data: xr.Dataset
    clock: Clock

    @property
    def period(self) -> np.ndarray:
        """In cycles, or one of `vi.REGIMES`: `(SIDE, SIDE)`."""
        return self.data["period"].values

    @property
    def impacts(self) -> np.ndarray:
        """In a period: `(SIDE, SIDE)`."""
        return self.data["impacts"].values


def known(lanes: dict[str, np.ndarray], cycles: int) -> np.ndarray:
    """Whether the closed form has a stable admissible motion with one impact at these points."""
    if not lanes["zeta"].size:
        return np.zeros(0, bool)
    points = np.stack([lanes["zeta"], lanes["k"], lanes["c"] * xi_per_c()], axis=1)
    found = closed_forms(points, cycles)
    stable = np.max(np.abs(found.multipliers), axis=-1) < 1
    return np.any(found.admissible & stable, axis=1)


def impossible(seen: Seen) -> tuple[int, int, int]:
    """Lanes on a motion with one impact; those of them that cannot be; free ones likewise.

    A lane on a motion with one impact in one or two cycles must have such a motion, stable and
    admissible, in the closed form (every third lane is looked at); and no lane can be free
    between the births.
    """
    total = wrong = 0
    for cycles in (1, 2):
        i, j = np.argwhere((seen.period == cycles) & (seen.impacts == 1))[::3].T
        total += i.size
        wrong += int(np.sum(~known(seen.plane.lane(i, j), cycles)))
    levels = seen.plane.axes[seen.plane.other]
    left, right = (np.interp(levels, *x[:, ::-1].T) for x in seen.plane.curves["birth"])
    between = (ZETA[:, None] > left) & (ZETA[:, None] < right)
    return total, wrong, int(np.sum(between & (seen.impacts == 0)))


def over_later(seen: Seen) -> tuple[int, int]:
    """Of so many lanes called chaotic, those that are no longer so after `LATE` cycles."""
    chaotic = np.argwhere(seen.period == vi.REGIMES.chaotic)
    i, j = _random.permutation(chaotic)[:LOOKED_AT].T
    late = settled(seen.plane.lane(i, j), vi.ExactFlight(), paired=True, settle=LATE)
    return i.size, int(np.sum(late["period"].values != vi.REGIMES.chaotic))


class Differing(NamedTuple):
    """How many random lanes have another regime by `vi.Adaptive`, and of what sort they are."""

    all: int
    irregular: int
    """Chaotic or unsettled by one of the two methods."""
    border: int
    """Regular, with a neighbour of another regime in the map."""
    rest: int


def again_by_adaptive(maps: list[Seen]) -> list[Differing]:
    """Random lanes of each map, simulated once more."""
    picked = _random.integers(0, SIDE, (len(maps), 2, SAMPLE))
    lanes = [seen.plane.lane(*place) for seen, place in zip(maps, picked, strict=True)]
    together = {name: np.concatenate([lane[name] for lane in lanes]) for name in lanes[0]}
    with Clock() as clock:
        again = settled(together, vi.Adaptive(rtol=1e-9), paired=True, lanes=256)
    say(f"{again.sizes['sample']} lanes by Adaptive in {clock.wall:.1f} s")
    found = []
    for part, (seen, (i, j)) in enumerate(zip(maps, picked, strict=True)):
        one = again.isel(sample=slice(part * SAMPLE, (part + 1) * SAMPLE))
        period, impacts = one["period"].values, one["impacts"].values
        was, had = seen.period[i, j], seen.impacts[i, j]
        other = (period != was) | ((period > 0) & (impacts != had))
        irregular = other & ((was <= 0) | (period <= 0))
        border = other & ~irregular & _borders(seen)[i, j]
        rest = other & ~irregular & ~border
        found.append(Differing(*(int(x.sum()) for x in (other, irregular, border, rest))))
    return found


def _borders(seen: Seen) -> np.ndarray:
    """Which lanes have another regime among their eight neighbours."""
    kind = np.stack([seen.period, np.where(seen.period > 0, seen.impacts, -1)])
    wide = np.pad(kind, ((0, 0), (1, 1), (1, 1)), mode="edge")
    shifted = [
        wide[:, a : a + SIDE, b : b + SIDE] for a, b in itertools.product(range(3), repeat=2)
    ]
    return np.any([np.any(kind != s, axis=0) for s in shifted], axis=0)
