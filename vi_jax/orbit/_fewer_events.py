"""The equations of a motion without some of its events, or of its least period."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from ._corrector import state_at
from ._shooting import Shooting
from ._solution import sections_of

# Sections of one motion that differ by less than this (relative to 1 + |state|) are the same: a
# choice, far above what a located point is off by, far below what tells motions apart.
_SAME = 1e-7


def without_events(
    old: Shooting, x: np.ndarray, which: Sequence[int]
) -> tuple[Shooting, np.ndarray]:
    """The equations of a motion without events that change nothing in it (it grazes there), and the
    unknowns that solve them.

    **Arguments:** the equations; their solution; which events to leave out.
    """
    at = jnp.asarray(x)
    clock, states = (np.asarray(a) for a in old.parts(at))
    period, keep = float(old.period(at)), [i for i in range(old.legs) if i not in which]
    if keep:
        clock, states = clock[keep], states[keep]
    else:
        section = state_at(old, at, jnp.asarray(0), jnp.asarray(period))
        clock, states = np.zeros(0), np.asarray(ravel_pytree(section)[0])[None]
    modes = tuple(old.modes[i] for i in keep) or (old.modes[which[-1]],)
    new = dataclasses.replace(old, events=tuple(old.events[i] for i in keep), modes=modes)
    count = len(old.parameters)
    return new, np.asarray(new.pack(clock, states, np.asarray(x)[-count:], period))


def of_least_period(old: Shooting, x: np.ndarray) -> tuple[Shooting, np.ndarray]:
    """The equations of the same motion over its least period, and the unknowns that solve them.

    **Arguments:** the equations; their solution.
    """
    leaves = jax.tree.leaves(sections_of(old, x)[0])
    rows = np.stack([np.asarray(leaf) for leaf in leaves], axis=-1)
    for cycles in range(1, old.cycles):
        turns, rest = divmod(old.cycles, cycles)
        apart = np.abs(np.roll(rows, -cycles, axis=0) - rows) / np.asarray(old.sizes)[1:]
        if not rest and apart.max() < _SAME and len(old.events) % turns == 0:
            break
    else:
        return old, x
    at, legs, count = jnp.asarray(x), max(1, len(old.events) // turns), len(old.parameters)
    clock, states = (np.asarray(a)[:legs] for a in old.parts(at))
    events = tuple(
        e if e.cycle is None else e._replace(cycle=e.cycle % cycles) for e in old.events[:legs]
    )
    steps = old.steps if events else max(1, old.steps // turns)
    new = dataclasses.replace(
        old, cycles=cycles, events=events, modes=old.modes[:legs], steps=steps
    )
    period = float(old.period(at)) / turns
    return new, np.asarray(new.pack(clock, states, np.asarray(x)[-count:], period))
