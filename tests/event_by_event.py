"""Follow a motion from event to event with SciPy."""

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
    """Integrate from the state `begin` at time 0 to `end` with DOP853.

    **Arguments:** `events` are pairs of functions of time and state. An event happens when the
    first rises through zero. The second returns the state after it, or `None` to end the motion.

    **Returns:** the last time, the state there, and the indices of the events.
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
