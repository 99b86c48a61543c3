"""A motor whose armature current takes time to build up."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import POSITIVE, real
from .motor import Motor
from .states import DCMotorState, TimedDCMotorState


class DCMotor(Motor):
    """A DC motor with the inductance of its armature, at a constant voltage.

    With the armature's L i' + R i + K_e φ' = u and the torque K_t i (primes: d/dt), and the torque
    M = K_t i/(J ω²) as one more component of the state, it has

        τe dM/dτ = τ0 (κ - W/w0) - M

    and `Motor`'s equation of the shaft with M in the line's place, where

        τe = ω L/R,  κ τ0 = K_t u/(R J ω²),  κ w0 = u/(K_e ω).

    Its steady torque is `Motor`'s line, which it approaches at first order in τe as τe → 0. In
    units of J ω² (and J ω³) the source gives the power κ w0 M, the armature turns the power
    M² w0/τ0 into heat and holds the energy τe M² w0/(2 τ0), and the shaft gets the power M W.

    Explicit methods are kept to steps of about τe, so that a motor of small τe costs more the
    smaller it is: below 0.05 use `Motor`, unless the current itself is asked for.
    """

    electrical_time: Float[Array, "..."] = eqx.field(
        kw_only=True, converter=real("electrical_time")
    )
    """τe = ω L/R, the electrical time constant (dimensionless), positive."""
    ranges: ClassVar = {**Motor.ranges, "electrical_time": POSITIVE}
    state: ClassVar = DCMotorState
    timed_state: ClassVar = TimedDCMotorState

    def torque(self, state, pace, paced):
        """The torque M of the state, and how fast it builds up."""
        return paced(state.M), (paced(self.build_up(state.W, state.M)),)

    def usual(self, name, known):
        """A torque that a start leaves out is the steady one at its speed."""
        return self.line(known["W"]) if name == "M" else super().usual(name, known)

    def build_up(self, W: Float[Array, "..."], M: Float[Array, "..."]) -> Float[Array, "..."]:
        """dM/dτ at this speed and torque."""
        return (self.line(W) - M) / self.electrical_time

    def rate(self) -> Float[Array, "..."]:
        """The fastest rate of shaft and armature together, by τ.

        1/τe of the current, or where that is slow √(τ0/(w0 τe)), at which speed and current swing.
        """
        own = 1 / self.electrical_time
        return jnp.maximum(own, jnp.sqrt(own * self.strength / self.no_load_speed))
