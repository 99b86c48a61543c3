"""The measurement of `peers.py`: codes built on pinned workers and timed in interleaved rounds."""

import statistics
import sys
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from .entries import CYCLES, KAPPA, LANES, ROUNDS, Entry, derivative_entries, entries
from .pool import Worker, cores, together
from .task import PARAMETERS, Task

RESTITUTIONS = (0.5, 0.8)


def note(text: str) -> None:
    """Print a line of progress."""
    print(f"{time.strftime('%H:%M:%S')} {text}", file=sys.stderr, flush=True)


@dataclass
class Job:
    """An entry, built on its workers."""

    entry: Entry
    workers: list[Worker]
    shares: list[np.ndarray]
    compiling: float = 0.0

    @property
    def lanes(self) -> np.ndarray:
        """Indices of its lanes."""
        return np.concatenate(self.shares)

    def begin_build(self, task: Task) -> None:
        """Send the entry to the workers to be compiled, without waiting."""
        for worker, share in zip(self.workers, self.shares, strict=True):
            name, code, options = self.entry.name, self.entry.code, self.entry.options
            worker.ask("build", name, code, task, KAPPA[share], options)

    def end_build(self) -> None:
        """Wait for the workers, and keep the largest compile time."""
        self.compiling = max(worker.answer() for worker in self.workers)
        note(f"  built {self.entry.name}")

    def result(self) -> np.ndarray:
        """Return the results of its lanes, in the order of `lanes`."""
        return np.concatenate(together(self.workers, "result", self.entry.name)[0])

    def timed(self) -> float:
        """Return the seconds for all lanes, scaled up if the entry runs a sample."""
        return together(self.workers, "run", self.entry.name)[1] * LANES / len(self.lanes)


class Bench:
    """The workers, which start when they are first needed."""

    def __init__(self):
        self.cores = cores()
        self._pinned: list[Worker] = []

    @property
    def pinned(self) -> list[Worker]:
        """One worker on each core."""
        if not self._pinned:
            self._pinned = [Worker(core) for core in self.cores]
        return self._pinned

    def jobs(self, listed: list[Entry], task: Task, *, all_cores: bool) -> list[Job]:
        """Build entries; those for one core are on different cores, to compile in parallel."""
        jobs = []
        for i, entry in enumerate(listed):
            shares = task.dealt(
                LANES, entry.block, entry.every, len(self.cores) if all_cores else 1
            )
            workers = self.pinned if all_cores else [self.pinned[i % len(self.cores)]]
            jobs.append(Job(entry, workers, shares))
            jobs[-1].begin_build(task)
        for job in jobs:
            job.end_build()
        return jobs

    def close(self) -> None:
        """End all workers."""
        for worker in self._pinned:
            worker.close()


def reference(bench: Bench, task: Task, *, jacobian: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the full-precision results, and the mask of the regular lanes."""
    found = []
    for name, shifted in (("reference", 0.0), ("shifted", 1e-10)):
        start = Task(task.drive, task.k, task.cycles, Y0=shifted)
        wanted = jacobian and not shifted
        options = {"tol": 1e-16, "wrapped": not wanted, "jacobian": wanted}
        entry = Entry(name, "heyoka_taylor", options)
        (job,) = bench.jobs([entry], start, all_cores=True)
        lanes = np.empty((LANES, 2, len(PARAMETERS)) if wanted else (LANES, 2))
        lanes[job.lanes] = job.result()
        found.append(lanes)
    if jacobian:
        return found[0], reference(bench, task)[1]
    return found[0], np.abs(found[0] - found[1]).max(axis=1) < 1e-6


def measure(bench: Bench, task: Task, listed: list[Entry], truth, *, all_cores: bool) -> list[dict]:
    """Return a row for each entry, measured in interleaved rounds."""
    exact, regular = truth
    jobs = bench.jobs(listed, task, all_cores=all_cores)
    rows: list[dict[str, Any]] = []
    for job in jobs:
        found, right = job.result(), exact[job.lanes]
        if found.ndim < right.ndim:  # the primal among derivatives has no such error
            error = np.full(len(found), np.nan)
        elif found.ndim == 3:
            error = np.abs(found - right).max(axis=(1, 2)) / np.abs(right).max(axis=(1, 2))
        else:
            error = np.abs(found - right).max(axis=1)
        error = error[regular[job.lanes]]
        rows.append(
            {
                "name": job.entry.name,
                "compiling": job.compiling,
                "error": float(np.median(error)),
                "lost": float(np.mean(error > 1e-3)),
                "lanes": len(job.lanes),
                "rounds": job.entry.rounds,
                "times": [],
            }
        )
    for i in range(ROUNDS):
        for job, row in zip(jobs, rows, strict=True):
            if i < job.entry.rounds:
                row["times"].append(job.timed())
    for row in rows:
        row["seconds"] = statistics.median(row["times"])
        note(f"  {row['name']:48s} {row['seconds']:9.3f} s  error {row['error']:.1e}")
    for worker in {id(worker): worker for job in jobs for worker in job.workers}.values():
        together([worker], "drop", "")
    return rows


def contest() -> dict[str, dict]:
    """Measure all sections of the page."""
    found: dict[str, dict] = {}
    bench = Bench()
    try:
        wanted = [(drive, k, False) for drive in ("motor", "ideal") for k in RESTITUTIONS]
        for drive, k, jacobian in [*wanted, ("motor", 0.5, True)]:
            task = Task(drive, k, CYCLES)
            truth = reference(bench, task, jacobian=jacobian)
            for all_cores in (False, True):
                kind = "derivatives" if jacobian else "states"
                key = f"{kind}, {drive}, {k}, {'all' if all_cores else 'one'}"
                note(key)
                listed = derivative_entries() if jacobian else entries(drive, all_cores)
                rows = measure(bench, task, listed, truth, all_cores=all_cores)
                found[key] = {"rows": rows, "regular": int(truth[1].sum())}
    finally:
        bench.close()
    return found
