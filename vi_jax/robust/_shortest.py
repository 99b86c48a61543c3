"""The shortest kick onto the stable manifold of a saddle, by its gradient.

The boundary of a basin is, near the shortest kick, the stable manifold of a saddle xₛ: the states x
whose image Pⁿ(x) has no part along the saddle's unstable direction. With w the left eigenvector of
the saddle's monodromy matrix for its multiplier outside the unit circle, that is

    g(z) = w·(Pⁿ(x(z)) - xₛ) = 0,

up to the square of Pⁿ(x) - xₛ, which shrinks as n grows. Least |z|² under it has Lagrange's
equations z = λ∇g, g = 0, which Newton's method solves; ∇g is exact, through the impacts, and its
own derivatives are differences of ∇g between lanes beside each other.
"""

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from ..machine import in_rows
from ..orbit import Orbit, cycle_map
from ._rays import Kick, Kicks
from ._settling import Row, Rows, Settling, images

# Where the motion on the edge is as near to the saddle as this, Newton's method begins; it goes on
# with one period more until a kick moves by less than that, relative to its norm. Choices.
_BEGINS, _STANDS = 0.05, 1e-11

# Below this, relative to the norm, a change that is no smaller than the one before is the method's
# own error (adaptive steps of 1e-11 leave some 1e-9 in a gradient), and the kick stands. A choice.
_NOISE = 1e-7

# Periods more that are tried, and Newton steps for each: choices.
_PERIODS, _STEPS = 12, 12

# Of the differences of gradients, relative to the norm of the kick; and the longest step, likewise.
_DIFFERENCE, _STEP = 1e-5, 0.2

# A kick that turns by more than this, relative to its norm, has left the place where it was begun.
_STRAYS = 0.5


Edge = Callable[[Kicks], tuple[Row, Kicks]]
"""g and its gradient at some kicks."""


def shortest(settling: Settling, kick: Kick, saddle: Orbit, z: Row) -> tuple[Row, float] | None:
    """The kick of least norm onto the stable manifold of a saddle, near a kick onto it that is
    known to rounding; `None` where Newton's method finds none, as beside a grazing.

    **Returns:** the kick and what it lacks: its distance from the manifold to first order and how
    far it is from standing at a right angle on it, both relative to its norm; the larger.
    """
    rows, normals = _frame(settling, saddle)
    if not np.isfinite(normals).all():
        return None
    period = len(rows)
    # A motion that begins within rounding of the manifold stays near it for so many periods.
    growth = float(np.max(np.abs(np.asarray(saddle.multipliers))))
    longest = int(np.clip(np.log(1e14) / np.log(growth), 8, 400))
    trail = settling.trail(kick.rows(z)[None], longest * period)[0]
    apart = settling.apart(trail[1:, None], rows)
    near = np.flatnonzero(apart.min(axis=1) <= _BEGINS)
    if not near.size:
        return None
    place = int(apart[near[0]].argmin())

    def edge(z: Kicks, cycles: int) -> tuple[Row, Kicks]:
        numbers = (jnp.asarray(x) for x in (kick.rows(z), cycles, settling.begin))
        there, jacobian = images(settling.the_map, settling.like, *numbers)
        slope = normals[place] @ np.asarray(jacobian)[:, :, list(kick.places)]
        away = settling.near(np.asarray(there), rows[place]) - rows[place]
        return away @ normals[place], slope / kick.weights

    first, before, last = z, None, np.inf
    for more in range(_PERIODS):
        found = _newton(functools.partial(edge, cycles=int(near[0]) + 1 + more * period), z)
        if found is None or np.linalg.norm(found[0] - first) > _STRAYS * np.linalg.norm(first):
            return before
        moved, z = float(np.linalg.norm(found[0] - z) / np.linalg.norm(z)), found[0]
        if more and _stands(moved, last):
            return found
        before, last = found if more else None, moved
    return before


def _stands(change: float, last: float) -> bool:
    """Whether a change, relative to the norm, is nothing, or nothing but the method's error."""
    return change <= _STANDS or last / 2 <= change <= _NOISE


def _frame(settling: Settling, saddle: Orbit) -> tuple[Rows, Rows]:
    """Section states of a saddle, and at each the left eigenvector that its unstable direction has
    there, of unit length."""
    period = int(saddle.cycles)
    rows = np.asarray(in_rows(saddle.sections))[:period]
    the_map = settling.the_map
    whole = cycle_map(the_map.machine, period, method=the_map.method)
    normals = []
    for row in rows:
        state = settling.state(row)
        jacobian = np.asarray(whole.jacobian(state))
        if not np.isfinite(jacobian).all():
            return rows, np.full_like(rows, np.nan)
        values, vectors = np.linalg.eig(jacobian.T)
        normal = np.real(vectors[:, np.argmax(np.abs(values))])
        normals.append(normal / np.linalg.norm(normal))
    return rows, np.array(normals)


def _newton(edge: Edge, z: Row) -> tuple[Row, float] | None:
    """A solution of Lagrange's equations near a kick, or `None`."""
    size, multiplier, last = z.size, None, np.inf
    for _ in range(_STEPS):
        step = _DIFFERENCE * np.linalg.norm(z)
        aside = step * np.eye(size)
        values, slopes = edge(np.concatenate([z[None], z + aside, z - aside]))
        if not np.isfinite(slopes).all() or not np.any(slopes[0]):
            return None
        # In units in which the gradient has length one.
        unit = np.linalg.norm(slopes[0])
        value, slope = values[0] / unit, slopes[0] / unit
        hessian = (slopes[1 : size + 1] - slopes[size + 1 :]) / (2 * step * unit)
        if multiplier is None:
            multiplier = float(z @ slope)
        lacks = np.concatenate([z - multiplier * slope, [value]])
        matrix = np.zeros((size + 1, size + 1))
        matrix[:size, :size] = np.eye(size) - multiplier * 0.5 * (hessian + hessian.T)
        matrix[:size, size], matrix[size, :size] = -slope, slope
        try:
            change = np.linalg.solve(matrix, -lacks)
        except np.linalg.LinAlgError:
            return None
        length, norm = float(np.linalg.norm(change[:size])), float(np.linalg.norm(z))
        change *= min(1.0, _STEP * norm / length) if length else 1.0
        z = z + change[:size]
        multiplier = None if length > _STEP * norm else multiplier + float(change[size])
        if _stands(length / norm, last):
            return z, float(np.max(np.abs(lacks)) / norm)
        last = length / norm
    return None
