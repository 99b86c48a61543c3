"""Delay differential equations by the method of steps: SciPy, cut at events and at images."""

import heapq
from bisect import bisect_right
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp


def by_steps(
    rate: Callable[..., Any], start: Sequence[float], before: Callable[[float], Any],
    delays: Sequence[float], end: float, *, guard: Callable[..., float] | None = None,
    jump: Callable[..., Any] | None = None, levels: int = 7,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the state at `end`, and the instants of events. `rate(t, y, pasts)` and
    `guard(t, y, pasts)` receive the state one delay ago, for each delay; `jump(y, pasts)` is the
    state after an event, where the guard rises through zero."""
    begins, pieces, events = [0.0], [], []

    def past(t: float, side: float) -> list[Any]:
        found = []
        for delay in delays:
            place = t - delay
            number = bisect_right(begins, place + side) - 1
            old = number < 0 or not pieces
            found.append(before(place) if old else pieces[min(number, len(pieces) - 1)](place))
        return found

    waiting = [(end, levels)]

    def wait_for_images(t: float, level: int) -> None:
        if level < levels:
            for delay in delays:
                heapq.heappush(waiting, (t + delay, level + 1))

    wait_for_images(0.0, 0)
    t, y, armed = 0.0, np.asarray(start, float), guard is None
    while t < end - 1e-12:
        while waiting[0][0] <= t + 1e-11:
            wait_for_images(*heapq.heappop(waiting))
        stop, begin = min(waiting[0][0], t + min(delays)), t
        armed = armed or (guard is not None and guard(t, y, past(t, 1e-11)) < -1e-9)
        stop = stop if armed else min(stop, t + 0.02)

        def side(s: float, begin: float = begin, stop: float = stop) -> float:
            return 1e-11 if s < 0.5 * (begin + stop) else -1e-11

        meets = None
        if guard is not None and armed:
            meets = lambda s, y, side=side: guard(s, y, past(s, side(s)))
            meets.terminal, meets.direction = True, 1
        found = solve_ivp(
            lambda s, y, side=side: rate(s, y, past(s, side(s))), (t, stop), y, method="DOP853",
            rtol=1e-12, atol=1e-14, max_step=0.1, events=meets, dense_output=True,
        )  # fmt: skip
        begins[len(pieces) :] = [t]
        pieces.append(found.sol)
        t, y = float(found.t[-1]), found.y[:, -1]
        if found.status == 1:
            events.append(t)
            armed = False  # until the guard has been negative
            y = np.asarray(jump(y, past(t, -1e-11)))
            wait_for_images(t, 0)
    return y, np.asarray(events)
