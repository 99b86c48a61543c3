"""The picture of Figure 2: closed forms, branches, sweeps, and the motions of the sweeps."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from vi_jax.plot import MORE_IMPACTS, STOP, color_of, mark_of, paler, plot_branch
from vi_jax.scans import REGIMES

from .discrepancy import between, rows
from .motions import GAP
from .response import RANGE, RESTITUTIONS, WALL, Response, System

# Arguments of `save_picture` for a small file.
LOOK = {"dpi": 72, "colors": 250}

# Line width of a closed form, which stays visible on both sides of lines on top of it.
_BAND = 7.0
# Circles for the run-up and dots for the close-down, as in the paper.
_UP: dict[str, Any] = {
    "marker": "o", "ls": "none", "color": "0.3", "mfc": "none", "ms": 3.8, "mew": 0.6, "zorder": 5
}  # fmt: skip
_DOWN: dict[str, Any] = {
    "marker": "o", "ls": "none", "color": "k", "mew": 0, "ms": 1.7, "zorder": 6
}  # fmt: skip


def draw_response(found: Response) -> Figure:
    """Draw Figure 2: above the whole range of ζ, undamped and damped; below from BB' to CC'."""
    titles = ["undamped, ξ = 0", f"Table 1, ξ = {found.systems[1].damping_ratio:.4f}"]
    figure = Figure(figsize=(15, 17.2))
    figure.set_layout_engine("constrained", w_pad=0.08)
    grid = figure.subplots(4, 2)
    colors = _colors(found)
    for column, k in enumerate(RESTITUTIONS):
        pair = found.systems[2 * column : 2 * column + 2]
        for row, (system, title) in enumerate(zip(pair, titles, strict=True)):
            _whole(grid[row, column], found, system)
            name = f"{'ab'[column]}) " if not row else ""
            grid[row, column].set_title(f"{name}k = {k:g}, d = 2, {title}", fontsize=12)
            _zoom(grid[2 + row, column], found.ratios, system, colors)
            grid[2 + row, column].set_title(f"k = {k:g}, {title}, enlarged", fontsize=11)
    for ax, row in zip(grid.T.ravel(), list(range(4)) * 2, strict=True):
        ax.grid(alpha=0.25, lw=0.5)
        ax.set_xlabel("frequency ratio ζ")
        ax.set_ylabel("min Y, max Y (a)" if row < 2 else "min Y (a)")
    lines: list[Any] = [
        Line2D([], [], color="0.4", lw=_BAND, alpha=0.35, label="closed form"),
        Line2D([], [], color="0.2", lw=1.4, label="continued: stable"),
        Line2D([], [], color="0.2", lw=1.4, ls="--", label="continued: unstable"),
        Line2D([], [], color="0.45", lw=1.4, ls="-.", label="free motion, ±1/|1 - ζ² + 2iξζ|"),
        Line2D([], [], color=STOP, lw=1.8, label="stop"),
        Line2D([], [], color="k", lw=1.0, ls=":", label="second stop of the paper's drawing?"),
        Line2D([], [], label="run-up", **{**_UP, "ms": 5}),
        Line2D([], [], label="close-down", **{**_DOWN, "ms": 3}),
        *(mark_of(kind) for kind in ("period-doubling", "fold", "grazing")),
    ]
    look: dict[str, Any] = {"frameon": False, "fontsize": 10, "alignment": "left"}
    figure.legend(handles=lines, loc="outside lower left", ncols=4, title="lines and marks", **look)
    motions = [Patch(color=color, label=name) for name, color in colors.items()]
    figure.legend(
        handles=motions, loc="outside lower right", ncols=3, title="colours: motions", **look
    )
    figure.suptitle(
        "Fig. 2 of the paper: ideal drive, Δ = 2a. Strips: what the sweeps settle on", fontsize=14
    )
    return figure


def _colors(found: Response) -> dict[str, str]:
    """Return a colour for each kind of motion in the strips; rare kinds share one."""
    fixed = {
        "2π, 1 impact": color_of(1, 1),
        "4π, 1 impact": color_of(2, 1),
        "4π, 2 impacts": MORE_IMPACTS,
        "4π, 3 impacts": paler(MORE_IMPACTS, 0.6),
        "6π, 2 impacts": color_of(3),
        "8π, 4 impacts": color_of(4),
        "8π, 5 impacts": paler(color_of(4), 0.55),
        "other period": color_of(9),
        "chaotic": color_of(REGIMES.chaotic),
        "no period found": color_of(REGIMES.unsettled),
    }
    names = set()
    for system in found.systems:
        for name in system.sweeps:
            names |= {r.motion for r in rows(system, name, between(system, found.ratios))}
    if names - set(fixed):
        names.add("other period")
    names |= {"2π, 1 impact", "4π, 1 impact", "4π, 2 impacts"}  # of the lines
    return {name: color for name, color in fixed.items() if name in names}


def _closed_curves(ax: Axes, ratios: np.ndarray, system: System) -> None:
    for n in (2, 1):
        form = system.closed[n]
        for i in range(2):
            y_min = np.where(form.admissible[:, i], form.y_min[:, i], np.nan)
            ax.plot(
                ratios, y_min, color=color_of(n, 1), lw=_BAND, alpha=0.35,
                solid_capstyle="butt", zorder=1.5,
            )  # fmt: skip


def _sweep_marks(ax: Axes, ratios: np.ndarray, system: System, name: str = "y_min") -> None:
    """Draw circles for the run-up and dots for the close-down, as in the paper."""
    up, down = (np.asarray(getattr(system.sweeps[s], name)) for s in ("run-up", "close-down"))
    ax.plot(ratios, up, **_UP)
    ax.plot(ratios, down, **_DOWN)


def _free(ax: Axes, system: System) -> None:
    """Draw the motion without impacts, also for ζ at which it would pass the stop."""
    zeta = np.linspace(*RANGE, 1401)
    free = 1 / np.abs(1 - zeta**2 + 2j * system.damping_ratio * zeta + 1e-300)
    for sign in (-1, 1):
        ax.plot(zeta, sign * free, color="0.45", lw=1.4, ls="-.", zorder=1)


def _lines(ax: Axes, system: System) -> None:
    """Draw the lines BB' and CC', and their names."""
    for letter, place in zip("BC", system.stretch, strict=True):
        ax.axvline(place, color="0.25", lw=1.0, ls=(0, (6, 3)))
        ax.text(
            place, 0.985, f" {letter}{letter}'", transform=ax.get_xaxis_transform(), va="top",
            fontsize=10,
        )  # fmt: skip


def _whole(ax: Axes, found: Response, system: System) -> None:
    _closed_curves(ax, found.ratios, system)
    _free(ax, system)
    for branch in system.branches:
        plot_branch(branch, ax=ax, special=False, legend=False, lw=1.4)
    _sweep_marks(ax, found.ratios, system)
    _sweep_marks(ax, found.ratios, system, "y_max")
    ax.axhline(GAP, color=STOP, lw=1.6)
    ax.axhline(WALL, color="k", lw=1.0, ls=":")
    ax.text(0.51, WALL + 0.06, "a stop here?", fontsize=8.5)
    _lines(ax, system)
    ax.set_xlim(*RANGE)
    ax.set_ylim(min(float(b.y_min.min()) for b in system.branches) - 0.3, 2.7)


def _zoom(
    ax: Axes,
    ratios: np.ndarray,
    system: System,
    colors: dict[str, str],
) -> None:
    """Draw the range from BB' to CC', with a strip of the motions' colours for each sweep.

    **Arguments:** `ratios`, the values of ζ; `colors` of the motions by name.
    """
    _closed_curves(ax, ratios, system)
    _free(ax, system)
    for branch in system.branches:
        plot_branch(branch, ax=ax, legend=False, lw=1.5)
    _sweep_marks(ax, ratios, system)
    ax.axhline(WALL, color="k", lw=1.0, ls=":")
    ax.text(0.658, WALL + 0.05, "a stop here?", fontsize=8.5)
    _lines(ax, system)
    ax.set_xlim(0.655, 1.01)
    ax.set_ylim(-4.45, -1.0)
    for y, name in ((-4.32, "run-up"), (-4.12, "close-down")):
        for row in rows(system, name, between(system, ratios)):
            color = colors.get(row.motion, colors.get("other period", "0.5"))
            ends = _edges(ratios, row.part)
            ax.fill_between(ends, y - 0.09, y + 0.09, color=color, lw=0)
            _name(ax, sum(ends) / 2, y, row.motion, ends[1] - ends[0], color)
        ax.text(0.704, y, name, ha="right", va="center", fontsize=8.5)


def _name(ax: Axes, x: float, y: float, motion: str, width: float, color: str) -> None:
    """Write a strip's motion, or only its period if the strip is too narrow.

    **Arguments:** `x` and `y`, the strip's middle; its `width`; `color` behind the text.
    """
    dark = np.dot(to_rgb(color), (0.3, 0.59, 0.11)) < 0.55
    for name in (motion, motion.partition(",")[0]):
        if width > 0.0026 * len(name):
            look = {"ha": "center", "va": "center", "fontsize": 8, "zorder": 7}
            ax.text(x, y, name, color="w" if dark else "k", **look)
            return


def _edges(ratios: np.ndarray, part: np.ndarray) -> tuple[float, float]:
    """Return the ends of a row's strip, half a step beyond its values."""
    half = np.gradient(ratios) / 2
    first, last = part[0], part[-1]
    return float(ratios[first] - half[first]), float(ratios[last] + half[last])
