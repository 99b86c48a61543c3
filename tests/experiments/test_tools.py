"""What the studies share."""

import time

import pytest
from tools.tables import table
from tools.timing import side_by_side


def test_table():
    text = table(["", "ζ"], [("2π", 0.9), ("", "–")])
    assert text == "| | ζ |\n|---|---|\n| 2π | 0.9 |\n|  | – |"
    with pytest.raises(ValueError, match="1 cells under 2 headings"):
        table(["a", "b"], [("alone",)])


def test_programs_run_in_turn():
    calls = []

    def slow():
        calls.append("slow")
        time.sleep(0.02)

    def quick():
        calls.append("quick")

    longer, shorter = side_by_side([slow, quick], rounds=3)
    assert longer >= 0.02 > shorter and calls == ["slow", "quick"] * 3
