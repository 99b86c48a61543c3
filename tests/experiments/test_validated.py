"""Examples of other codes: each script reproduces the numbers on the page."""

import re
from math import floor, log10

import pytest
from validated.__main__ import ORDER, PAGE, SCRIPTS, comparison_of, described, section
from validated._comparison import Comparison, last_digit


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_the_script_is_short_and_on_the_page(script):
    text = script.read_text(encoding="utf-8")
    assert text.startswith('# %% [markdown]\n"""# ') and len(text.splitlines()) <= 60
    part = sections()[script.stem]
    assert described(script)[1] in part


def test_the_page_has_every_script_once():
    assert list(sections()) == list(ORDER)
    assert sorted(ORDER) == [path.stem for path in SCRIPTS]


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.stem for path in SCRIPTS])
def test_the_script_reproduces_the_page(name):
    (script,) = (path for path in SCRIPTS if path.stem == name)
    comparison = comparison_of(script)
    part = sections()[script.stem]
    now = section(script, comparison, 0.0)
    # The text must agree word for word, except for the table and the time.
    prose = [re.sub(r"\), \d+ s\.", "", re.sub(r"^\|.*\n", "", x, flags=re.M)) for x in (part, now)]
    assert prose[1].strip() == f"## {prose[0].strip()}"
    printed = rows(part)
    assert len(printed) == len(comparison.numbers) > 0
    for cells, number in zip(printed, comparison.numbers, strict=True):
        quantity, theirs, ours, difference = cells
        assert (quantity, theirs) == (number.quantity, number.theirs)
        # Rounding differs between machines: allow two units of the last digit, or a zero's bound.
        zero = float(theirs) == 0
        slack = number.allowed if zero else 2 * last_digit(ours)
        if name == "duffing_basins":
            # Rounding decides where starts near fractal boundaries go: with AVX2 39 of 10,000 go
            # elsewhere than with AVX-512.
            slack = max(slack, 0.2 * number.allowed)
        assert abs(float(ours) - float(number.ours)) <= slack, quantity
        assert float(difference) <= number.allowed * 1.1, quantity  # printed with one digit
        size = 10.0 ** floor(log10(float(difference) or 1e-300))
        assert abs(float(difference) - number.difference) <= 0.51 * size + slack, quantity


def test_deviating_numbers_raise():
    good = Comparison("a code", "a page", "printed", [("x", "0.488", 0.4884), ("n", "0", 0.0)])
    assert str(good).splitlines()[2:] == ["| x | 0.488 | 0.4884 | 4e-04 |", "| n | 0 | 0e+00 | 0 |"]
    assert (last_digit("0.488"), last_digit("12"), last_digit("1.25e-3")) == (1e-3, 1.0, 1e-5)
    for wrong in (0.4886, float("nan")):
        with pytest.raises(ValueError, match=r"x: theirs 0\.488, ours .* 5e-04 apart"):
            Comparison("a code", "a page", "printed", [("x", "0.488", wrong)])
    with pytest.raises(ValueError, match="1e-02 apart"):
        Comparison("a code", "a page", "printed", [("x", "0.488", 0.5, 0.01)])


def sections():
    """Return the page's sections by the name of their script."""
    _, *parts = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.M)
    return {re.findall(r"validated/(\w+)\.py\), \d+ s\.", part)[0]: part for part in parts}


def rows(part):
    """Return the cells of a section's table, without its header."""
    lines = [x for x in part.splitlines() if x.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
