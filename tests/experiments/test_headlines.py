"""The headline numbers on the pages of the studies agree with those of the library now."""

import inspect
from pathlib import Path

import pytest
from tools.study import headlines

from headline_numbers import machines, orbits, paper
from headline_numbers.closed_forms import Expected

FOLDER = Path(__file__).parents[2] / "experiments"

PATHS = {path.stem: path for path in FOLDER.glob("studies/*.py")}
COMPUTED = {
    name: function
    for module in (machines, orbits, paper)
    for name, function in vars(module).items()
}


def stale(kept: dict[str, float], computed: Expected) -> list[str]:
    """Return the computed numbers that a page lacks or has with another value."""
    missing = [f"{name} is not kept" for name in computed if name not in kept]
    return missing + [
        f"{name}: kept {kept[name]}, computed {value} (± {slack:g})"
        for name, (value, slack) in computed.items()
        if name in kept and not abs(kept[name] - value) <= slack
    ]


@pytest.mark.slow
# `robust/test_minimal_kick.py` tests the kick of `robustness`.
@pytest.mark.parametrize("name", sorted(set(PATHS) - {"robustness"}))
def test_headline_numbers(name):
    kept = headlines(PATHS[name].with_suffix(".md").read_text(encoding="utf-8"))
    function = COMPUTED[name]
    computed = function(kept) if inspect.signature(function).parameters else function()
    assert computed and not stale(kept, computed)
