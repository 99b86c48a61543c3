"""Motions of many machines with contacts and friction by time stepping, like J. J. Moreau's scheme.

No event is located. In each step, the contacts that the middle of the step reaches are struck, the
fastest first. Then impulses of them all satisfy the conditions of contact for velocities. The error
is of first order in the step.
"""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

_OPEN = 9

# Most impacts of one step, and the least speed of approach.
_IMPACTS, _STILL = 60, 1e-9


def _gradients(functions: Callable[..., Any], q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values (lanes, rows) and derivatives (lanes, rows, coordinates), by complex steps."""
    values = np.stack(functions(q), 1)
    columns = []
    for i in range(q.shape[1]):
        z = q.astype(complex)
        z[:, i] += 1e-30j
        columns.append(np.imag(np.stack(functions(z), 1)) / 1e-30)
    return values, np.stack(columns, 2)


def _impulses(
    gains: np.ndarray, free: np.ndarray, mu: np.ndarray, active: np.ndarray
) -> np.ndarray:
    """Return impulses (lanes, 2n) such that the velocities G λ + b satisfy the conditions of
    contact: those of the set of modes that violates them least. Of equal sets it is the first, in
    which few contacts push."""
    n = mu.shape[1]
    modes = np.array(list(itertools.product([_OPEN, 0, 1, -1], repeat=n)))
    pushes, sticks, slip = modes != _OPEN, modes == 0, np.where(modes == _OPEN, 0, modes)
    held = np.concatenate([pushes, sticks], 1)[None]
    # A set with linearly dependent rows is another one with fewer contacts.
    alone = np.broadcast_to((1 + 1e-13) * np.eye(2 * n), (len(mu), len(modes), 2 * n, 2 * n)).copy()
    i = np.arange(n)
    alone[:, :, n + i, i] = slip * mu[:, None]  # a force against the slip
    matrix = np.where(held[..., None], gains[:, None] + 1e-13 * np.eye(2 * n), alone)
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


def moreau(
    gaps: Callable[..., Any], places: Callable[..., Any], mass: np.ndarray,
    force: Callable[..., Any], mu: np.ndarray, restitution: np.ndarray, q: np.ndarray,
    v: np.ndarray, end: float, steps: int,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return positions and velocities at the time `end`, (lanes, coordinates).

    **Arguments:** `gaps` and `places`, functions of the coordinates (lanes, coordinates) that
    return for each contact its gap and its place along the surface; `mass`, (lanes, coordinates);
    `force(t, q, v)`; `mu` and `restitution`, (lanes, contacts).
    """
    dt, n = end / steps, mu.shape[1]

    def pushed(v: np.ndarray, impulse: np.ndarray) -> np.ndarray:
        return v + np.einsum("lik,li->lk", rows, impulse) / mass

    for k in range(steps):
        middle = q + 0.5 * dt * v
        gap, normals = _gradients(gaps, middle)
        active = gap <= 0
        if active.any():
            _, tangents = _gradients(places, middle)
            rows = np.concatenate([normals, tangents], 1)
            gains = np.einsum("lik,lk,ljk->lij", rows, 1 / mass, rows)
            for _ in range(_IMPACTS):
                speeds = np.einsum("lik,lk->li", rows, v)
                closing = np.where(active, -speeds[:, :n], 0.0)
                fastest = closing.max(1, keepdims=True)
                closes = fastest > _STILL
                if not closes.any():
                    break
                struck = closes & (closing >= (1 - 1e-9) * fastest)
                speeds[:, :n] -= restitution * closing * struck
                v = pushed(v, closes * _impulses(gains, speeds, mu, struck))
        after = v + dt * force((k + 0.5) * dt, middle, v) / mass
        if active.any():
            speeds = np.einsum("lik,lk->li", rows, after)
            after = pushed(after, _impulses(gains, speeds, mu, active))
        q, v = middle + 0.5 * dt * after, after
    return q, v
