"""How the woodpecker toy is drawn: with the lengths of the machine, and a bird around them."""

from typing import Any

import numpy as np

from .._types import Machine, State

WOOD, SLEEVE, BIRD, CREST = "#c9a36b", "#6f6f6f", "#4c5b66", "#d55e00"
INK = "0.15"


def draw_woodpecker(machine: Machine, pen: object, state: State) -> None:
    """The pole, upright at x = 0, with the toy at its height; by a `vi_jax.plot.Pen`."""
    size = {
        name: float(getattr(machine, name))
        for name in ("sleeve_arm", "bird_arm", "beak_arm", "beak_height", "sleeve_height",
                     "sleeve_radius", "pole_radius")
    }  # fmt: skip
    middle = np.array([0.0, float(state.height)])
    tilt, lean = float(state.sleeve_angle), float(state.bird_angle)
    _pole(pen, size)
    hang = middle + _turned([(size["sleeve_arm"], 0.0)], tilt)[0]
    _sleeve(pen, size, middle, tilt, hang)
    _bird(pen, size, hang, lean)
    _names(pen, size, middle, hang)


def _turned(points: object, angle: float) -> np.ndarray:
    """Points turned counterclockwise about the origin."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.asarray(points, float) @ np.array([[cosine, sine], [-sine, cosine]])


def _filled(pen: Any, points: np.ndarray, color: str, alpha: float = 1.0, **look: Any) -> None:
    """Fill a polygon.

    **Arguments:** `points`, (corners, 2); `look`, further options of matplotlib's `fill`.
    """
    look = {"lw": 1.2, "edgecolor": INK, "joinstyle": "round", **look}
    pen.ax.fill(*points.T, facecolor=color, alpha=alpha, **look)


def _oval(middle: object, long: float, wide: float, angle: float) -> np.ndarray:
    turn = np.linspace(0, 2 * np.pi, 60)
    return middle + _turned(np.stack([long * np.cos(turn), wide * np.sin(turn)], -1), angle)


def _pole(pen: Any, size: dict[str, float]) -> None:
    """As long as the motion, with rings a centimetre apart by which its way down is seen."""
    half, above = size["pole_radius"], size["beak_height"] + size["bird_arm"]
    low, high = -pen.reach - above, above + size["sleeve_height"]
    corners = np.array([(-half, low), (half, low), (half, high), (-half, high)])
    _filled(pen, corners, WOOD, 0.75, lw=0.0)
    for side in (-half, half):
        pen.line((side, low), (side, high), lw=1.0, color="#7a5c2e")
    for ring in np.arange(np.ceil(low / 0.01), high / 0.01) * 0.01:
        pen.line((-half, ring), (half, ring), lw=0.7, color="#7a5c2e")


def _sleeve(pen: Any, size: dict[str, float], middle: Any, tilt: float, hang: Any) -> None:
    """A tube cut open: its two walls about the pole, and the spring that starts at it.

    **Arguments:** `size`, lengths by name; `middle` and `hang`, (x, y) of its middle and of the
    spring's other end; `tilt` in radians.
    """
    inside, half = size["sleeve_radius"], size["sleeve_height"]
    wall = 0.28 * inside
    for side in (-1, 1):
        across = side * np.array([inside, inside, inside + wall, inside + wall])
        up = half * np.array([-1, 1, 1, -1])
        _filled(pen, middle + _turned(np.stack([across, up], -1), tilt), SLEEVE)
    root = middle + _turned([(inside + wall, 0.0)], tilt)[0]
    way = hang - root
    along = np.linspace(0, 1, 14)
    aside = np.array([0.0, *np.tile([1.0, -1.0], 6), 0.0]) * 0.22 * half
    normal = np.array([-way[1], way[0]]) / max(float(np.hypot(*way)), 1e-12)
    coil = root + along[:, None] * way + aside[:, None] * normal
    pen.line(*((float(x), float(y)) for x, y in coil), lw=1.3, zorder=3)


def _bird(pen: Any, size: dict[str, float], hang: Any, lean: float) -> None:
    """The tip of its beak and its centre of mass are the machine's; feathers are free."""
    tip = np.array([size["bird_arm"] - size["beak_arm"], size["beak_height"]])
    centre = np.array([size["bird_arm"], 0.0])
    head = tip + np.array([0.5 * (centre[0] - tip[0]), 0.0])
    long = float(np.hypot(*(head - centre)))
    angle = float(np.arctan2(*(head - centre)[::-1]))
    round_ = 0.23 * long

    def put(points: object, color: str, alpha: float = 1.0, **look: Any) -> None:
        _filled(pen, hang + _turned(points, lean), color, alpha, **look)

    axis, aside = (head - centre) / long, _turned([(head - centre) / long], np.pi / 2)[0]
    tail = centre - 1.15 * long * axis
    put([tail - 0.1 * long * aside, tail + 0.06 * long * aside, centre + 0.2 * long * aside,
         centre - 0.25 * long * aside], BIRD)  # fmt: skip
    put(_oval(centre + 0.2 * long * axis, 0.8 * long, 0.33 * long, angle), BIRD)
    put(_oval(centre - 0.02 * long * axis - 0.1 * long * aside, 0.48 * long, 0.17 * long, angle),
        "#8fa3b0", lw=0.8)  # fmt: skip
    put([tip, *(head + round_ * np.array([(-0.5, 0.45), (-0.5, -0.45)]))], "#e0b83f")
    put(_oval(head, round_, round_, 0.0), BIRD)
    crest = np.linspace(0.25, 1.0, 20) * np.pi
    put(head + round_ * np.stack([np.cos(crest - 0.35), np.sin(crest - 0.35)], -1), CREST)
    eye = head + round_ * np.array([-0.35, 0.15])
    put(_oval(eye, 0.14 * round_, 0.14 * round_, 0.0), "white", lw=0.8)
    # What holds it: from its breast to the end of the spring, the origin of its own axes.
    breast = hang + _turned([centre + 0.3 * long * aside], lean)[0]
    (x, y), end = map(float, hang), (float(breast[0]), float(breast[1]))
    pen.line((x, y), end, lw=3.0, color=INK, zorder=1)
    pen.pin(x, y)


def _names(pen: Any, size: dict[str, float], middle: Any, hang: Any) -> None:
    """Write the names of the parts, where the pen writes labels."""
    left, up = -2.6 * size["sleeve_radius"], float(middle[1])
    pen.label(left, up, "sleeve, $\\varphi_M$", ha="right")
    pen.label(left, up + 1.2 * size["beak_height"], "pole, $\\mu$", ha="right")
    right = float(hang[0]) + 1.6 * size["bird_arm"]
    pen.label(right, float(hang[1]), "bird, $\\varphi_S$", ha="left")
    pen.label(1.3 * size["sleeve_radius"], up - 1.7 * size["bird_arm"], "spring, $c$", ha="left")
