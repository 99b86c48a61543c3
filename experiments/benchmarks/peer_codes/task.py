"""The task of every code: only numbers, so that it can be sent to a worker."""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

Run = Callable[[], np.ndarray]

PARAMETERS = ("κ", "ξ", "τ0", "ε", "d", "k")
"""The parameters of the derivatives; the start's W = κ changes with κ."""


@dataclass(frozen=True)
class Task:
    """Table 1's machine (T0 = 10 N·m), dimensionless, from Y = V = 0 and W = κ."""

    drive: str
    k: float
    cycles: int
    Y0: float = 0.0
    gap: float = 2.0
    xi: float = 0.5 / (2 * sqrt(0.35 * 9 * pi**2))
    tau0: float = 10 * 0.35 / (0.06 * 9 * pi**2)
    eps: float = 0.35 * 0.04**2 / 0.06
    mu: float = 0.2 * 0.04**2 / 0.06

    @property
    def motor(self) -> bool:
        """True if the crank's speed is part of the state."""
        return self.drive == "motor"

    def dealt(self, lanes: int, block: int, every: int, shares: int) -> list[np.ndarray]:
        """Return the indices of lanes for each worker: blocks of neighbours, in turn.

        A slow code is timed on a sample: one of `every` blocks.
        """
        block = min(block, max(1, lanes // (shares * every)))
        blocks = np.arange(lanes).reshape(-1, block)[every // 2 :: every]
        return [blocks[i::shares].ravel() for i in range(shares)]
