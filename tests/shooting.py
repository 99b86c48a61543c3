"""Shooting with SciPy: integration to events, fixed points of a map and their derivatives."""

import numpy as np
from scipy.integrate import solve_ivp


def flown(field, s, x, end, guards, noted=None):
    """Integrate from the state `x` at `s` until a guard rises through zero, or to `end`. Return the
    guard's index (or `None`), s and state there, and the states at which `noted` rises."""

    def watched(guard, terminal):
        def value(s, x):
            return guard(s, x)

        value.terminal, value.direction = terminal, 1
        return value

    events = [watched(guard, True) for guard in guards]
    events += [watched(noted, False)] if noted is not None else []
    found = solve_ivp(field, (s, end), x, events=events, method="DOP853", rtol=1e-13, atol=1e-14)
    which = [i for i, times in enumerate(found.t_events[: len(guards)]) if times.size]
    way = found.y_events[-1] if noted is not None else []
    return (which[0] if which else None), found.t[-1], found.y[:, -1], way


def derivative(function, x, h):
    """Differentiate by finite differences of fourth order."""
    columns = []
    for step in h * np.eye(len(x)):
        near = function(x + step) - function(x - step)
        far = function(x + 2 * step) - function(x - 2 * step)
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=-1)


def fixed_point(function, x, h=1e-4):
    """Return the fixed point near `x`, and the derivative of the map there."""
    x = np.array(x, float)
    matrix = derivative(function, x, h)
    for _ in range(20):
        lacks = function(x) - x
        x = x - np.linalg.solve(matrix - np.eye(len(x)), lacks)
        if np.abs(lacks).max() < 3e-12:
            return x, derivative(function, x, h)
    raise ArithmeticError("no fixed point")
