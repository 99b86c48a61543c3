"""A capsule that moves along the ground by internal impacts: dry friction, sticking, drift."""

from math import pi
from typing import Any, ClassVar

import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, SHARE, Range
from .._types import Scalar, State
from ..machine import DryFriction, Mechanical, RigidStop
from ._base import ForcedMachine, number_field


class Capsule(ForcedMachine, Mechanical):
    """A mass m on a spring k in a capsule of mass M, driven against a rigid stop of the capsule.
    The capsule slides on the ground with friction, and its impacts move it forward.

    With lengths in F/k and times in √(m/k), where F is the unit of force (that of friction with
    `friction=1`; Liu and Páez Chávez, Nonlinear Dynamics 88, 2017, where the stop is elastic):

        x1'' = α cos ωt - p - 2 ξ p',   γ x2'' = p + 2 ξ p' - friction,   p = x1 - x2 ≤ δ

    for the mass x1 and the capsule x2. At p = δ the relative speed is reversed and scaled by e, and
    the momentum of both is conserved. The independent variable is ωt, a cycle 2π. The coordinates
    are `place` p, from where the spring is relaxed, and `travel`, the distance that the capsule has
    moved since the cycle began. Its mean speed over a cycle is the average `progress`.

    **Arguments:** `amplitude` α of the force on the mass, any number; `frequency` ω, positive;
    `damping_ratio` ξ, not negative; `mass_ratio` γ = M/m, positive; `gap` δ, any number;
    `restitution` e in [0, 1]; `friction` of the sliding capsule, not negative; `static_ratio`, the
    ratio of static to sliding friction, at least 1.
    """

    amplitude: Any = number_field("amplitude", 1.6, REAL, "F")
    frequency: Any = number_field("frequency", 1.0, POSITIVE, "√(k/m)")
    damping_ratio: Any = number_field("damping_ratio", 0.05, NOT_NEGATIVE)
    mass_ratio: Any = number_field("mass_ratio", 5.0, POSITIVE)
    gap: Any = number_field("gap", 0.5, REAL, "F/k")
    restitution: Any = number_field("restitution", 0.6, SHARE)
    friction: Any = number_field("friction", 1.0, NOT_NEGATIVE, "F")
    static_ratio: Any = number_field("static_ratio", 1.0, Range(1.0))
    q: ClassVar = ("place", "travel")
    quantity_units: ClassVar = {
        **dict.fromkeys(("place", "travel"), "F/k"),
        **dict.fromkeys(("v.place", "v.travel", "progress"), "F/√(k m)"),
        "rate": "√(k/m)", "time": "√(m/k)", "energy": "F²/k", "power": "F²/√(k m)",
    }  # fmt: skip
    labels: ClassVar = ("place in the capsule (F/k)", "its speed (F/√(k m))")  # pyright: ignore

    @property
    def mass(self) -> list[list[Any]]:  # pyright: ignore
        """The mass matrix for the mass relative to the capsule, and for the capsule (unit: m)."""
        return [[1.0, 1.0], [1.0, 1 + self.mass_ratio]]

    def force(self, t: Scalar, q: Any, v: Any) -> dict[str, Any]:
        """Return the forces of the drive, and of spring and dashpot between mass and capsule."""
        drive = self.amplitude * jnp.cos(t)
        return {"place": drive - q.place - 2 * self.damping_ratio * v.place, "travel": drive}

    @property
    def contacts(self) -> tuple[RigidStop, DryFriction]:
        return (
            RigidStop(self.gap, self.restitution, on="place"),
            DryFriction(self.friction, static_ratio=self.static_ratio, on="travel"),
        )

    def step_limit(self, s: Scalar, state: State) -> Scalar:
        """Return a fifth of the drive's cycle, or of the period of mass and capsule if shorter."""
        stiffness = jnp.sqrt(1 + 1 / self.mass_ratio)
        return 0.4 * pi * jnp.minimum(1.0, self.frequency / stiffness)

    def averages(self, s: Scalar, state: State, *modes: Scalar) -> dict[str, Scalar]:
        return {"progress": state.v.travel}

    def renewed(self, state: State) -> State:
        return state.replace(travel=jnp.zeros_like(state.travel))
