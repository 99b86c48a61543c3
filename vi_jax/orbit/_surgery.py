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

from ._corrector import Step, advance, observe, state_at
from ._flight import Event
from ._shooting import Shooting
from ._solution import sections_of


def halves(problem: Shooting, step: Step) -> np.ndarray:
    """How the second half of the period differs from the first; empty if it cannot be alike."""
    events, cycles = problem.events, problem.cycles
    legs = len(events)
    if cycles % 2 or legs % 2 or not _alike(events, cycles):
        return np.zeros(0)
    x = jnp.asarray(step.x)
    turn = float(problem.period(x)) / 2
    if not legs:
        middle = state_at(problem, x, jnp.asarray(0), jnp.asarray(turn))
        return np.asarray(ravel_pytree(middle)[0] - x[: problem.states])
    clock, states = (np.asarray(a) for a in problem.parts(x))
    half = legs // 2
    late = clock[half:] - clock[:half] - turn
    return np.append(late, (states[half:] - states[:half]).ravel())


def _alike(events: tuple[Event, ...], cycles: int) -> bool:
    """Whether both halves of a period have the same events."""
    half = len(events) // 2
    return events[:half] == tuple(event.later(-(cycles // 2)) for event in events[half:])


def several(old: Shooting, n: int) -> Shooting:
    """The equations of a motion that is gone through n times."""
    events = tuple(event.later(i * old.cycles) for i in range(n) for event in old.events)
    return dataclasses.replace(
        old, cycles=n * old.cycles, events=events, modes=old.modes * (n if events else 1),
        steps=n * old.steps,
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
        modes=problem.modes[: max(1, legs)], steps=problem.steps // 2,
    )  # fmt: skip
    clock, states = (np.asarray(a) for a in problem.parts(x))
    if legs:
        clock = 0.5 * (clock[:legs] + clock[legs:] - turn)
        states = 0.5 * (states[:legs] + states[legs:])
    else:
        states = states + 0.5 * halves(problem, at)
    mean = np.asarray(half.pack(clock, states, at.x[-count:], turn))
    scale = half.scale(scale[-count:])
    along = np.append(np.zeros(mean.size - 1), 1.0)

    def missing(shift: float) -> float:
        step = advance(half, mean, along, scale, shift)
        M = step.seen.monodromy
        return float(np.linalg.det(M + np.eye(len(M)))) if bool(step.good) else np.nan

    from scipy.optimize import newton  # slow to load

    shift, report = newton(  # pyright: ignore[reportAssignmentType]
        missing, 0.0, x1=1e-6, tol=1e-14, full_output=True, disp=False
    )
    if not report.converged or not abs(shift) < 1e-2:
        return at, half, advance(half, mean, along, scale, 0.0)
    found = advance(half, mean, along, scale, float(shift))
    x = repeated(half, found.x, problem)
    return at._replace(x=x, size=found.size, seen=observe(problem, x)), half, found


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
