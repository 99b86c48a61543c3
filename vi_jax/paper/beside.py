"""A second process, for work that needs nothing of the rest.

What takes the time of a reproduction is tracing and compiling, and tracing holds Python's lock: two
threads keep little more than one core busy, two processes keep two.
"""

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax

# Reads what to call, and writes what it returns. It is no function of a module, since the process
# must not run the caller's script again, as those of `multiprocessing` do.
_PROGRAM = """
import pickle, sys
from pathlib import Path

function, arguments = pickle.loads(Path(sys.argv[1]).read_bytes())
Path(sys.argv[2]).write_bytes(pickle.dumps(function(*arguments)))
"""


def second_core() -> bool:
    """Whether another process would have a core of its own. An accelerator's memory is not shared
    out: there one process does all."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (cores or 1) > 1 and jax.default_backend() == "cpu" and bool(sys.executable)


@contextmanager
def beside(function: Callable[..., Any], *arguments: Any) -> Iterator[Callable[[], Any]]:
    """Begin a call in another process, in the precision of this one; it ends with the block.

    **Arguments:** a function of a module and its arguments, all of which can be pickled, as what
    it returns.

    **Returns:** a function that waits for the result. If the process fails, for whatever reason,
    the call is made again in this one, so that an error is raised here.
    """
    with TemporaryDirectory() as folder:
        asked, found = Path(folder) / "asked", Path(folder) / "found"
        asked.write_bytes(pickle.dumps((function, arguments)))
        here = {
            "PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path),
            "JAX_ENABLE_X64": str(int(jax.config.read("jax_enable_x64"))),
            "JAX_PLATFORMS": "cpu",
        }
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, str(asked), str(found)],
            env={**os.environ, **here},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

        def result() -> Any:
            if process.wait() == 0:
                return pickle.loads(found.read_bytes())
            return function(*arguments)

        try:
            yield result
        finally:
            process.kill()
            process.wait()
