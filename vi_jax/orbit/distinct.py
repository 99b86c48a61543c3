"""Which of many found orbits are different motions."""

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import given_number
from ..machine import state_in_words
from .results import InWords, Orbit, impacts_in_words, span_in_words, trimmed


class Orbits(InWords, list[Orbit]):
    """Several periodic motions: a list that prints as a table, one motion a line."""

    def __str__(self) -> str:
        return "\n".join(
            [f"{len(self)} orbit{'' if len(self) == 1 else 's'}", *map(_in_words, self)]
        )


def _in_words(orbit: Orbit) -> str:
    """A motion in one line."""
    cycles = int(orbit.cycles)
    period = orbit.machine.period_of(cycles)
    stable = "stable" if bool(orbit.stable) else "unstable"
    where, span = state_in_words(orbit.state, 6, orbit.machine.units), span_in_words(orbit, 6)
    size = f"greatest multiplier {np.abs(orbit.multipliers).max():.6g}"
    return f"  {period}, {impacts_in_words(int(orbit.impacts))}, {stable}: {where}; {span}; {size}"


def distinct_orbits(orbits: Orbit, *, tolerance: float = 1e-6) -> tuple[Orbits, np.ndarray]:
    """The different motions among many searches.

    Motions that differ only by the cycle on which they are observed count as one, and a motion
    found with a multiple of its period counts with its least period. Searches that found nothing
    are left out. Host-side: not to be traced.

    **Arguments:** a batch of orbits from `find_orbit` (of any shape); two motions are the same if
    their sections agree to `tolerance` (relative to 1 + |state|).

    **Returns:** the orbits, a list that prints one motion a line, by period and then by least Y,
    each on the section on which it was first found; and for each the number of searches that found
    it.
    """
    if not isinstance(orbits, Orbit):
        raise TypeError(f"Argument `orbits` must be from `find_orbit`, but got {orbits!r}.")
    given_number("tolerance", tolerance, low=0.0)
    shape = orbits.residual.shape
    flat = jtu.tree_map(lambda x: jnp.reshape(x, (-1, *x.shape[len(shape) :])), orbits)
    sections = np.stack([np.asarray(x) for x in jtu.tree_leaves(flat.sections)], axis=-1)
    cycles, found = np.asarray(flat.cycles), np.asarray(flat.successful)
    kinds: list[tuple[int, np.ndarray]] = []
    first: list[int] = []
    counts: list[int] = []
    for i in np.flatnonzero(found):
        path = sections[i, : cycles[i]]
        for j, (period, other) in enumerate(kinds):
            if period == cycles[i]:
                apart = np.abs(other - path[0]) / (1 + np.abs(other))
                if (apart.max(axis=1) <= tolerance).any():
                    counts[j] += 1
                    break
        else:
            kinds.append((int(cycles[i]), path))
            first.append(int(i))
            counts.append(1)
    chosen = [trimmed(jtu.tree_map(lambda x, i=i: x[i], flat)) for i in first]
    order = sorted(range(len(chosen)), key=lambda j: (kinds[j][0], float(chosen[j].y_min)))
    return Orbits(chosen[j] for j in order), np.array([counts[j] for j in order], int)
