"""The truth, by code that the package has no part in."""

from collections.abc import Callable
from math import cos, pi, sin
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from event_by_event import followed


def root(function: Callable[[float], float], low: float, high: float, xtol: float) -> float:
    """Where a function of opposite signs at both ends is zero."""
    found: Any = brentq(function, low, high, xtol=xtol)
    return float(found)


def flown(zeta: float, xi: float, stops: list, Y: float, V: float, cycles: int) -> np.ndarray:
    """States of the ideal drive in each half cycle, by matrix exponentials.

    `stops` are (side, gap, k).

    Impacts are found in 400 steps of the shorter period, their times by `brentq`. A body that has
    no speed left on a stop (k = 0) is held there until cos φ = ± gap.
    """
    matrix = np.zeros((4, 4))
    matrix[0, 1], matrix[1, 0], matrix[1, 1] = 1.0, -1.0, -2 * xi
    matrix[1, 2], matrix[2, 3], matrix[3, 2] = 1.0, -zeta, zeta
    steps = 2 * int(200 * max(1.0, 1 / zeta))
    dt = 2 * pi / zeta / steps
    whole = expm(matrix * dt)
    y: Any = np.array([Y, V])
    states = [(Y, V)]

    def moved(y, at, length):
        z = np.array([*y, cos(zeta * at), sin(zeta * at)])
        return ((whole if length == dt else expm(matrix * length)) @ z)[:2]

    for _ in range(cycles):
        for i in range(steps):
            if 2 * i == steps:
                states.append(tuple(y))
            at, left, length = i * dt, dt, dt
            while True:
                held = None
                for sign, gap, _k in stops:
                    pressed = sign * cos(zeta * at) - gap > 1e-13
                    if abs(y[0] - sign * gap) < 1e-15 and y[1] == 0 and pressed:
                        held = sign, gap
                if held:
                    sign, gap = held

                    def force(t, at=at, sign=sign, gap=gap):
                        return sign * cos(zeta * (at + t)) - gap

                    if force(left) > 0:
                        break
                    wait = root(force, 0, left, xtol=1e-15)
                    at, left = at + wait + 1e-15, left - wait
                length = dt if left == dt else left
                new = moved(y, at, length)
                hit = next((s for s in stops if s[0] * new[0] > s[1] and s[0] * new[1] > 0), None)
                if hit is None:
                    y = new
                    break
                sign, gap, k = hit

                def beyond(t, y=y, at=at, sign=sign, gap=gap):
                    return sign * moved(y, at, t)[0] - gap

                first = 1e-12 * dt if beyond(0.0) >= 0 else 0.0
                spent = root(beyond, first, left, xtol=1e-16) if beyond(first) < 0 else first
                speed = moved(y, at, spent)[1]
                y = np.array([sign * gap, -k * speed if k else 0.0])
                at, left = at + spent, left - spent
        states.append(tuple(y))
    return np.array(states)


def turned(motor: dict, stops: list, start: list, cycles: int, ratio: float = 0.0) -> np.ndarray:
    """Section states (Y, V, W) of the motor by SciPy's DOP853 in time, impacts as its events."""

    def slide(phi):
        if not ratio:
            return np.cos(phi), -np.sin(phi), -np.cos(phi)
        root = np.sqrt(1 - (ratio * np.sin(phi)) ** 2)
        double = np.sin(2 * phi)
        u = np.cos(phi) + (root - 1) / ratio
        du = -np.sin(phi) - 0.5 * ratio * double / root
        ddu = -np.cos(phi) - ratio * np.cos(2 * phi) / root - ratio**3 * double**2 / (4 * root**3)
        return u, du, ddu

    def rates(t, x):
        Y, V, W, phi = x
        u, du, ddu = slide(phi)
        torque = motor["tau0"] * (motor["kappa"] - W) + motor["eps"] * du * (Y - u)
        torque -= motor["mu"] * du * ddu * W * W
        return [V, u - Y - 2 * motor["xi"] * V, torque / (1 + motor["mu"] * du**2), W]

    def ends(t, x):
        states.append([*x[:3]])
        return None if len(states) > cycles else [*x[:3], 0.0]

    def hit(sign, gap, k):
        return lambda t, x: sign * x[0] - gap, lambda t, x: [sign * gap, -k * x[1], *x[2:]]

    states = [start]
    events = [(lambda t, x: x[3] - 2 * pi, ends), *(hit(*stop) for stop in stops)]
    options = {"rtol": 3e-14, "atol": 1e-14, "max_step": 0.2}
    followed(rates, [*start, 0.0], 1e5, events, **options)
    return np.array(states)
