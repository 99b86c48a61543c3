"""The page's pictures: figures made once, whose lines are given new numbers at each redraw.

Frames and labels take most of the time of drawing one; they are kept until the limits change.
"""

import tempfile
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from ..machine import logged_turn, name_in, stops_of
from ..plot import BLUE, GREEN, RED, animate
from .motion import WINDOW, Motion, seen_evenly
from .subject import SHOWN, Diagram

MAPS = ("section map", "impact map", "drive's speed")
"""What the third picture of a motion shows."""

# Dots per inch, and the look of lines behind: choices.
_DPI, _FAINT = 90, {"color": "0.88", "lw": 0.8, "zorder": 0}

# Of the motion's extent, the least that a map of its sections shows, so that sections that move a
# little need no new frame: a choice.
_WIDE = 0.3

# Limits are kept while what is drawn is within them and fills so much of them.
_FILLED = 0.5


class MotionPicture:
    """Four pictures of a motion in one: its time history, phase portrait, map, and multipliers."""

    def __init__(self, labels: tuple[str, str]):
        """**Arguments:** what the machine calls its position and its velocity."""
        self._names = tuple(map(name_in, labels))
        self.figure = Figure(figsize=(11.2, 6.6), dpi=_DPI)
        self._canvas = FigureCanvasAgg(self.figure)
        grid = self.figure.add_gridspec(
            2, 3, left=0.065, right=0.985, bottom=0.08, top=0.98, wspace=0.26, hspace=0.26
        )
        self._course = self.figure.add_subplot(grid[0, :])
        self._portrait, self._map, self._circle = (
            self.figure.add_subplot(grid[1, i]) for i in range(3)
        )
        self._course.set(xlabel="cycles", ylabel=labels[0], xlim=(0, WINDOW))
        self._portrait.set(xlabel=labels[0], ylabel=labels[1])
        self._lines = self._made_lines()
        look = {"ha": "center", "color": "0.4", "animated": True}
        self._notes = [
            ax.text(0.5, 0.45, "", transform=ax.transAxes, **look)
            for ax in (self._map, self._circle)
        ]
        self._drawn, self._frame = None, None

    def _made_lines(self) -> dict[str, Line2D]:
        lines = {}
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

    def draw(self, motion: Motion, which: str = MAPS[0]) -> bytes:
        """Return the picture of a motion, as PNG; the map is `which` out of `MAPS`."""
        self._set_motion(motion)
        self._set_map(motion, which)
        mu = motion.multipliers
        self._lines["multipliers"].set_data(np.real(mu), np.imag(mu))
        self._notes[1].set_text("" if mu.size else "no period")
        axes = (self._course, self._portrait, self._map)
        frame = [(ax.get_xlabel(), *ax.get_xlim(), *ax.get_ylim()) for ax in axes]
        if frame != self._drawn:
            self._canvas.draw()
            self._frame = self._canvas.copy_from_bbox(self.figure.bbox)
            self._drawn = frame
        self._canvas.restore_region(self._frame)
        for artist in (*self._lines.values(), *self._notes):
            self.figure.draw_artist(artist)
        picture = Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert("RGB")
        out = BytesIO()
        picture.save(out, "png", compress_level=1)
        return out.getvalue()

    def _set_motion(self, motion: Motion) -> None:
        lines, path = self._lines, motion.path
        stops = [stop for stop in stops_of(motion.machine) if stop.coordinate == 0]
        places = [float(stop.place) for stop in stops] or [np.nan]
        lines["course"].set_data(path.cycles, path.Y)
        lines["portrait"].set_data(path.Y, path.V)
        at, across = np.repeat(places, 3), np.tile([0.0, 1.0, np.nan], len(places))
        lines["course stop"].set_data(across, at)  # a line for each stop
        lines["portrait stop"].set_data(at, across)
        lines["sections"].set_data(*motion.places)
        _fit(self._course, y=np.append(path.Y, places))
        _fit(self._portrait, x=np.append(path.Y, places), y=path.V)

    def _set_map(self, motion: Motion, which: str) -> None:
        (Y, V), note = motion.places, ""
        if which == MAPS[0]:
            x, y, names = Y, V, [f"{name} on the section" for name in self._names]
            for values, drawn, way in ((Y, motion.path.Y, "x"), (V, motion.path.V, "y")):
                span = np.ptp(drawn[np.isfinite(drawn)]) if np.isfinite(drawn).any() else 0.0
                _fit(self._map, **{way: values}, least=max(_WIDE * float(span), 1e-12))
        elif which == MAPS[1]:
            x, y = motion.impact_phase, motion.impact_speed
            names, note = ["phase of the impact", "speed before it"], "" if x.size else "no impact"
            self._map.set_xlim(0, float(logged_turn(motion.machine)))
            _fit(self._map, y=np.append(y, 0.0))
        else:
            y = motion.frequency_ratio
            x, names = np.arange(1.0, y.size + 1), ["cycle", "ζ of the cycle"]
            note = "" if np.isfinite(y).any() else "no drive"
            self._map.set_xlim(0, y.size + 1)
            _fit(self._map, y=y, least=0.1)
        self._lines["map"].set_data(x, y)
        self._map.set(xlabel=names[0], ylabel=names[1])
        self._notes[0].set_text(note)


def draw_diagram(found: Diagram, chosen: float, shown: str) -> Axes:
    """A bifurcation diagram, with the chosen value marked; `shown`, out of `SHOWN`."""
    figure = Figure(figsize=(11.2, 3.6), dpi=_DPI)
    ax, rows = figure.add_axes((0.065, 0.14, 0.92, 0.84)), getattr(found, SHOWN[shown])
    ax.plot(found.values, rows, "o", color="0.15", ms=1.3, mew=0)
    ax.axvline(chosen, color=RED, lw=1)
    ax.set(xlabel=found.label, ylabel=shown, xlim=found.values[[0, -1]])
    return ax


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


def gif_of(motion: Motion) -> bytes:
    """The machine moving through the cycles that are drawn, as a GIF that takes seconds to make."""
    evenly = seen_evenly(motion.machine, motion.window.last)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "motion.gif"
        animate(motion.window, evenly, seconds=4, fps=15).save(path)
        return path.read_bytes()
