"""Numbers of other people's examples beside those that vi_jax gives: what the gallery shares."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
from tools.tables import table


@dataclass(frozen=True)
class Number:
    """One number of an example, theirs and ours.

    **Arguments:** what it is, with its unit; theirs, written as it was published, digits and all;
    ours; how far apart they may be, by default half a unit of the last digit of theirs and the
    rounding of a run (1e-12 of it).
    """

    quantity: str
    theirs: str
    ours: Any
    within: float | None = None

    @property
    def difference(self) -> float:
        """How far apart they are."""
        return abs(float(self.ours) - float(self.theirs))

    @property
    def allowed(self) -> float:
        """How far apart they may be."""
        if self.within is not None:
            return self.within
        return 0.5 * last_digit(self.theirs) + 1e-12 * max(1.0, abs(float(self.theirs)))

    @property
    def printed(self) -> str:
        """Ours with two more digits than theirs, and twelve at most."""
        if float(self.theirs) == 0:
            return f"{float(self.ours):.0e}"
        digits = len(self.theirs.lower().partition("e")[0].replace(".", "").lstrip("-0"))
        return f"{float(self.ours):.{min(digits + 2, 12)}g}"


@dataclass(frozen=True)
class Comparison:
    """An example of others beside what vi_jax gives; shown as the table of its numbers.

    **Arguments:** the code or the authors that it is of; where it is published; how their numbers
    were obtained; `(quantity, theirs, ours)` or `(quantity, theirs, ours, within)` of each
    `Number`.

    **Raises:** `ValueError` if a number of ours is farther from theirs than it may be.
    """

    code: str
    source: str
    how: str
    numbers: Sequence[Any]

    def __post_init__(self):
        object.__setattr__(self, "numbers", [Number(*row) for row in self.numbers])
        for row in self.numbers:
            if not row.difference <= row.allowed:
                raise ValueError(
                    f"{row.quantity}: theirs {row.theirs}, ours {float(row.ours)!r}, which may be "
                    f"{row.allowed:.0e} apart."
                )

    def __str__(self):
        rows = [(x.quantity, x.theirs, x.printed, f"{x.difference:.0e}") for x in self.numbers]
        rows = [(*row[:3], "0" if float(row[3]) == 0 else row[3]) for row in rows]
        return table(["quantity", "theirs", "ours", "difference"], rows)


def last_digit(number: str) -> float:
    """A unit of the last digit of a number that is written in decimals."""
    mantissa, _, exponent = number.lower().partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
