"""The equations of a motion without some of its events, or over another number of its cycles.

A branch may spring from a motion of half the period of its own (`origin`).
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ._corrector import Step, advance, halves_apart, observe, state_at, tangent_at
from ._locate import zero_near
from ._observed import ROUNDING
from ._shooting import Shooting
from ._solution import sections_of


def several(old: Shooting, n: int) -> Shooting:
    """The equations of a motion that is gone through n times."""
    events = tuple(event.later(i * old.cycles) for i in range(n) for event in old.events)
    # With events `steps` counts those of one leg, which stays as long; but each hop of a chatter
    # takes a part of `steps / cycles`, so that there they grow with the cycles.
    steps = old.steps if events and not old.landings else n * old.steps
    return dataclasses.replace(
        old, cycles=n * old.cycles, events=events, modes=old.modes * (n if events else 1),
        steps=steps,
    )  # fmt: skip


def repeated(problem: Shooting, x: np.ndarray | Array, new: Shooting) -> np.ndarray:
    """The unknowns of a motion that is gone through several times, as those of `new`."""
    clock, states = (np.asarray(a) for a in problem.parts(jnp.asarray(x)))
    turn, n = float(problem.period(jnp.asarray(x))), new.cycles // problem.cycles
    if problem.events:
        clock = (clock + turn * np.arange(n)[:, None]).ravel()
        states = np.tile(states, (n, 1))
    return np.asarray(new.pack(clock, states, x[-len(problem.parameters) :], n * turn))


def origin(problem: Shooting, at: Step, scale: np.ndarray) -> tuple[Step, Shooting, Step]:
    """The point where a branch springs, on the branch and on the motion of half the period, with
    the problem of that motion; on the latter it is located.

    Both branches cross there, so that the equations of this one cannot be solved close by. The
    mean of the two halves is a motion of half the period but for a term of second order.
    """
    count = len(problem.parameters)
    legs, x = len(problem.events) // 2, jnp.asarray(at.x)
    turn = float(problem.period(x)) / 2
    half = dataclasses.replace(
        problem, cycles=problem.cycles // 2, events=problem.events[:legs],
        modes=problem.modes[: max(1, legs)],
        steps=problem.steps if legs else problem.steps // 2,
    )  # fmt: skip
    clock, states = (np.asarray(a) for a in problem.parts(x))
    if legs:
        clock = 0.5 * (clock[:legs] + clock[legs:] - turn)
        states = 0.5 * (states[:legs] + states[legs:])
    else:
        states = states + 0.5 * halves_apart(problem, at) * problem.half_scale()
    mean = np.asarray(half.pack(clock, states, at.x[-count:], turn))
    scale = half.scale(scale[-count:])

    def doubling(step: Step) -> float:
        return float(np.linalg.det(step.seen.monodromy + np.eye(problem.states)))

    found = zero_near(half, mean, scale, doubling)
    if found is None:
        return at, half, advance(half, mean, np.eye(mean.size)[-1], scale, 0.0)
    x = repeated(half, found.x, problem)
    return at._replace(x=x, size=found.size, seen=observe(problem, x)), half, found


def admissible_beside(
    problem: Shooting, x: np.ndarray, scale: np.ndarray, distance: float
) -> Step | None:
    """The admissible motion at a distance from a solution, on whichever side there is one."""
    tangent = tangent_at(problem, x, scale)
    for sense in (1.0, -1.0):
        found = advance(problem, x, sense * tangent, scale, distance)
        seen = found.seen
        inside = min(seen.nearest.room, seen.pull.room, *seen.approach) > 0
        together = ROUNDING * problem.radian
        if bool(found.good) and inside and min(seen.order, seen.apart + together) > 0:
            return found
    return None


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
