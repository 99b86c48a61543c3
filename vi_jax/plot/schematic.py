"""Schematics of machines: each part is drawn at its position, in the field's conventions."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, FancyArrowPatch, Rectangle

from .._checks import instance_of
from .._types import State
from ..machine import AbstractMachine, SoftStop, convert_start
from .colors import BLUE, GREEN, RED
from .motion import all_stops, new_axes

INK = "0.15"

Point = tuple[float, float]


class Pen:
    """Drawing of a machine's parts, for the method `sketch(pen, state, phase)` of a machine.

    Lengths are those of the machine's coordinate. `x` is horizontal to the right and `y` upward;
    `size` is a suitable size of a body.
    """

    blue, red, green = BLUE, RED, GREEN

    def __init__(self, ax: Axes, *, reach: float = 1.0, size: float = 1.0, labels: bool = False):
        self.ax = ax
        self.reach = reach
        """Largest distance from zero in the motion drawn, or of a stop."""
        self.size = size
        """A good size for a body."""
        self.labels = labels
        """True to write names next to the parts."""

    def label(self, x: float, y: float, text: str, **look: Any) -> None:
        """Write a name at a place, if `labels` is true."""
        if self.labels:
            look = {"ha": "center", "va": "center", "fontsize": 11, "color": INK, **look}
            self.ax.text(x, y, text, **look)

    def line(self, *points: Point, **look: Any) -> None:
        """Draw a line through these points."""
        look = {"color": INK, "lw": 1.6, "solid_capstyle": "round", **look}
        self.ax.plot(*np.asarray(points, float).T, **look)

    def body(self, x: float, y: float = 0.0, *, width: float | None = None,
             height: float | None = None, color: str = BLUE) -> None:  # fmt: skip
        """Draw a body with its middle at (x, y). **Arguments:** `width`, the pen's size by default;
        `height`, as the width by default."""
        width = self.size if width is None else width
        height = width if height is None else height
        self._draw_shape(Rectangle, (x - width / 2, y - height / 2), width, height, color=color)

    def ball(self, x: float, y: float, radius: float, *, color: str = BLUE) -> None:
        """Draw a ball with its middle at (x, y)."""
        self._draw_shape(Circle, (x, y), radius, color=color)

    def _draw_shape(self, shape: Any, *place: Any, color: str) -> None:
        for fill, alpha in ((color, 0.28), ("none", 1.0)):
            self.ax.add_patch(shape(*place, facecolor=fill, edgecolor=color, alpha=alpha, lw=1.6))

    def disc(self, x: float, y: float, radius: float) -> None:
        """Draw a rotor or a crank's disc with its shaft."""
        self.ax.add_patch(Circle((x, y), radius, fill=False, edgecolor=INK, lw=1.6))
        self.pin(x, y, filled=True)

    def pin(self, x: float, y: float, *, filled: bool = False) -> None:
        """Draw a joint between two parts, open or filled."""
        self.ax.plot(x, y, "o", color=INK if filled else "white", mec=INK, ms=6, zorder=4)

    def wall(
        self, x: float, side: int = 1, *, low: float, high: float, slot: float = 0.0,
        color: str = GREEN,
    ) -> None:  # fmt: skip
        """Draw a wall, hatched behind its face.

        **Arguments:** `x`, the position of the face; `side` of the hatching, right (1) or left
        (-1); `low` and `high`, its ends; `slot`, half the height of an opening about y = 0.
        """
        depth = 0.22 * self.size
        for bottom, top in ((low, -slot), (slot, high)) if slot else ((low, high),):
            self.ax.plot([x, x], [bottom, top], color=color, lw=2.6, solid_capstyle="butt")
            for y in np.arange(bottom, top - 0.6 * depth, 0.8 * depth):
                self.ax.plot([x, x + side * depth], [y, y + 0.7 * depth], color=color, lw=0.9)

    def soft_stop(self, face: float, side: int, row: float = 0.0, slot: float = 0.0) -> float:
        """Draw a plate at `face` on a spring, and a wall (see `wall`); return the wall's place."""
        size, back = self.size, face + side * 0.8 * self.size
        plate = (face, row + 0.3 * size), (face, row + 0.7 * size)
        self.line(*plate, color=GREEN, lw=2.6)
        self.spring((face, row + 0.5 * size), (back, row + 0.5 * size), coils=3)
        self.wall(back, side, low=row - 0.5 * size, high=row + 0.8 * size, slot=slot)
        return back

    def stop(self, stop: Any, *, rest: float = 0.0, row: float = 0.0, slot: float = 0.0) -> float:
        """Draw a stop for the face of a body of the pen's size, rigid or on a spring; return the
        position of its wall.

        **Arguments:** `rest`, the position of the body's middle at coordinate 0; `row`, its height;
        `slot`, as for `wall`, for a stop on the left, where springs are.
        """
        face, slot = rest + float(stop.place) + stop.sign * self.size / 2, slot * (stop.sign < 0)
        if isinstance(stop, SoftStop):
            return self.soft_stop(face, stop.sign, row, slot)
        low, high = row - 0.5 * self.size, row + 0.8 * self.size
        self.wall(face, stop.sign, low=low, high=high, slot=slot)
        return face

    def floor(self, left: float, right: float, y: float) -> None:
        """Draw the ground from left to right."""
        self.ax.plot([left, right], [y, y], color="0.7", lw=1.0, zorder=0)

    def spring(self, start: Point, end: Point, *, coils: int = 6) -> None:
        """Draw a spring between two points."""
        length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
        lead = min(0.2 * self.size, 0.2 * length)  # straight at both ends
        turns = np.tile([0.2 * self.size, -0.2 * self.size], coils)
        along = [0.0, *np.linspace(lead, length - lead, turns.size + 2), length]
        self._along(start, end, along, [0, 0, *turns, 0, 0], lw=1.3)

    def damper(self, start: Point, end: Point) -> None:
        """Draw a dashpot between two points, its cylinder on the side of `start`."""
        half, length = 0.13 * self.size, float(np.hypot(end[0] - start[0], end[1] - start[1]))
        foot, piston, cup = 0.2 * length, 0.5 * length, 0.65 * length
        self._along(start, end, [0, foot], [0, 0], lw=1.3)
        self._along(start, end, [cup, foot, foot, cup], [-half, -half, half, half], lw=1.3)
        self._along(start, end, [piston, piston], [-0.7 * half, 0.7 * half], lw=2.0)
        self._along(start, end, [piston, length], [0, 0], lw=1.3)

    def _along(self, start: Point, end: Point, along: object, across: object, **look: Any) -> None:
        """Draw a line in coordinates along and across the line between two points."""
        direction = np.subtract(end, start)
        length = np.hypot(*direction)
        unit = direction / length if length else np.array([1.0, 0.0])
        x = start[0] + np.asarray(along) * unit[0] - np.asarray(across) * unit[1]
        y = start[1] + np.asarray(along) * unit[1] + np.asarray(across) * unit[0]
        self.ax.plot(x, y, **{"color": INK, "solid_joinstyle": "round", **look})

    def arrow(self, start: Point, end: Point, *, color: str = INK, bend: float = 0.0) -> None:
        """Draw a force, or a sense of rotation if it is bent."""
        self.ax.add_patch(
            FancyArrowPatch(
                start, end, connectionstyle=f"arc3,rad={bend}", arrowstyle="-|>",
                mutation_scale=12, color=color, lw=1.4, shrinkA=0, shrinkB=0,
            )
        )  # fmt: skip

    def length(self, left: float, right: float, y: float, text: str, *, down: float) -> None:
        """Draw a length between two places, with its name; only with labels.

        **Arguments:** `left` and `right`, the places; `y`, the height; `down`, the distance of the
        name above that (below, if negative).
        """
        if not self.labels:
            return
        look = {"arrowstyle": "<->", "color": "0.3", "lw": 1.0, "shrinkA": 0, "shrinkB": 0}
        self.ax.annotate("", (right, y), (left, y), arrowprops=look)
        self.label((left + right) / 2, y + down, text, color="0.2")

    def mark(self, x: float, low: float, high: float) -> None:
        """Draw a dotted line at the end of a length; only with labels."""
        if self.labels:
            self.ax.plot([x, x], [low, high], color="0.5", lw=0.8, ls=":")


def sketch(machine: AbstractMachine, pen: Pen, state: State, phase: float) -> None:
    """Draw a machine in a state, by its own `sketch(pen, state, phase)` if it has one."""
    draw = getattr(machine, "sketch", None)
    if draw is not None:
        draw(pen, state, phase)
    else:
        _bodies(machine, pen, state)


def plot_sketch(
    machine: AbstractMachine, state: State = None, *, phase: Any = None, ax: Axes | None = None
) -> Axes:
    """Draw a schematic of a machine with the names of its parts.

    A machine of your own is drawn by its method `sketch(pen, state, phase)`, if it has one: `pen`
    (a `vi_jax.plot.Pen`) draws bodies, springs and walls. Otherwise bodies between stops are drawn.

    **Arguments:**

    - `machine`: the machine.
    - `state`: the state to draw; by default its own start.
    - `phase`: the reading of its clock, by default 0; for a shaft the angle, by default 0.3π.
    - `ax`: axes to draw into; by default a new figure.
    """
    instance_of("machine", machine, AbstractMachine, "a `Scene` or an `AbstractMachine`")
    state = machine.start() if state is None else convert_start(machine, state)
    if phase is None:
        phase = getattr(machine, "sketched_at", 0.0)
    ax = new_axes(ax)
    sketch(machine, pen_for(machine, ax, _positions(machine, state), labels=True), state, phase)
    ax.set_aspect("equal", adjustable="datalim")
    ax.axis("off")
    ax.margins(0.06)
    return ax


def _positions(machine: AbstractMachine, state: State) -> np.ndarray:
    return np.array([float(c.position(state)) for c in machine.coordinates])


def pen_for(
    machine: AbstractMachine, ax: Axes, positions: np.ndarray, *, labels: bool = False
) -> Pen:
    """Return a pen with a reach for these positions and the stops."""
    stops = [abs(float(stop.place)) for stop in all_stops(machine)]
    reach = max(0.0, *map(float, np.abs(positions).ravel()), *stops) or 1.0
    return Pen(ax, reach=reach, size=0.35 * reach, labels=labels)


def _bodies(machine: AbstractMachine, pen: Pen, state: State) -> None:
    """Draw every coordinate as a body between its stops, one below the other."""
    size = pen.size
    for i, place in enumerate(_positions(machine, state)):
        row = -2.2 * size * i
        ends = pen.reach + 1.4 * size
        pen.floor(-ends, ends, row - 0.5 * size)
        pen.body(place, row, width=size)
        for stop in all_stops(machine, i):
            pen.stop(stop, row=row)
        pen.mark(0.0, row - 0.5 * size, row + 1.1 * size)
        pen.mark(place, row, row + 1.1 * size)
        if place:
            pen.length(0.0, place, row + size, machine.labels[0], down=0.25 * size)
