"""A ball in a vibrating box: impact pair, impact damper, vibro-impact harvester."""

from collections.abc import Mapping
from math import sin
from typing import Any, ClassVar

import jax.numpy as jnp

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, SHARE, number
from .._types import Number, Scalar, State
from ..machine import Mechanical, RigidStop, Shown
from ._base import PhaseMachine, number_field, stops_at


class PairState(Shown):
    """The state of the ball in its box."""

    units: ClassVar = {"place": "a", "speed": "a ω"}

    place: Scalar
    """Position of the ball, from the middle of the box (unit: a)."""
    speed: Scalar
    """Speed of the ball relative to the box (unit: a ω)."""


class FreePairState(PairState):
    """The states of the ball in its box, and of the box."""

    units: ClassVar = {**PairState.units, "box": "a", "box_speed": "a ω"}

    box: Scalar
    """Position of the box (unit: a)."""
    box_speed: Scalar
    """Speed of the box (unit: a ω)."""


class ImpactPair(PhaseMachine, Mechanical):
    """A ball between the walls of a box.

    The box moves as a sin ωt. If `mass_ratio` is given, it is a body on a spring and a damper,
    driven by a force: X'' + 2 ξ Ω X' + Ω² X = F sin s between impacts. An impact reverses the
    relative speed, scales it by e, and conserves momentum. The independent variable is s = ωt, a
    cycle 2π.

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
      and `force` F (unit: M a ω²), of a free box.
    """

    half_gap: Any = number_field("half_gap", 1.6, POSITIVE, "a")
    restitution: Any = number_field("restitution", 0.5, SHARE)
    mass_ratio: Any = number_field("mass_ratio", None, POSITIVE)
    damping_ratio: Any = number_field("damping_ratio", 0.05, NOT_NEGATIVE)
    frequency: Any = number_field("frequency", 1.0, NOT_NEGATIVE, "ω")
    force: Any = number_field("force", 0.5, REAL, "M a ω²")  # pyright: ignore
    _velocity_names: ClassVar = {"place": "speed", "box": "box_speed"}
    labels: ClassVar = ("place in the box (a)", "speed in the box (a ω)")  # pyright: ignore

    @property
    def q(self) -> tuple[str, ...]:  # pyright: ignore
        """The coordinates: the ball relative to the box, and the box if it is free."""
        return ("place",) if self.mass_ratio is None else ("place", "box")

    @property
    def mass(self) -> Any:  # pyright: ignore
        """The mass of the ball, or the mass matrix of the ball and a free box."""
        ball = self.mass_ratio
        return (1.0,) if ball is None else [[ball, ball], [ball, 1 + ball]]

    def _applied(self, t: Scalar, q: Any, v: Any, *modes: Scalar) -> dict[str, Any]:
        """Return the forces on the ball relative to a prescribed box, or on ball and box."""
        if self.mass_ratio is None:
            return {"place": jnp.sin(t)}
        pull = -self.frequency * (self.frequency * q.box + 2 * self.damping_ratio * v.box)
        return {"place": 0.0, "box": pull + self.force * jnp.sin(t)}

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        """Both walls, the right one first."""
        return stops_at(self.half_gap, self.restitution, on="place")

    @property
    def quantity_units(self) -> Mapping[str, str]:  # pyright: ignore
        """The units, with the mass of the ball as unit of mass, or that of a free box."""
        mass = "m" if self.mass_ratio is None else "M"
        rates = {"rate": "ω", "time": "1/ω", "energy": f"{mass} a² ω²", "power": f"{mass} a² ω³"}
        return {**FreePairState.units, **rates}

    def start(
        self,
        *,
        place: Number = 0.0,
        speed: Number = 0.5,
        box: Number = 0.0,
        box_speed: Number = 0.0,
    ) -> Any:
        """Return a state, by default with the ball in the middle and a free box at rest."""
        ball = number("place", place), number("speed", speed)
        if self.mass_ratio is None:
            return PairState(*ball)
        return FreePairState(*ball, number("box", box), number("box_speed", box_speed))

    def mirrored(self, state: State) -> Any:
        """Return the state with left and right exchanged, half a cycle later."""
        return type(state)(*(-x for x in vars(state).values()))

    def sketch(self, pen: Any, state: Any, phase: float) -> None:
        """Draw a box with a ball in it."""
        free = self.mass_ratio is not None
        box = float(state.box) if free else sin(phase)
        radius, wall, half = 0.4 * pen.size, 0.25 * pen.size, float(self.half_gap)
        edge, top = half + radius + wall, 1.6 * radius
        for side in (-1, 1):
            face = box + side * (edge - wall / 2)
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
