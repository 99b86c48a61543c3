"""Where the rays of kicks from a motion leave its basin first."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ._settling import Row, Settling

Kicks = Float[np.ndarray, "..."]
"""Kicks, the components last."""

# Points of a ray that are judged at once between two others: a choice, three bits a round.
_BETWEEN = 7

# Rounds by which the exits of the rays are narrowed before they are compared, and at most those of
# a closer look. Choices.
_COARSE, _FINE = 7, 17

# Points on a ray as the rays grow, doubled until one leaves, at most so many times.
_DOUBLINGS = 12

# Directions looked at around the best, per dimension; a round narrows them to a third. Choices.
AROUND, NARROWER = 12, 3.0


class Kick(eqx.Module):
    """The kicks that are looked for: which numbers of the state, how they are weighed, how far.

    A kick is a vector in units of the weights: component i of the state changes by zᵢ/wᵢ, and |z|
    is the kick's norm.
    """

    start: Row
    """The state that is kicked."""
    places: tuple[int, ...] = eqx.field(static=True)
    """Of the components, among all numbers of the state."""
    weights: Row
    low: Row
    """The least that each component may become, -∞ if any."""
    high: Row

    @property
    def size(self) -> int:
        """Number of components."""
        return len(self.places)

    def rows(self, z: Kicks) -> Any:
        """The states that kicks lead to."""
        rows = np.broadcast_to(self.start, (*z.shape[:-1], self.start.size)).copy()
        rows[..., self.places] += z / self.weights
        return rows

    def allowed(self, z: Kicks) -> Bool[np.ndarray, "..."]:
        """Whether they stay within the bounds."""
        there = self.rows(z)[..., self.places]
        return np.asarray(((there >= self.low) & (there <= self.high)).all(axis=-1))


@dataclasses.dataclass(frozen=True)
class Exits:
    """Where rays leave the basin."""

    directions: Kicks
    """Units, (rays, components)."""
    inside: Float[np.ndarray, " rays"]
    """The last radius on each that comes back, before the first that does not."""
    outside: Float[np.ndarray, " rays"]
    """The first that does not; infinite where a ray ends before (a stop, a bound)."""


def spread(count: int, size: int, seed: int) -> Kicks:
    """Directions all around: both ways along a line, evenly around a circle, at random in more
    dimensions."""
    if size == 1:
        return np.array([[1.0], [-1.0]])
    if size == 2:
        angle = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    z = np.random.default_rng(seed).normal(size=(count, size))
    return z / np.linalg.norm(z, axis=1, keepdims=True)


def exits(
    settling: Settling, kick: Kick, directions: Kicks, inside: Any, outside: Any, points: int
) -> Exits:
    """Of so many points between two radii of each ray, the first that does not come back.

    **Arguments:** `inside` and `outside`, the radii of each ray, of which the latter is judged too.
    """
    parts = np.arange(1, points + 1) / points
    inside = np.broadcast_to(inside, len(directions)).astype(float)
    outside = np.broadcast_to(outside, len(directions)).astype(float)
    radii = inside[:, None] + parts * (outside - inside)[:, None]
    z = radii[..., None] * directions[:, None]
    # What lies beyond a bound is not judged: the ray ends at the last point within.
    within = np.logical_and.accumulate(kick.allowed(z), axis=1).sum(axis=1)
    rows = kick.rows(z)
    rows[~kick.allowed(z)] = kick.start
    place, leaves = settling.first_change(rows)
    leaves &= place < within
    ends = np.concatenate([inside[:, None], radii], axis=1)
    rays = np.arange(len(directions))
    last = ends[rays, np.minimum(np.where(leaves, place, 0), points)]
    first = np.where(leaves, ends[rays, np.minimum(place + 1, points)], np.inf)
    return Exits(directions, last, first)


def narrowed(settling: Settling, kick: Kick, found: Exits, rounds: int) -> Exits:
    """Exits to some bits more: the first change in each bracket, again and again."""
    good = np.isfinite(found.outside)
    inside, outside = found.inside[good], found.outside[good]
    directions = found.directions[good]
    for _ in range(rounds):
        if not good.any() or np.all(outside - inside <= 4e-16 * outside):
            break
        new = exits(settling, kick, directions, inside, outside, _BETWEEN + 1)
        # The outer end of a bracket was judged before; a bracket without a change is kept.
        same = ~np.isfinite(new.outside)
        inside = np.where(same, inside, new.inside)
        outside = np.where(same, outside, new.outside)
    return Exits(directions, inside, outside)


def first_exits(
    settling: Settling, kick: Kick, directions: int, points: int, largest: float | None, seed: int
) -> Exits:
    """Where rays all around leave the basin, each to some bits.

    The rays grow until one leaves, then points are set as densely again on what is not longer than
    the shortest way out, until that is not shortened any more.

    **Arguments:** numbers of rays and of points on each; the largest norm of a kick, `None` for as
    large as it takes to leave.
    """
    rays = spread(directions, kick.size, seed)
    reach = largest
    if reach is None:
        sizes = settling.unit + np.abs(kick.start[list(kick.places)])
        reach = float(np.max(kick.weights * sizes)) / 4
    found = exits(settling, kick, rays, 0.0, reach, points)
    for _ in range(_DOUBLINGS if largest is None else 0):
        if np.isfinite(found.outside).any():
            break
        reach *= 2
        found = exits(settling, kick, rays, 0.0, reach, points)
    while np.isfinite(found.outside).any():
        least = found.outside.min()
        closer = exits(settling, kick, rays, 0.0, least, points)
        nearer = closer.outside < found.outside
        found = Exits(
            rays,
            np.where(nearer, closer.inside, found.inside),
            np.where(nearer, closer.outside, found.outside),
        )
        if found.outside.min() > 0.5 * least:
            break
    return narrowed(settling, kick, found, _COARSE)


def nearest_first(found: Exits, most: int) -> list[int]:
    """The rays that leave sooner than their neighbours, the soonest first, at most so many: two
    neighbours around a circle, a choice of three per dimension in more."""
    units, size = found.directions, found.directions.shape[1]
    neighbours = 3 * size if size > 2 else 2 * (size - 1)
    near = np.argsort(-(units @ units.T), axis=1, kind="stable")[:, 1 : neighbours + 1]
    least = found.outside <= np.min(found.outside[near], axis=1, initial=np.inf)
    order = np.argsort(found.outside, kind="stable")
    return [int(i) for i in order if least[i]][:most]


def nearer(
    settling: Settling, kick: Kick, unit: Row, radius: float, angle: float, rounds: int, seed: int
) -> tuple[Row, float, float]:
    """A direction near another one that leaves sooner, by looking ever more closely around the
    best: for a boundary without a derivative.

    **Returns:** the direction, the last radius that comes back and the first that does not.
    """
    rng = np.random.default_rng(seed)
    best: tuple[Row, float, float] = unit, 0.0, radius
    for _ in range(rounds):
        around = _around(best[0], angle, rng)
        coarse = exits(settling, kick, around, 0.0, best[2] * (1 + angle**2), 2 * AROUND)
        # A direction so far off is worse by the square of the angle, or better.
        bits = min(_FINE, math.ceil(-math.log2(angle**2) / 3) + 1)
        found = narrowed(settling, kick, coarse, max(1, bits))
        if len(found.outside):
            i = int(np.argmin(found.outside))
            if found.outside[i] <= best[2]:
                best = found.directions[i], float(found.inside[i]), float(found.outside[i])
        angle /= NARROWER
    return best


def _around(unit: Row, angle: float, rng: np.random.Generator) -> Kicks:
    """Directions within an angle of another one, and itself."""
    if unit.size == 1:
        return unit[None]
    across = np.linalg.svd(unit[None])[2][1:]
    if unit.size == 2:
        steps = np.linspace(-angle, angle, 2 * AROUND + 1)[:, None]
    else:
        steps = rng.normal(size=(AROUND * unit.size, unit.size - 1)) * angle / 2
        steps = np.concatenate([np.zeros((1, unit.size - 1)), steps])
    z = np.asarray(unit) + np.asarray(steps) @ across
    return z / np.linalg.norm(z, axis=1, keepdims=True)
