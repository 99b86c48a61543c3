"""A ball in a vibrating box: impact pair, impact damper, vibro-impact harvester."""

from collections.abc import Mapping
from math import pi, sin
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, SHARE
from .._types import Scalar, State
from ..machine import Mechanical, RigidStop
from ._base import ReadyMachine, number_field, stops_at


class ImpactPair(ReadyMachine, Mechanical):
    """A ball between the walls of a box.

    The box moves as a sin ωt. If `mass_ratio` is given, it is a body on a spring and a damper,
    driven by a force: X'' + 2 ξ Ω X' + Ω² X = F sin s between impacts. An impact reverses the
    relative speed, scales it by e, and conserves momentum. The independent variable is s = ωt, a
    cycle 2π. The coordinates are `place`, the position of the ball from the middle of the box,
    and `box`, the position of a free box.

    Let the motion of the box be prescribed and σ = (1 - e)/(1 + e). The symmetric motion with one
    impact at each wall in a cycle has the flight speed w of (π w/2 - λ)² + σ² w² = 1 and the speed
    of approach 2w/(1 + e). Its fold is at λ = √(1 + π²/(4σ²)), and it loses its symmetry at
    λ = (π/2 - 2/π)/√(4/π² + σ²) (Heiman, Bajaj and Sherman, Journal of Sound and Vibration 124,
    1988).

    **Arguments:**

    - `half_gap` λ: half of the box's length minus the ball's (unit: a), positive.
    - `restitution` e in [0, 1].
    - `mass_ratio`: the ball's mass over the box's, positive; without it the box's motion is given.
    - `damping_ratio` ξ, `frequency` Ω (of the box on its spring, unit: ω; 0 leaves out the spring)
      and `amplitude` F of the force (unit: M a ω²), of a free box.
    """

    half_gap: Any = number_field("half_gap", 1.6, POSITIVE, "a")
    restitution: Any = number_field("restitution", 0.5, SHARE)
    mass_ratio: Any = number_field("mass_ratio", None, POSITIVE)
    damping_ratio: Any = number_field("damping_ratio", 0.05, NOT_NEGATIVE)
    frequency: Any = number_field("frequency", 1.0, NOT_NEGATIVE, "ω")
    amplitude: Any = number_field("amplitude", 0.5, REAL, "M a ω²")
    cycle: ClassVar = 2 * pi
    labels: ClassVar = ("place in the box (a)", "speed in the box (a ω)")  # pyright: ignore

    @property
    def q(self) -> tuple[str, ...]:  # pyright: ignore
        return ("place",) if self.mass_ratio is None else ("place", "box")

    @property
    def mass(self) -> Any:  # pyright: ignore
        ball = self.mass_ratio
        return (1.0,) if ball is None else [[ball, ball], [ball, 1 + ball]]

    def force(self, t: Scalar, q: Any, v: Any) -> dict[str, Any]:
        if self.mass_ratio is None:
            return {"place": jnp.sin(t)}
        pull = -self.frequency * (self.frequency * q.box + 2 * self.damping_ratio * v.box)
        return {"place": 0.0, "box": pull + self.amplitude * jnp.sin(t)}

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        return stops_at(self.half_gap, self.restitution, on="place")

    @property
    def quantity_units(self) -> Mapping[str, str]:  # pyright: ignore
        """The units, with the mass of the ball as unit of mass, or that of a free box."""
        mass = "m" if self.mass_ratio is None else "M"
        units = {"place": "a", "box": "a", "v.place": "a ω", "v.box": "a ω", "rate": "ω"}
        return {**units, "time": "1/ω", "energy": f"{mass} a² ω²", "power": f"{mass} a² ω³"}

    def start(self) -> Any:
        """Return a state with the ball in flight from the middle, and a free box at rest."""
        return self.at(v={"place": 0.5})

    def mirrored(self, state: State) -> State:
        return jax.tree.map(jnp.negative, state)

    def sketch(self, pen: Any, state: Any, phase: float) -> None:
        free = self.mass_ratio is not None
        box = float(state.box) if free else sin(phase)
        radius, wall, half = 0.4 * pen.size, 0.25 * pen.size, float(self.half_gap)
        edge, top = half + radius + wall, 1.6 * radius
        for face in (box - edge + wall / 2, box + edge - wall / 2):
            pen.body(face, width=wall, height=2 * top, color=pen.green)
        pen.body(box, -top - wall / 2, width=2 * edge, height=wall, color=pen.green)
        pen.ball(box + float(state.place), radius - top, radius)
        pen.floor(-2.2 * half - 2.0, 2.2 * half + 2.0, -top - wall)
        if free:
            post = -edge - pen.reach - 1.6
            pen.spring((post, 0.0), (box - edge, 0.0))
            pen.wall(post, -1, low=-top, high=top, color="0.5")
            pen.arrow((box + edge, 0.0), (box + edge + 0.6 * pen.size, 0.0))
            pen.label(box + edge, 0.45 * pen.size, "$F\\,\\sin\\,\\omega t$", ha="left")
        else:
            words, right = "$a\\,\\sin\\,\\omega t$", box + edge + 0.2 * pen.size
            pen.label(right, 0.0, words, ha="left", color=pen.green)
        pen.label(box, top + 0.2 * pen.size, "$e$")
