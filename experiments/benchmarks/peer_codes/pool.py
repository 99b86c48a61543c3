"""Workers: a process pinned to each core, and one with all cores, controlled through pipes.

`python -m peer_codes.pool CORES` is such a process. It is pinned before any library is imported, so
that each library counts only the cores that it may use.
"""

import importlib
import os
import pickle
import struct
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import IO, Any

import numpy as np


def cores() -> list[int]:
    """Return the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


class Worker:
    """A process that builds and runs codes, and answers calls in order."""

    def __init__(self, cores: list[int], *, devices: int = 1):
        flags = os.environ.get("XLA_FLAGS", "")
        here = Path(__file__).parents[1]
        paths = [str(here), str(here.parents[1]), os.environ.get("PYTHONPATH", "")]
        env = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count={devices}".strip(),
            "JAX_PLATFORMS": "cpu",
            "OMP_NUM_THREADS": str(len(cores)),
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", "peer_codes.pool", ",".join(map(str, cores))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=env,
        )

    def ask(self, *message: Any) -> None:
        """Send a call without waiting for its answer."""
        assert self.process.stdin is not None
        _send(self.process.stdin, message)

    def answer(self) -> Any:
        """Return the answer to the oldest call. **Raises:** `RuntimeError` with its traceback."""
        assert self.process.stdout is not None
        good, value = _receive(self.process.stdout)
        if not good:
            raise RuntimeError(value)
        return value

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def together(workers: list[Worker], messages: list[tuple]) -> tuple[list, float]:
    """Return the answers of workers that run at the same time, and the seconds until the last."""
    begin = time.perf_counter()
    for worker, message in zip(workers, messages, strict=True):
        worker.ask(*message)
    answers = [worker.answer() for worker in workers]
    return answers, time.perf_counter() - begin


def _send(pipe: IO[bytes], value: Any) -> None:
    data = pickle.dumps(value)
    pipe.write(struct.pack("<Q", len(data)) + data)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> Any:
    head = pipe.read(8)
    if len(head) < 8:
        raise EOFError("A worker ended before its answer.")
    return pickle.loads(pipe.read(struct.unpack("<Q", head)[0]))


def _serve() -> None:
    # Output that a library prints must not mix with the answers.
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    runs: dict[str, Any] = {}

    def handle(what: str, key: str, *rest: Any) -> Any:
        if what == "build":
            code, task, kappas, options = rest
            module = importlib.import_module(f"peer_codes.{code}")
            runs[key], seconds = module.build(task, np.asarray(kappas), **options)
            return seconds
        if what == "result":
            return np.asarray(runs[key]())
        if what == "drop":
            runs.clear()
            return None
        runs[key]()
        return None

    while True:
        try:
            message = _receive(sys.stdin.buffer)
        except EOFError:
            return
        try:
            _send(pipe, (True, handle(*message)))
        except Exception:
            _send(pipe, (False, traceback.format_exc()))


if __name__ == "__main__":
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core) for core in sys.argv[1].split(",")})
    _serve()
