"""Workers: processes with a core of their own, in which codes are built and run.

A worker begins on its core, so that each library counts only the core that it may use.
"""

import importlib
import os
import time
import traceback
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

import numpy as np


def cores() -> list[int]:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


class Worker:
    """A process that builds and runs codes, and answers calls in order."""

    def __init__(self, core: int):
        context, before, ours = get_context("spawn"), dict(os.environ), cores()
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        # A process begins with the environment and the cores of the one that starts it.
        os.environ |= {"JAX_PLATFORMS": "cpu", "OMP_NUM_THREADS": "1"}
        _pin([core])
        try:
            self._process.start()
        finally:
            _pin(ours)
            os.environ.clear()
            os.environ |= before

    def ask(self, *message: Any) -> None:
        """Send a call without waiting for its answer."""
        self._pipe.send(message)

    def answer(self) -> Any:
        """Return the answer to the oldest call. **Raises:** `RuntimeError` with its traceback."""
        good, value = self._pipe.recv()
        if not good:
            raise RuntimeError(value)
        return value

    def close(self) -> None:
        """End the process."""
        self._pipe.send(None)
        self._process.join()


def _pin(on: list[int]) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, on)


def together(workers: list[Worker], *message: Any) -> tuple[list, float]:
    """Return the answers of workers to the same call, and the seconds until the last."""
    begin = time.perf_counter()
    for worker in workers:
        worker.ask(*message)
    answers = [worker.answer() for worker in workers]
    return answers, time.perf_counter() - begin


def _serve(pipe: Connection) -> None:
    runs: dict[str, Any] = {}

    def handle(what: str, key: str, *rest: Any) -> Any:
        if what == "build":
            code, task, kappas, options = rest
            module = importlib.import_module(f"peer_codes.{code}")
            runs[key], seconds = module.build(task, np.asarray(kappas), **options)
            return seconds
        if what == "drop":
            return runs.clear()
        found = np.asarray(runs[key]())
        return found if what == "result" else None

    while (message := pipe.recv()) is not None:
        try:
            pipe.send((True, handle(*message)))
        except Exception:
            pipe.send((False, traceback.format_exc()))
