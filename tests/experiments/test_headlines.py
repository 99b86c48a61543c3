"""The headline numbers on the pages of the studies agree with those of the library now."""

import inspect
from pathlib import Path

import pytest
from reproduction.report import KEPT, read
from reproduction.report import headline_numbers as of_report
from tools.study import headlines

from headline_numbers import benchmarks, machines, orbits, paper
from headline_numbers.closed_forms import Expected

FOLDER = Path(__file__).parents[2] / "experiments"

PATHS = {p.stem: p for kind in ("studies", "benchmarks") for p in FOLDER.glob(f"{kind}/*.py")}
# The page of `gpu` has times only.
NAMES = ["reproduction", *sorted(set(PATHS) - {"gpu"})]
COMPUTED = {
    name: function
    for module in (benchmarks, machines, orbits, paper)
    for name, function in vars(module).items()
}


def kept_of(name: str) -> dict[str, float]:
    if name == "reproduction":
        return of_report(read(KEPT))
    return headlines(PATHS[name].with_suffix(".md").read_text(encoding="utf-8"))


def stale(kept: dict[str, float], computed: Expected) -> list[str]:
    """Return the computed numbers that a page lacks or has with another value."""
    missing = [f"{name} is not kept" for name in computed if name not in kept]
    return missing + [
        f"{name}: kept {kept[name]}, computed {value} (± {slack:g})"
        for name, (value, slack) in computed.items()
        if name in kept and not abs(kept[name] - value) <= slack
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_headline_numbers(name):
    kept, function = kept_of(name), COMPUTED[name]
    computed = function(kept) if inspect.signature(function).parameters else function()
    assert computed and not stale(kept, computed)
