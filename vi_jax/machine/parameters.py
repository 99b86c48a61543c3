"""Table 1 of the paper in SI units, and the way from there to a dimensionless scene and back."""

import dataclasses
from math import pi
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._checks import (
    NOT_NEGATIVE,
    POSITIVE,
    REAL,
    SHARE,
    Range,
    concrete,
    in_range,
    one_of,
    optional_real,
    real,
    require_ranges,
)
from .._messages import warn
from .drives import CosineCrank, DCMotor, IdealDrive, Motor, SliderCrank
from .scene import Oscillator, Scene
from .shown import Shown
from .stop import RigidStop

# Crank radii from which a length is taken to be in another unit than metres: a choice. Table 1's
# gap is 2 of them, and would be 2,000 if given in millimetres.
_LONG = 1000.0

# A plain number is taken as well as an array of them to `vmap` over.
Number = Float[Array, "..."] | float


def _si(name: str, unit: str, default: float | None, allowed: Range = REAL) -> Any:
    """A field for a number in this unit, or for a quantity of `pint` that can be given in it."""
    convert = real(name) if default is not None else optional_real(name)
    return eqx.field(
        default=default,
        converter=lambda x: convert(_magnitude(name, unit, x)),
        kw_only=True,
        metadata={"unit": unit, "range": allowed},
    )


def _magnitude(name: str, unit: str, value: Any) -> Any:
    if not (hasattr(value, "magnitude") and hasattr(value, "to")):
        return value
    try:
        return value.to(unit).magnitude
    except Exception as error:  # of a kind that only its library knows
        raise ValueError(
            f"Argument `{name}` must be in {unit or 'no unit'}, or in one that can be converted, "
            f"but got {value}."
        ) from error


class Parameters(Shown):
    """The machine in SI units; the defaults are Table 1 of the paper (T0 = 10 N·m, κ = 0.9).

    Each number may be a quantity of `pint`, in any unit of its kind.

    The dimensionless groups, with ω = √(k0/m_C): ξ = c/(2 m_C ω), d = Δ/a, μ = m_B a²/J,
    ε = m_C a²/J, τ0 = T0/(J ω²), w0 = Ω0/ω, λ = a/l, and with `electrical_time`
    τe = ωL/R. A motor of the constants K_t and K_e at the voltage u has κT0 = K_t u/R, κΩ0 = u/K_e.
    """

    body_mass: Number = _si("body_mass", "kg", 0.35, POSITIVE)
    """m_C, mass of the impacting body, kg."""
    slider_mass: Number = _si("slider_mass", "kg", 0.2, NOT_NEGATIVE)
    """m_B, mass of the slider, kg."""
    stiffness: Number = _si("stiffness", "N/m", 9 * pi**2, POSITIVE)
    """k0, stiffness of the spring, N/m."""
    damping: Number = _si("damping", "N*s/m", 0.5, NOT_NEGATIVE)
    """c, viscous damping of the body, N·s/m."""
    crank_radius: Number = _si("crank_radius", "m", 0.04, POSITIVE)
    """a, crank radius and unit of length, m."""
    rod_length: Number = _si("rod_length", "m", 0.12, POSITIVE)
    """l, length of the rod, m (exact kinematics only)."""
    inertia: Number = _si("inertia", "kg*m**2", 0.06, POSITIVE)
    """J, moment of inertia of the disc, kg·m²."""
    restitution: Number = _si("restitution", "", 0.5, SHARE)
    """k, coefficient of restitution, dimensionless."""
    gap: Number = _si("gap", "m", 0.08)
    """Δ, distance of the stop from the unstretched position, m."""
    torque: Number = _si("torque", "N*m", 10.0, NOT_NEGATIVE)
    """T0, stall torque of the motor at κ = 1, N·m."""
    control: Number = _si("control", "", 0.9)
    """κ, motor control, dimensionless; the frequency ratio ζ of an ideal drive."""
    no_load_speed: Number | None = _si("no_load_speed", "rad/s", None, POSITIVE)
    """Ω0, no-load speed of the motor at κ = 1, rad/s. `None` means ω, which makes the tabulated
    κ = 0.5…1.9 the tabulated range of ζ; the paper does not give Ω0."""

    electrical_time: Number | None = _si("electrical_time", "s", None, POSITIVE)
    """L/R, the armature's inductance over its resistance, s. `None` leaves the armature out."""

    def __check_init__(self):
        require_ranges(self)
        for name in ("gap", "rod_length"):
            self._warn_if_long(name)

    def _warn_if_long(self, name: str) -> None:
        """Millimetres for metres are in range, and make a machine that never meets its stop."""
        length, radius = concrete(getattr(self, name)), concrete(self.crank_radius)
        if length is None or radius is None:
            return
        lengths, radii = np.broadcast_arrays(length, radius)
        long = abs(lengths) >= _LONG * radii
        if long.any():
            length, radius = lengths[long][0], radii[long][0]
            warn(
                f"Argument `{name}` is {length:g} m, {length / radius:.0f} times the crank radius "
                f"of {radius:g} m: lengths are in metres."
            )

    @property
    def units(self) -> dict[str, str]:
        """SI units of each parameter."""
        written = ((f.name, f.metadata["unit"]) for f in dataclasses.fields(self))
        return {name: unit.replace("**2", "²").replace("*", "·") for name, unit in written}

    @property
    def natural_frequency(self) -> Number:
        """Natural frequency of the body on its spring, ω = √(k0/m_C), in rad/s."""
        return (self.stiffness / self.body_mass) ** 0.5

    def scene(self, *, drive: str = "motor", crank: str = "cosine") -> Scene:
        """The dimensionless scene.

        **Arguments:** `drive` is `"motor"` or `"ideal"` (which turns at ζ = κ); `crank` is
        `"cosine"` (first approximation) or `"slider"` (exact kinematics).
        """
        one_of("drive", drive, ("motor", "ideal"))
        one_of("crank", crank, ("cosine", "slider"))
        require_ranges(self)  # again: a number may have been put in place of another
        omega = self.natural_frequency
        if drive == "ideal":
            turning: IdealDrive | Motor = IdealDrive(self.control)
        else:
            per_inertia = self.crank_radius**2 / self.inertia
            free = 1.0 if self.no_load_speed is None else self.no_load_speed / omega
            time = self.electrical_time
            lag = {} if time is None else {"electrical_time": time * omega}
            turning = (DCMotor if lag else Motor)(
                strength=self.torque / (self.inertia * omega**2),
                control=self.control,
                coupling=self.body_mass * per_inertia,
                slider_inertia=self.slider_mass * per_inertia,
                no_load_speed=free,
                **lag,
            )
        damping = self.damping / (2 * self.body_mass * omega)
        if any(isinstance(x, Tracer) for x in jtu.tree_leaves(self)):
            # Of numbers that are out of range some give a scene of numbers that are not.
            damping = jnp.where(in_range(self), damping, jnp.nan)
        exact = SliderCrank(self.crank_radius / self.rod_length) if crank == "slider" else None
        return Scene(
            oscillator=Oscillator(damping),
            drive=turning,
            stops=(RigidStop(_ratio(self.gap, self.crank_radius), self.restitution),),
            crank=exact or CosineCrank(),
        )

    def metres(self, Y: Any) -> Any:
        """A dimensionless position Y in m."""
        return self.crank_radius * Y

    def metres_per_second(self, V: Any) -> Any:
        """A dimensionless velocity V = dY/dτ in m/s."""
        return self.crank_radius * self.natural_frequency * V

    def radians_per_second(self, W: Any) -> Any:
        """A dimensionless crank speed W (or a frequency ratio ζ) in rad/s."""
        return self.natural_frequency * W

    def seconds(self, tau: Any) -> Any:
        """A dimensionless time τ in s."""
        return tau / self.natural_frequency


def _ratio(a: Any, b: Any) -> Any:
    """a / b; of known numbers a known one, inside of `jit` too."""
    over, under = concrete(a), concrete(b)
    return a / b if over is None or under is None else over / under
