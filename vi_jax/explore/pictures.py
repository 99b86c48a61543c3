"""The page's pictures: figures made once, whose lines are given new numbers at each redraw.

Frames and labels take most of the time of drawing one; they are kept until the limits change.
"""

import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from PIL import Image

from ..machine import UNITS, AbstractMachine, name_in
from ..plot import BLUE, GREEN, RED, animate, axis_name
from .diagram import SHOWN, Diagram
from .motion import WINDOW, Motion, seen_evenly

MAPS = ("impact map", "section map")
"""What the third picture of an ideal motion shows."""

# Dots per inch, and the look of lines behind: choices.
_DPI, _FAINT = 90, {"color": "0.88", "lw": 0.8, "zorder": 0}

# Of the motion's extent, the least that a map of its sections shows, so that sections that move a
# little need no new frame: a choice.
_WIDE = 0.3

# Of an animation: a choice, which takes some seconds to draw.
_SECONDS, _FPS = 4, 15

# Limits are kept while what is drawn is within them and fills so much of them.
_FILLED = 0.5


class MotionPicture:
    """Four pictures of a motion in one: its time history, phase portrait, map, and multipliers;
    with a motor the crank's speed takes the place of the map."""

    def __init__(self, *, motor: bool = False, labels: tuple[str, str] | None = None):
        """**Arguments:** `motor`, whether the crank's speed is shown; `labels`, what a machine of
        another kind than the paper's calls its position and its velocity."""
        self._motor = motor
        self._labels = labels or ("Y = y/a", "V = dY/dτ")
        self._names = tuple(map(name_in, self._labels))
        self._across = "cycles" if labels else "drive cycles φ/(2π)"
        self.figure = Figure(figsize=(11.2, 6.6), dpi=_DPI)
        self._canvas = FigureCanvasAgg(self.figure)
        grid = self.figure.add_gridspec(
            2, 3, left=0.065, right=0.985, bottom=0.08, top=0.98, wspace=0.26, hspace=0.26
        )
        self._course = self.figure.add_subplot(grid[0, :])
        self._portrait, self._map, self._circle = (
            self.figure.add_subplot(grid[1, i]) for i in range(3)
        )
        self._lines, self._notes = self._made_lines(), self._made_notes()
        self._drawn, self._frame = None, None

    def _made_lines(self) -> dict[str, Line2D]:
        lines = {}
        self._course.set(xlabel=self._across, ylabel=self._labels[0], xlim=(0, WINDOW))
        self._portrait.set(xlabel=self._labels[0], ylabel=self._labels[1])
        for name, ax in (("course", self._course), ("portrait", self._portrait)):
            line = ax.axhline if name == "course" else ax.axvline
            lines[f"{name} stop"] = line(0, color=GREEN, lw=1.8)
            (lines[name],) = ax.plot([], [], color=BLUE, lw=1.2)
        for name, ax in (("sections", self._portrait), ("map", self._map)):
            (lines[name],) = ax.plot([], [], "o", color=RED, ms=3.2, mew=0)
        angle = np.linspace(0, 2 * np.pi, 129)
        self._circle.plot(np.cos(angle), np.sin(angle), color="0.5", lw=1)
        self._circle.axhline(0, **_FAINT)
        self._circle.axvline(0, **_FAINT)
        (lines["multipliers"],) = self._circle.plot([], [], "o", color=BLUE, ms=6)
        self._circle.set(xlim=(-1.6, 1.6), ylim=(-1.2, 1.2), xlabel="Re μ", ylabel="Im μ")
        self._circle.set_aspect("equal")
        for line in lines.values():
            line.set_animated(True)  # left out where the frames are drawn
        return lines

    def _made_notes(self) -> dict[str, Text]:
        look = {"ha": "center", "color": "0.4", "animated": True}
        return {
            name: ax.text(0.5, 0.45, "", transform=ax.transAxes, **look)
            for name, ax in (("map", self._map), ("multipliers", self._circle))
        }

    def draw(self, motion: Motion, gap: object, *, which: str = MAPS[0]) -> bytes:
        """The picture of a motion, as PNG.

        **Arguments:** `gap`, the place of the stop, or of several; `which`, out of `MAPS`.
        """
        self._set_motion(motion, gap)
        if self._motor:
            self._set_speed(motion)
        elif which == MAPS[0]:
            self._set_impacts(motion)
        else:
            self._set_sections(motion)
        mu = np.asarray(motion.multipliers, complex)
        self._lines["multipliers"].set_data(np.real(mu), np.imag(mu))
        self._notes["multipliers"].set_text("" if mu.size else "no period")
        axes = (self._course, self._portrait, self._map)
        frame = [(ax.get_xlabel(), *ax.get_xlim(), *ax.get_ylim()) for ax in axes]
        if frame != self._drawn:
            self._canvas.draw()
            self._frame = self._canvas.copy_from_bbox(self.figure.bbox)
            self._drawn = frame
        self._canvas.restore_region(self._frame)
        for artist in (*self._lines.values(), *self._notes.values()):
            self.figure.draw_artist(artist)
        return _packed(self._canvas)

    def _set_motion(self, motion: Motion, gap: Any) -> None:
        lines, path = self._lines, motion.path
        lines["course"].set_data(path.cycles, path.Y)
        lines["portrait"].set_data(path.Y, path.V)
        at = np.repeat(np.atleast_1d(gap), 3)
        across = np.tile([0.0, 1.0, np.nan], at.size // 3)  # a line for each stop
        lines["course stop"].set_data(across, at)
        lines["portrait stop"].set_data(at, across)
        lines["sections"].set_data(*motion.places)
        _fit(self._course, y=np.append(path.Y, gap))
        _fit(self._portrait, x=np.append(path.Y, gap), y=path.V)

    def _set_map(self, x: np.ndarray, y: np.ndarray, across: str, up: str, note: str = "") -> None:
        """Draw the map of impacts or of sections.

        **Arguments:** `x` and `y`, its points; `across` and `up`, the names of its axes; `note`, a
        text in it.
        """
        self._lines["map"].set_data(x, y)
        self._map.set(xlabel=across, ylabel=up)
        self._notes["map"].set_text(note)

    def _set_impacts(self, motion: Motion) -> None:
        phase, speed = motion.impact_phase / np.pi, motion.impact_speed
        note = "" if phase.size else "no impact"
        self._set_map(phase, speed, "crank angle of the impact, φ/π", "V⁻", note)
        self._map.set_xlim(0, 2)
        _fit(self._map, y=np.append(speed, 0.0))

    def _set_sections(self, motion: Motion) -> None:
        Y, V = motion.places
        self._set_map(Y, V, *(f"{name} on the section" for name in self._names))
        for values, drawn, way in ((Y, motion.path.Y, "x"), (V, motion.path.V, "y")):
            span = np.ptp(drawn[np.isfinite(drawn)]) if np.isfinite(drawn).any() else 0.0
            _fit(self._map, **{way: values}, least=max(_WIDE * float(span), 1e-12))

    def _set_speed(self, motion: Motion) -> None:
        ratio = motion.frequency_ratio
        cycle = np.arange(1, ratio.size + 1)
        self._set_map(cycle, ratio, "drive cycle", "ζ of the cycle")
        self._map.set_xlim(0, ratio.size + 1)
        _fit(self._map, y=ratio, least=0.1)


class DiagramPicture:
    """A bifurcation diagram, with the chosen value marked."""

    def __init__(self):
        self.figure = Figure(figsize=(11.2, 3.6), dpi=_DPI)
        self.ax = self.figure.add_axes((0.065, 0.14, 0.92, 0.84))
        (self._dots,) = self.ax.plot([], [], "o", color="0.15", ms=1.3, mew=0)
        self._mark = self.ax.axvline(0, color=RED, lw=1)

    def set(self, found: Diagram, chosen: float, *, shown: str, label: str | None = None) -> Axes:
        """The axes, with the diagram in them; `label`, what is written across."""
        rows = getattr(found, SHOWN[shown])
        across = np.broadcast_to(found.values[:, None], rows.shape)
        self._dots.set_data(across.ravel(), rows.ravel())
        self._mark.set_xdata([chosen, chosen])
        self.ax.set(xlabel=label or axis_name(found.parameter, UNITS), ylabel=shown)
        self.ax.set_xlim(found.values[0], found.values[-1])
        _fit(self.ax, y=rows)
        return self.ax


def _fit(
    ax: Axes, *, x: np.ndarray | None = None, y: np.ndarray | None = None, least: float = 0.01
) -> None:
    """Limits around what is finite, a little wider; kept where they still suit."""
    for values, getter, setter in ((x, ax.get_xlim, ax.set_xlim), (y, ax.get_ylim, ax.set_ylim)):
        if values is None:
            continue
        values = values[np.isfinite(values)]
        if not values.size:
            continue
        low, high, (left, right) = float(values.min()), float(values.max()), getter()
        width = max(high - low, least)
        if left <= low and high <= right and width >= _FILLED * (right - left):
            continue
        setter(low - 0.1 * width, high + 0.1 * width)


def gif_of(motion: Motion, machine: AbstractMachine) -> bytes:
    """The machine moving through the cycles that are drawn of its motion, as a GIF."""
    evenly = seen_evenly(machine, motion.window.last)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "motion.gif"
        animate(motion.window, evenly, seconds=_SECONDS, fps=_FPS).save(path)
        return path.read_bytes()


def _packed(canvas: FigureCanvasAgg) -> bytes:
    """What is drawn, as PNG, packed in little time."""
    picture, out = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"), BytesIO()
    picture.save(out, "png", compress_level=1)
    return out.getvalue()
