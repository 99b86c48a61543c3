"""A machine of one's own: balls in a row that touch, with or without a wall behind the last."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi


class Balls(eqx.Module):
    x: tuple[jax.Array, ...]
    v: tuple[jax.Array, ...]


def balls(x, v):
    """A state of the chain."""
    return Balls(*(tuple(jnp.asarray(float(a)) for a in each) for each in (x, v)))


class Chain(vi.AbstractMachine):
    """Balls without size, each to be left of the next, and the last one of a wall; a constant force
    per mass presses them to the right."""

    restitution: Any = 1.0
    masses: tuple[float, ...] = (1.0, 1.0, 1.0)
    wall: float | None = None
    force: Any = 0.0
    length: Any = 1.0

    @property
    def contacts(self):
        count = len(self.masses) - 1
        between = tuple(vi.RigidStop(0.0, self.restitution, coordinate=i) for i in range(count))
        if self.wall is None:
            return between
        return (*between, vi.RigidStop(self.wall, self.restitution, coordinate=count))

    @property
    def coordinates(self):
        found = [self._between(i) for i in range(len(self.masses) - 1)]
        if self.wall is not None:
            last = vi.Coordinate(
                lambda z: z.x[-1],
                lambda z: z.v[-1],
                lambda z, Y, V: Balls((*z.x[:-1], Y), (*z.v[:-1], V)),
                self.masses[-1],
            )
            found.append(last)
        return tuple(found)

    def _between(self, i):
        a, b = self.masses[i : i + 2]

        def placed(z, Y, V):
            far, fast = Y - (z.x[i] - z.x[i + 1]), V - (z.v[i] - z.v[i + 1])
            x, v = list(z.x), list(z.v)
            x[i], x[i + 1] = x[i] + b / (a + b) * far, x[i + 1] - a / (a + b) * far
            v[i], v[i + 1] = v[i] + b / (a + b) * fast, v[i + 1] - a / (a + b) * fast
            return Balls(tuple(x), tuple(v))

        def apart(numbers):
            return numbers[i] - numbers[i + 1]

        return vi.Coordinate(lambda z: apart(z.x), lambda z: apart(z.v), placed, a * b / (a + b))

    @property
    def cycle(self):
        return self.length

    def field(self, s, z):
        return Balls(z.v, tuple(self.force + 0 * v for v in z.v))


def passed(v, k, masses, wall=False):
    """Velocities after all impacts of balls that touch: the fastest approach first, equal ones
    together; and the contacts struck, in their order. Of sequences that end."""
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
    """Impacts (time, contact) of balls above a floor at `wall` = 0, each flight in closed form; the
    force is one per mass."""
    x, v, time, found = -np.array(heights, float), np.zeros(len(heights)), 0.0, []
    while time < until:
        # Balls fall alike, so that neighbours come together at their difference of speeds.
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
