"""Words that several modules need for what they print."""

import numpy as np


def so_many(number: int | np.integer, noun: str) -> str:
    """So many of something, in words; the noun takes an s."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
