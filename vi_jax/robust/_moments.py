"""When a motion is kicked: its state at any moment of its period, and the moment of the least."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from ..flow import simulate
from ..machine import bare, in_rows, is_autonomous
from ._settling import Row, Settling, until

# How exactly the worst moment is found, as a part of a cycle: the norm is flat there. A choice.
_MOMENT = 1e-6


class Moments:
    """The moments of a motion's period, each a number of a cycle and a clock since its section.

    **Arguments:** what judges starts, which knows the motion; a section state of it; the number of
    the cycle that begins there.

    **Raises:** `ValueError` for a motion without sections.
    """

    def __init__(self, settling: Settling, start: Row, cycle: int):
        machine, like = settling.the_map.machine, settling.like
        self.settling = settling
        self.autonomous = is_autonomous(machine, like)
        first = int(settling.distances(start[None])[0].argmin())
        self.rows = np.roll(settling.motion, cycle - first, axis=0)
        lengths = [float(jnp.asarray(machine.cycle))] * len(self.rows)
        if self.autonomous:
            run = simulate(machine, settling.state(self.rows[0]), len(self.rows))
            lengths = [float(x) for x in np.asarray(run.duration)]
        self.lengths = np.array(lengths)
        self.ends = np.cumsum(lengths)

    def cycle(self, number: int) -> int:
        """The number of a cycle within the period."""
        return number % len(self.rows)

    def spread(self, count: int) -> np.ndarray:
        """Clocks of so many moments in each cycle."""
        parts = np.arange(count) / count
        return ((self.ends - self.lengths)[:, None] + parts * self.lengths[:, None]).ravel()

    def of(self, clock: float) -> tuple[int, float]:
        """Cycle and phase of a clock that counts through the period, and beyond its ends."""
        clock = float(np.mod(clock, self.ends[-1]))
        cycle = min(int(np.searchsorted(self.ends, clock, side="right")), len(self.ends) - 1)
        return cycle, max(0.0, clock - (self.ends[cycle - 1] if cycle else 0.0))

    def at(self, cycle: int, phase: float) -> tuple[Settling, Row]:
        """The state there, and what judges starts at this moment."""
        row, machine = self.rows[self.cycle(cycle)], self.settling.the_map.machine
        if phase == 0:
            return self.settling.starting(0.0), row
        if self.autonomous:
            method = self.settling.the_map.method
            there = simulate(
                machine.observed_every(phase), self.settling.state(row), 1, method=method,
                record="sections",
            )  # fmt: skip
            return self.settling.starting(0.0), np.asarray(in_rows(bare(there.last), 0))
        numbers = (jnp.asarray(x) for x in (row, phase))
        later = until(self.settling.the_map, self.settling.like, *numbers)
        return self.settling.starting(phase), np.asarray(later)

    def least_between(self, clock: float, apart: float, norm: Callable[[float], float]) -> float:
        """The clock of the least norm within so much of one, beside which norms are larger."""
        options = {"xatol": _MOMENT * float(self.lengths.max())}
        bounds = (clock - apart, clock + apart)
        found: Any = minimize_scalar(norm, bounds=bounds, method="bounded", options=options)
        return float(found.x)
