"""All studies and benchmarks run as scripts, and have a table and a figure."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from differences import some

FOLDER = Path(__file__).parents[2] / "experiments"
STUDIES = sorted([*FOLDER.glob("studies/*.py"), *FOLDER.glob("benchmarks/*.py")])
WITHOUT_FIGURE = {"gpu", "first_calls", "delays", "regimes"}
# These need the extra `bench`, or JiTCDDE.
RUN_ELSEWHERE = {"peers", "chains", "delays"}
# These run with the slow tests, the others before a release; Pyright checks their calls.
# `test_headlines.py` tests the headline numbers.
SLOW = {"basins_map"}


@pytest.mark.parametrize("study", STUDIES, ids=lambda path: path.stem)
def test_table_and_figure_exist(study):
    assert study.with_suffix(".md").exists()
    assert study.read_text(encoding="utf-8").startswith(("# %%", '"""'))
    if study.stem in WITHOUT_FIGURE:
        return
    path = FOLDER / "figures" / f"{study.stem}.png"
    assert path.stat().st_size < 200_000
    assert Image.open(path).size[0] >= 800


@pytest.mark.parametrize(
    "name", some([p.stem for p in STUDIES if p.stem not in RUN_ELSEWHERE], *SLOW)
)
def test_runs(name, tmp_path):
    (study,) = (path for path in STUDIES if path.stem == name)
    environment = {**os.environ, "PYTHONPATH": str(FOLDER.parent)}
    done = subprocess.run(
        [sys.executable, str(study), "--quick"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
