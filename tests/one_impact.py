"""Motions of x'' + 2ξx' + x = F cos ωt with one impact on x = gap in n periods of the force, in
closed form, apart from the package: ξ of either sign."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq


class OneImpact(NamedTuple):
    """Both motions: the slower one first; complex where there is none."""

    speed: np.ndarray
    """Of approach."""
    trace: np.ndarray
    """Of the monodromy matrix, whose determinant is `determinant`."""
    determinant: float


def one_impact(frequency, force, *, damping, restitution, gap, cycles) -> OneImpact:
    """Between impacts w = (x, x') = h + p with the steady vibration p = Re P exp(iωt). A period T
    later h is what it was: h⁺ = E h⁺ + J, J = (0, -(1 + k)v), so that h⁺ = v g. With x = gap and
    x' = v before the impact, (gap - v g₁)² + (v (1 - g₂ - (1 + k))/ω)² = |P|²."""
    A = np.array([[0.0, 1.0], [-1.0, -2 * damping]])
    period = 2 * np.pi * cycles / frequency
    E, k = expm(A * period), restitution
    g = np.linalg.solve(np.eye(2) - E, [0.0, -(1 + k)])
    swing = force / abs(1 - frequency**2 + 2j * damping * frequency)
    rest = (1 - g[1] - (1 + k)) / frequency
    speed = np.roots([g[0] ** 2 + rest**2, -2 * gap * g[0], gap**2 - swing**2]).astype(complex)
    speed = np.sort_complex(speed)
    # P exp(iωt) at the impact, and with it the force and both accelerations.
    turned = (gap - speed * g[0]) - 1j * speed * rest
    pushed = turned * (1 - frequency**2 + 2j * damping * frequency)
    if np.isreal(speed).all():
        pushed = pushed.real
    before = pushed - gap - 2 * damping * speed
    after = pushed - gap + 2 * damping * k * speed
    # The saltation matrix of x' ← -k x' is [[-k, 0], [(after + k before)/v, -k]].
    trace = -k * np.trace(E) + (after + k * before) / speed * E[0, 1]
    return OneImpact(speed, trace, float(k**2 * np.linalg.det(E)))


def impact_map(frequency, force, *, damping, restitution, gap, cycles):
    """The map from what an impact of the faster motion differs by (in clock and speed of approach)
    to what the next one does, by flights in closed form and Newton's method; |damping| < 1."""
    given = {"damping": damping, "restitution": restitution, "gap": gap, "cycles": cycles}
    speed = one_impact(frequency, force, **given).speed[1].real
    period, turn = 2 * np.pi * cycles / frequency, np.sqrt(1 - damping**2)
    swing = force / (1 - frequency**2 + 2j * damping * frequency)
    root = -damping + 1j * turn

    def steady(t):
        return swing * np.exp(1j * frequency * t)

    def flight(begin, v):
        """Place and speed at a time, from the stop on at x' = v."""
        x0 = gap - steady(begin).real
        v0 = v - (1j * frequency * steady(begin)).real
        # h = Re H exp(root·(t - begin)) with h = x0, h' = v0.
        free = x0 + 1j * (-damping * x0 - v0) / turn

        def at(t):
            h = free * np.exp(root * (t - begin))
            return (h + steady(t)).real, (root * h + 1j * frequency * steady(t)).real

        return at

    # The phase at which the motion impacts: x = gap, x' = v before, and a period later again.
    A = np.array([[0.0, 1.0], [-1.0, -2 * damping]])
    jump = [0.0, -(1 + restitution)]
    g = np.linalg.solve(np.eye(2) - expm(A * period), jump)
    rest = speed * (1 - g[1] - (1 + restitution)) / frequency
    first = np.angle((gap - speed * g[0] - 1j * rest) / swing) / frequency

    def following(differs):
        at = flight(first + differs[0], -restitution * (speed + differs[1]))
        t = first + period
        for _ in range(50):
            x, v = at(t)
            t -= (x - gap) / v
        return np.array([t - period - first, at(t)[1] - speed])

    return following


def doubling_coefficient(step, h=2e-3):
    """The cubic coefficient of a map of the plane with a multiplier -1 at 0, positive where the
    motions of twice the period are stable, by differences (Kuznetsov, Elements of Applied
    Bifurcation Theory, 2004, equation 5.43)."""

    def slope(direction, h=1e-4):
        ends = [step(n * h * direction) for n in (-2, -1, 1, 2)]
        return np.dot([1, -8, 8, -1], ends) / (12 * h)

    J = np.stack([slope(e) for e in np.eye(2)], axis=1)
    (values, vectors), (others, lefts) = np.linalg.eig(J), np.linalg.eig(J.T)
    q = vectors[:, np.argmin(np.abs(values + 1))].real
    p = lefts[:, np.argmin(np.abs(others + 1))].real
    p = p / (p @ q)
    along = np.array([step(n * h * q) for n in range(-3, 4)])
    second = np.dot([0, -1, 16, -30, 16, -1, 0], along) / (12 * h**2)
    third = np.dot([1, -8, 13, 0, -13, 8, -1], along) / (8 * h**3)
    bend = np.linalg.solve(np.eye(2) - J, second)
    corners = [a * b * step(h * (a * q + b * bend)) for a in (-1, 1) for b in (-1, 1)]
    return float(p @ (third + 3 * sum(corners) / (4 * h**2)) / 6)


def doubles(restitution, damping, low, high, *, gap=2.0):
    """The frequency between two at which the faster motion with one impact a cycle doubles."""
    given = {"damping": damping, "restitution": restitution, "gap": gap, "cycles": 1}

    def missing(frequency):
        found = one_impact(frequency, 1.0, **given)
        return found.trace[1].real + 1 + found.determinant

    return brentq(missing, low, high, xtol=1e-15)


def degenerate(parameters, low, high, between):
    """Where between two values of a number that doubling is degenerate: its frequency, and the
    number. By differences of the map, which are right to some 1e-7.

    **Arguments:** `parameters`, restitution and damping as a function of the number; the values; an
    interval of the frequency.
    """

    def coefficient(number):
        k, xi = parameters(number)
        given = {"damping": xi, "restitution": k, "gap": 2.0, "cycles": 1}
        return doubling_coefficient(impact_map(doubles(k, xi, *between), 1.0, **given))

    number = brentq(coefficient, low, high, xtol=1e-12)
    return doubles(*parameters(number), *between), number
