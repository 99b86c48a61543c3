"""What a machine does beside a grazing, where the local map forecasts it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._programs import compiled
from ._forecast import (
    Settled,
    is_local,
    settled,
)
from ._full_machine import Simulated, alike, simulated
from ._local_map import Graze
from ._shooting import Shooting

# Decades below the greatest depth that are looked at: a choice.
DECADES = 4

# The machine is asked at one value of so many, and where nothing is touched at one of these.
ASKED, _SPARSE = 6, 4

# The machine agrees over a stretch of the parameter if it does in so much of each half decade: at
# the edges of windows the first order that a local map is does not decide.
_AGREES = 0.75


class Motions(NamedTuple):
    """What is settled on at several values of the parameter, as the local map or the machine has
    it."""

    offset: Float[np.ndarray, " values"]
    """The parameter, less its value at the grazing."""
    period: Int[np.ndarray, " values"]
    """In periods of the motion that grazes; 0 where there is none, -1 where what follows is far
    away."""
    impacts: Float[np.ndarray, " values"]
    """Impacts at the touch in a period; on average over one where there is none."""
    position: Float[np.ndarray, "values looked"]
    """Of the first coordinate on the section, less that of the smooth motion."""


@compiled
def _position_of(problem: Shooting, states):
    """The first coordinate in each state."""
    flat = states.reshape(-1, problem.states)
    return jax.vmap(lambda u: problem.machine.position(problem.unravel(u)))(flat).reshape(
        states.shape[:-1]
    )


def positions(graze: Graze, offsets: np.ndarray, beside: np.ndarray) -> np.ndarray:
    """The first coordinate on the section, less that of the smooth motion.

    **Arguments:** the parameter's offsets; states, less the smooth motion's, (values, looked, n).
    """
    smooth = graze.section.state + np.outer(offsets, graze.section.slope)
    there = _position_of(graze.problem, jnp.asarray(smooth[:, None] + beside))
    return np.asarray(there) - np.asarray(_position_of(graze.problem, jnp.asarray(smooth)))[:, None]


def beside_grazing(
    graze: Graze, offsets: np.ndarray, found: Settled, near: np.ndarray
) -> tuple[Motions, tuple[np.ndarray, np.ndarray], tuple[int, int] | None]:
    """What the machine does at the same values; whether that is alike there, and (at some of them)
    on the other side; and period and impacts of what it settles on if it goes far away.

    **Arguments:** the parameter's offsets; what the local map settles on there, and where near.
    """
    sparse = offsets[::_SPARSE]
    machine = simulated(graze, np.concatenate([offsets, -sparse]))
    n = len(offsets)
    seen = Simulated(*(part[:n] for part in machine))
    beyond = Motions(offsets, seen.period, seen.impacts, positions(graze, offsets, seen.places))
    other = settled(graze.map, -sparse)
    stays = is_local(graze.map, -sparse, other)
    return (
        beyond,
        (
            alike(found, near, seen),
            alike(other, stays, Simulated(*(part[n:] for part in machine))),
        ),
        _far(seen, graze.problem.cycles),
    )


def _far(seen: Simulated, cycles: int) -> tuple[int, int] | None:
    """Period and impacts of what most of the lanes that left settle on."""
    left = seen.period < 0
    if left.mean() < 0.5:
        return None
    both = zip(seen.far[left], seen.hits[left], strict=True)
    kinds = [(int(p) * cycles, round(float(n)) if p else 0) for p, n in both]
    return max(set(kinds), key=kinds.count)


def stretch(
    size: np.ndarray, here: np.ndarray, there: np.ndarray
) -> tuple[tuple[float, float] | None, float]:
    """The longest stretch, in half decades, in which forecast and machine agree, and the share of
    values there that do.

    **Arguments:** sizes of the offsets, rising; where both agree, and on the other side.
    """
    parts = 2 * DECADES
    half = np.minimum((np.arange(len(size)) * parts) // (len(size) - 1), parts - 1)
    good = [
        here[half == i].mean() >= _AGREES and there[half[::_SPARSE] == i].all()
        for i in range(parts)
    ]
    best, begin = (0, 0), None
    for i, fits in enumerate([*good, False]):
        if fits and begin is None:
            begin = i
        elif not fits and begin is not None:
            best, begin = max(best, (begin, i), key=lambda b: b[1] - b[0]), None
    inside = (half >= best[0]) & (half < best[1])
    if not inside.any():
        return None, np.nan
    share = np.concatenate([here[inside], there[inside[::_SPARSE]]]).mean()
    return (float(size[inside][0]), float(size[inside][-1])), float(share)
