"""Coordinates that contacts act on."""

from collections.abc import Callable
from typing import Any, NamedTuple

from .._types import Scalar, State


class Coordinate(NamedTuple):
    """A coordinate that stops limit."""

    position: Callable[[State], Scalar]
    velocity: Callable[[State], Scalar]
    """What an impact reverses; of the sign of d(position)/ds."""
    placed: Callable[[State, Any, Any], State]
    """A state with another position and velocity, and with all that an impact changes besides."""
    mass: Any = 1.0
    """What an impact acts on, in the machine's unit of mass: of two bodies the reduced mass. A
    number, or a function `mass(s, state)`."""

    def mass_at(self, s: Scalar, state: State) -> Any:
        """The mass in a state."""
        return self.mass(s, state) if callable(self.mass) else self.mass
