"""A cantilever beam with a stop, by its exact modes."""

import dataclasses
from functools import cache
from math import pi
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    REAL,
    SHARE,
    Range,
    count,
    flag,
    one_of,
    optional_real,
    require_ranges,
)
from .._types import Scalar
from ..machine import RigidStop
from ._base import number_field, stops_at
from .linear import LinearMachine


@cache
def _roots(modes: int) -> np.ndarray:
    """Return the first roots β of cos β cosh β = -1, by Newton's method on cos β + 1/cosh β."""
    x = (np.arange(modes) + 0.5) * pi
    with np.errstate(over="ignore"):
        for _ in range(8):
            x = x + (np.cos(x) + 1 / np.cosh(x)) / (np.sin(x) + np.tanh(x) / np.cosh(x))
    return x


@cache
def _shape_factors(modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return σ = (cosh β + cos β)/(sinh β + sin β) and (1 - σ)e^β of each mode, not cancelling."""
    x = _roots(modes)
    small = np.exp(-x)
    denominator = 0.5 * (1 - small * small) + small * np.sin(x)
    return (
        (0.5 * (1 + small * small) + small * np.cos(x)) / denominator,
        (np.sin(x) - np.cos(x) - small) / denominator,
    )


class Beam(LinearMachine):
    """A slender beam, clamped at one end and free at the other, that hits a stop; in its modes:

        EI ∂⁴w/∂x⁴ + ρA ∂²w/∂s² = load,   w = Σ φᵢ(x/L) qᵢ(s),   ωᵢ = βᵢ² √(EI/(ρA L⁴))

    with cos β cosh β = -1 and φ = cosh βξ - cos βξ - σ (sinh βξ - sin βξ). The mean of φ² is 1 (R.
    D. Blevins, Formulas for Natural Frequency and Mode Shape, 1979). The state is a
    `StructureState` of the modes' coordinates q, and w at a place is `shape(place) @ q`.

    The clamp moves as a cos ωs, and w is relative to it, or a force F cos ωs acts on the tip. An
    impact acts on all modes at once (F. C. Moon and S. W. Shaw, International Journal of Non-Linear
    Mechanics 18, 1983, had one). More modes make the effective mass of an impact smaller, and the
    steps shorter while they oscillate. A cycle is 2π/ω.

    **Arguments:**

    - `modes`: the number of modes, at least 1; static.
    - `gap` of the stop, any number, or `None` for no stop; `restitution` in [0, 1]; `place` of the
      stop along the beam, in (0, 1] of its length; `two_sided` for a stop on each side, static.
    - `damping_ratio`, not negative, one for all modes or (modes,).
    - `amplitude` of the excitation, a or F, any number; `shaken`: `"base"` or `"tip"`, static;
      `frequency` ω, positive.
    - `length` L, `bending_stiffness` EI and `mass_per_length` ρA, positive, by default 1.
    """

    modes: int = eqx.field(kw_only=True, static=True, default=3)  # pyright: ignore
    gap: Scalar | None = eqx.field(
        kw_only=True, default=0.1, converter=optional_real("gap"), metadata={"range": REAL}
    )
    restitution: Any = number_field("restitution", 0.8, SHARE)
    place: Any = number_field("place", 1.0, Range(0.0, 1.0, open_low=True))
    damping_ratio: Float[Array, "..."] = number_field("damping_ratio", 0.01, NOT_NEGATIVE)
    amplitude: Any = number_field("amplitude", 0.1)
    frequency: Any = number_field("frequency", 3.0, POSITIVE)
    length: Any = number_field("length", 1.0, POSITIVE)
    bending_stiffness: Any = number_field("bending_stiffness", 1.0, POSITIVE)
    mass_per_length: Any = number_field("mass_per_length", 1.0, POSITIVE)
    shaken: str = eqx.field(kw_only=True, static=True, default="base")
    two_sided: bool = eqx.field(kw_only=True, static=True, default=False)

    def __check_init__(self):
        count("modes", self.modes, least=1)
        one_of("shaken", self.shaken, ("base", "tip"))
        flag("two_sided", self.two_sided)
        if self.damping_ratio.shape not in ((), (self.modes,)):
            raise ValueError(
                f"Argument `damping_ratio` must be one number, or one for each of {self.modes} "
                f"modes, but has the shape {self.damping_ratio.shape}."
            )
        require_ranges(self)

    @property
    def natural_frequencies(self) -> Float[Array, " modes"]:
        """The angular frequencies ωᵢ of the modes, lowest first."""
        stiff = self.bending_stiffness / (self.mass_per_length * self.length**4)
        return jnp.asarray(_roots(self.modes) ** 2) * jnp.sqrt(stiff)

    @property
    def mass(self) -> Float[Array, " modes"]:  # pyright: ignore
        return jnp.full((self.modes,), self.mass_per_length * self.length)

    @property
    def stiffness(self) -> Float[Array, " modes"]:  # pyright: ignore
        return self.mass * self.natural_frequencies**2

    @property
    def damping(self) -> Float[Array, " modes"]:  # pyright: ignore
        return 2 * self.damping_ratio * self.natural_frequencies * self.mass

    @property
    def contacts(self) -> tuple[RigidStop, ...]:  # pyright: ignore
        if self.gap is None:
            return ()
        first, *other = stops_at(self.gap, self.restitution, two_sided=self.two_sided)
        return dataclasses.replace(first, at=self.shape(self.place)), *other

    @property
    def forces(self) -> tuple[None, Float[Array, " modes"], None]:
        """The force on each mode: inertia due to the clamp's motion, or the force on the tip."""
        if self.shaken == "tip":
            return None, self.amplitude * self.shape(1.0), None
        mean = jnp.asarray(2 * _shape_factors(self.modes)[0] / _roots(self.modes))
        return None, self.mass * mean * self.amplitude * self.frequency**2, None

    @property
    def labels(self) -> tuple[str, str]:
        return "w at the stop" if self.contacts else "q of mode 1", "its rate"

    def shape(self, place: Any) -> Float[Array, "*places modes"]:
        """Return φ of each mode at places along the beam, in [0, 1] of its length."""
        x = jnp.asarray(place)[..., None]
        beta, (sigma, growth) = _roots(self.modes), _shape_factors(self.modes)
        exponentials = jnp.exp(beta * (x - 1)) * growth + (1 + sigma) * jnp.exp(-beta * x)
        return 0.5 * exponentials - jnp.cos(beta * x) + sigma * jnp.sin(beta * x)
