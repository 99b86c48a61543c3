"""Drawing of Figures 3 and 4: three panels each, the undamped system above the damped one."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tools.pictures import legend_below, panels, save_picture
from vi_jax.flow import Run
from vi_jax.plot import STOP, angle_axis, color_of, motion_path, plot_history

from .motions import Case

# The colour of a simulated motion is neutral, because the picture is to show its regime.
_INK = "0.2"


def draw_figure(number: int, cases: tuple[Case, Case], path: Path) -> None:
    """Draw Figure 3 (from rest) or 4 (from the 4π state) of the paper into a PNG file."""
    figure, grid = panels(14, 8.4, 2, 3, w_pad=0.08, sharey=True)
    for row, case in zip(grid, cases, strict=True):
        _draw_row(number, case, list(row))
    begins = "from rest (Y = V = 0)" if number == 3 else "from the 4π state fitted by optax"
    figure.suptitle(
        f"Fig. {number} of the paper: ζ = 0.90, k = 0.50, Δ = 2a, ideal drive, {begins}",
        fontsize=13,
    )
    common_legend(figure, grid[0, :2], 7)  # the undamped panels have every curve
    save_picture(figure, path, colors=64)


def common_legend(figure: Figure, axes: np.ndarray, columns: int) -> None:
    """Draw one legend below the figure with the entries of all these axes."""
    handles = [handle for ax in axes for handle in ax.get_legend_handles_labels()[0]]
    legend_below(figure, handles, columns, fontsize=11)


def _draw_row(number: int, case: Case, axes: list[Axes]) -> None:
    run = case.from_rest if number == 3 else case.from_fit
    cycles = run.impacts.shape[0]
    ratio = float(case.scene.damping_ratio)
    named = "undamped, ξ = 0" if case.name == "undamped" else f"Table 1, ξ = {ratio:.4f}"
    _panel(axes[0], number, case, run, (0, 2))
    _whole(axes[1], case, run)
    _panel(axes[2], number, case, run, (cycles - 4, cycles))
    titles = "a) first 4π", f"b) all {cycles} cycles", "c) last 8π"
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(f"{title}   ({named})", fontsize=11)
        ax.grid(alpha=0.25, lw=0.5)
        ax.set_ylim(-3.7, 2.6)
    for ax in axes[1:]:
        ax.set_ylabel("")
    if not case.long_exists:
        over = -float(case.long.clearance[0])
        note = f"no 4π closed form:\nit would pass the stop by {over:.2g}a"
        if number == 4:
            note += "\n(started from the undamped 4π state)"
        axes[0].text(0.03, 0.04, note, transform=axes[0].transAxes, fontsize=9, color="0.3")


def _forms(case: Case) -> list[tuple[int, Run, dict[str, Any]]]:
    """Return the period, the run and the look of each closed form."""
    forms = [(1, case.on_short, (4, 2))] + [(2, case.from_long, (5, 3))] * case.long_exists
    return [(n, run, {"color": color_of(n, 1), "dashes": dashes}) for n, run, dashes in forms]


def _panel(ax: Axes, number: int, case: Case, run: Run, window: tuple[int, int]) -> None:
    """Draw the cycles of a window of the run with the closed forms on top."""
    plot_history(
        run, machine=case.scene, ax=ax, window=window, stops=False, lw=3.2,
        color=_INK, alpha=0.55, label="simulation",
    )  # fmt: skip
    for period, form, look in _forms(case):
        # In Figure 4 the run starts on the section of the closed form.
        shift = case.long_shift if number == 3 and period == 2 else 0
        # The path of one period, repeated over the window.
        one = motion_path(form, machine=case.scene, window=(0, period))
        begin = window[0] - window[0] % period - 2 * period + shift
        starts = np.arange(begin, window[1] + period, period)
        place = (one.cycles + starts[:, None]).ravel()
        keep = (place >= window[0]) & (place <= window[1])
        Y = np.tile(one.Y, len(starts))[keep]
        ax.plot(2 * place[keep], Y, lw=1.8, label=f"{2 * period}π closed form", **look)
    _stop(ax, case, label=True)
    angle_axis(ax, every=1 if window[1] - window[0] < 3 else 2)
    ax.set_xlim(2 * window[0], 2 * window[1])


def _whole(ax: Axes, case: Case, run: Run) -> None:
    """Draw the smallest Y of each cycle of the run, with those of the closed forms as levels."""
    cycle = np.arange(run.impacts.shape[0]) + 0.5
    dots = {"ls": "none", "ms": 4.5, "mew": 0, "color": _INK, "alpha": 0.55}
    ax.plot(cycle, np.asarray(run.y_min), "o", label="simulation: smallest Y of each cycle", **dots)
    for period, form, look in _forms(case):
        for Y in np.asarray(form.y_min)[:period]:
            ax.axhline(float(Y), lw=1.4, zorder=3, **look)
    _stop(ax, case)
    ax.set_xlabel("drive cycles φ/(2π)")
    ax.set_xlim(0, run.impacts.shape[0])


def _stop(ax: Axes, case: Case, *, label: bool = False) -> None:
    name = "stop, Y = 2" if label else None
    ax.axhline(float(case.scene.stops[0].gap), color=STOP, lw=1.8, label=name)
