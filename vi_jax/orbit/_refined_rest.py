"""The place at which a rest is gained or lost, from the hops of its chatter.

A rest is lost where its chatter takes until the stop lets go of the body. At that place each hop is
the one before it on a smaller scale: with the acceleration b τ that presses the body on the stop,
τ the time that is left, a body that leaves at the speed u comes back after σ τ, at the speed V:

    u = b τ² σ (3 - σ)/6,   V = b τ² σ (3 - 2σ)/6,   and leaves again with k V, with r τ left,

where r = 1 - σ, and it does so on the smaller scale, u r², where k (3 - 2σ) = (3 - σ) r². The
speeds of impact fall by r² from hop to hop there. On the one side of the place they come to fall by
k, and the body rests; on the other one faster, and it escapes.

Simulation tells the sides apart by the last hops, which drown in the rounding of the body's place
(of a third power of τ). So the place is looked for at which two hops long before them fall by r²;
for hops later and later that place converges, by a factor known from σ, and is extrapolated.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._programs import compiled
from ._corrector import Step
from ._section_map import SectionMap
from ._shooting import Shooting

# Impacts of a cycle among which a chatter is looked for: a choice; with restitution 0.8 some fifty
# hops take it from the scale of a cycle to a thousandth.
_LISTED = 256

# From where simulation tells the sides apart, the true place is less than this away (in the
# parameter's scale): a choice. Of tried machines it was 2e-5.
_FAR = 1e-3

# The place moves from hop to hop by less and less: so many times at least, and each time by a share
# that is as far from the expected one: choices. With restitution 0.1 it does so twice above the
# rounding; 0.9 to 1.2 times the expected share were seen before that is felt.
_LEAST, _ALIKE = 2, 0.2

# The secant begins with so long a step, and ends with one that is shorter than this: choices, below
# what is left of the rounding in the places.
_BESIDE, _TOLERANCE = 1e-8, 1e-13

# Terms of the departure from the limit that are taken away: the first is a share τ of it, or τ²
# where the acceleration has no term in τ², as that of a wall that is shaken by a sine alone.
_TERMS, _FIRST = 2, (1, 2)


@compiled
def _impacts(problem: SectionMap, x):
    """Speed and stop of all impacts of a period, in their order."""
    log = problem.flown(x, impact_log=_LISTED).impact_log
    assert log is not None
    return log.speed.ravel(), log.stop.ravel()


def refined_rest(problem: Shooting, at: Step, scale: np.ndarray) -> Step:
    """The point at which a rest is gained or lost, from one close to it; the same where no chatter
    is found that takes until the stop lets go.

    **Arguments:** the equations of motions that rest; the point; the size of each unknown.
    """

    def speeds(place: float, stop: int) -> np.ndarray:
        x = jnp.asarray(at.x + place * at.tangent * scale)
        speed, where = (np.asarray(a) for a in _impacts(problem, x))
        return speed[where == stop]

    assert isinstance(problem, SectionMap)
    for i, stop in enumerate(problem.at(jnp.asarray(at.x)).stops):
        V = speeds(0.0, i)
        k = float(stop.share(jnp.asarray(V[-1]))) if V.size > 1 else 0.0
        if 0 < k < 1:
            place = _critical(lambda place, i=i: speeds(place, i), V, k)
            if place is not None and abs(place) < _FAR:
                return at._replace(x=at.x + place * at.tangent * scale)
    return at


def _similar(k: float) -> tuple[float, float]:
    """Of hops on ever smaller scales r, and how fast a departure from them grows, as q: by r^-q a
    hop."""
    from scipy.optimize import brentq  # slow to load

    root: Any = brentq(lambda a: (3 - a) * (1 - a) ** 2 - k * (3 - 2 * a), 0.0, 1.0, xtol=1e-15)
    a = float(root)
    r = 1 - a
    # Derivatives by σ of u/(b τ²), of a hop and of the next one.
    this, after = (3 - 2 * a) / 6, k * ((3 - 4 * a) / r**2 + 2 * a * (3 - 2 * a) / r**3) / 6
    return r, float(-np.log(after / this) / np.log(r))


def _critical(speeds: Callable[[float], np.ndarray], V: np.ndarray, k: float) -> float | None:
    """The place at which the hops of a chatter get smaller by the same factor all along; `None` if
    none do.

    **Arguments:** `speeds`, those of the impacts on a stop by the place; what they are where the
    search begins, two at least; the stop's coefficient of restitution at low speeds.
    """
    from scipy.optimize import newton  # slow to load

    r, q = _similar(k)

    def by(hop: int, begin: float) -> float:
        """Where this hop and the next one fall by r²; NaN if nowhere near."""

        def off(place: float) -> float:
            V = speeds(place)
            return float(np.log(V[hop + 1] / V[hop] / r**2)) if hop + 1 < V.size else np.nan

        place: Any = newton(off, begin, x1=begin + _BESIDE, tol=_TOLERANCE, maxiter=20, disp=False)
        return float(place) if abs(place) < _FAR else np.nan

    # The hops that fall so already tell the place best; what those before and after them tell
    # leads there.
    best = int(np.argmin(np.abs(V[1:] / V[:-1] / r**2 - 1)))
    places = [by(best, 0.0)]
    for hop in range(best + 1, V.size - 1):
        places.append(by(hop, places[-1]))
        if np.isnan(places[-1]):
            break
    for hop in reversed(range(best)):
        places.insert(0, by(hop, places[0]))
        if np.isnan(places[0]):
            break
    return _limit(np.array(places), r, q)


def _limit(places: np.ndarray, r: float, q: float) -> float | None:
    """What a sequence converges to, whose departure falls by r^(1 + q), r^(2 + q) … from term to
    term; `None` if it does not. Its begin and its end, where rounding is all that is left, are not
    counted."""
    steps = np.diff(places)

    def run(first: int) -> tuple[int, int]:
        """The longest part that falls by the factor of this term."""
        falls = np.abs(steps[1:] / (r ** (first + q) * steps[:-1]) - 1) < _ALIKE
        ends = np.flatnonzero(np.diff(np.concatenate([[False], falls, [False]])))
        begin, end = max(ends.reshape(-1, 2), key=np.ptp, default=(0, 0))
        return int(begin), int(end)

    runs = {first: run(first) for first in _FIRST}
    first = max(runs, key=lambda first: runs[first][1] - runs[first][0])
    begin, end = runs[first]
    if end - begin < _LEAST:
        return None
    places = places[begin : end + 2]
    for term in range(first, first + _TERMS):
        factor = r ** (term + q)
        places = places[1:] + np.diff(places) * factor / (1 - factor)
    return float(places[-1])
