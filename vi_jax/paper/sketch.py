"""A sketch in the place of Figure 1: the machine, with the names of Table 1."""

from math import cos, pi, sin, sqrt

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

from ..plot.motion import BLUE, GREEN, RED
from ..scene import Parameters

_INK = {"color": "0.15", "lw": 1.6}


def draw_sketch() -> Figure:
    """The mechanical model: motor and disc, lever AB, slider B, spring, body C, stop.

    Crank, lever and gap are to scale (a : l : Δ = 1 : 3 : 2), at one angle of the crank.
    """
    table = Parameters()
    a, rod, gap = 1.0, float(table.rod_length / table.crank_radius), 2.0
    figure = Figure(figsize=(12, 5), dpi=110)
    figure.set_layout_engine("constrained")
    ax = figure.subplots()
    phi = 0.3 * pi
    pin = (a * cos(phi), a * sin(phi))
    slider = pin[0] + sqrt(rod**2 - pin[1] ** 2)
    rest = rod + 3.6  # where the body is with u = l and the spring at its free length
    body = rest + 0.5
    _drive(ax, a, pin, slider, phi)
    _block(ax, slider, 0.55, RED, "B, $m_B$")
    _block(ax, body, 0.8, BLUE, "C, $m_C$")
    _spring(ax, slider + 0.28, body - 0.4)
    ax.text((slider + body) / 2, 0.55, "$k_0$, $l_0$", ha="center", fontsize=12)
    _damper(ax, body)
    stop = rest + gap + 0.4  # the body's face
    ax.plot([stop, stop], [-0.75, 0.95], color=GREEN, lw=3)
    for y in np.arange(-0.7, 0.95, 0.2):
        ax.plot([stop, stop + 0.18], [y, y + 0.14], color=GREEN, lw=1.0)
    ax.text(stop + 0.3, 0.1, "stop,\nrestitution $k$", ha="left", color=GREEN, fontsize=12)
    ax.plot([-1.6, stop + 0.3], [-0.42, -0.42], color="0.7", lw=1.0, zorder=0)
    _length(ax, 0.0, slider, -1.75, "$u(\\varphi)$")
    _length(ax, rest, body, 1.35, "$y$")
    _length(ax, rest, rest + gap, 1.8, "$\\Delta = 2a$")
    _length(ax, 0.0, body, -2.4, "$x = l_0 + l + y$")
    ax.plot([rest, rest], [0.45, 1.95], color="0.5", lw=0.8, ls=":")
    ax.plot([rest + gap, rest + gap], [0.2, 1.95], color="0.5", lw=0.8, ls=":")
    ax.set_aspect("equal")
    ax.set(xlim=(-1.9, stop + 1.9), ylim=(-2.7, 2.4))
    ax.axis("off")
    ax.set_title("Fig. 1 of the paper, drawn from its text", fontsize=12)
    return figure


def _drive(ax: Axes, a: float, pin: tuple[float, float], slider: float, phi: float) -> None:
    ax.add_patch(Circle((0, 0), a, fill=False, **_INK))
    ax.plot(0, 0, "o", color="0.15", ms=6)
    ax.plot([0, pin[0]], [0, pin[1]], **_INK)
    ax.plot([pin[0], slider], [pin[1], 0], color="0.15", lw=3)
    ax.plot(*pin, "o", color="white", mec="0.15", ms=8)
    ax.plot([0, 1.3], [0, 0], color="0.5", lw=0.8, ls=":")
    turn = np.linspace(0, phi, 40)
    ax.plot(0.45 * np.cos(turn), 0.45 * np.sin(turn), color="0.15", lw=1.0)
    ax.text(0.55, 0.18, "$\\varphi$", fontsize=12)
    ax.text(pin[0] - 0.05, pin[1] + 0.18, "A", fontsize=12)
    ax.text(pin[0] / 2 - 0.28, pin[1] / 2 + 0.05, "$a$", fontsize=12)
    ax.text((pin[0] + slider) / 2, pin[1] / 2 + 0.2, "$l$ (massless)", fontsize=12)
    ax.text(-0.72, -0.6, "$J$", fontsize=12)
    arrow = FancyArrowPatch(
        (-0.2, 1.18), (-0.9, 0.75), connectionstyle="arc3,rad=0.3", arrowstyle="->",
        mutation_scale=14, color="0.15",
    )  # fmt: skip
    ax.add_patch(arrow)
    ax.text(-1.8, 1.35, "motor, $T(\\varphi')$", fontsize=12)


def _block(ax: Axes, x: float, width: float, color: str, name: str) -> None:
    box = Rectangle((x - width / 2, -0.4), width, 0.8, facecolor=color, alpha=0.25, edgecolor=color)
    ax.add_patch(box)
    ax.text(x - width / 2, -0.75, name, ha="left", fontsize=12, color=color)
    ax.plot(x, 0, ".", color=color)


def _spring(ax: Axes, left: float, right: float) -> None:
    zigzag = np.tile([0.22, -0.22], 6)
    x = np.linspace(left + 0.25, right - 0.25, zigzag.size + 2)
    ax.plot([left, *x, right], [0, 0, *zigzag, 0, 0], color="0.15", lw=1.3)


def _damper(ax: Axes, body: float) -> None:
    """Of the body to the ground."""
    x, y = body + 0.32, -1.3
    ax.plot([x, x], [-0.4, y + 0.15], color="0.15", lw=1.2)
    ax.plot([x - 0.14, x + 0.14], [y + 0.15, y + 0.15], color="0.15", lw=1.6)
    ax.plot([x - 0.2, x - 0.2, x + 0.2, x + 0.2], [y + 0.28, y, y, y + 0.28], color="0.15", lw=1.2)
    ax.plot([x, x], [y, y - 0.22], color="0.15", lw=1.2)
    ax.plot([x - 0.35, x + 0.35], [y - 0.22, y - 0.22], color="0.5", lw=2.5)
    ax.text(x + 0.3, y + 0.05, "$c$", fontsize=12)


def _length(ax: Axes, left: float, right: float, y: float, name: str) -> None:
    ax.annotate(
        "", (right, y), (left, y), arrowprops={"arrowstyle": "<->", "color": "0.3", "lw": 1.0}
    )
    ax.text((left + right) / 2, y + 0.08, name, ha="center", fontsize=12, color="0.2")
