"""Tools of the studies."""

import pytest
from tools.tables import table


def test_table():
    text = table(["", "ζ"], [("2π", 0.9), ("", "–")])
    assert text == "| | ζ |\n|---|---|\n| 2π | 0.9 |\n|  | – |"
    with pytest.raises(ValueError, match="1 cells under 2 headings"):
        table(["a", "b"], [("alone",)])
