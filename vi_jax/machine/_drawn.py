"""How the paper's scene is drawn."""

from math import cos, sin
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._types import State


def draw_scene(machine: Any, pen: Any, state: State, phase: float) -> None:
    """The crank with its slider, the spring and the body between its stops; by a `Pen`."""
    crank = machine.crank
    size = pen.size = max(0.8, 0.25 * pen.reach)  # beside a crank of radius 1
    rod = float(crank.drawn_rod)
    pin = cos(phase), sin(phase)
    slider = rod + float(crank.slide(jnp.asarray(phase)).U)
    spring = pen.reach + 1.0 + size + 0.5  # never shorter than half a crank in this motion
    rest = rod + spring
    body = rest + float(state.Y)
    ends = rest + pen.reach + 2.0 * size
    floor = -0.5 * size
    pen.floor(rod - 1.5, ends, floor)
    _crank(machine, pen, pin, slider)
    pen.body(slider, width=0.55, height=0.7, color=pen.red)
    pen.spring((slider + 0.28, 0.0), (body - size / 2, 0.0))
    pen.body(body, width=size, height=size)
    if float(machine.damping_ratio) > 0:
        post, low = rest - pen.reach - 0.9 * size, floor - 0.55 * size
        pen.line((body, floor), (body, low), lw=1.3)
        pen.damper((post, low), (body, low))
        pen.wall(post, -1, low=low - 0.35 * size, high=low + 0.35 * size, color="0.5")
        pen.label((post + body) / 2, low - 0.42 * size, "$c$")
    for stop in (*machine.stops, *machine.soft_stops):
        back = pen.stop(stop, rest=rest, slot=0.34 * size)  # the spring passes through it
        words = "soft stop" if stop in machine.soft_stops else "stop, $k$"
        if stop.sign > 0 or stop in machine.soft_stops:
            pen.label(back + stop.sign * 0.3 * size, 0.8 * size + 0.25, words, color=pen.green)
    pen.label(slider, -0.7, "$m_B$", color=pen.red)
    pen.label(body, 0.0, "$m_C$", color=pen.blue)
    pen.label(slider + 0.9, 0.2 * size + 0.3, "$k_0$")
    top = 0.5 * size + 0.45
    pen.mark(rest, 0.5 * size, top + 0.6)
    if float(state.Y):
        pen.mark(body, 0.5 * size, top + 0.1)
        pen.length(rest, body, top, "$Y$", down=0.22)
    for stop in machine.stops:
        place = rest + float(stop.place)
        if stop.sign > 0:
            pen.mark(place, 0.5 * size, top + 0.6)
            pen.length(rest, place, top + 0.5, "$d$", down=0.22)


def _crank(machine: Any, pen: Any, pin: tuple[float, float], slider: float) -> None:
    pen.disc(0.0, 0.0, 1.0)
    pen.line((0.0, 0.0), pin)
    pen.line(pin, (slider, 0.0), lw=2.6)
    pen.pin(*pin)
    pen.pin(slider, 0.0)
    if not pen.labels:
        return
    angle = np.linspace(0, np.arctan2(pin[1], pin[0]), 40)
    pen.line((0.0, 0.0), (1.35, 0.0), color="0.5", lw=0.8, ls=":")
    pen.line(*zip(0.45 * np.cos(angle), 0.45 * np.sin(angle), strict=True), lw=1.0)
    pen.label(0.62, 0.2, "$\\varphi$")
    pen.label(pin[0] / 2 - 0.18, pin[1] / 2 + 0.12, "$a$")
    pen.label((pin[0] + slider) / 2, pin[1] / 2 + 0.28, "$l$")
    pen.arrow((-0.15, 1.2), (-0.95, 0.75), bend=0.3)
    pen.label(0.1, 1.45, machine.drive.caption)
