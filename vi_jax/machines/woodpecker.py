"""The woodpecker toy: a bird on a spring that pecks its way down a pole, jamming and slipping."""

from functools import partial
from math import pi
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from .._checks import NOT_NEGATIVE, POSITIVE, REAL, SHARE, concrete
from .._types import Scalar, State
from ..machine import Mechanical, RigidStop, counter_of, rising, solved
from ._base import ReadyMachine, number_field

WOOD, SLEEVE, BIRD, BEAK = "#c9a36b", "#6f6f6f", "#4c5b66", "#e0b83f"


class Woodpecker(ReadyMachine, Mechanical):
    """A sleeve with some play on a pole, and a bird on a spring at it that pecks the pole.

    The sleeve tilts until its edge jams on the pole by friction. The bird swings on and lifts the
    edge off. The sleeve slides down and jams the other way; the beak hits the pole, and the bird
    swings back. The coordinates are the height y of the sleeve above that where the cycle began,
    `height`, and small angles φM of the sleeve and φS of the bird, `sleeve_angle` and `bird_angle`,
    counterclockwise with the bird on the right of the pole:

        T = ½ m_M y'² + ½ J_M φM'² + ½ J_S φS'² + ½ m_S (y' + l_M φM' + l_G φS')²
        U = ½ c (φM - φS)² + m_M g y + m_S g (y + l_M φM + l_G φS)

    Three contacts have Newton's restitution, and Coulomb friction μ in impacts and between them.
    The lower and the upper edge of the sleeve have r_M - r_O ± h_M φM ≥ 0 and slip with y' + r_M
    φM'. The beak has l_M + l_G - l_S - r_O - h_S φS ≥ 0 and slips with y' + l_M φM' + (l_G - l_S)
    φS' (Ch. Glocker, Dynamik von Starrkörpersystemen mit Reibung und Stößen, 1995; F. Pfeiffer and
    Ch. Glocker, Multibody Dynamics with Unilateral Contacts, 1996). Numbers are as in the example
    of the Siconos software. A slipping contact may stick after an impact by the cone of friction.

    Only its weight drives it. A cycle ends when φS falls through `section_angle`, after a varying
    time. Its mean speed of descent is the average `descent`. Time is the independent variable, and
    units are SI units. The stops are, in this order, the beak, the upper and the lower edge of the
    sleeve; the switches are the friction on each.

    **Arguments:**

    - `friction` μ, not negative; `sleeve_restitution`, `beak_restitution` in [0, 1].
    - `sleeve_mass` m_M, `bird_mass` m_S (kg), `sleeve_inertia` J_M, `bird_inertia` J_S (kg m²),
      `stiffness` c of the spring (N m/rad), `gravity` g (m/s²), all positive.
    - `sleeve_arm` l_M, from the pole's axis to the spring; `bird_arm` l_G, from there to the bird's
      centre of mass; `beak_arm` l_S, from there back to the tip of its beak, which is `beak_height`
      h_S above; `sleeve_height` h_M, half of the sleeve's; `sleeve_radius` r_M inside, greater than
      `pole_radius` r_O (all in m, positive).
    - `section_angle` (rad), any angle that the bird swings through.
    """

    friction: Any = number_field("friction", 0.3, NOT_NEGATIVE)
    sleeve_restitution: Any = number_field("sleeve_restitution", 0.0, SHARE)
    beak_restitution: Any = number_field("beak_restitution", 0.5, SHARE)
    sleeve_mass: Any = number_field("sleeve_mass", 3e-4, POSITIVE, "kg")
    bird_mass: Any = number_field("bird_mass", 4.5e-3, POSITIVE, "kg")
    sleeve_inertia: Any = number_field("sleeve_inertia", 5e-9, POSITIVE, "kg m²")
    bird_inertia: Any = number_field("bird_inertia", 7e-7, POSITIVE, "kg m²")
    stiffness: Any = number_field("stiffness", 0.0056, POSITIVE, "N m/rad")
    gravity: Any = number_field("gravity", 9.81, POSITIVE, "m/s²")
    sleeve_arm: Any = number_field("sleeve_arm", 0.010, POSITIVE, "m")
    bird_arm: Any = number_field("bird_arm", 0.015, POSITIVE, "m")
    beak_arm: Any = number_field("beak_arm", 0.0201, POSITIVE, "m")
    sleeve_height: Any = number_field("sleeve_height", 0.0058, POSITIVE, "m")
    beak_height: Any = number_field("beak_height", 0.02, POSITIVE, "m")
    sleeve_radius: Any = number_field("sleeve_radius", 0.0031, POSITIVE, "m")
    pole_radius: Any = number_field("pole_radius", 0.0025, POSITIVE, "m")
    section_angle: Any = number_field("section_angle", -0.2788, REAL, "rad")
    q: ClassVar = ("height", "sleeve_angle", "bird_angle")
    quantity_units: ClassVar = {
        **dict.fromkeys(("height", "play", "reach", "gap"), "m"), "phase": "s",
        **dict.fromkeys(("v.height", "descent"), "m/s"), "sleeve_angle": "rad", "bird_angle": "rad",
        "v.sleeve_angle": "rad/s", "v.bird_angle": "rad/s", "rate": "1/s", "time": "s",
        "energy": "J", "power": "W",
    }  # fmt: skip
    labels: ClassVar = ("beak towards the pole (m)", "its speed (m/s)")  # pyright: ignore
    ranges: ClassVar = {"play": POSITIVE}

    def __check_init__(self):
        play = concrete(self.play)
        if play is not None and not (play > 0).all():
            raise ValueError(
                "Argument `sleeve_radius` must be greater than `pole_radius`, but the play between "
                f"them is {play.min():g} m."
            )
        super().__check_init__()

    @property
    def play(self) -> Scalar:
        """The distance r_M - r_O of the upright sleeve from the pole (m)."""
        return self.sleeve_radius - self.pole_radius

    @property
    def reach(self) -> Scalar:
        """The distance l_M + l_G - l_S - r_O of an upright bird's beak from the pole (m)."""
        return self.sleeve_arm + self.bird_arm - self.beak_arm - self.pole_radius

    @property
    def contacts(self) -> tuple[RigidStop, ...]:
        """The pole at the beak and at both edges of the sleeve. Gaps and slips are in metres."""
        arm = self.bird_arm - self.beak_arm
        beak = lambda q: self.beak_height * q.bird_angle
        edge = lambda q: self.sleeve_height * q.sleeve_angle
        slip_of_beak = lambda q: q.height + self.sleeve_arm * q.sleeve_angle + arm * q.bird_angle
        slip_of_edge = lambda q: q.height + self.sleeve_radius * q.sleeve_angle
        pole = partial(RigidStop, friction=self.friction)
        at_edge = partial(pole, self.play, self.sleeve_restitution, on=edge, along=slip_of_edge)
        return (
            pole(self.reach, self.beak_restitution, on=beak, along=slip_of_beak, name="beak"),
            at_edge(side="right", name="upper edge"),
            at_edge(side="left", name="lower edge"),
        )

    @property
    def mass(self) -> list[list[Any]]:  # pyright: ignore
        own = self.sleeve_mass, self.sleeve_inertia, self.bird_inertia
        arms = list(enumerate((1.0, self.sleeve_arm, self.bird_arm)))
        return [[self.bird_mass * a * b + (i == j) * own[i] for j, b in arms] for i, a in arms]

    def force(self, t: Scalar, q: Any, v: Any) -> dict[str, Any]:
        moment = self.stiffness * (q.sleeve_angle - q.bird_angle)
        weight = self.bird_mass * self.gravity
        return {
            "height": -self.sleeve_mass * self.gravity - weight,
            "sleeve_angle": -moment - weight * self.sleeve_arm,
            "bird_angle": moment - weight * self.bird_arm,
        }

    def _usual(self) -> Scalar:
        """Return 2π √((J_S + m_S l_G²)/c), the bird's period on its spring with a jammed sleeve."""
        inertia = self.bird_inertia + self.bird_mass * self.bird_arm**2
        return 2 * pi * jnp.sqrt(inertia / self.stiffness)

    def step_limit(self, s: Scalar, state: State) -> Scalar:
        """Return a fifth of the period of relative oscillations of sleeve and bird in free fall."""
        _, sleeve, bird = solved(self.mass, (0.0, -1.0, 1.0))
        return 0.4 * pi / jnp.sqrt(self.stiffness * (bird - sleeve))

    cycle: ClassVar = rising(lambda m, z: m.section_angle - z.bird_angle, usual=_usual)

    def averages(self, s: Scalar, state: State, *modes: Scalar) -> dict[str, Scalar]:
        return {"descent": -state.v.height}

    def renewed(self, state: State) -> State:
        """Return the state with height zero; unchanged if it is observed at equal intervals."""
        is_observed = counter_of(self) is None
        return state if is_observed else state.replace(height=jnp.zeros_like(state.height))

    def start(self) -> Any:
        """Return a state near the cycle of the default numbers: on the section, the sleeve on its
        lower edge and sliding down, the bird swinging away."""
        jammed = -self.play / self.sleeve_height
        speeds = {"height": -0.34, "bird_angle": -7.5}
        return self.at(sleeve_angle=jammed, bird_angle=self.section_angle, v=speeds)

    def sketch(self, pen: Any, state: State, phase: float) -> None:
        inside, half = float(self.sleeve_radius), float(self.sleeve_height)
        pole, arm = float(self.pole_radius), float(self.bird_arm)
        beak = float(self.bird_arm - self.beak_arm), float(self.beak_height)
        middle, tilt = np.array([0.0, float(state.height)]), float(state.sleeve_angle)
        joint = middle + _rotated((float(self.sleeve_arm), 0.0), tilt)

        def filled(about: Any, points: Any, angle: float, color: str) -> None:
            shape = about + _rotated(points, angle)
            pen.ax.fill(*shape.T, facecolor=color, edgecolor="0.15", lw=1.2, joinstyle="round")

        # The pole is as long as the motion. Rings a centimetre apart show the descent.
        low, high = -pen.reach - beak[1] - arm, beak[1] + arm + half
        filled(0.0, [(-pole, low), (pole, low), (pole, high), (-pole, high)], 0.0, WOOD)
        for ring in np.arange(np.ceil(low / 0.01), high / 0.01) * 0.01:
            pen.line((-pole, ring), (pole, ring), lw=0.7, color="#7a5c2e")
        for side in (-1, 1):  # the two walls of the sleeve, cut open
            x = side * inside * np.array([1.0, 1.0, 1.28, 1.28])
            filled(middle, np.stack([x, half * np.array([-1, 1, 1, -1])], -1), tilt, SLEEVE)
        pen.spring(tuple(middle + _rotated((1.28 * inside, 0.0), tilt)), tuple(joint))
        # The tip of its beak and its centre of mass are the machine's.
        bird_tilt, centre = float(state.bird_angle), np.array([arm, 0.0])
        head = np.array([0.5 * (beak[0] + arm), beak[1]])
        long = float(np.hypot(*(head - centre)))
        along = float(np.arctan2(*(head - centre)[::-1]))
        thick = np.array([0.0, 0.1 * long])
        filled(joint, [beak, head + thick, head - thick], bird_tilt, BEAK)
        filled(joint, centre + _rotated(_oval(0.8 * long, 0.33 * long), along), bird_tilt, BIRD)
        filled(joint, head + _oval(0.23 * long, 0.23 * long), bird_tilt, BIRD)
        pen.line(tuple(joint), tuple(joint + _rotated(centre, bird_tilt)), lw=3.0)
        left, up, right = -2.6 * inside, float(middle[1]), float(joint[0]) + 1.6 * arm
        pen.label(left, up, "sleeve, $\\varphi_M$", ha="right")
        pen.label(left, up + 1.2 * beak[1], "pole, $\\mu$", ha="right")
        pen.label(right, float(joint[1]), "bird, $\\varphi_S$", ha="left")
        pen.label(1.3 * inside, up - 1.7 * arm, "spring, $c$", ha="left")


def _rotated(points: Any, angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(points, float) @ np.array([[cosine, sine], [-sine, cosine]])


def _oval(long: float, wide: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 60)
    return np.stack([long * np.cos(turn), wide * np.sin(turn)], -1)
