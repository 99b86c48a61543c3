"""The page of other codes' examples, taken apart."""

import re

from validated.__main__ import PAGE


def sections():
    """The page's parts, one for each script, by their names."""
    _, *parts = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.M)
    return {re.findall(r"validated/(\w+)\.py\), \d+ s\.", part)[0]: part for part in parts}


def rows(part):
    """The cells of a section's table, without its head."""
    lines = [x for x in part.splitlines() if x.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
