"""Attractors of the local map of a grazing, on decades of the parameter, and their scenario."""

from typing import NamedTuple

import numpy as np

from ..flow import NamedEnumeration
from .local_map import LocalMap
from .tolerances import ALIKE, SAME

# Longest period that is sought, and the number of iterates in which it is sought.
LONGEST, SOUGHT = 64, 192

# A motion beyond so many kicks does not return: a choice.
_LOST = 1e9

# Bounds of the iterates in which the slowest transient settles to the share `SAME`.
_FEWEST, _MOST = 400, 6000

# An attractor shrinks towards the grazing if its depth is at most this multiple of a first impact's
# (in trials a chain of impacts within a small attractor reached half of it). Its test uses so many
# depths in this interval, relative to the largest relevant one. Choices.
_LOCAL, _TINY, _PROBES = 4.0, (1e-14, 1e-12), 24

# Largest share of aperiodic values for adjacent windows, and smallest share for chaos alone.
# Measured for the root map of one multiplier λ: at most 1.5 % at λ = 0.24; 2.6 % at 0.26; 6 % at
# 0.3; 36 % at 0.5; 91 % at 0.66; 96.8 % at 0.67; all above 0.7.
_FEW, _ALL = 0.02, 0.96

# Number of iterates in which the greatest entry is sought, which scales the parameter.
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


class Attractors(NamedTuple):
    """Attractors of the map near the grazing, lane by lane."""

    period: np.ndarray
    """In periods of the motion that grazes; 0 if none up to `LONGEST`, -1 if it goes away."""
    impacts: np.ndarray
    """Impacts at the touches in a period; the mean over one without a period."""
    places: np.ndarray
    """States after the first touch, less the smooth motion there, in the sizes of the state;
    (lanes, SOUGHT, states)."""
    depth: np.ndarray
    """The deepest penetration √(-h), without an impact."""


def periods_in(rows: np.ndarray, hits: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the least period of each lane up to `LONGEST`, or 0. `rows` (lanes, length,
    components) must repeat to a share `ALIKE` of a kick's `size`, `hits` (impacts per iterate)
    exactly."""
    found = np.zeros(len(rows), int)
    for p in range(LONGEST, 0, -1):
        differences = np.abs(rows[:, p:] - rows[:, :-p]).max(axis=(1, 2))
        same_hits = (hits[:, p:] == hits[:, :-p]).all(axis=1)
        found = np.where(same_hits & (differences <= ALIKE * size), p, found)
    return found


def transient_length(local: LocalMap) -> int:
    """Return the number of iterates of the transient, from the multiplier that decays or grows most
    slowly."""
    with np.errstate(divide="ignore"):
        rate = np.abs(np.log(np.abs(np.linalg.eigvals(local.matrix)))).min()
        return int(np.clip(-np.log(SAME) / rate, _FEWEST, _MOST))


def kick_sizes(local: LocalMap, offsets: np.ndarray) -> np.ndarray:
    """Return the largest change of a state by the first impact, at each offset of the parameter."""
    depth = np.abs(np.outer(offsets, local.slopes))
    return (depth**local.orders * np.abs(local.kicks).max(axis=1)).max(axis=1)


def find_attractors(local: LocalMap, offsets: np.ndarray) -> Attractors:
    found = _iterate(local, offsets)
    near = found.depth <= local_depths(local, offsets)
    return found._replace(period=np.where(near, found.period, -1))


def _iterate(local: LocalMap, offsets: np.ndarray) -> Attractors:
    z = np.zeros((len(offsets), local.matrices.shape[1]))
    settle = transient_length(local)
    places = np.zeros((len(offsets), SOUGHT, z.shape[1]))
    hits = np.zeros((len(offsets), SOUGHT))
    deepest, size = np.zeros(len(offsets)), kick_sizes(local, offsets)
    with np.errstate(over="ignore", invalid="ignore"):
        for n in range(settle + SOUGHT):
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
    # The smooth motion is met exactly, though it attracts none if it is unstable.
    is_unstable = np.abs(np.linalg.eigvals(local.matrix)).max() > 1
    is_lost = ~(np.abs(z).max(axis=1) <= _LOST * size) | (is_unstable & ~hits.any(axis=1))
    period = np.where(is_lost, -1, period)
    return Attractors(period, impacts_in(hits, period), places, deepest)


def impacts_in(hits: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Return the impacts in a period of each lane; without a period the mean in an iterate."""
    last = np.arange(hits.shape[1]) >= hits.shape[1] - period[:, None]
    return np.where(period > 0, (hits * last).sum(axis=1), hits.mean(axis=1))


def local_depths(local: LocalMap, offsets: np.ndarray) -> np.ndarray:
    """Return the greatest depth of an attractor that begins at the grazing, at each offset.

    Its depth is a multiple of that of a first impact, √ε. It is of the order of ε^(1/4) if an
    impact causes a second touch that is deeper than ε, as for some motions between two stops.
    Iterates far below all offsets decide between the two.
    """
    first = np.sqrt(np.abs(np.outer(offsets, local.slopes)).max(axis=1))
    if local.orders[0] != 0.5:
        return _LOCAL * first
    scale = np.sqrt(natural_depth(local))
    sense = -np.sign(local.slopes[0])
    tiny_offsets = sense * np.geomspace(*_TINY, _PROBES) * scale**2 / np.abs(local.slopes[0])
    shallow = np.sqrt(np.abs(np.outer(tiny_offsets, local.slopes)).max(axis=1))
    found = _iterate(local, tiny_offsets)
    if (found.depth <= _LOCAL * shallow).mean() > 0.5:
        return _LOCAL * first
    is_near = (found.depth <= _LOCAL * np.sqrt(scale * shallow)) & (found.period >= 0)
    return _LOCAL * np.sqrt(scale * first) if is_near.mean() > 0.5 else _LOCAL * first


def natural_depth(local: LocalMap) -> float:
    """Return the depth (in the distance h) at which a kick of order 1/2 changes a later distance by
    this depth. Beyond it there are no windows."""
    entries = np.abs(local.entries(_ENTRIES)) if local.orders[0] == 0.5 else np.array([np.inf])
    return float(entries.max() ** 2)


def scenario_of(local: LocalMap, offsets: np.ndarray, found: Attractors) -> tuple[str, float]:
    """Return the scenario's name in `SCENARIOS`, and the share of offsets without a period. The
    half of the offsets nearer to zero decides whether an attractor is near, and whether it is the
    motion itself. The offsets lie on the side of the impacts, evenly spaced by their logarithm."""
    is_near = found.period >= 0
    is_close = np.abs(offsets) <= np.median(np.abs(offsets))
    if is_near[is_close].mean() < 0.5:
        folds = local.orders[0] == 0.5 and len(local.kicks) == 1 and _sum_of_entries(local) < 0
        return ("nonsmooth_fold" if folds else "jump"), 0.0
    if (found.period[is_near & is_close] == 1).mean() > _ALL:
        return "persistence", 0.0
    period, impacts = found.period[is_near], found.impacts[is_near]
    aperiodic = float((period == 0).mean())
    if aperiodic > _ALL:
        return "chaos", aperiodic
    # A motion with one impact in n periods, or its period doublings.
    single = (period > 1) & (impacts > 0) & (period == impacts * (period // np.maximum(impacts, 1)))
    adding = single.sum() > 0.5 * (period > 0).sum() and _are_adjacent(
        offsets[is_near], np.where(single & (impacts == 1), period, 0)
    )
    if aperiodic < _FEW:
        return ("period_adding" if adding else "periodic"), aperiodic
    return ("period_adding_with_chaos" if adding else "windows_and_chaos"), aperiodic


def _are_adjacent(offsets: np.ndarray, period: np.ndarray) -> bool:
    """Return whether the periods of motions with one impact (0 elsewhere) grow towards the grazing,
    with some n next to n + 1. 5 and 7 without 6, as between two stops, are no period adding."""
    kinds = np.unique(period[period > 0])
    places = [np.median(np.log(np.abs(offsets[period == n]))) for n in kinds]
    return bool((np.diff(places) < 0).all() and (np.diff(kinds) == 1).any())


def _sum_of_entries(local: LocalMap) -> float:
    """Return Σ eₙ; its sign gives the side of the motion with an impact in each period."""
    return float(local.gradients[0] @ local.kicked(1)[-1])


class Windows(NamedTuple):
    """Intervals of motions with one impact in n periods, n = 1, 2, …; by the local map."""

    period: np.ndarray
    """n of each row, in periods of the motion that grazes."""
    exists: np.ndarray
    """Offsets of the parameter between which it exists, the nearer first, or NaN; (n, 2)."""
    stable: np.ndarray
    """Offsets between which it is stable; (n, 2)."""


def windows(local: LocalMap, reach: float, count: int) -> Windows:
    """Return motions with one impact in n = 1 … count periods, by the root map of one touch.

    The smooth motion is a distance ε beyond the stop. The depth y of the impact solves y² + Eₙ y =
    ε with Eₙ = ∂h (I - Nⁿ)⁻¹ Nⁿ kick. At the other passages the distance must be positive. The
    matrix of the motion is Nⁿ (I - kick ∂h/2y).
    """
    N, h, kick = local.matrix, local.gradients[0], local.kicks[0]
    identity = np.eye(len(N))
    depths = np.sqrt(reach) * np.geomspace(1e-6, 1, 1200)
    existing, stable = [], []
    for n in range(1, count + 1):
        power = np.linalg.matrix_power(N, n)
        distances = local.kicked(n)[1:] @ h  # over y
        residual = depths**2 + distances[-1] * depths
        offset = -residual / local.slopes[0]
        exists = (-residual + distances[:-1, None] * depths > 0).all(axis=0)
        kick_slopes = np.einsum("y,i,j->yij", -0.5 / depths, kick, h)
        values = np.linalg.eigvals(power @ (identity + kick_slopes))
        existing.append(_interval(offset[exists]))
        stable.append(_interval(offset[exists & (np.abs(values).max(axis=1) < 1)]))
    return Windows(np.arange(1, count + 1), np.array(existing), np.array(stable))


def _interval(offset: np.ndarray) -> tuple[float, float]:
    """Return the ends of an interval, the one nearer to zero first."""
    if not offset.size:
        return np.nan, np.nan
    low, high = float(offset.min()), float(offset.max())
    return (low, high) if abs(low) <= abs(high) else (high, low)
