"""How a study is run: `--quick` or in full, what it reports on its way, and what it writes."""

import sys
import time
from pathlib import Path
from typing import Any

from headlines import keep
from matplotlib.figure import Figure

QUICK = "--quick" in sys.argv
"""Whether to take few values, and to write nothing."""

_EXPERIMENTS = Path(__file__).parents[1]
_BEGIN = time.perf_counter()


def say(text: object) -> None:
    """Print a line with the seconds since the start and the processor time used so far."""
    clock, used = time.perf_counter() - _BEGIN, time.process_time()
    print(f"[{clock:5.1f} s, CPU {used:5.1f} s] {text}", flush=True)


def write(study: str, page: str, numbers: dict[str, float], figure: Figure, **look: Any) -> None:
    """Write a study's page and picture, beside each other's numbers; nothing with `--quick`.

    **Arguments:** the study's name, which is that of its file; its page in Markdown; its headline
    numbers by name; its picture, and options of `save_picture`.
    """
    if QUICK:
        return
    folders = (_EXPERIMENTS / kind for kind in ("studies", "benchmarks"))
    folder = next(x for x in folders if (x / f"{study}.py").exists())
    keep(folder, study, page, numbers, figure, **look)
