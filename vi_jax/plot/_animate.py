"""Animations: a machine in motion above its time history."""

from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import animation
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .._checks import count, flag, given_number, instance_of
from ..flow import Run
from ..machine import AbstractMachine, logged_turn, phase_at, stops_of, without_turns
from ..orbit import Orbit
from .colors import BLUE, RED
from .motion import counts_by_angle, drawn_path, motion_path, plot_history, turns
from .schematic import pen_for, sketch

# Samples of a cycle of an orbit; seconds per cycle, and at most in all.
_SAMPLES, _SECONDS_PER_CYCLE, _LONGEST = 128, 2.5, 12.0
# Frames from which the limits of the drawing are computed.
_LIMIT_FRAMES = 12
# Inches: the width of a figure, and the height of the time history.
_WIDTH, _LOWER = 7.2, 2.1
# The largest size of the pictures in an HTML file, MB.
_MOST = 50.0


class _Frames(NamedTuple):
    """The data of all frames as rows: cycles, states, and positions by coordinate."""

    cycles: np.ndarray
    states: Any
    positions: np.ndarray


def animate(
    motion: Run | Orbit,
    machine: AbstractMachine | None = None,
    *,
    window: tuple[float | int, float | int] | None = None,
    seconds: float | int | None = None,
    fps: int = 25,
    history: bool = True,
    figure: Figure | None = None,
) -> "MotionAnimation":
    """Animate a motion: the machine moves above its time history.

    A notebook shows the result; `animation.save("motion.gif")` writes a file.

    **Arguments:**

    - `motion`: a `Run` simulated with `samples=...` (and `impact_log=...`, for exact corners at
      impacts), or an `Orbit`, of which one period is drawn.
    - `machine`: the machine; needed for a run, and left out for an orbit, which contains it. For
      the drawing, see `plot_sketch`.
    - `window`: the first and the last cycle to draw.
    - `seconds`: the duration; by default 2.5 s per cycle, up to 12 s.
    - `fps`: frames per second.
    - `history`: whether to draw the time history below.
    - `figure`: an empty figure to draw into, one of pyplot's for a window; by default a new one.

    **Returns:** a `MotionAnimation`, a subclass of matplotlib's `FuncAnimation`.

    **Raises:** `TypeError` if `motion` is not a motion; `ValueError` for a motion without samples,
    a batch, a failed motion, or numbers out of range.
    """
    instance_of("motion", motion, (Run, Orbit), "a `Run` or an `Orbit`")
    fps = count("fps", fps, least=1, most=100)
    history = flag("history", history)
    if isinstance(motion, Orbit):
        if machine is not None:
            raise ValueError("Argument `machine` must be left out: an orbit has its own.")
        if not motion.residual.ndim and not bool(motion.successful):
            raise ValueError(
                "Argument `motion` is an orbit whose search failed. Pass an orbit that was found."
            )
        machine, motion = motion.machine, motion.trajectory(samples=_SAMPLES)
    if machine is None:
        raise ValueError("Argument `machine` must be given for a `Run`: it is drawn.")
    instance_of("machine", machine, AbstractMachine, "a `Scene` or an `AbstractMachine`")
    path = motion_path(motion, machine=machine, window=window)
    good = np.isfinite(path.Y)
    if np.sum(good) < 2:
        raise ValueError(
            "Argument `motion` must have two samples at least within the window that are numbers, "
            f"but has {int(np.sum(good))}."
        )
    shown = float(np.ptp(path.cycles[good]))
    if seconds is None:
        seconds = min(_LONGEST, _SECONDS_PER_CYCLE * shown)
    seconds = given_number("seconds", seconds, low=0.0, high=3600.0, open_low=True)
    frames = _frames(motion, machine, path, good, max(2, ceil(seconds * fps)))
    return MotionAnimation(figure, machine, motion, frames, fps, history)


def _frames(
    run: Run, machine: AbstractMachine, path: Any, good: np.ndarray, number: int
) -> _Frames:
    """Return frames evenly spaced in time, interpolated between the points that are `good`."""
    samples = run.samples
    assert samples is not None
    cycles, time = (np.asarray(x, float) for x in (samples.cycles, samples.time))
    inside = np.isfinite(time)
    low, high = path.cycles[good][[0, -1]]
    ends = np.interp([low, high], cycles[inside], time[inside])
    frame_cycles = np.interp(np.linspace(ends[0], ends[1], number), time[inside], cycles[inside])

    def between(x: object) -> np.ndarray:
        x = np.asarray(x, float)[inside]
        rows = [np.interp(frame_cycles, cycles[inside], row) for row in x.reshape(len(x), -1).T]
        return np.stack(rows, axis=-1).reshape(-1, *x.shape[1:])

    states = jax.tree_util.tree_map(between, samples.state)
    # The corners of the paths at impacts, which samples do not contain.
    for k in sorted({0, *(stop.coordinate for stop in stops_of(machine))}):
        line = motion_path(run, machine=machine, coordinate=k)
        known = np.isfinite(line.Y)
        Y, V = (np.interp(frame_cycles, line.cycles[known], x[known]) for x in (line.Y, line.V))
        states = jax.vmap(machine.coordinates[k].placed)(states, Y, V)
    places = [np.asarray(jax.vmap(c.position)(states), float) for c in machine.coordinates]
    return _Frames(frame_cycles, states, np.stack(places))


class MotionAnimation(animation.FuncAnimation):
    """An animation of a motion, from `animate`.

    A notebook shows it, `save` writes it to a file, and `draw(i)` returns one frame.
    """

    def __init__(
        self, figure: Figure | None, machine: AbstractMachine, run: Run, frames: _Frames, fps: int,
        history: bool,
    ):  # fmt: skip
        self.fps = fps
        """Frames per second."""
        self._machine, self._frames = machine, frames
        self._drawing = Figure().subplots()
        self._limits = self._limits_of_frames()
        (left, right), (low, high) = self._limits
        height = float(np.clip(_WIDTH * (high - low) / (right - left), 1.2, 4.2))
        if figure is None:
            figure = Figure(figsize=(_WIDTH, height + _LOWER * history), dpi=100)
            FigureCanvasAgg(figure)
        rows = figure.subplots(1 + history, 1, height_ratios=(height, 1.3)[: 1 + history])
        self._figure = figure
        self._drawing, *below = np.atleast_1d(rows)
        figure.subplots_adjust(left=0.09, right=0.98, top=0.98, bottom=0.55 / (height + _LOWER))
        if not history:
            figure.subplots_adjust(bottom=0.02)
        self._history = _History(below[0], run, machine, frames) if history else None
        super().__init__(
            figure, self._draw, frames=len(frames.cycles), interval=1000 / fps, repeat=True
        )
        # No warning of matplotlib of an animation that is never shown.
        self._draw_was_started = True

    def __len__(self) -> int:
        return len(self._frames.cycles)

    def draw(self, index: int) -> Figure:
        """Return the figure at one frame, a still picture."""
        self._draw(range(len(self))[index])
        return self._figure

    def _draw(self, index: int) -> list[Any]:
        ax = self._drawing
        ax.clear()
        self._draw_machine(index)
        ax.axis("off")
        ax.set_aspect("equal")
        (left, right), (low, high) = self._limits
        ax.set(xlim=(left, right), ylim=(low, high))
        if self._history is not None:
            self._history.move(index)
        return []

    def _draw_machine(self, index: int) -> None:
        machine, frames = self._machine, self._frames
        state = jax.tree_util.tree_map(lambda x: jnp.asarray(x[index]), frames.states)
        turn = float(logged_turn(machine))
        phase = float(phase_at(machine, (frames.cycles[index] % 1.0) * turn))
        sketch(machine, pen_for(machine, self._drawing, frames.positions), state, phase)

    def _limits_of_frames(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the limits of all frames, so that the picture does not move."""
        places = self._frames.positions
        number = places.shape[1]
        chosen = {int(f(row)) for row in places for f in (np.argmin, np.argmax)}
        chosen |= {int(i) for i in np.linspace(0, number - 1, _LIMIT_FRAMES)}
        for index in sorted(chosen):
            self._draw_machine(index)
        box = self._drawing.dataLim
        width, height = 0.04 * box.width, 0.06 * box.height
        self._drawing.clear()
        return (box.x0 - width, box.x1 + width), (box.y0 - height, box.y1 + height)

    def _repr_html_(self) -> str:
        return self.to_jshtml(fps=self.fps)

    def save(self, filename: str | Path, writer: Any = None, **options: Any) -> None:  # pyright: ignore
        """Write a file by one of matplotlib's writers.

        **Arguments:** `filename`; `writer`, by default Pillow for a `.gif`, an HTML page for an
        `.html`, and ffmpeg, if installed, for others; options of `Animation.save`.
        """
        kinds = {".gif": animation.PillowWriter, ".html": animation.HTMLWriter}
        kind = kinds.get(Path(filename).suffix)
        if writer is None and kind is not None:
            embed = {"embed_frames": True, "embed_limit": _MOST} if kind is kinds[".html"] else {}
            writer = kind(fps=self.fps, **embed)
        super().save(filename, "ffmpeg" if writer is None else writer, **options)


class _History:
    """The time history, with the past part drawn over it."""

    def __init__(self, ax: Axes, run: Run, machine: AbstractMachine, frames: _Frames):
        unit = "angle" if counts_by_angle(machine) else "cycles"
        ends = float(frames.cycles[0]), float(frames.cycles[-1])
        window = ends[0] - 1e-9, ends[1] + 1e-9
        plot_history(run, machine=machine, ax=ax, window=window, unit=unit, color="0.75", lw=1.2)
        self._factor = 2.0 if unit == "angle" else 1.0
        path = drawn_path(run, machine=machine, window=window, coordinate=0)
        self._x, self._Y = self._factor * path.cycles, path.Y
        self._frames, self._dots = frames, frames.positions[0]
        if turns(run, machine, 0):
            self._dots = without_turns(self._dots)
        (self._line,) = ax.plot([], [], color=BLUE, lw=1.6)
        (self._dot,) = ax.plot([], [], "o", color=RED, ms=6, zorder=5)
        ax.set_xlim(self._factor * ends[0], self._factor * ends[1])
        ax.spines[["top", "right"]].set_visible(False)

    def move(self, index: int) -> None:
        """Draw the motion up to the frame with this index."""
        place, Y = self._factor * self._frames.cycles[index], self._dots[index]
        passed = self._x <= place
        self._line.set_data([*self._x[passed], place], [*self._Y[passed], Y])
        self._dot.set_data([place], [Y])
