"""Which of many found orbits are different motions."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import given_number, short
from .._messages import so_many
from ..machine import (
    angles_in,
    bare,
    cycles_in_words,
    in_rows,
    nearest_images,
    state_in_words,
    units_of,
)
from .floquet import STABILITY
from .results import InWords, Orbit, hits_in_words, span_in_words, trimmed


def unit_of(states: Any) -> Any:
    """Return what counts as 1 where states of a motion are compared: the largest of their
    components, but at most 1; and 1 if all are zero."""
    size = abs(states).max()
    return (size + (size == 0)).clip(None, 1)


def distance(here: Any, there: Any, unit: Any = 1) -> Any:
    """Return how far states lie from others, relative to `unit` + |state| of the latter.

    Of the components, the last axis, that counts which differs most. Everywhere in the package this
    number says whether two states, or two motions, are the same; `unit` is that of `unit_of`.
    """
    return (abs(here - there) / (unit + abs(there))).max(axis=-1)


class Orbits(InWords, list[Orbit]):
    """Several periodic motions: a list that prints as a table, one motion a line."""

    def __str__(self) -> str:
        return "\n".join([so_many(len(self), "orbit"), *map(in_one_line, self)])


def in_one_line(orbit: Orbit) -> str:
    """A motion in one line."""
    cycles = int(orbit.cycles)
    period = cycles_in_words(orbit.machine, cycles)
    stable = STABILITY[orbit.stability].partition(":")[0]
    where = state_in_words(bare(orbit.state), 6, units_of(orbit.machine))
    size = f"; greatest multiplier {np.abs(orbit.multipliers).max():.6g}"
    size = "" if orbit.stability == STABILITY.unknown else size
    found = f"  {period}, {hits_in_words(orbit)}, {stable}: {where}; {span_in_words(orbit, 6)}"
    return found + size


def distinct_orbits(orbits: Orbit, *, tolerance: float = 1e-6) -> tuple[Orbits, np.ndarray]:
    """Return the different motions among many searches.

    Motions that differ only by the cycle on which they are observed count as one, and a motion
    found with a multiple of its period counts with its least period. Searches that found nothing
    are left out. Host-side: not to be traced.

    **Arguments:** a batch of orbits from `find_orbit` (of any shape); two motions are the same if
    their sections agree to `tolerance` (relative to the size of the motion: u + |state|, u the
    largest component, at most 1).

    **Returns:** the orbits, a list that prints one motion a line, by period and then by least Y,
    each on the section on which it was first found; and for each of them the number of searches
    that found it.
    """
    if not isinstance(orbits, Orbit):
        raise TypeError(f"Argument `orbits` must be from `find_orbit`, but got {short(orbits)}.")
    given_number("tolerance", tolerance, low=0.0)
    found, counts = distinct_among([orbits], tolerance)
    return found, counts[:, 0]


def distinct_among(batches: Sequence[Orbit], tolerance: float) -> tuple[Orbits, np.ndarray]:
    """The different motions in several batches of searches, whose periods asked for may differ; and
    how many searches of each batch found each, (motions, batches). See `distinct_orbits`."""
    chosen: list[Orbit] = []
    paths: list[np.ndarray] = []
    counts: list[np.ndarray] = []
    for which, orbits in enumerate(batches):
        shape = orbits.residual.shape

        def in_one_row(x: object, shape: tuple[int, ...] = shape) -> np.ndarray:
            x = np.asarray(x)
            return x.reshape(-1, *x.shape[len(shape) :])

        found = in_one_row(orbits.successful)
        flat = jtu.tree_map(in_one_row, orbits)
        sections, cycles = np.asarray(in_rows(flat.sections, 2)), flat.cycles
        angles = angles_in(orbits.machine, jtu.tree_map(lambda x: x[0, 0], flat.sections))
        for i in np.flatnonzero(found):
            path = sections[i, : cycles[i]]
            j = _known(paths, path, tolerance, angles)
            if j == len(paths):
                paths.append(path)
                chosen.append(trimmed(jtu.tree_map(lambda x, i=i: jnp.asarray(x[i]), flat)))
                counts.append(np.zeros(len(batches), int))
            counts[j][which] += 1
    order = sorted(range(len(chosen)), key=lambda j: (len(paths[j]), float(chosen[j].y_min)))
    table = np.array([counts[j] for j in order], int).reshape(len(order), len(batches))
    return Orbits(chosen[j] for j in order), table


def _known(
    paths: list[np.ndarray], path: np.ndarray, tolerance: float, angles: np.ndarray | None
) -> int:
    """Which of the known motions one is, by its sections from whichever of them on; else how many
    there are."""
    for j, other in enumerate(paths):
        if len(other) == len(path):
            here = nearest_images(angles, path[0], other)
            if distance(here, other, unit_of(other)).min() <= tolerance:
                return j
    return len(paths)
