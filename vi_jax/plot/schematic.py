"""Schematics of machines: each part drawn where it is."""

from functools import singledispatch
from math import cos, pi, sin
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from .._checks import instance_of
from .._types import State
from ..machine import AbstractMachine, Scene, ShaftMachine, SoftStop
from ..machines import BouncingBall, Duffing, ImpactPair, UnbalancedRotor
from .colors import GREEN, RED
from .motion import new_axes
from .pen import Pen


def sketch(machine: AbstractMachine, pen: Pen, state: State, phase: float) -> None:
    """Draw a machine in a state: by its own `sketch(pen, state, phase)`, if it has one."""
    own = getattr(machine, "sketch", None)
    if own is not None:
        own(pen, state, phase)
    else:
        _drawn(machine, pen, state, phase)


def plot_sketch(
    machine: AbstractMachine, state: State = None, *, phase: Any = None, ax: Axes | None = None
) -> Axes:
    """A schematic of a machine with the names of its parts.

    A machine of your own is drawn by its method `sketch(pen, state, phase)`, if it has one: `pen`
    (a `vi_jax.plot.Pen`) draws bodies, springs and walls. Otherwise its bodies are drawn between
    their stops.

    **Arguments:**

    - `machine`: the machine.
    - `state`: the state to draw; by default its own start.
    - `phase`: the reading of its clock, by default 0; where a shaft turns its angle, by default
      0.3π.
    - `ax`: axes to draw into; a new figure if left out.

    **Returns:** the axes.
    """
    instance_of("machine", machine, AbstractMachine, "a `Scene` or an `AbstractMachine`")
    state = machine.start() if state is None else machine.adopt(state)
    if phase is None:
        phase = _shown_phase(machine)
    ax = new_axes(ax)
    reach = reach_of(machine, _positions(machine, state))
    sketch(machine, Pen(ax, reach=reach, size=size_of(machine, reach), labels=True), state, phase)
    frame_axes(ax)
    return ax


def frame_axes(ax: Axes) -> None:
    """No ticks, and equal scales."""
    ax.set_aspect("equal", adjustable="datalim")
    ax.axis("off")
    ax.margins(0.06)


def _positions(machine: AbstractMachine, state: State) -> np.ndarray:
    return np.array([float(c.position(state)) for c in machine.coordinates])


def reach_of(machine: AbstractMachine, positions: np.ndarray) -> float:
    """The largest distance from zero of these positions and of the stops."""
    soft = [switch for switch in machine.switches if isinstance(switch, SoftStop)]
    stops = [abs(float(stop.place)) for stop in (*machine.stops, *soft)]
    return max(0.0, *map(float, np.abs(positions).ravel()), *stops) or 1.0


@singledispatch
def size_of(machine: AbstractMachine, reach: float) -> float:
    """A good size for a body, in the unit of its coordinate: a share of its motion."""
    return 0.35 * reach


@size_of.register
def _(machine: Scene, reach: float) -> float:
    return max(0.8, 0.25 * reach)  # beside a crank of radius 1


@singledispatch
def _shown_phase(machine: AbstractMachine) -> float:
    """The reading of its clock at which a machine is drawn by default."""
    return 0.0


@_shown_phase.register
def _(machine: ShaftMachine) -> float:
    return 0.3 * pi  # the crank or the rotor turned out of line


@singledispatch
def _drawn(machine: AbstractMachine, pen: Pen, state: State, phase: float) -> None:
    """Every coordinate as a body between its stops, one below the other."""
    size = pen.size
    for i, place in enumerate(_positions(machine, state)):
        row = -2.2 * size * i
        ends = pen.reach + 1.4 * size
        pen.floor(-ends, ends, row - 0.5 * size)
        pen.body(place, row, width=size)
        for stop in (stop for stop in machine.stops if stop.coordinate == i):
            face = float(stop.place) + stop.sign * size / 2
            pen.wall(face, stop.sign, low=row - 0.5 * size, high=row + 0.8 * size)
        for stop in (stop for stop in machine.switches if isinstance(stop, SoftStop)):
            if stop.coordinate == i:
                _soft_stop(pen, float(stop.place) + stop.sign * size / 2, stop.sign, size, row)
        pen.mark(0.0, row - 0.5 * size, row + 1.1 * size)
        pen.mark(place, row, row + 1.1 * size)
        if place:
            pen.length(0.0, place, row + size, machine.labels[0], down=0.25 * size)


@_drawn.register
def _(machine: Scene, pen: Pen, state: State, phase: float) -> None:
    crank, size = machine.crank, pen.size
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
    pen.body(slider, width=0.55, height=0.7, color=RED)
    pen.spring((slider + 0.28, 0.0), (body - size / 2, 0.0))
    pen.body(body, width=size, height=size)
    if float(machine.damping_ratio) > 0:
        post, low = rest - pen.reach - 0.9 * size, floor - 0.55 * size
        pen.line((body, floor), (body, low), lw=1.3)
        pen.damper((post, low), (body, low))
        pen.wall(post, -1, low=low - 0.35 * size, high=low + 0.35 * size, color="0.5")
        pen.label((post + body) / 2, low - 0.42 * size, "$c$")
    for stop in (*machine.stops, *machine.soft_stops):
        _stop(pen, stop, rest, size, rigid=stop in machine.stops)
    pen.label(slider, -0.7, "$m_B$", color=RED)
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


def _crank(machine: Scene, pen: Pen, pin: tuple[float, float], slider: float) -> None:
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


def _stop(pen: Pen, stop: Any, rest: float, size: float, *, rigid: bool) -> None:
    """A wall that the body's face meets at the gap; a compliant one stands on a spring.

    **Arguments:** `rest`, the place of the body's middle where its position is 0; `size`, its
    width; `rigid`, whether the stop is.
    """
    sign = 1 if stop.side == "right" else -1
    face = rest + sign * (float(stop.gap) + size / 2)
    slot = 0.0 if sign > 0 else 0.34 * size  # the spring passes through a stop on the left
    high, low = 0.8 * size, -0.5 * size
    if rigid:
        pen.wall(face, sign, low=low, high=high, slot=slot)
        if sign > 0:
            pen.label(face + 0.3 * size, high + 0.25, "stop, $k$", color=GREEN)
        return
    back = _soft_stop(pen, face, sign, size, slot=slot)
    pen.label(back + sign * 0.3 * size, high + 0.25, "soft stop", color=GREEN)


def _soft_stop(
    pen: Pen, face: float, sign: int, size: float, row: float = 0.0, slot: float = 0.0
) -> float:
    """A plate at `face` on a spring before a wall, whose place is returned."""
    back = face + sign * 0.8 * size
    pen.line((face, row + 0.3 * size), (face, row + 0.7 * size), color=GREEN, lw=2.6)
    pen.spring((face, row + 0.5 * size), (back, row + 0.5 * size), coils=3)
    pen.wall(back, sign, low=row - 0.5 * size, high=row + 0.8 * size, slot=slot)
    return back


@_drawn.register
def _(machine: BouncingBall, pen: Pen, state: State, phase: float) -> None:
    radius, table = 0.3 * pen.size, -float(machine.acceleration) * cos(phase)
    wide = 2.4 * pen.size
    pen.body(0.0, table - 0.15 * pen.size, width=wide, height=0.3 * pen.size, color=GREEN)
    pen.ball(0.0, table + radius + float(state.height), radius)
    pen.arrow((-0.7 * wide, 0.35 * pen.size), (-0.7 * wide, -0.35 * pen.size))
    pen.label(-0.7 * wide, 0.6 * pen.size, "$g$")
    pen.label(0.62 * wide, table, "$-\\Gamma\\,\\cos\\,\\omega t$", ha="left", color=GREEN)


@_drawn.register
def _(machine: ImpactPair, pen: Pen, state: State, phase: float) -> None:
    free = machine.mass_ratio is not None
    box = float(state.box) if free else sin(phase)
    radius, half = 0.4 * pen.size, float(machine.half_gap)
    wall = 0.25 * pen.size
    height = 3.2 * radius
    base = -height / 2
    for sign in (-1, 1):
        face = box + sign * (half + radius + wall / 2)
        pen.body(face, width=wall, height=height, color=GREEN)
    pen.body(box, base - wall / 2, width=2 * (half + radius + wall), height=wall, color=GREEN)
    pen.ball(box + float(state.place), base + radius, radius)
    pen.floor(-2.2 * half - 2.0, 2.2 * half + 2.0, base - wall)
    edge = half + radius + wall
    if free:
        post = -edge - pen.reach - 1.6
        pen.spring((post, 0.0), (box - edge, 0.0))
        pen.wall(post, -1, low=base, high=-base, color="0.5")
        pen.arrow((box + edge, 0.0), (box + edge + 0.6 * pen.size, 0.0))
        pen.label(box + edge, 0.45 * pen.size, "$F\\,\\sin\\,\\omega t$", ha="left")
    else:
        pen.label(
            box + edge + 0.2 * pen.size, 0.0, "$a\\,\\sin\\,\\omega t$", ha="left", color=GREEN
        )
    pen.label(box, height / 2 + 0.2 * pen.size, "$e$")


def _supported(machine: AbstractMachine, pen: Pen, place: float) -> float:
    """Draw a body between stops, on a spring and a damper from a post; return the post's place."""
    size = pen.size
    post, back = -pen.reach - 2.6 * size, place - size / 2
    pen.floor(post, pen.reach + 1.4 * size, -0.5 * size)
    pen.wall(post, -1, low=-0.5 * size, high=0.8 * size, color="0.5")
    pen.spring((post, 0.23 * size), (back, 0.23 * size))
    pen.damper((post, -0.24 * size), (back, -0.24 * size))
    pen.body(place, width=size)
    for stop in machine.stops:
        face = float(stop.place) + stop.sign * size / 2
        # Spring and damper pass through a stop on the left.
        slot = 0.0 if stop.sign > 0 else 0.43 * size
        pen.wall(face, stop.sign, low=-0.5 * size, high=0.8 * size, slot=slot)
    return post


@_drawn.register
def _(machine: Duffing, pen: Pen, state: State, phase: float) -> None:
    place, size = float(state.Y), pen.size
    post = _supported(machine, pen, place)
    pull = 0.9 * size * cos(phase)
    if abs(pull) > 0.1 * size:
        pen.arrow((place, 0.75 * size), (place + pull, 0.75 * size))
    pen.label(place, 1.0 * size, "$A\\,\\cos\\,\\omega t$")
    pen.label((post + place) / 2, 0.75 * size, "$\\alpha x + \\beta x^3$")


@_drawn.register
def _(machine: UnbalancedRotor, pen: Pen, state: State, phase: float) -> None:
    place, size = float(state.Y), pen.size
    radius = 0.34 * size
    post = _supported(machine, pen, place)
    pen.disc(place, 0.0, radius)
    heavy = place + radius * cos(phase), radius * sin(phase)
    pen.line((place, 0.0), heavy)
    pen.ball(*heavy, 0.1 * size, color=RED)
    pen.label(place + 0.15 * size, 0.68 * size, "$m,\\ r$", color=RED)
    pen.label(place + 0.68 * size, 0.0, "$M$", color=pen.blue)
    pen.label((post + place) / 2, 0.7 * size, "$k,\\ c$")
