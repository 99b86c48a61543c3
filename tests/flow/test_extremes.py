"""The rows of the envelope: each corner beside its own expectation."""

import pytest

from envelope import CASES, numbers

# The others take longer than a minute together.
BRIEF = ("d within", "rtol")


def rows():
    for case in CASES:
        slow = () if case.range.startswith(BRIEF) else pytest.mark.slow
        yield pytest.param(case, id=case.range, marks=slow)


@pytest.mark.parametrize("case", list(rows()))
def test_corner(case, monkeypatch):
    monkeypatch.setattr(numbers, "QUICK", True)  # the study's table is of ten times as many
    found = case.measure()
    for name, promise in case.promise.items():
        assert found[name] <= promise, (name, found[name])
