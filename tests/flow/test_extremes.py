"""The rows of `experiments/studies/extremes.py`: each corner beside its own expectation."""

import importlib.util
import sys
from pathlib import Path

import pytest

PATH = Path(__file__).parents[2] / "experiments" / "studies" / "extremes.py"
spec = importlib.util.spec_from_file_location("extremes", PATH)
assert spec is not None and spec.loader is not None
extremes = importlib.util.module_from_spec(spec)
sys.modules["extremes"] = extremes
spec.loader.exec_module(extremes)

# The others take longer than a minute together.
BRIEF = ("ζ = 1, ξ = 0", "d within", "denormal", "rtol")


def rows():
    for case in extremes.CASES:
        slow = () if case.range.startswith(BRIEF) else pytest.mark.slow
        yield pytest.param(case, id=case.range, marks=slow)


@pytest.mark.parametrize("case", rows())
def test_corner(case):
    found = case.measure()
    for name, promise in case.promise.items():
        assert found[name] <= promise, (name, found[name])
