"""The page's pictures. A motion's is SVG: written in milliseconds, sharp at any size."""

import html
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..machine import logged_turn, name_in, stops_of
from ..plot import BLUE, GREEN, RED, animate
from .subject import SHOWN, WINDOW, Diagram, Motion, observed_evenly

MAPS = ("section map", "impact map", "drive's speed")
"""The choices of the third picture of a motion."""

_STYLE = f"""
text {{ font: 13px "DejaVu Sans", sans-serif }} rect {{ fill: none }} .frame {{ stroke: black }}
path {{ fill: none; stroke-linecap: round; stroke-linejoin: round }} .behind {{ stroke: #e0e0e0 }}
.circle {{ stroke: gray }} .motion {{ stroke: {BLUE}; stroke-width: 1.5 }}
.stop {{ stroke: {GREEN}; stroke-width: 2.4 }} .section {{ stroke: {RED}; stroke-width: 4.2 }}
.multiplier {{ stroke: {BLUE}; stroke-width: 8 }}
"""

# Limits are kept while the data have this margin to them and fill this share of them. The least
# extent of data, as a share of their size, and of sections, as a share of their motion's. Choices.
_EDGE, _FILL, _LEAST, _WIDE = 0.02, 0.5, 0.001, 0.1

_EXPONENTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class _Panel:
    """One of the panels in a picture: its frame, its limits, and its drawings."""

    def __init__(self, left: int, top: int, width: int, height: int):
        self.corner, self.size = (left, top), (width, height)
        self.limits = [(0.0, 1.0), (0.0, 1.0)]
        self._drawn: list[str] = []

    def fit(self, axis: int, values: np.ndarray, *, least: float = 0.0) -> None:
        """Set limits around finite values, a little wider; keep them if they still suit."""
        values = values[np.abs(values) < 1e300]
        if not values.size:
            return
        low, high, (left, right) = float(values.min()), float(values.max()), self.limits[axis]
        width, middle = max(high - low, least, _LEAST * max(-low, high), 1e-12), (low + high) / 2
        edge, filled = _EDGE * (right - left), _FILL * (right - left)
        if low < left + edge or high > right - edge or width < filled:
            self.limits[axis] = middle - 0.6 * width, middle + 0.6 * width

    def draw(self, style: str, x: np.ndarray, y: np.ndarray, *, dots: bool = False) -> None:
        """Draw a line, with gaps at values that are not finite, or dots."""
        points = np.stack([self._pixels(0, x), self._pixels(1, y)], axis=-1)
        good = np.isfinite(points[:, 0] + points[:, 1])
        begins = good & ~np.append(False, good[:-1])
        text = "".join(
            f"M{x:.1f} {y:.1f}h.01" if dots else f"{'M' if first else 'L'}{x:.1f} {y:.1f}"
            for (x, y), first in zip(points[good].tolist(), begins[good].tolist(), strict=True)
        )
        self._drawn.append(f'<path class="{style}" d="{text}"/>')

    def _pixels(self, axis: int, values: np.ndarray) -> np.ndarray:
        low, high = self.limits[axis]
        share = (values - low) / (high - low)
        return self.size[axis] * (1 - share if axis else share)

    def framed(self, labels: Sequence[str], note: str = "") -> str:
        """Return the drawings in their frame, and begin anew."""
        (left, top), (width, height), middle = self.corner, self.size, 'text-anchor="middle"'
        drawn, self._drawn = "".join(self._drawn), []
        (across, x_label), (upwards, y_label) = (self._ticks(k, labels[k]) for k in (0, 1))
        ticks = [f'<path class="frame" d="M{x:.1f} {height}v4"/><text x="{x:.1f}" '
                 f'y="{height + 18}" {middle}>{word}</text>' for x, word in across]  # fmt: skip
        ticks += [f'<path class="frame" d="M0 {y:.1f}h-4"/><text x="-7" y="{y + 4.5:.1f}" '
                  f'text-anchor="end">{word}</text>' for y, word in upwards]  # fmt: skip
        return (
            f'<g transform="translate({left} {top})"><svg width="{width}" height="{height}">{drawn}'
            f'</svg>{"".join(ticks)}<text y="-8">{y_label}</text>'
            f'<text x="{width / 2}" y="{height + 36}" {middle}>{x_label}</text>'
            f'<text x="{width / 2}" y="{height / 2}" {middle} fill="gray">{note}</text>'
            f'<rect class="frame" width="{width}" height="{height}"/></g>'
        )

    def _ticks(self, axis: int, label: str) -> tuple[list[tuple[float, str]], str]:
        """Return positions and texts of the ticks, and the label with their common power of ten."""
        low, high = self.limits[axis]
        most = min(8, self.size[axis] // (48, 32)[axis])
        places = np.asarray(MaxNLocator(most, steps=[1, 2, 5, 10]).tick_values(low, high))
        places, size = places[(low <= places) & (places <= high)], max(abs(low), abs(high))
        power = 0 if 0.1 <= size < 1e5 else 3 * int(np.floor(np.log10(size) / 3))
        digits = max(5, int(np.log10(size / (high - low))) + 4)
        texts = [f"{x:.{digits}g}".replace("-", "−") for x in places / 10.0**power]
        label = html.escape(label) + (f" × 10{str(power).translate(_EXPONENTS)}" if power else "")
        return list(zip(self._pixels(axis, places), texts, strict=True)), label


class MotionPicture:
    """Four panels of a motion: its time history, phase portrait, map, and multipliers."""

    def __init__(self, labels: tuple[str, str]):
        """**Arguments:** `labels`, the machine's labels of position and velocity."""
        self._labels = labels
        self._history = _Panel(66, 28, 930, 200)
        lower = (_Panel(left, 312, 248, 200) for left in (66, 407, 748))
        self._portrait, self._map, self._circle = lower
        self._history.limits[0] = (0.0, WINDOW)
        self._circle.limits = [(-1.488, 1.488), (-1.2, 1.2)]  # for a round circle

    def draw(self, motion: Motion, which: str = MAPS[0]) -> bytes:
        """Return the picture of a motion as SVG; the map is `which` out of `MAPS`."""
        panels = (*self._motion(motion), self._mapped(motion, which), self._multipliers(motion))
        return (
            '<svg xmlns="http://www.w3.org/2000/svg" width="1008" height="560" '
            f'viewBox="0 0 1008 560"><style>{_STYLE}</style>'
            f'<rect width="1008" height="560" style="fill: white"/>{"".join(panels)}</svg>'
        ).encode()

    def _motion(self, motion: Motion) -> tuple[str, str]:
        history, portrait, path = self._history, self._portrait, motion.path
        places = [float(x.place) for x in stops_of(motion.machine) if x.coordinate == 0]
        history.fit(1, np.append(path.Y, places))
        portrait.fit(0, np.append(path.Y, places))
        portrait.fit(1, path.V)
        for place in places:
            history.draw("stop", np.array(history.limits[0]), np.repeat(place, 2))
            portrait.draw("stop", np.repeat(place, 2), np.array(portrait.limits[1]))
        history.draw("motion", path.cycles, path.Y)
        portrait.draw("motion", path.Y, path.V)
        portrait.draw("section", *motion.places, dots=True)
        return history.framed(("cycles", self._labels[0])), portrait.framed(self._labels)

    def _mapped(self, motion: Motion, which: str) -> str:
        panel, note = self._map, ""
        if which == MAPS[0]:
            x, y = motion.places
            names = [f"{name_in(label)} on the section" for label in self._labels]
            for axis, (low, high) in enumerate(self._portrait.limits):
                panel.fit(axis, motion.places[axis], least=_WIDE * (high - low))
        elif which == MAPS[1]:
            x, y = motion.impact_phase, motion.impact_speed
            names, note = ["phase of the impact", "speed before it"], "" if x.size else "no impact"
            panel.limits[0] = (0.0, float(logged_turn(motion.machine)))
            panel.fit(1, np.append(y, 0.0))
        else:
            y = motion.frequency_ratio
            x, names = np.arange(1.0, y.size + 1), ["cycle", "ζ of the cycle"]
            note = "" if np.isfinite(y).any() else "no drive"
            panel.limits[0] = (0.0, y.size + 1.0)
            panel.fit(1, y, least=0.02)
        panel.draw("section", x, y, dots=True)
        return panel.framed(names, note)

    def _multipliers(self, motion: Motion) -> str:
        panel, angle, mu = self._circle, np.linspace(0, 2 * np.pi, 129), motion.multipliers
        for x, y in ([0, 0], [-9, 9]), ([-9, 9], [0, 0]):
            panel.draw("behind", np.array(x), np.array(y))
        panel.draw("circle", np.cos(angle), np.sin(angle))
        panel.draw("multiplier", np.real(mu), np.imag(mu), dots=True)
        return panel.framed(("Re μ", "Im μ"), "" if mu.size else "no period")


def draw_diagram(found: Diagram, chosen: float, shown: str) -> Axes:
    """Return a bifurcation diagram, with the chosen value marked; `shown` is out of `SHOWN`."""
    figure = Figure(figsize=(11.2, 3.6), dpi=90)
    ax, rows = figure.add_axes((0.065, 0.14, 0.92, 0.84)), getattr(found, SHOWN[shown])
    ax.plot(found.values, rows, "o", color="0.15", ms=1.3, mew=0)
    ax.axvline(chosen, color=RED, lw=1)
    ax.set(xlabel=found.label, ylabel=shown, xlim=found.values[[0, -1]])
    return ax


def gif_of(motion: Motion) -> bytes:
    """Return an animation of the drawn cycles as a GIF, which takes seconds."""
    machine = observed_evenly(motion.machine, motion.window.last)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "motion.gif"
        animate(motion.window, machine, seconds=4, fps=15).save(path)
        return path.read_bytes()
