"""The picture of Figure 2: closed forms, branches, sweeps, and the motions of the sweeps."""

from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from tools.pictures import panels
from vi_jax.plot import MORE_IMPACTS, STOP, color_of, mark_of, paler, plot_branch
from vi_jax.scans import REGIMES

from .motions import GAP
from .response import DIRECTIONS, RANGE, RESTITUTIONS, WALL, Response, System

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


def draw_response(found: Response, described: list[dict]) -> Figure:
    """Draw Figure 2: above the whole range of ζ, undamped and damped; below from BB' to CC'."""
    titles = ["undamped, ξ = 0", f"Table 1, ξ = {found.systems[1].damping_ratio:.4f}"]
    figure, grid = panels(15, 17.2, 4, 2, w_pad=0.08)
    colors = _colors(described)
    for column, k in enumerate(RESTITUTIONS):
        for row, title in enumerate(titles):
            system, panel = found.systems[2 * column + row], described[2 * column + row]
            _whole(grid[row, column], found, system)
            name = f"{'ab'[column]}) " if not row else ""
            grid[row, column].set_title(f"{name}k = {k:g}, d = 2, {title}", fontsize=12)
            _zoom(grid[2 + row, column], found.ratios, system, panel, colors)
            grid[2 + row, column].set_title(f"k = {k:g}, {title}, enlarged", fontsize=11)
    for ax, row in zip(grid.T.ravel(), list(range(4)) * 2, strict=True):
        ax.grid(alpha=0.25, lw=0.5)
        ax.set_xlabel("frequency ratio ζ")
        ax.set_ylabel("min Y, max Y (a)" if row < 2 else "min Y (a)")
    line = partial(Line2D, [], [])
    lines: list[Any] = [
        line(color="0.4", lw=_BAND, alpha=0.35, label="closed form"),
        line(color="0.2", lw=1.4, label="continued: stable"),
        line(color="0.2", lw=1.4, ls="--", label="continued: unstable"),
        line(color="0.45", lw=1.4, ls="-.", label="free motion, ±1/|1 - ζ² + 2iξζ|"),
        line(color=STOP, lw=1.8, label="stop"),
        line(color="k", lw=1.0, ls=":", label="second stop of the paper's drawing?"),
        line(label="run-up", **{**_UP, "ms": 5}),
        line(label="close-down", **{**_DOWN, "ms": 3}),
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


def _colors(panels: list[dict]) -> dict[str, str]:
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
    sweeps = [at for panel in panels for at in panel["sweeps"].values()]
    names = {motion["motion"] for at in sweeps for motion in at["motions"]}
    if names - set(fixed):
        names.add("other period")
    names |= {"2π, 1 impact", "4π, 1 impact", "4π, 2 impacts"}  # of the lines
    return {name: color for name, color in fixed.items() if name in names}


def _curves(
    ax: Axes, ratios: np.ndarray, system: System, name_at: tuple[float, float], **look: Any
) -> None:
    """Draw the curves of one system and its sweeps' least Y, the lines BB' and CC', and the wall
    with its name at some ζ and Y."""
    for n in (2, 1):
        form = system.closed[n]
        for i in range(2):
            y_min = np.where(form.admissible[:, i], form.y_min[:, i], np.nan)
            ax.plot(
                ratios, y_min, color=color_of(n, 1), lw=_BAND, alpha=0.35,
                solid_capstyle="butt", zorder=1.5,
            )  # fmt: skip
    # The motion without impacts, also for ζ at which it would pass the stop.
    zeta = np.linspace(*RANGE, 1401)
    free = 1 / np.abs(1 - zeta**2 + 2j * system.damping_ratio * zeta + 1e-300)
    for sign in (-1, 1):
        ax.plot(zeta, sign * free, color="0.45", lw=1.4, ls="-.", zorder=1)
    for branch in system.branches:
        plot_branch(branch, ax=ax, legend=False, **look)
    _sweep_marks(ax, ratios, system, "y_min")
    ax.axhline(GAP, color=STOP, lw=1.6)
    ax.axhline(WALL, color="k", lw=1.0, ls=":")
    ax.text(*name_at, "a stop here?", fontsize=8.5)
    for letter, line in zip("BC", system.stretch, strict=True):
        ax.axvline(line, color="0.25", lw=1.0, ls=(0, (6, 3)))
        ax.text(
            line, 0.985, f" {letter}{letter}'", transform=ax.get_xaxis_transform(), va="top",
            fontsize=10,
        )  # fmt: skip


def _sweep_marks(ax: Axes, ratios: np.ndarray, system: System, name: str) -> None:
    """Draw circles for the run-up and dots for the close-down, as in the paper."""
    for sweep, look in zip(DIRECTIONS, (_UP, _DOWN), strict=True):
        ax.plot(ratios, np.asarray(getattr(system.sweeps[sweep], name)), **look)


def _whole(ax: Axes, found: Response, system: System) -> None:
    _curves(ax, found.ratios, system, (0.51, WALL + 0.06), special=False, lw=1.4)
    _sweep_marks(ax, found.ratios, system, "y_max")
    ax.set_xlim(*RANGE)
    ax.set_ylim(min(float(b.y_min.min()) for b in system.branches) - 0.3, 2.7)


def _zoom(
    ax: Axes, ratios: np.ndarray, system: System, panel: dict, colors: dict[str, str]
) -> None:
    """Draw the range from BB' to CC', with a strip of the motions' colours for each sweep."""
    _curves(ax, ratios, system, (0.658, WALL + 0.05), lw=1.5)
    ax.set_xlim(0.655, 1.01)
    ax.set_ylim(-4.45, -1.0)
    half = np.gradient(ratios) / 2  # a strip ends half a step beyond its values
    for y, name in zip((-4.32, -4.12), DIRECTIONS, strict=True):
        for x in panel["sweeps"][name]["motions"]:
            color = colors.get(x["motion"], colors.get("other period", "0.5"))
            first = x["from"] - float(np.interp(x["from"], ratios, half))
            last = x["to"] + float(np.interp(x["to"], ratios, half))
            ax.fill_between((first, last), y - 0.09, y + 0.09, color=color, lw=0)
            _name(ax, (first + last) / 2, y, x["motion"], last - first, color)
        ax.text(0.704, y, name, ha="right", va="center", fontsize=8.5)


def _name(ax: Axes, x: float, y: float, motion: str, width: float, color: str) -> None:
    """Write a strip's motion at its middle, or only its period if the strip is too narrow."""
    dark = np.dot(to_rgb(color), (0.3, 0.59, 0.11)) < 0.55
    for name in (motion, motion.partition(",")[0]):
        if width > 0.0026 * len(name):
            look = {"ha": "center", "va": "center", "fontsize": 8, "zorder": 7}
            ax.text(x, y, name, color="w" if dark else "k", **look)
            return
