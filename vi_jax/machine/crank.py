"""Cranks: how the slider moves with the crank angle."""

import abc
from typing import ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from .._checks import Range, real, require_ranges
from .._types import Scalar
from .own import by_default, is_own
from .shown import Shown
from .trig import sincos


class Slide(NamedTuple):
    """The slider's displacement U and its first two derivatives by the crank angle (unit: a)."""

    U: Float[Array, "..."]
    U_phi: Float[Array, "..."]
    U_phiphi: Float[Array, "..."]


class AbstractCrank(Shown):
    """A crank asks for one method, `slide(phase)`."""

    @property
    def is_odd(self) -> bool:
        """Whether the slider half a turn later is where its image is: U(φ + π) = -U(φ)."""
        return False

    @property
    def drawn_rod(self) -> Scalar | float:
        """Length of the rod in pictures (unit: a)."""
        return 3.0

    @abc.abstractmethod
    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """The slider's displacement at crank angle `phase` (radians), in units of the crank a."""


class CosineCrank(AbstractCrank):
    """The first approximation of the paper (Eq. 4): U = cos φ."""

    @property
    def is_odd(self):
        """True, unless a subclass has another `slide`."""
        return not is_own(type(self).slide)

    @by_default
    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """U = cos φ and its derivatives (dimensionless)."""
        sine, cosine = sincos(phase)
        return Slide(cosine, -sine, -cosine)


class SliderCrank(AbstractCrank):
    """The exact kinematics of crank a and rod l: U = cos φ + (√(1 - λ² sin² φ) - 1)/λ."""

    ratio: Float[Array, "..."] = eqx.field(converter=real("ratio"))
    """λ = a/l (dimensionless), in (0, 1)."""
    ranges: ClassVar = {"ratio": Range(0.0, 1.0, open_low=True, open_high=True)}

    def __check_init__(self):
        require_ranges(self)

    @property
    def drawn_rod(self):
        """Length of the rod in radii of the crank, 1/λ, for drawings."""
        return 1 / self.ratio

    def slide(self, phase: Float[Array, "..."]) -> Slide:
        """Exact U and its derivatives (dimensionless)."""
        sine, cosine = sincos(phase)
        inverse = 1 / (1 - (self.ratio * sine) ** 2) ** 0.5
        # (r - 1)/λ as -λ sin²/(1 + r): no cancellation for a long rod.
        lag = self.ratio * sine * sine * inverse / (1 + inverse)
        slope = self.ratio * sine * cosine * inverse
        bend = self.ratio * (cosine**2 - sine**2) * inverse + self.ratio * slope**2 * inverse
        return Slide(cosine - lag, -sine - slope, -cosine - bend)
