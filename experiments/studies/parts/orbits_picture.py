"""The picture of `all_orbits.py`, and the motions that it shows."""

from typing import Any

import numpy as np
import vi_jax as vi
from matplotlib import patheffects
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from vi_jax.plot.colors import STOP, color_of, paler


class Kind:
    """A motion, with the number of searches that led to it for each period asked for."""

    def __init__(self, orbit: vi.Orbit, counts: np.ndarray):
        self.orbit, self.counts = orbit, counts
        self.path = np.stack([np.asarray(orbit.sections.Y), np.asarray(orbit.sections.V)], axis=-1)

    @property
    def stable(self) -> bool:
        """Whether all multipliers lie within the unit circle."""
        return bool(self.orbit.stable)

    @property
    def size(self) -> float:
        """Modulus of the largest multiplier."""
        return float(abs(self.orbit.multipliers[0]))

    @property
    def color(self) -> str:
        """By its period and its impacts."""
        return color_of(len(self.path), float(self.orbit.impacts))


def picture(kinds: list[Kind], basin: np.ndarray, side: list[np.ndarray]) -> Figure:
    """The sections over the basins, and a phase portrait of each motion.

    **Arguments:** the motions; for each cell of the grid of starts the number of the motion at
    which it ends, or -1; the edges of the cells in Y and in V.
    """
    figure = Figure(figsize=(12.5, 6.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = np.ravel(figure.subfigures(1, 2, width_ratios=(1, 1.15), squeeze=False))
    axes = left.subplots(1, 1, squeeze=False)[0, 0]
    stable = [j for j, kind in enumerate(kinds) if kind.stable]
    pale = [paler(kinds[j].color, 0.45) for j in stable]
    axes.pcolormesh(
        *side,
        np.select([basin == j for j in stable], list(range(len(stable))), len(stable)),
        cmap=ListedColormap([*pale, "white"]), vmin=-0.5, vmax=len(stable) + 0.5,
    )  # fmt: skip
    (low, gap), (slowest, fastest) = ((edges[0], edges[-1]) for edges in side)
    axes.set(xlabel="Y = y/a at φ = π", ylabel="V = dY/dτ at φ = π (a ω)")
    axes.set(xlim=(low, gap + 0.2), ylim=(slowest, fastest))
    axes.axvline(gap, color=STOP, lw=1.8, label="stop")
    _sections(axes, kinds, gap)
    for j, color in zip(stable, pale, strict=True):
        axes.plot([], [], "s", ms=10, color=color, mec="0.6", label=f"basin of {chr(65 + j)}")
    axes.plot([], [], "s", ms=10, color="white", mec="0.6", label="none of these")
    axes.plot([], [], "o", color="w", mec="k", label="stable orbit")
    axes.plot([], [], "X", color="w", mec="k", label="unstable orbit")
    left.legend(loc="outside upper center", ncols=4, fontsize=9)
    _portraits(right, kinds)
    return figure


def _sections(axes: Any, kinds: list[Kind], gap: float) -> None:
    """Every section point, with its motion's letter where there is most room."""
    angles = np.arange(16) * np.pi / 8
    ways = 0.17 * np.stack([np.cos(angles), np.sin(angles)], axis=1) * (1, 1.5)
    taken = np.concatenate([kind.path for kind in kinds])
    for j, kind in enumerate(kinds):
        look = {"color": kind.color, "mec": "k", "mew": 0.7, "ms": 6 if kind.stable else 7}
        axes.plot(*kind.path.T, "o" if kind.stable else "X", **look)
        for point in kind.path:
            places = point + ways
            far = np.abs((places[:, None] - taken) / (1, 1.5)).max(axis=2)
            far = np.where(places[:, 0] > gap + 0.1, 0.0, far.min(axis=1))
            place = places[np.argmax(far)]
            taken = np.concatenate([taken, [place]])
            text = axes.text(*place, chr(65 + j), fontsize=10, ha="center", va="center")
            text.set_path_effects([patheffects.withStroke(linewidth=2.2, foreground="w")])


def _portraits(figure: Any, kinds: list[Kind]) -> None:
    """A panel for each motion."""
    panels = figure.subplots(-(-len(kinds) // 2), 2, sharex=True, sharey=True, squeeze=False)
    panels = panels.ravel()
    for j, (panel, kind) in enumerate(zip(panels, kinds, strict=False)):
        vi.plot_phase_portrait(
            kind.orbit.trajectory(), kind.orbit.machine, ax=panel, color=kind.color, lw=1.4,
            ls="-" if kind.stable else "--",
        )  # fmt: skip
        title = f"{chr(65 + j)}: {2 * len(kind.path)}π, |μ| = {kind.size:.3f}"
        panel.set_title(title, fontsize=10)
        panel.set(xlim=(-3.4, 1.4), ylim=(-4, 4), ylabel="V (a ω)")
        panel.label_outer()
    last = panels[-1]
    if len(kinds) < len(panels):  # an empty panel: the axis of its column, and what the lines are
        last.spines[["left", "right", "top"]].set_visible(False)
        last.tick_params(left=False)
        last.plot([], [], color="k", lw=1.4, label="stable")
        last.plot([], [], color="k", lw=1.4, ls="--", label="unstable")
        last.plot([], [], "ko", ms=4, label="at φ = π")
        last.plot([], [], color=STOP, lw=1.8, label="stop")
        last.legend(loc="center", ncols=2, fontsize=9, frameon=False)
    for panel in panels[-2:]:
        panel.set_xlabel("Y = y/a")
