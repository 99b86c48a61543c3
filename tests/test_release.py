"""The released source archive and wheel, installed outside the checkout."""

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# The installed wheel must not need the checkout.
FIRST_STEPS = """
import jax
jax.config.update("jax_enable_x64", True)
import vi_jax as vi
print(vi.__file__)
scene = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=20.0, damping_ratio=0.1)
run = vi.simulate(scene, scene.start(), 2)
assert bool(run.successful) and vi.__version__
"""


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
def test_the_wheel_runs_outside_the_checkout(built, tmp_path):
    (path,) = built.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    assert "vi_jax/py.typed" in names
    assert {name.split("/")[0].split("-")[0] for name in names} == {"vi_jax"}
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--quiet", "--target"]
    subprocess.run([*install, str(tmp_path / "site"), str(path)], check=True, capture_output=True)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    run = lambda *words: subprocess.run(
        [sys.executable, *words], cwd=tmp_path, env=environment, check=True,
        capture_output=True, text=True,
    ).stdout  # fmt: skip
    assert Path(run("-c", FIRST_STEPS).split()[0]).is_relative_to(tmp_path)
    command = "import sys; from vi_jax.cli import main; sys.argv[1:] = ['--help']; main()"
    assert "explore" in run("-c", command)
