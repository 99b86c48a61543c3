"""Published numbers compared with those of vi_jax: shared code of the scripts."""

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

    **Arguments:** the quantity, with its unit; theirs, with all digits as published; ours; the
    allowed difference, by default half a unit of the last digit of theirs plus the rounding of a
    run (1e-12 of the number).
    """

    quantity: str
    theirs: str
    ours: Any
    within: float | None = None

    @property
    def difference(self) -> float:
        """The absolute difference of both numbers."""
        return abs(float(self.ours) - float(self.theirs))

    @property
    def allowed(self) -> float:
        """The allowed difference."""
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
    """A published example compared with vi_jax; printed as a table of its numbers.

    **Arguments:** the code or the authors; the source; the origin of their numbers;
    `(quantity, theirs, ours)` or `(quantity, theirs, ours, within)` of each `Number`.

    **Raises:** `ValueError` if a number of ours differs from theirs by more than is allowed.
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
    """Return one unit of the last digit of a number written in decimals."""
    mantissa, _, exponent = number.lower().partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
