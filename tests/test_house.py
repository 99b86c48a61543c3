"""Packages import in one direction and nothing private; no file is too long."""

import ast
import graphlib
import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import vi_jax

HOUSE = Path(__file__).parents[1] / "vi_jax"
FILES = sorted(HOUSE.rglob("*.py"))

# Each package may import from those before it.
ORDER = "lanes machine machines flow orbit scans robust plot explore cli".split()
LATE = [["explore", "serve"], ["explore", "subject"]]
TOOLS = {"_checks", "_loading", "_messages", "_programs", "_types"}


def imports(path: Path) -> Iterator[tuple[list[str], str]]:
    """Yield the modules of the package that a file imports from, and the imported names."""
    here = list(path.relative_to(HOUSE).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.ImportFrom):
            continue
        words = (node.module or "").split(".") if node.module else []
        if node.level:
            words = [*here[: len(here) + 1 - node.level], *words]
        elif words[:1] == ["vi_jax"]:
            words = words[1:]
        else:
            continue
        for name in node.names:
            yield words, name.name


def test_packages_import_in_one_direction_and_nothing_private():
    packages = {path.name for path in HOUSE.iterdir() if (path / "__init__.py").exists()}
    assert packages == set(ORDER)
    seen = 0
    for path in FILES:
        package = path.relative_to(HOUSE).parts[0]
        if package not in ORDER:
            continue
        for words, name in imports(path):
            other = words[0] if words else name
            if other == package or other in TOOLS:
                continue
            seen += 1
            assert other in ORDER and ORDER.index(other) < ORDER.index(package), (path, other)
            # Import from `__init__`, except for modules that load slowly.
            assert len(words) <= 1 or words in LATE, (path, words)
            assert not name.startswith("_"), (path, name)
    assert seen > 100


def test_files_of_orbit_import_in_no_circle():
    room = {path.stem: path for path in FILES if path.parent == HOUSE / "orbit"}
    room.pop("__init__")
    graph = {
        name: {words[1] for words, _ in imports(path) if words[:1] == ["orbit"] and words[1:]}
        for name, path in room.items()
    }
    assert len([*graphlib.TopologicalSorter(graph).static_order()]) == len(room)


def test_no_file_has_more_than_800_lines():
    assert not [path for path in FILES if path.read_text(encoding="utf-8").count("\n") > 800]


def test_each_name_is_listed_once_and_belongs_to_its_package():
    listed = [
        (name.name, node.module)
        for node in ast.parse((HOUSE / "__init__.pyi").read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    ]
    names = [name for name, _ in listed]
    assert len(set(names)) == len(names) > 100 and sorted(names) == vi_jax.__all__
    for name, package in listed:
        if package is not None:
            module = importlib.import_module(f"vi_jax.{package}")
            assert getattr(vi_jax, name) is getattr(module, name)
    with pytest.raises(AttributeError, match="'vi_jax' has no attribute 'simulat'"):
        vi_jax.simulat  # noqa: B018


def test_members_of_a_machine_are_few_and_documented():
    members = [name for name in dir(vi_jax.AbstractMachine) if not name.startswith("_")]
    assert len(members) <= 24  # four of them for delays
    text = " ".join(vi_jax.AbstractMachine.__doc__.split())
    assert not [name for name in members if f"`{name}`" not in text and f".{name}(" not in text]


def test_simulate_loads_no_other_package():
    others = {f"vi_jax.{name}" for name in ("orbit", "scans", "robust", "plot")}
    run = f"import sys, vi_jax; vi_jax.simulate; print([x for x in sys.modules if x in {others}])"
    command = [sys.executable, "-c", run]
    out = subprocess.run(command, capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
