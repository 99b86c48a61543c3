"""How pictures and messages speak of a machine."""

from collections.abc import Mapping

from .._checks import fields_with
from .._messages import so_many
from .shown import Shown
from .units import PLAIN, unit_in


class Worded(Shown):
    """The words of a machine: names and units for pictures and messages."""

    @property
    def labels(self) -> tuple[str, str]:
        """What pictures write beside position and velocity, with units."""
        return PLAIN

    @property
    def units(self) -> Mapping[str, str]:
        """The units of its quantities by their names: `position`, `velocity`, `time`, `rate` (of
        what grows in time, as exponents do), `energy`, `power`, and each number and component of a
        state by its own name. "1" is without unit; the name "" stands for all that is not named,
        and what is not stated is shown without. By default those of `labels`, in brackets, and of
        fields."""
        found = zip(("position", "velocity"), map(unit_in, self.labels), strict=True)
        own = {**dict(found), **fields_with(type(self), "unit")}
        return {x: unit for x, unit in own.items() if unit}

    def period_of(self, cycles: int) -> str:
        """A duration of so many cycles, in words."""
        return so_many(cycles, "cycle")

    def place_of(self, since_section: float, cycles: int) -> str:
        """A reading of the clock within a motion of so many cycles, in words."""
        return f"clock {since_section:.6g} after its section (motion of {self.period_of(cycles)})"
