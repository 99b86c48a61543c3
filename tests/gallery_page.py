"""Parse the page of examples from other codes."""

import re

from validated.__main__ import PAGE


def sections():
    """Return the page's sections by the name of their script."""
    _, *parts = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.M)
    return {re.findall(r"validated/(\w+)\.py\), \d+ s\.", part)[0]: part for part in parts}


def rows(part):
    """Return the cells of a section's table, without its header."""
    lines = [x for x in part.splitlines() if x.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
