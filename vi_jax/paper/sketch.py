"""A sketch in the place of Figure 1: the machine, with the names of Table 1."""

from math import cos, pi, sin, sqrt

import numpy as np
from matplotlib.figure import Figure

from ..machine import Parameters
from ..plot import Pen


def draw_sketch() -> Figure:
    """The mechanical model: motor and disc, lever AB, slider B, spring, body C, stop.

    Crank, lever and gap are to scale (a : l : Δ = 1 : 3 : 2), at one angle of the crank.
    """
    table = Parameters()
    a, rod, gap = 1.0, float(table.rod_length / table.crank_radius), 2.0
    figure = Figure(figsize=(12, 5), dpi=110)
    figure.set_layout_engine("constrained")
    ax = figure.subplots()
    pen = Pen(ax, size=0.8, labels=True)
    phi = 0.3 * pi
    pin = (a * cos(phi), a * sin(phi))
    slider = pin[0] + sqrt(rod**2 - pin[1] ** 2)
    rest = rod + 3.6  # where the body is with u = l and the spring at its free length
    body = rest + 0.5
    stop = rest + gap + 0.4  # the body's face
    pen.floor(-1.6, stop + 0.3, -0.42)
    _drive(pen, a, pin, slider, phi)
    for x, width, color, name in (
        (slider, 0.55, Pen.red, "B, $m_B$"), (body, 0.8, Pen.blue, "C, $m_C$"),
    ):  # fmt: skip
        pen.body(x, width=width, height=0.8, color=color)
        pen.label(x - width / 2, -0.65, name, ha="left", color=color)
    pen.spring((slider + 0.28, 0.0), (body - 0.4, 0.0))
    pen.label((slider + body) / 2, 0.55, "$k_0$, $l_0$")
    pen.damper((body + 0.2, -1.45), (body + 0.2, -0.4))  # of the body to the ground
    pen.line((body - 0.15, -1.45), (body + 0.55, -1.45), color="0.5", lw=2.5)
    pen.label(body + 0.5, -1.15, "$c$")
    pen.wall(stop, low=-0.75, high=0.95)
    pen.label(stop + 0.3, 0.1, "stop,\nrestitution $k$", ha="left", color=Pen.green)
    pen.length(0.0, slider, -1.75, "$u(\\varphi)$", down=0.18)
    pen.length(rest, body, 1.35, "$y$", down=0.18)
    pen.length(rest, rest + gap, 1.8, "$\\Delta = 2a$", down=0.18)
    pen.length(0.0, body, -2.4, "$x = l_0 + l + y$", down=0.18)
    pen.mark(rest, 0.45, 1.95)
    pen.mark(rest + gap, 0.2, 1.95)
    ax.set_aspect("equal")
    ax.set(xlim=(-1.9, stop + 1.9), ylim=(-2.7, 2.4))
    ax.axis("off")
    ax.set_title("Fig. 1 of the paper, drawn from its text", fontsize=12)
    return figure


def _drive(pen: Pen, a: float, pin: tuple[float, float], slider: float, phi: float) -> None:
    """The motor's disc, the lever and their names.

    **Arguments:** `a`, the crank radius; `pin`, (x, y) of its end; `slider`, the place of the
    slider; `phi`, the crank angle (radians).
    """
    pen.disc(0.0, 0.0, a)
    pen.line((0.0, 0.0), pin)
    pen.line(pin, (slider, 0.0), lw=3)
    pen.pin(*pin)
    pen.line((0.0, 0.0), (1.3, 0.0), color="0.5", lw=0.8, ls=":")
    turn = np.linspace(0, phi, 40)
    pen.line(*zip(0.45 * np.cos(turn), 0.45 * np.sin(turn), strict=True), lw=1.0)
    pen.label(0.62, 0.25, "$\\varphi$")
    pen.label(pin[0], pin[1] + 0.25, "A")
    pen.label(pin[0] / 2 - 0.2, pin[1] / 2 + 0.12, "$a$")
    pen.label((pin[0] + slider) / 2, pin[1] / 2 + 0.25, "$l$ (massless)")
    pen.label(-0.65, -0.55, "$J$")
    pen.arrow((-0.2, 1.18), (-0.9, 0.75), bend=0.3)
    pen.label(-1.8, 1.4, "motor, $T(\\varphi')$", ha="left")
