"""Kicks from rays made exact, on the section or at another moment, and the worst moment."""

import dataclasses
from typing import NamedTuple

import numpy as np

from ..orbit import Orbit
from ._edge_state import EdgeState, tracked
from ._moments import Moments
from ._rays import NARROWER, Exits, Kick, exits, first_exits, narrowed, nearer, nearest_first
from ._settling import Row, Settling
from ._shortest import Shortest, shortest

# Of the kick, relative to it: by how much more and less simulation confirms it.
ASIDE = 1e-6

# Rounds of looking more closely around the best rays: before Newton's method, and instead of it.
# Choices: the latter narrow a turn of 1/128 to 1e-8.
_LOOKS, _MORE_LOOKS = 2, 14

# Rounds of bisection by eight that leave nothing between two numbers of double precision.
_ROUNDING = 18

# How much longer than what rays found Newton's may be, and how much shorter: else it is another
# kick. A choice, for rays as dense as the default.
_LONGER, _SHORTER = 1e-4, 0.05

# Edges are tracked for so many rounds.
_ROUNDS = 40

# How far along the ray of a kick at one moment the boundary is looked for at the next, relative to
# its norm; and by how much the worst moment's rays reach beyond the kick found for it. Choices.
_REACH, _BEYOND = 2.0, 1.05


class Here(NamedTuple):
    """The moment at which a motion is kicked."""

    settling: Settling
    kick: Kick
    cycle: int
    phase: float

    def at(self, moments: Moments, cycle: int, phase: float) -> "Here":
        """The same kicks at another moment."""
        settling, start = moments.at(cycle, phase)
        kick = dataclasses.replace(self.kick, start=start)
        return Here(settling, kick, cycle, phase)


class Look(NamedTuple):
    """How kicks are looked for; each as `minimal_kick` has it."""

    directions: int
    points: int
    largest: float | None
    candidates: int
    longest: int
    seed: int

    def angle(self, size: int) -> float:
        """How far rays beside each other are apart."""
        return 2 * np.pi / self.directions ** (1 / max(1, size - 1))

    def exits(self, here: Here) -> Exits:
        """Where rays leave the basin."""
        return first_exits(
            here.settling, here.kick, self.directions, self.points, self.largest, self.seed
        )

    def best(self, found: Exits) -> list[int]:
        """Those of them that leave sooner than their neighbours.

        **Raises:** `ValueError` if none leaves.
        """
        best = nearest_first(found, self.candidates)
        if not best or not np.isfinite(found.outside[best[0]]):
            raise ValueError(
                "No kick leads elsewhere, of those that `components`, `bounds` and `largest` "
                "allow: the motion came back from all of them."
            )
        return best


class Found(NamedTuple):
    """A kick onto the boundary."""

    z: Row
    residual: float
    exact: bool
    edge: EdgeState


def exact(here: Here, unit: Row, radius: float, look: Look) -> Found:
    """The shortest kick near a ray that leaves the basin at a radius."""
    settling, kick, _, _ = here
    angle = look.angle(kick.size)
    unit, inside, outside = nearer(settling, kick, unit, radius, angle, _LOOKS, look.seed)
    line = narrowed(
        settling, kick, Exits(unit[None], np.array([inside]), np.array([outside])), _ROUNDING
    )
    outside = float(line.outside[0])
    ends = kick.rows(np.array([line.inside[0], outside * (1 + ASIDE)])[:, None] * unit)
    if settling.begin > 0:
        ends = settling.carried(ends, 1)
    edge = tracked(settling.starting(0.0), ends[0], ends[1], look.longest, _ROUNDS)
    if edge.kind == "saddle" and edge.orbit is not None:
        better = _made_exact(here, edge.orbit, unit * outside, _SHORTER)
        if better is not None:
            return Found(better.z, better.residual, True, edge)
    narrow = angle / NARROWER**_LOOKS
    unit, inside, outside = nearer(settling, kick, unit, outside, narrow, _MORE_LOOKS, look.seed)
    return Found(unit * outside, (outside - inside) / outside, False, edge)


def _made_exact(here: Here, saddle: Orbit, z: Row, shorter: float) -> Shortest | None:
    """The shortest kick near one onto the boundary, which may be so much shorter, relative to its
    norm; `None` where Newton's method finds none such."""
    better = shortest(here.settling, here.kick, saddle, z)
    if better is None:
        return None
    change = np.linalg.norm(better.z) / np.linalg.norm(z) - 1
    return better if -shorter <= change <= _LONGER else None


def worst(moments: Moments, here: Here, look: Look, phases: int) -> tuple[Here, Look]:
    """The moment of the period at which the least kick is smallest, and how to look for it there.

    The first rays at each moment reach no further than the least kick so far, so that most moments
    cost one look.

    **Raises:** `ValueError` where at no moment a kick leads elsewhere.
    """
    clocks, reach = moments.spread(phases), look
    at, found = 0.0, look.exits(here.at(moments, *moments.of(0.0)))
    for clock in clocks[1:]:
        least = float(found.outside.min(initial=np.inf))
        reach = reach if np.isinf(least) else look._replace(largest=least)
        rays = reach.exits(here.at(moments, *moments.of(clock)))
        if rays.outside.min(initial=np.inf) < least:
            at, found = float(clock), rays
    ray = look.best(found)[0]
    least = float(found.outside[ray])
    there = here.at(moments, *moments.of(at))
    first = exact(there, found.directions[ray], least, look)
    nearby, saddle = [first.z], first.edge.orbit if first.exact else None

    def norm(clock: float) -> float:
        z = _nearby(here.at(moments, *moments.of(clock)), nearby[0], saddle, look)
        if z is None:
            return _REACH * float(np.linalg.norm(nearby[0]))
        if np.linalg.norm(z) <= np.linalg.norm(nearby[0]):
            nearby[0] = z
        return float(np.linalg.norm(z))

    apart = moments.ends[-1] / len(clocks)
    refined = moments.least_between(at, apart, norm)
    if norm(refined) > np.linalg.norm(first.z):
        refined = at  # an impact beside it: to one side of it kicks are others
    reach = _BEYOND * float(np.linalg.norm(nearby[0]))
    return here.at(moments, *moments.of(refined)), look._replace(largest=reach)


def _nearby(here: Here, z: Row, saddle: Orbit | None, look: Look) -> Row | None:
    """The least kick near that of a moment before; `None` where the boundary is not there."""
    settling, kick, _, _ = here
    norm = float(np.linalg.norm(z))
    unit = z / norm
    line = exits(settling, kick, unit[None], 0.0, _REACH * norm, look.points)
    line = narrowed(settling, kick, line, _ROUNDING)
    if not line.outside.size:
        return None
    outside = float(line.outside[0])
    if saddle is not None:
        better = _made_exact(here, saddle, unit * outside, 1.0)
        return unit * outside if better is None else better.z
    unit, _, outside = nearer(
        settling, kick, unit, outside, look.angle(kick.size), _LOOKS, look.seed
    )
    return unit * outside
