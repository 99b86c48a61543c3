"""Motions of many machines with contacts and friction by time stepping, like J. J. Moreau's scheme.

No event is located. In each step, the contacts that the middle of the step reaches are struck, the
fastest first, with the share of Newton's restitution that gains no energy. Then impulses of all
satisfy the conditions of contact for velocities. The error is of first order in the step.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

_OPEN = 9

# Most impacts of one step, and the least speed of approach.
_IMPACTS, _STILL = 60, 1e-9

# A step with an impact faster than this is divided into so many parts: two corners of a nearly flat
# block strike within 1e-5, in an order that matters.
_SLOW, _PARTS = 1e-3, 16


def _gradients(functions: Callable[..., Any], q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values (lanes, rows) and derivatives (lanes, rows, coordinates), by complex steps."""
    values = np.stack(functions(q), 1)
    columns = []
    for i in range(q.shape[1]):
        z = q.astype(complex)
        z[:, i] += 1e-30j
        columns.append(np.imag(np.stack(functions(z), 1)) / 1e-30)
    return values, np.stack(columns, 2)


@functools.cache
def _modes_of(n: int) -> np.ndarray:
    return np.array(list(itertools.product([_OPEN, 0, 1, -1], repeat=n)))


def _impulses(
    gains: np.ndarray, free: np.ndarray, mu: np.ndarray, active: np.ndarray
) -> np.ndarray:
    """Return impulses (lanes, 2n) such that the velocities G λ + b satisfy the conditions of
    contact: those of the set of modes that violates them least. Of equal sets it is the first, in
    which few contacts push."""
    n = mu.shape[1]
    modes = _modes_of(n)
    pushes, sticks, slip = modes != _OPEN, modes == 0, np.where(modes == _OPEN, 0, modes)
    held = np.concatenate([pushes, sticks], 1)[None]
    # A set with linearly dependent rows is another one with fewer contacts.
    alone = np.broadcast_to((1 + 1e-13) * np.eye(2 * n), (len(mu), len(modes), 2 * n, 2 * n)).copy()
    i = np.arange(n)
    alone[:, :, n + i, i] = slip * mu[:, None]  # a force against the slip
    matrix = np.where(
        held[..., None], gains[:, None] + 1e-13 * np.diag(1.0 + np.arange(2 * n)), alone
    )
    right = np.where(held, -free[:, None], 0.0)
    force = np.linalg.solve(matrix, right[..., None])[..., 0]
    rate = force @ gains + free[:, None]
    own, shut = np.einsum("lii->li", gains)[:, None], active[:, None]
    push, drag, opens, along = force[..., :n], force[..., n:], rate[..., :n], rate[..., n:]
    beyond = (np.abs(drag) - mu[:, None] * push) * own[..., n:]
    faults = [
        np.where(pushes, np.abs(opens), np.where(shut, -opens, 0)),
        np.where(pushes & ~shut, np.inf, -push * own[..., :n]),
        np.where(sticks, np.maximum(beyond, np.abs(along)), -slip * along),
    ]
    wrong = np.maximum.reduce(faults).max(2)
    size = 1e-14 + np.abs(free).max(1)
    enough = wrong <= 1e-11 * size[:, None]
    chosen = np.where(enough.any(1), enough.argmax(1), wrong.argmin(1))
    return force[np.arange(len(mu)), chosen]


def _without_gain(
    gains: np.ndarray, speeds: np.ndarray, inelastic: np.ndarray, full: np.ndarray
) -> np.ndarray:
    """Return the mean of two impulses (lanes, 2n) with the largest share θ of the second that gains
    no energy. The gain a + bθ + cθ² is not positive at θ = 0."""
    change, middle = full - inelastic, speeds + 0.5 * np.einsum("lij,lj->li", gains, inelastic)
    inner = lambda x, y: np.einsum("li,li->l", x, y)
    a, c = inner(inelastic, middle), 0.5 * np.einsum("li,lij,lj->l", change, gains, change)
    b = inner(change, middle) + 0.5 * np.einsum("li,lij,lj->l", inelastic, gains, change)
    within = a + b + c <= 1e-12 * np.abs(inner(full, speeds))
    root = np.sqrt(np.maximum(b * b - 4 * np.minimum(a, 0) * c, 0)) - b
    share = np.where(within, 1.0, root / np.where(within, 1.0, 2 * c))
    return inelastic + share[:, None] * change


def rows_of(
    gaps: Callable[..., Any], places: Callable[..., Any], given: dict[str, np.ndarray],
    q: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return gaps (lanes, n), the rows of normals and tangents, and their gains. See `moreau`."""
    gap, normals = _gradients(lambda q: gaps(q, given), q)
    _, tangents = _gradients(lambda q: places(q, given), q)
    rows = np.concatenate([normals, tangents], 1)
    return gap, rows, np.einsum("lik,lk,ljk->lij", rows, 1 / given["mass"], rows)


def impacts(
    rows: np.ndarray, gains: np.ndarray, v: np.ndarray, active: np.ndarray,
    given: dict[str, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return velocities after impacts on the contacts that are `active`, the fastest first, and the
    greatest speed of approach. See `moreau`."""
    mu, top = given["mu"], np.zeros(len(v))
    n = mu.shape[1]
    for _ in range(_IMPACTS):
        speeds = np.einsum("lik,lk->li", rows, v)
        closing = np.where(active, -speeds[:, :n], 0.0)
        fastest = closing.max(1, keepdims=True)
        closes, top = fastest > _STILL, np.maximum(top, fastest[:, 0])
        if not closes.any():
            break
        struck = closes & (closing >= (1 - 1e-9) * fastest)
        inelastic, before = _impulses(gains, speeds, mu, struck), speeds.copy()
        speeds[:, :n] -= given["restitution"] * closing * struck
        full = _impulses(gains, speeds, mu, struck)
        impulse = closes * _without_gain(gains, before, inelastic, full)
        v = v + np.einsum("lik,li->lk", rows, impulse) / given["mass"]
    return v, top


def moreau(
    gaps: Callable[..., Any], places: Callable[..., Any], force: Callable[..., Any],
    given: dict[str, np.ndarray], q: np.ndarray, v: np.ndarray, end: float, steps: int,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return positions and velocities at the time `end`, (lanes, coordinates).

    **Arguments:** `gaps` and `places`, functions of the coordinates (lanes, coordinates) and of
    `given` that return for each contact its gap and its place along the surface; `force(t, q, v,
    given)`; `given`, arrays with a row for each lane: `mass`, (lanes, coordinates), `mu` and
    `restitution`, (lanes, contacts), and others.
    """
    dt = end / steps
    for k in range(steps):
        *new, speed = _step(gaps, places, force, given, q, v, k * dt, dt)
        hit = np.flatnonzero(speed > _SLOW)
        if hit.size:
            part = {name: x[hit] for name, x in given.items()}
            end_of_part = q[hit], v[hit]
            for j in range(_PARTS):
                t = (k + j / _PARTS) * dt
                *end_of_part, _ = _step(gaps, places, force, part, *end_of_part, t, dt / _PARTS)
            for x, y in zip(new, end_of_part, strict=True):
                x[hit] = y
        q, v = new
    return q, v


def _step(
    gaps: Callable[..., Any], places: Callable[..., Any], force: Callable[..., Any],
    given: dict[str, np.ndarray], q: np.ndarray, v: np.ndarray, t: float, dt: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return positions and velocities after a step, and the greatest speed of its impacts."""
    mass, middle = given["mass"], q + 0.5 * dt * v
    gap, rows, gains = rows_of(gaps, places, given, middle)
    active = gap <= 0
    if not active.any():
        v = v + dt * force(t + 0.5 * dt, middle, v, given) / mass
        return middle + 0.5 * dt * v, v, np.zeros(len(q))
    v, fastest = impacts(rows, gains, v, active, given)
    v = v + dt * force(t + 0.5 * dt, middle, v, given) / mass
    speeds = np.einsum("lik,lk->li", rows, v)
    impulse = _impulses(gains, speeds, given["mu"], active)
    v = v + np.einsum("lik,li->lk", rows, impulse) / mass
    return middle + 0.5 * dt * v, v, fastest
