"""All files agree on the version and the requirements."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
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
