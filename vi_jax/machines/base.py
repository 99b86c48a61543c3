"""What the machines of this room share."""

from math import pi
from typing import Any, ClassVar

from .._checks import require_ranges
from ..scene import AbstractScene


class PhaseMachine(AbstractScene):
    """A machine whose independent variable is the phase of its drive, and whose numbers are in
    their `ranges`."""

    ranges: ClassVar[dict[str, Any]]

    def __check_init__(self):
        require_ranges(self)

    @property
    def cycle(self) -> float:
        """2π."""
        return 2 * pi
