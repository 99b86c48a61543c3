"""The contents of the released source archive and wheel, the version and the requirements."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("release")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return folder


@pytest.mark.slow
def test_the_source_archive_is_complete_and_small(built):
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    assert {"README.md", "LICENSE", "pyproject.toml", "vi_jax/py.typed"} <= names
    assert not [name for name in names if "__pycache__" in name or name.startswith(".venv")]
    assert path.stat().st_size < 20e6


@pytest.mark.slow
def test_the_wheel_has_the_package_only(built):
    (path,) = built.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    assert "vi_jax/py.typed" in names
    assert {name.split("/")[0].split("-")[0] for name in names} == {"vi_jax"}


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
RECIPE = (ROOT / ".conda" / "meta.yaml").read_text("utf-8")


def test_one_version():
    version = PROJECT["version"]
    assert f"\n  version: {version}\n" in RECIPE
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"## {version}\n" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_the_conda_recipe_has_the_requirements_of_the_package():
    run = RECIPE.partition("  run:\n")[2].partition("\n\n")[0]
    asked = {re.sub("-base$", "", name): at for name, at in re.findall(r"- (\S+) (\S+)", run)}
    wanted = dict(re.fullmatch(r"([\w-]+)(.*)", x).groups() for x in PROJECT["dependencies"])  # pyright: ignore
    assert asked == {**wanted, "python": PROJECT["requires-python"]}
