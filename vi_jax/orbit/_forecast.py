"""What the local map of a grazing settles on: iterated over decades of the parameter, and named."""

from typing import Any, NamedTuple

import numpy as np

from ..flow import NamedEnumeration
from ._local_map import LocalMap

# Longest period looked for, and the iterates it is looked for in.
LONGEST, LOOKED = 64, 192

# A motion is periodic if it repeats within this share of one kick: a choice, far above what
# settling leaves (`_LEFT`) and far below what chaos differs by.
_REPEATS = 1e-3

# Farther away than so many kicks nothing comes back: a choice.
_LOST = 1e9

# So much of what the slowest multiplier keeps may be left after settling; within these bounds.
_LEFT, _FEWEST, _MOST = 1e-7, 400, 6000

# Attractors of the local map shrink towards the grazing; one whose depth is so many times that of a
# first impact does not (a chain of impacts within a small attractor reached twice that at most in
# trials). Depths, over the largest that matters, at which that is tried, and how many. Choices.
_LOCAL, _TINY, _PROBES = 4.0, (1e-14, 1e-12), 24

# Of all values at most so many may be aperiodic for windows that lie next to each other, and at
# least so many for chaos alone. Measured for the root map of one multiplier λ: at most 1.5 % at
# λ = 0.24, 2.6 % at 0.26, 6 % at 0.3, 36 % at 0.5, 91 % at 0.66, 96.8 % at 0.67, all above 0.7.
_FEW, _ALL = 0.02, 0.96

# So many iterates are sought through for the greatest entry, by which the parameter is scaled.
_ENTRIES = 24


class SCENARIOS(NamedEnumeration):
    """Scenarios beyond a grazing, on the side of the parameter on which impacts appear."""

    persistence = "the motion continues and stays stable, now with the impact"
    nonsmooth_fold = (
        "it meets an unstable motion with the impact, and both end: the next motion is far away"
    )
    period_adding = (
        "period adding: windows of motions with one impact in n periods lie next to each other, n "
        "growing towards the grazing"
    )
    period_adding_with_chaos = (
        "period adding with chaos between: windows of motions with one impact in n periods, n "
        "growing towards the grazing, and chaos between them"
    )
    chaos = "chaos at once, its size growing as the root of the parameter"
    periodic = "other periodic motions with impacts, near the old one"
    windows_and_chaos = "other periodic motions and chaos in turn, near the old one"
    jump = "no attractor is near: the next motion is far away"


class Settled(NamedTuple):
    """What the map settles on near the grazing, lane by lane."""

    period: np.ndarray
    """In periods of the motion that grazes; 0 where there is none up to `LONGEST`, -1 where what
    attracts is not near."""
    impacts: np.ndarray
    """At the touches, in a period; a mean over one where there is no period."""
    places: np.ndarray
    """Behind the first touch, less the smooth motion there; (lanes, LOOKED, states)."""
    depth: np.ndarray
    """The deepest penetration √(-h) that there would be."""


def periods_in(rows: np.ndarray, hits: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The least period of each lane up to `LONGEST`, or 0.

    **Arguments:** `rows`, what repeats, (lanes, length, numbers); `hits`, the impacts in each
    iterate, (lanes, length); `size`, how large one kick is, (lanes,).
    """
    found = np.zeros(len(rows), int)
    for p in range(LONGEST, 0, -1):
        apart = np.abs(rows[:, p:] - rows[:, :-p]).max(axis=(1, 2))
        same = (hits[:, p:] == hits[:, :-p]).all(axis=1)
        found = np.where(same & (apart <= _REPEATS * size), p, found)
    return found


def settling(local: LocalMap) -> int:
    """How many iterates it takes to settle, by the slowest multiplier."""
    slowest = np.abs(np.linalg.eigvals(local.matrix)).max()
    if slowest <= 0 or slowest >= 1:
        return _FEWEST if slowest <= 0 else _MOST
    return int(np.clip(np.log(_LEFT) / np.log(slowest), _FEWEST, _MOST))


def kick_sizes(local: LocalMap, offsets: np.ndarray) -> np.ndarray:
    """The largest change of a state by the first impact, at each offset of the parameter."""
    depth = np.abs(np.outer(offsets, local.slopes))
    return (depth**local.orders * np.abs(local.kicks).max(axis=1)).max(axis=1)


def settled(local: LocalMap, offsets: np.ndarray) -> Settled:
    """What the local map settles on, at each offset of the parameter."""
    found = _iterated(local, offsets)
    near = found.depth <= local_depths(local, offsets)
    return found._replace(period=np.where(near, found.period, -1))


def lanes_of(found: Settled, which: Any) -> Settled:
    """Some of the lanes, by number or by flag."""
    return Settled(*(part[which] for part in found))


def _iterated(local: LocalMap, offsets: np.ndarray) -> Settled:
    """The local map iterated from the smooth motion on, at each offset of the parameter."""
    z = np.zeros((len(offsets), local.matrices.shape[1]))
    settle = settling(local)
    places = np.zeros((len(offsets), LOOKED, z.shape[1]))
    hits = np.zeros((len(offsets), LOOKED))
    deepest, size = np.zeros(len(offsets)), kick_sizes(local, offsets)
    with np.errstate(over="ignore", invalid="ignore"):
        for n in range(settle + LOOKED):
            i = n - settle
            for k, N in enumerate(local.matrices):
                depth = np.maximum(-(local.slopes[k] * offsets + z @ local.gradients[k]), 0.0)
                kicked = z + depth[:, None] ** local.orders[k] * local.kicks[k]
                z = kicked @ N.T
                if i >= 0:
                    hits[:, i] += depth > 0
                    deepest = np.maximum(deepest, np.sqrt(depth))
                    if k == 0:
                        places[:, i] = kicked
        period = periods_in(places, hits, size)
    lost = ~(np.abs(z).max(axis=1) <= _LOST * size)
    period = np.where(lost, -1, period)
    return Settled(period, impacts_in(hits, period), places, deepest)


def impacts_in(hits: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Impacts in a period of each lane; in an iterate, on average, where there is none."""
    last = np.arange(hits.shape[1]) >= hits.shape[1] - period[:, None]
    return np.where(period > 0, (hits * last).sum(axis=1), hits.mean(axis=1))


def local_depths(local: LocalMap, offsets: np.ndarray) -> np.ndarray:
    """How deep an attractor that begins at the grazing may be, at each offset of the parameter.

    Its depth is that of a first impact, √ε, times a number; or, where an impact brings a further
    touch that is as much deeper as the kick is larger than ε, of the order of its root (as of some
    motions between two stops). Whether that happens is seen far below all offsets.
    """
    first = np.sqrt(np.abs(np.outer(offsets, local.slopes)).max(axis=1))
    if local.orders[0] != 0.5:
        return _LOCAL * first
    scale = np.sqrt(natural_depth(local))
    sense = -np.sign(local.slopes[0])
    tiny = sense * np.geomspace(*_TINY, _PROBES) * scale**2 / np.abs(local.slopes[0])
    shallow = np.sqrt(np.abs(np.outer(tiny, local.slopes)).max(axis=1))
    found = _iterated(local, tiny)
    if (found.depth <= _LOCAL * shallow).mean() > 0.5:
        return _LOCAL * first
    near = (found.depth <= _LOCAL * np.sqrt(scale * shallow)) & (found.period >= 0)
    return _LOCAL * np.sqrt(scale * first) if near.mean() > 0.5 else _LOCAL * first


def natural_depth(local: LocalMap) -> float:
    """The depth (in the distance h) at which a kick of the root is as large as what it adds to the
    distance later: beyond it there are no windows."""
    entries = np.abs(local.entries(_ENTRIES)) if local.orders[0] == 0.5 else np.array([np.inf])
    return float(entries.max() ** 2)


def scenario_of(local: LocalMap, offsets: np.ndarray, found: Settled) -> tuple[str, float]:
    """What follows, by its name in `SCENARIOS`, and the share of offsets without a period. Whether
    there is an attractor near, and whether that is the motion itself, the nearer half says.

    **Arguments:** the map; offsets of the parameter on the side of the impacts, evenly spaced by
    their logarithm; what it settles on there.
    """
    near = found.period >= 0
    close = np.abs(offsets) <= np.median(np.abs(offsets))
    if near[close].mean() < 0.5:
        folds = local.orders[0] == 0.5 and len(local.kicks) == 1 and _sum_of_entries(local) < 0
        return ("nonsmooth_fold" if folds else "jump"), 0.0
    if (found.period[near & close] == 1).mean() > _ALL:
        return "persistence", 0.0
    period, impacts = found.period[near], found.impacts[near]
    aperiodic = float((period == 0).mean())
    if aperiodic > _ALL:
        return "chaos", aperiodic
    # A motion with one impact in n periods, or what doubling makes of it.
    single = (period > 1) & (impacts > 0) & (period == impacts * (period // np.maximum(impacts, 1)))
    adding = single.sum() > 0.5 * (period > 0).sum() and _next_to_each_other(
        offsets[near], np.where(single & (impacts == 1), period, 0)
    )
    if aperiodic < _FEW:
        return ("period_adding" if adding else "periodic"), aperiodic
    return ("period_adding_with_chaos" if adding else "windows_and_chaos"), aperiodic


def _next_to_each_other(offsets: np.ndarray, period: np.ndarray) -> bool:
    """Whether the periods of motions with one impact (0 elsewhere) grow towards the grazing, some n
    next to n + 1. Between two stops, say, there may be 5 and 7 without 6 or anything beyond: no
    period adding."""
    kinds = np.unique(period[period > 0])
    places = [np.median(np.log(np.abs(offsets[period == n]))) for n in kinds]
    return bool((np.diff(places) < 0).all() and (np.diff(kinds) == 1).any())


def _sum_of_entries(local: LocalMap) -> float:
    """Σ eₙ, whose sign says on which side there is a motion with an impact in each period."""
    N, u = local.matrix, local.kicks[0]
    return float(local.gradients[0] @ np.linalg.solve(np.eye(len(N)) - N, N @ u))


class Windows(NamedTuple):
    """Where motions with one impact in n periods exist, n = 1, 2, …; by the local map."""

    period: np.ndarray
    """n of each row: how many cycles of the machine one motion takes."""
    exists: np.ndarray
    """Values of the parameter, less that of the grazing, between which it does, the nearer end
    first; NaN where nowhere; (n, 2)."""
    stable: np.ndarray
    """And is stable; (n, 2)."""


def windows(local: LocalMap, reach: float, count: int) -> Windows:
    """Motions with one impact in n = 1 … count periods, by the local map of one touch with a root.

    The depth y of the impact solves y² + Eₙ y = ε with Eₙ = ∂h (I - Nⁿ)⁻¹ Nⁿ kick, ε being how far
    the smooth motion is beyond the stop; at the other passages the distance has to be positive. The
    matrix of the motion is Nⁿ (I - kick ∂h/2y).

    **Arguments:** the map; the greatest depth looked at (of h); how many.
    """
    N, h, kick = local.matrix, local.gradients[0], local.kicks[0]
    identity = np.eye(len(N))
    depths = np.sqrt(reach) * np.geomspace(1e-6, 1, 1200)
    exist, steady = [], []
    for n in range(1, count + 1):
        power = np.linalg.matrix_power(N, n)
        back = np.linalg.solve(identity - power, power @ kick)  # where it comes to, over y
        lack = depths**2 + (h @ back) * depths
        offset = -lack / local.slopes[0]
        exists, u = np.ones(len(depths), bool), back + kick
        for _ in range(1, n):
            u = N @ u
            exists &= -lack + (h @ u) * depths > 0
        kicked = np.einsum("y,i,j->yij", -0.5 / depths, kick, h)
        values = np.linalg.eigvals(power @ (identity + kicked))
        exist.append(_between(offset[exists]))
        steady.append(_between(offset[exists & (np.abs(values).max(axis=1) < 1)]))
    return Windows(np.arange(1, count + 1), np.array(exist), np.array(steady))


def _between(offset: np.ndarray) -> tuple[float, float]:
    """The ends of an interval, the one nearer to zero first."""
    if not offset.size:
        return np.nan, np.nan
    low, high = float(offset.min()), float(offset.max())
    return (low, high) if abs(low) <= abs(high) else (high, low)
