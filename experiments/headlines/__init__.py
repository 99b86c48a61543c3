"""A study's table and picture, kept so that neither can grow stale unnoticed.

The page ends with the study's headline numbers as JSON, which a test computes again with the
library as it is. The picture carries a fingerprint of all numbers in the page's tables and in that
JSON, so that a picture of one run cannot stand beside the table of another.
"""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from tools.pictures import save_picture, stamp

FINGERPRINT = "vi_jax fingerprint of the table's numbers"
_TITLE = "## Headline numbers"
_NOTE = "Computed again by the tests, which fail where the library gives others."
_NUMBER = re.compile(r"\d+(?:,\d{3})*(?:\.\d+)?(?:e[+-]?\d+)?")


def keep(
    folder: Path, study: str, text: str, numbers: dict[str, float], figure: Figure, **look: Any
) -> None:
    """Write a study's page with its headline numbers, and its picture with their fingerprint.

    **Arguments:** the folder of the page, beside which is that of the pictures; the study's name;
    its page; headline numbers by name; the picture, and options of `save_picture`.
    """
    rounded = {name: float(f"{value:.12g}") for name, value in numbers.items()}
    listed = json.dumps(rounded, indent=2, ensure_ascii=False, allow_nan=False)
    page = f"{text.rstrip()}\n\n{_TITLE}\n\n{_NOTE}\n\n```json\n{listed}\n```\n"
    picture = folder.parent / "figures" / f"{study}.png"
    folder.mkdir(parents=True, exist_ok=True)
    picture.parent.mkdir(parents=True, exist_ok=True)
    save_picture(figure, picture, **look)
    stamp(picture, FINGERPRINT, fingerprint(page))
    (folder / f"{study}.md").write_text(page, encoding="utf-8")


def headlines(page: str) -> dict[str, float]:
    """The headline numbers of a page; none without such a block."""
    _, _, rest = page.partition(_TITLE)
    block = re.search(r"```json\n(.*?)```", rest, re.DOTALL)
    return {} if block is None else json.loads(block[1])


def fingerprint(page: str) -> str:
    """Of the numbers in a page's tables and of its headline numbers; its prose is free."""
    tables = "\n".join(line for line in page.splitlines() if line.startswith("|"))
    kept = json.dumps(headlines(page), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256((" ".join(_NUMBER.findall(tables)) + kept).encode()).hexdigest()
