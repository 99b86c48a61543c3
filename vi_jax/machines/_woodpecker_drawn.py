"""How the woodpecker toy is drawn: with the lengths of the machine, and a bird around them."""

from typing import Any

import numpy as np

from .._types import Machine, State

WOOD, SLEEVE, BIRD, BEAK = "#c9a36b", "#6f6f6f", "#4c5b66", "#e0b83f"


def draw_woodpecker(machine: Machine, pen: Any, state: State) -> None:
    """The pole, upright at x = 0, with the toy at its height; by a `vi_jax.plot.Pen`."""
    m: Any = machine
    inside, half = float(m.sleeve_radius), float(m.sleeve_height)
    pole, arm = float(m.pole_radius), float(m.bird_arm)
    beak = float(m.bird_arm - m.beak_arm), float(m.beak_height)
    middle, tilt = np.array([0.0, float(state.height)]), float(state.sleeve_angle)
    hang = middle + _turned((float(m.sleeve_arm), 0.0), tilt)

    def filled(about: Any, points: Any, angle: float, color: str) -> None:
        shape = about + _turned(points, angle)
        pen.ax.fill(*shape.T, facecolor=color, edgecolor="0.15", lw=1.2, joinstyle="round")

    # The pole is as long as the motion, with rings a centimetre apart that show the way down.
    low, high = -pen.reach - beak[1] - arm, beak[1] + arm + half
    filled(0.0, [(-pole, low), (pole, low), (pole, high), (-pole, high)], 0.0, WOOD)
    for ring in np.arange(np.ceil(low / 0.01), high / 0.01) * 0.01:
        pen.line((-pole, ring), (pole, ring), lw=0.7, color="#7a5c2e")
    for side in (-1, 1):  # the two walls of the sleeve, cut open
        x = side * inside * np.array([1.0, 1.0, 1.28, 1.28])
        filled(middle, np.stack([x, half * np.array([-1, 1, 1, -1])], -1), tilt, SLEEVE)
    pen.spring(tuple(middle + _turned((1.28 * inside, 0.0), tilt)), tuple(hang))
    # The tip of its beak and its centre of mass are the machine's.
    lean, centre = float(state.bird_angle), np.array([arm, 0.0])
    head = np.array([0.5 * (beak[0] + arm), beak[1]])
    long = float(np.hypot(*(head - centre)))
    along = float(np.arctan2(*(head - centre)[::-1]))
    thick = np.array([0.0, 0.1 * long])
    filled(hang, [beak, head + thick, head - thick], lean, BEAK)
    filled(hang, centre + _turned(_oval(0.8 * long, 0.33 * long), along), lean, BIRD)
    filled(hang, head + _oval(0.23 * long, 0.23 * long), lean, BIRD)
    pen.line(tuple(hang), tuple(hang + _turned(centre, lean)), lw=3.0)
    left, up, right = -2.6 * inside, float(middle[1]), float(hang[0]) + 1.6 * arm
    pen.label(left, up, "sleeve, $\\varphi_M$", ha="right")
    pen.label(left, up + 1.2 * beak[1], "pole, $\\mu$", ha="right")
    pen.label(right, float(hang[1]), "bird, $\\varphi_S$", ha="left")
    pen.label(1.3 * inside, up - 1.7 * arm, "spring, $c$", ha="left")


def _turned(points: Any, angle: float) -> np.ndarray:
    """Points turned counterclockwise about the origin."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(points, float) @ np.array([[cosine, sine], [-sine, cosine]])


def _oval(long: float, wide: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 60)
    return np.stack([long * np.cos(turn), wide * np.sin(turn)], -1)
