"""The frame of a study: its `--quick` option, its progress lines, its page and its picture.

A study's page ends with its headline numbers as JSON. A test computes them again with the current
library. All studies are in double precision.
"""

import json
import re
import sys
import time
from pathlib import Path
from typing import Any

import jax
from matplotlib.figure import Figure

from .kept import keep_programs
from .pictures import save_picture

jax.config.update("jax_enable_x64", True)
QUICK = "--quick" in sys.argv
"""True if the study takes few values and writes nothing."""

_EXPERIMENTS = Path(__file__).parents[1]
if Path(sys.argv[0]).resolve().parent == _EXPERIMENTS / "studies":  # benchmarks measure compiling
    keep_programs()
_BEGIN = time.perf_counter()
_TITLE = "## Headline numbers"
_NOTE = "Computed again by the tests, which fail where the library gives others."


def say(text: object) -> None:
    """Print a line with the seconds since the start and the processor time used so far."""
    clock, used = time.perf_counter() - _BEGIN, time.process_time()
    print(f"[{clock:5.1f} s, CPU {used:5.1f} s] {text}", flush=True)


def write(
    study: str, text: str, numbers: dict[str, float], figure: Figure | None = None, **look: Any
) -> None:
    """Write a study's page and picture; with `--quick`, write nothing.

    **Arguments:** the name of the study, which is that of its file; its page in Markdown; its
    headline numbers by name; its picture; options of `save_picture`.
    """
    if QUICK:
        return
    folders = (_EXPERIMENTS / kind for kind in ("studies", "benchmarks"))
    folder = next(x for x in folders if (x / f"{study}.py").exists())
    rounded = {name: float(f"{value:.12g}") for name, value in numbers.items()}
    listed = json.dumps(rounded, indent=2, ensure_ascii=False, allow_nan=False)
    page = f"{text.rstrip()}\n\n{_TITLE}\n\n{_NOTE}\n\n```json\n{listed}\n```\n"
    if figure is not None:
        save_picture(figure, _EXPERIMENTS / "figures" / f"{study}.png", **look)
    (folder / f"{study}.md").write_text(page, encoding="utf-8")


def headlines(page: str) -> dict[str, float]:
    """Return the headline numbers of a page."""
    _, _, rest = page.partition(_TITLE)
    block = re.search(r"```json\n(.*?)```", rest, re.DOTALL)
    return {} if block is None else json.loads(block[1])
