"""Run times of several programs, measured in turn."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax


def side_by_side(programs: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """Return the median seconds of each program, run in turn, so that a busy machine delays all."""
    times: list[list[float]] = [[] for _ in programs]
    for _ in range(rounds):
        for program, own in zip(programs, times, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(program())
            own.append(time.perf_counter() - begin)
    return [statistics.median(own) for own in times]
