"""Parts that the ready machines share: fields, pairs of stops, and kinds of drive."""

from collections.abc import Mapping
from math import pi
from typing import Any, ClassVar

import equinox as eqx

from .._checks import REAL, Range, optional_real, real, require_ranges
from .._types import Scalar, State
from ..machine import AbstractMachine, RigidStop, stops_of


def number_field(name: str, default: float | None, allowed: Range = REAL, unit: str = "") -> Any:
    """Return a keyword field for a real number in a range, optional if the default is `None`."""
    converter = real(name) if default is not None else optional_real(name)
    about = {"range": allowed, "unit": unit}
    return eqx.field(kw_only=True, default=default, converter=converter, metadata=about)


def stops_at(
    gap: Any, restitution: Any, *, two_sided: bool = True, **others: Any
) -> tuple[RigidStop, ...]:
    """Return equal stops at this distance from zero: on the right, and if two-sided on the left."""
    sides = ("right", "left") if two_sided else ("right",)
    return tuple(RigidStop(gap, restitution, side, **others) for side in sides)


class ReadyMachine(AbstractMachine):
    """A machine whose numbers are in their ranges. Numbers without a unit in their field and in
    `quantity_units` are dimensionless."""

    quantity_units: ClassVar[Mapping[str, str]] = {}
    """The units of the state's components and of time, rates, energy and power."""

    def __check_init__(self):
        require_ranges(self)

    @property
    def units(self) -> Mapping[str, str]:
        return {**super().units, **self.quantity_units, "": "1"}


class ForcedMachine(ReadyMachine):
    """A machine driven at an angular frequency ω, its field `frequency`, with the phase ωt as the
    independent variable."""

    frequency: eqx.AbstractVar[Scalar]
    cycle: ClassVar = 2 * pi

    def pace(self, s: Scalar, state: State) -> Scalar:
        """Return dt/ds = 1/ω, the duration of a unit of phase."""
        return 1 / self.frequency


def draw_supported_body(machine: Any, pen: Any, place: float) -> float:
    """Draw a body between stops, on a spring and a damper from a post; return the post's place."""
    size = pen.size
    post, back = -pen.reach - 2.6 * size, place - size / 2
    pen.floor(post, pen.reach + 1.4 * size, -0.5 * size)
    pen.wall(post, -1, low=-0.5 * size, high=0.8 * size, color="0.5")
    pen.spring((post, 0.23 * size), (back, 0.23 * size))
    pen.damper((post, -0.24 * size), (back, -0.24 * size))
    pen.body(place, width=size)
    for stop in stops_of(machine):
        pen.stop(stop, slot=0.43 * size)  # spring and damper pass through one on the left
    return post
