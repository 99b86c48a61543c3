"""The code of all pages runs, their links resolve, and the reference has all public names."""

import os
import re
import runpy
import subprocess
import sys
from inspect import ismodule
from pathlib import Path
from typing import Any

import jax
import matplotlib
import matplotlib.pyplot as plt
import pytest
import vi_jax as vi
from vi_jax import cli

matplotlib.use("Agg")
ROOT = Path(__file__).parents[2]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", *DOCS]
LINKED = [*PAGES, ROOT / "CHANGELOG.md", *sorted((ROOT / "experiments").rglob("*.md"))]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """Return the blocks of code in this language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S)


def cases(language: str):
    """Return the pages that have blocks in this language."""
    return [
        pytest.param(page, id=name_of(page), marks=pytest.mark.slow)
        for page in PAGES
        if blocks(page, language)
    ]


# These pages run in separate processes: the README as users run it, the other since it starts
# processes. All others run in this process, so that shared programs are compiled once.
APART = {"README.md", "docs/howto/cluster.md"}


def run_apart(folder: Path) -> str:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "page.py"],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Work in an empty folder, with JAX's default precision; pages must enable double precision."""
    monkeypatch.chdir(tmp_path)
    jax.config.update("jax_enable_x64", False)
    yield tmp_path
    jax.config.update("jax_enable_x64", True)
    plt.close("all")


def words(printed: str) -> list[Any]:
    """Return the words and numbers of an output, with a tolerance for other processors' rounding.
    Lines with residuals are left out: they are rounding."""
    kept = [line for line in printed.splitlines() if "residual" not in line]
    parts = re.split(r"(-?\d+\.\d+)", " ".join(kept))
    return [pytest.approx(float(x), abs=2e-6) if i % 2 else x.strip() for i, x in enumerate(parts)]


@pytest.mark.parametrize("page", cases("python"))
def test_code_runs(page, folder):
    """All blocks of a page run as one script."""
    code = "\n".join(blocks(page, "python"))
    Path("page.py").write_text(code, encoding="utf-8")
    if name_of(page) in APART:
        said = run_apart(folder)
        for shown in blocks(page, "text") if page.name == "README.md" else []:
            assert words(shown) == words(said)
    else:
        runpy.run_path("page.py")
    for picture in re.findall(r'savefig\("([^"]*)"', code):
        assert Path(picture).exists()


@pytest.mark.parametrize("page", cases("toml"))
def test_files_run(page, folder):
    """Each file runs with the verb that its table names."""
    for text in blocks(page, "toml"):
        Path("page.toml").write_text(text, encoding="utf-8")
        verb = next(x for x in ("scan", "sweep", "basins", "simulate") if f"[{x}]" in text)
        assert cli.main([verb, "page.toml"]) == 0
        for name in re.findall(r'^(?:picture|output|store) = "(.*)"', text, re.M):
            assert Path(name).exists()


@pytest.mark.parametrize("page", LINKED, ids=name_of)
def test_links_resolve(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.M | re.S)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if not link.startswith(("http://", "https://", "#", "mailto:")):
            assert (page.parent / link.split("#")[0]).exists(), link


def test_every_public_name_is_in_the_reference():
    text = "".join(page.read_text("utf-8") for page in (ROOT / "docs" / "reference").glob("*.md"))
    described = {path.split(".")[-1] for path in re.findall(r"^::: (\S+)$", text, re.M)}
    for module in (vi, vi.machines):
        public = {x for x in dir(module) if x[0] != "_" and not ismodule(getattr(module, x))}
        assert public - {"TYPE_CHECKING"} <= described
