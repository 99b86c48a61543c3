"""Long runs in parts, so that Ctrl-C is answered between two of them and loses nothing."""

import dataclasses
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._types import State
from ..flow import RESULTS, Run, RunOptions, Samples, planned, simulate
from ..machine import AbstractMachine, with_leaf
from ..scans import Sweep, sweep, taken_along

# Intervals (samples, or cycles as so many) of one part: a fraction of a second. Each other length
# is another program, so that it is chosen before the time is known.
_INTERVALS, _PER_CYCLE = 16384, 16

# Seconds that a part should take where its length is no matter of the program.
_PATIENCE = 0.3


@contextmanager
def noted_interrupts() -> Iterator[Callable[[], bool]]:
    """Within it Ctrl-C is noted and not raised, however often. Gives whether there was one."""
    pressed: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return

    def note(number: int, _: object) -> None:
        if not pressed:
            print("interrupted: keeping what was computed …", file=sys.stderr, flush=True)
        pressed.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


def simulate_in_parts(
    machine: AbstractMachine,
    start: State,
    cycles: int,
    *,
    interrupted: Callable[[], bool],
    settle: int = 0,
    samples: int = 0,
    max_steps: int | None = None,
    **options: Any,
) -> Run:
    """As `simulate` of one lane, with `interrupted` asked between its parts, all of one program.

    **Arguments:** `interrupted`, whether to end here; all else as for `simulate`.

    **Returns:** the run, shorter if it was interrupted.

    **Raises:** `KeyboardInterrupt` if it was before anything was to be kept; as `simulate`.
    """
    asked = RunOptions(settle=settle, samples=samples, max_steps=max_steps, **options)
    planned(machine, start, cycles, asked)
    number = math.ceil(cycles * max(_PER_CYCLE, samples) / _INTERVALS)
    length = math.ceil(cycles / number)
    spent, runs = 0, []

    def part(start: State, settle: int) -> Run:
        nonlocal spent
        left = None if max_steps is None else max(1, max_steps - spent)
        run = simulate(
            machine, start, length, settle=settle, samples=samples, max_steps=left, **options
        )
        spent += int(run.steps)
        return run

    begin, chunk = start, length
    while settle > chunk:
        clock = time.perf_counter()
        run = part(begin, chunk - length)
        settle, begin = settle - chunk, run.last
        if not bool(run.successful):
            return _joined([run] + [_ended(run)] * (number - 1), cycles, samples, spent)
        if interrupted():
            raise KeyboardInterrupt
        if time.perf_counter() - clock < _PATIENCE:
            chunk *= 2
    for i in range(number):
        run = part(begin, settle if not i else 0)
        runs.append(run)
        begin = run.last
        if not bool(run.successful):
            runs += [_ended(run)] * (number - len(runs))
            break
        if interrupted():
            break
    return _joined(runs, cycles, samples, spent)


def _ended(run: Run) -> Run:
    """A part after the end of a lane: NaN, and counts of 0."""
    return jtu.tree_map(lambda x: jnp.full_like(x, jnp.nan if eqx.is_inexact_array(x) else 0), run)


def _joined(runs: list[Run], cycles: int, samples: int, steps: int) -> Run:
    """Parts of one run, without the cycles beyond the last that was asked for."""
    last, length = runs[-1], runs[0].impacts.shape[0]
    done = min(cycles, length * len(runs))

    def joined(parts: list[Any], number: int, *, shared: int = 0) -> Any:
        """Rows of all parts; `shared` of each are those with which the part before has ended."""
        return jtu.tree_map(
            lambda first, *others: _row([first, *(x[shared:] for x in others)])[:number], *parts
        )

    apart = (
        "sections", "quantities", "samples", "errors", "result", "steps", "rejected", "labels",
        "units",
    )  # fmt: skip
    rows = {
        field.name: joined([getattr(run, field.name) for run in runs], done)
        for field in dataclasses.fields(Run)
        if field.name not in apart
    }
    sections = joined([run.sections for run in runs], done + 1, shared=1)
    quantities = joined([run.quantities for run in runs], done + 1, shared=1)
    dense, sampled = None, [run.samples for run in runs if run.samples is not None]
    if sampled:
        times, passed = [], 0.0
        for part in sampled:
            times.append(np.asarray(part.time) + passed)
            passed = times[-1][-1]
        states = [part.state for part in sampled]
        dense = Samples(
            cycles=jnp.arange(done * samples + 1, dtype=sampled[0].time.dtype) / samples,
            time=joined(times, done * samples + 1, shared=1),
            state=joined(states, done * samples + 1, shared=1),
            quantities=joined([x.quantities for x in sampled], done * samples + 1, shared=1),
        )
    failed = next((run for run in runs if not bool(run.successful)), last)
    # What happened after the last cycle that was asked for is nobody's concern.
    whole = all(bool(jnp.isfinite(x[-1]).all()) for x in jtu.tree_leaves(sections))
    return Run(
        **rows,
        sections=sections,
        quantities=quantities,
        samples=dense,
        errors=None,
        result=RESULTS.successful if whole else failed.result,
        steps=jnp.asarray(steps, last.steps.dtype),
        rejected=jnp.asarray(sum(int(run.rejected) for run in runs), last.rejected.dtype),
        labels=last.labels,
        units=last.units,
    )


def sweep_in_parts(
    machine: AbstractMachine,
    parameter: str,
    values: Any,
    *,
    start: Any,
    interrupted: Callable[[], bool],
    **options: Any,
) -> Sweep:
    """As `sweep`, value by value, all by one program, with `interrupted` asked between them.

    **Arguments:** `interrupted`, whether to end here; all else as for `sweep`.

    **Returns:** the sweep, shorter if it was interrupted.

    **Raises:** as `sweep`.
    """
    found = []
    for value in values:
        if start is not None and found:
            start = taken_along(with_leaf(machine, parameter, value), start)
        run = sweep(machine, parameter, jnp.asarray([value]), start=start, **options)
        found.append(run)
        if bool(run.successful[0]):
            start = jtu.tree_map(lambda x: x[0, -1], run.sections)
        if interrupted():
            break
    return jtu.tree_map(lambda *x: _row(x), *found)


def _row(parts: Sequence[Any]) -> Any:
    """Parts in a row, put together by NumPy: hundreds of them would be a program to compile."""
    return jnp.asarray(np.concatenate([np.asarray(part) for part in parts]))
