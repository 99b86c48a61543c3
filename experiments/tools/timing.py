"""Clocks: of a stretch of work, of one call, and of several programs side by side."""

import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax


class Clock:
    """Wall time and processor time of a `with` block, in seconds: `wall` and `cpu` afterwards."""

    wall = cpu = 0.0

    def __enter__(self) -> "Clock":
        self._begin = os.times()
        return self

    def __exit__(self, *_: object) -> None:
        end = os.times()
        self.wall = end.elapsed - self._begin.elapsed
        self.cpu = sum(end[:2]) - sum(self._begin[:2])


def seconds_of(work: Callable[[], Any]) -> tuple[Any, float]:
    """A result, waited for, and the seconds that it took."""
    begin = time.perf_counter()
    result = jax.block_until_ready(work())
    return result, time.perf_counter() - begin


def repeated(work: Callable[[], Any], rounds: int = 5) -> tuple[Any, list[float]]:
    """A result, and the seconds of so many further calls, which need not compile any more."""
    result, _ = seconds_of(work)
    return result, [seconds_of(work)[1] for _ in range(rounds)]


def side_by_side(programs: Sequence[Callable[[], Any]], rounds: int) -> list[float]:
    """Median seconds of each program, run in turn, so that a busy machine delays all alike."""
    times: list[list[float]] = [[] for _ in programs]
    for _ in range(rounds):
        for program, own in zip(programs, times, strict=True):
            own.append(seconds_of(program)[1])
    return [statistics.median(own) for own in times]
