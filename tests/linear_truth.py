"""Linear machines with rigid stops by SciPy's matrix exponential, independent of the package."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq


class Chatters(Exception):
    """A cycle has more impacts than `most`."""


class Contact(NamedTuple):
    """A stop: sign·c·x ≤ gap."""

    row: np.ndarray
    gap: float
    restitution: float
    sign: int = 1


class LinearTruth:
    """M x'' + C x' + K x = f₀ + f₁ cos ωs + f₂ sin ωs between stops.

    The state is (x, v, 1, cos ωs, sin ωs), so that the flow is linear. Gaps are checked at both
    ends of each step (1/40 of the fastest period) and at their extremum in it. Events are found by
    Brent's method or bisection. A contact without restitution rests on its stop until its force
    changes sign."""

    def __init__(self, matrices, loads, frequency, contacts, most=60):
        mass, damping, stiffness = (np.asarray(x, float) for x in matrices)
        n, self.contacts, self.frequency, self.most = len(mass), contacts, frequency, most
        self.n, self.inverse = n, np.linalg.inv(mass)
        self.free = np.zeros((2 * n + 3, 2 * n + 3))
        self.free[:n, n : 2 * n] = np.eye(n)
        self.free[n : 2 * n, :n] = -self.inverse @ stiffness
        self.free[n : 2 * n, n : 2 * n] = -self.inverse @ damping
        self.free[n : 2 * n, 2 * n :] = self.inverse @ np.stack(loads, axis=1)
        self.free[2 * n + 1, 2 * n + 2], self.free[2 * n + 2, 2 * n + 1] = -frequency, frequency
        fastest = np.sqrt(np.abs(np.linalg.eigvals(self.inverse @ stiffness)).max())
        self.steps = int(np.ceil(40 * max(fastest / frequency, 1.0)))
        self.known = {}

    def held(self, resting):
        """Return the matrix of the flow while these contacts rest."""
        if not resting:
            return self.free
        c = np.stack([self.contacts[i].row for i in resting])
        push = self.inverse @ c.T
        project = np.eye(len(self.free))
        rows = slice(self.n, 2 * self.n)
        project[rows, rows] -= push @ np.linalg.solve(c @ push, c)
        return project @ self.free

    def moved(self, resting, length, z):
        key = resting, length
        if key not in self.known:
            self.known[key] = expm(self.held(resting) * length)
        return self.known[key] @ z

    def depth(self, i, z):
        c = self.contacts[i]
        return c.sign * (c.row @ z[: self.n]) - c.gap

    def speed(self, i, z):
        c = self.contacts[i]
        return c.sign * (c.row @ z[self.n : 2 * self.n])

    def pressed(self, i, resting, z):
        others = tuple(j for j in resting if j != i)
        rate = self.held(others) @ z
        return self.contacts[i].sign * (self.contacts[i].row @ rate[self.n : 2 * self.n])

    def first_zero(self, resting, z, length, function):
        """Return a time at which a function of the state changes from negative to positive."""
        value = lambda t: function(expm(self.held(resting) * t) @ z)
        low, high = 0.0, length
        if value(low) < 0 < value(high):  # a few roundings wide, as after 48 bisections
            width = 4e-15 * length
            root = brentq(value, low, high, xtol=width / 4, rtol=1e-15)
            low, high = max(root - width, low), min(root + width, high)
            if not value(low) <= 0 < value(high):
                low, high = 0.0, length
        while low < (middle := 0.5 * (low + high)) < high and high - low > 2e-16 * length:
            if value(middle) > 0:
                high = middle
            else:
                low = middle
        return high

    def event(self, resting, z, length):
        """Return time and contact of the first event within a step, or `None`."""
        end, found = self.moved(resting, length, z), []
        for i in range(len(self.contacts)):
            if i in resting:
                if self.pressed(i, resting, end) < 0:
                    found.append(
                        (
                            self.first_zero(
                                resting, z, length, lambda y, i=i: -self.pressed(i, resting, y)
                            ),
                            i,
                        )
                    )
                continue
            reach = length
            if self.speed(i, z) > 0 > self.speed(i, end):  # the gap has an extremum in the step
                reach = self.first_zero(resting, z, length, lambda y, i=i: -self.speed(i, y))
            top = end if reach == length else expm(self.held(resting) * reach) @ z
            if self.depth(i, top) > 1e-13 and self.speed(i, top) > -1e-9:
                found.append(
                    (self.first_zero(resting, z, reach, lambda y, i=i: self.depth(i, y)), i)
                )
        return min(found) if found else None

    def cycle(self, x, v, resting=()):
        """Return positions, velocities, number of impacts and resting contacts after a cycle."""
        z, clock, impacts = np.concatenate([x, v, [1.0, 1.0, 0.0]]), 0.0, 0
        period = 2 * np.pi / self.frequency
        step, behind = period / self.steps, 0
        while clock < period * (1 - 1e-14):
            # After an impact, a hop may begin and end within a step.
            length = min(step / 16 if behind < 32 else step, period - clock)
            behind += 1
            event = self.event(resting, z, length)
            if event is None:
                z, clock = self.moved(resting, length, z), clock + length
                continue
            length, i = event
            z, clock = expm(self.held(resting) * length) @ z, clock + length
            if i in resting:
                resting = tuple(j for j in resting if j != i)
                continue
            impacts, behind = impacts + 1, 0
            if impacts > self.most:
                raise Chatters
            c = self.contacts[i]
            push = self.inverse @ c.row
            speed = c.row @ z[self.n : 2 * self.n]
            z[self.n : 2 * self.n] -= (1 + c.restitution) * speed * push / (c.row @ push)
            z[: self.n] -= c.sign * self.depth(i, z) * push / (c.row @ push)
            if c.restitution == 0 and self.pressed(i, resting, z) > 0:
                resting = (*resting, i)
        return z[: self.n], z[self.n : 2 * self.n], impacts, resting
