"""The examples are short, run, and agree with their notebooks and the gallery."""

import os
import re
import subprocess
import sys

import pytest
from examples.__main__ import EXAMPLES, FIGURES, HERE, cells, notebook, printed_in
from PIL import Image

from differences import quick

# This one runs with the slow tests, the others before a release; Pyright checks their calls.
SLOW = {"paper_discrepancy"}


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_script_notebook_and_picture_agree(example):
    text = example.read_text(encoding="utf-8")
    assert text.startswith('# %% [markdown]\n"""# ')
    assert len(text.splitlines()) <= 40
    assert f'figure.savefig("{example.stem}.png")' in text
    book = example.with_suffix(".ipynb").read_text(encoding="utf-8")
    texts = printed_in(book)
    assert book == notebook(example, texts), "run `python experiments/examples --notebooks`"
    assert len(book) < 200_000
    picture = FIGURES / f"{example.stem}.png"
    assert picture.stat().st_size < 100_000
    assert Image.open(picture).size[0] >= 700


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_the_gallery_shows_the_example(example):
    gallery = (HERE.parents[1] / "docs" / "gallery.md").read_text(encoding="utf-8")
    (_, told), *_ = cells(example.read_text(encoding="utf-8"))
    assert f"#{told}\n\n" in gallery
    assert f"(../experiments/figures/examples/{example.stem}.png)" in gallery


@pytest.mark.parametrize("name", quick([path.stem for path in EXAMPLES], slow=SLOW))
def test_runs(name, tmp_path):
    (example,) = (path for path in EXAMPLES if path.stem == name)
    environment = {**os.environ, "PYTHONPATH": str(HERE.parents[1])}
    done = subprocess.run(
        [sys.executable, str(example)],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / f"{example.stem}.png").exists()
    kept = "".join(printed_in(example.with_suffix(".ipynb").read_text(encoding="utf-8")))
    assert _words(kept) == _words(done.stdout), "run `python experiments/examples`"


def _words(text):
    """Replace the numbers of a text, whose last digits depend on the processor."""
    return re.sub(r"[-+]?\d[\d.,]*(e[-+]?\d+)?", "#", text)
