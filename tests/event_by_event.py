"""Motions with events that SciPy follows one by one."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp


def followed(
    rate: Callable[..., Any],
    begin: Sequence[float],
    end: float,
    events: Sequence[tuple[Callable[..., Any], Callable[..., Any]]],
    **options: Any,
) -> tuple[float, np.ndarray, list[int]]:
    """Follow a motion from the state `begin` at time 0 to `end`, by DOP853.

    **Arguments:** `events` are pairs of a guard of time and state, which rises through zero, and of
    a function of both that returns the state after the event, or `None` where the motion is to end.

    **Returns:** the last time, the state there, and the numbers of the events met.
    """

    def watched(guard: Any) -> Any:
        value: Any = lambda t, x: guard(t, x)
        value.terminal, value.direction = True, 1
        return value

    options = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14, **options}
    guards, t, x = [watched(guard) for guard, _ in events], 0.0, np.array(begin, float)
    met: list[int] = []
    while t < end - 1e-14:
        found: Any = solve_ivp(rate, (t, end), x, events=guards, **options)
        t, x = found.t[-1], found.y[:, -1].copy()
        which = [i for i, times in enumerate(found.t_events) if times.size]
        if which:
            met.append(which[0])
            after = events[which[0]][1](t, x.copy())
            if after is None:
                break
            x = np.array(after, float)
    return t, x, met
