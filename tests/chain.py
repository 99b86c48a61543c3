"""A row of balls, with or without a wall behind the last."""

from itertools import pairwise
from typing import Any

import numpy as np
import vi_jax as vi


class Chain(vi.Mechanical):
    """Point masses on a line, each left of the next and the last left of the wall. The acceleration
    `pressed` pushes them to the right."""

    restitution: Any = 1.0
    weights: tuple[float, ...] = (1.0, 1.0, 1.0)
    wall: float | None = None
    pressed: Any = 0.0
    length: Any = 1.0

    @property
    def q(self):
        return tuple("abcdef"[: len(self.weights)])

    @property
    def mass(self):
        return self.weights

    @property
    def cycle(self):
        return self.length

    @property
    def contacts(self):
        gaps = [lambda q, a=a, b=b: getattr(q, a) - getattr(q, b) for a, b in pairwise(self.q)]
        stops = [vi.RigidStop(0.0, self.restitution, on=gap) for gap in gaps]
        if self.wall is not None:
            stops.append(vi.RigidStop(self.wall, self.restitution, on=self.q[-1]))
        return tuple(stops)

    def force(self, t, q, v):
        return dict(zip(self.q, (m * self.pressed for m in self.weights), strict=True))

    def balls(self, x, v):
        x, v = (dict(zip(self.q, map(float, each), strict=True)) for each in (x, v))
        return self.at(**x, v=v)


def row(z):
    """Return the positions and velocities of a chain as two arrays."""
    places = [x for name, x in vars(z).items() if name != "v"]
    return np.array(places), np.array([*vars(z.v).values()])


def passed(v, k, masses, wall=False):
    """Return the velocities after all impacts of touching balls, and the contacts in impact order.
    The fastest approach is resolved first, equal ones together."""
    v, masses, struck = np.array(v, float), np.asarray(masses, float), []
    count = len(v) - 1 + wall
    normals = np.zeros((count, len(v)))
    for i in range(count):
        normals[i, i] = 1
        if i + 1 < len(v):
            normals[i, i + 1] = -1
    first = (normals @ v).max()
    while (normals @ v).max() > 1e-12 * first:
        approach = normals @ v
        on = np.flatnonzero(approach >= approach.max() * (1 - 1e-9))
        n = normals[on]
        impulse = np.linalg.solve(n / masses @ n.T, -(1 + k) * approach[on])
        v = v + n.T @ impulse / masses
        struck += on.tolist()
    return v, struck


def dropped(heights, k, masses, until):
    """Return the impacts (time, contact) of balls above a floor, with flights in closed form. Their
    acceleration is 1, towards the floor."""
    x, v, time, found = -np.array(heights, float), np.zeros(len(heights)), 0.0, []
    while time < until:
        # Accelerations are equal: neighbours approach at a constant relative speed.
        waits = []
        for i in range(len(x) - 1):
            fast = v[i] - v[i + 1]
            waits.append((x[i + 1] - x[i]) / fast if fast > 1e-15 else np.inf)
        waits.append(-v[-1] + np.sqrt(v[-1] ** 2 - 2 * x[-1]))
        i = int(np.argmin([w if w > 0 else np.inf for w in waits]))
        t, time = waits[i], time + waits[i]
        x, v = x + v * t + t * t / 2, v + t
        if i == len(x) - 1:
            x[i], v[i] = 0.0, -k * v[i]
        else:
            a, b = masses[i : i + 2]
            impulse = (1 + k) * (v[i] - v[i + 1]) * a * b / (a + b)
            v[i], v[i + 1] = v[i] - impulse / a, v[i + 1] + impulse / b
            x[i + 1] = x[i]
        found.append((time, i))
    return found
