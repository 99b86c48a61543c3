"""Draws Figures 3 and 4: three panels each, the undamped system above the damped one."""

import json
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..flow import Run
from ..plot import motion_path, plot_history, save_picture
from ..plot.motion import GREEN, PINK, RED, angle_axis
from ..plot.stamp import stamp
from .motions import Case

_DPI = 110

# Under this name a picture keeps what it shows.
DRAWN = "vi_jax numbers drawn"


def draw_figure(number: int, cases: tuple[Case, Case], path: Path) -> None:
    """Draw Figure 3 (from rest) or 4 (from the 4π state) of the paper into a PNG file.

    **Arguments:** 3 or 4; the undamped and the damped case; the file to write.
    """
    if number not in (3, 4):
        raise ValueError(f"Argument `number` must be 3 or 4, but got {number!r}.")
    figure = Figure(figsize=(14, 8.4), dpi=_DPI)
    figure.set_layout_engine("constrained", w_pad=0.08)
    grid = figure.subplots(2, 3, sharey=True)
    for row, case in zip(grid, cases, strict=True):
        _draw_row(number, case, list(row))
    figure.suptitle(_title(number), fontsize=13)
    # An undamped panel has every curve.
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=11)
    save_picture(figure, path, dpi=_DPI, colors=64)
    stamp(path, DRAWN, json.dumps(drawn_numbers(number, cases)))


def drawn_numbers(number: int, cases: tuple[Case, Case]) -> dict[str, list[float]]:
    """What tells a picture of other numbers: minima of the first cycles and of the closed forms."""
    numbers = {}
    for case in cases:
        run = case.from_rest if number == 3 else case.from_fit
        minima = np.asarray(run.y_min)[:40].tolist()
        numbers[case.name] = [*minima, float(case.short.y_min[0]), float(case.long.y_min[0])]
    return numbers


def _title(number: int) -> str:
    begins = "from rest (Y = V = 0)" if number == 3 else "from the 4π state fitted by optax"
    return f"Fig. {number} of the paper: ζ = 0.90, k = 0.50, Δ = 2a, ideal drive, {begins}"


def _draw_row(number: int, case: Case, axes: list[Axes]) -> None:
    run = case.from_rest if number == 3 else case.from_fit
    cycles = run.impacts.shape[0]
    ratio = float(case.scene.damping_ratio)
    named = "undamped, ξ = 0" if case.name == "undamped" else f"Table 1, ξ = {ratio:.4f}"
    _panel(axes[0], number, case, run, (0, 2))
    _whole(axes[1], case, run)
    _panel(axes[2], number, case, run, (cycles - 4, cycles))
    for letter, ax, what in zip(
        "abc", axes, ("first 4π", f"all {cycles} cycles", "last 8π"), strict=True
    ):
        ax.set_title(f"{letter}) {what}   ({named})", fontsize=11)
        ax.grid(alpha=0.25, lw=0.5)
        ax.set_ylim(-3.7, 2.6)
        if letter != "a":
            ax.set_ylabel("")
    if not case.long_exists:
        over = -float(case.long.clearance[0])
        note = f"no 4π closed form:\nit would pass the stop by {over:.2g}a"
        if number == 4:
            note += "\n(started from the undamped 4π state)"
        axes[0].text(0.03, 0.04, note, transform=axes[0].transAxes, fontsize=9, color="0.3")


def _panel(ax: Axes, number: int, case: Case, run: Run, window: tuple[int, int]) -> None:
    """A few cycles of the run with the closed forms on top."""
    plot_history(
        run, scene=case.scene, ax=ax, window=window, stops=False, lw=2.4, alpha=0.75,
        label="simulation",
    )  # fmt: skip
    for period, color, dash in ((1, RED, (4, 2)), (2, PINK, (5, 3))):
        if period == 2 and not case.long_exists:
            continue
        # In Figure 4 the run starts on the closed form's own section.
        shift = case.long_shift if number == 3 and period == 2 else 0
        place, Y = _tiled(case, period, shift, window)
        ax.plot(2 * place, Y, color=color, lw=1.6, dashes=dash, label=f"{2 * period}π closed form")
    _stop(ax, case)
    angle_axis(ax, every=1 if window[1] - window[0] < 3 else 2)
    ax.set_xlim(2 * window[0], 2 * window[1])


def _tiled(
    case: Case, period: int, shift: int, window: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """A closed form over the cycles of a window, corners at the impacts included."""
    run = case.on_short if period == 1 else case.from_long
    one = motion_path(run, scene=case.scene, window=(0, period))
    starts = range(window[0] - 2 * period + shift % period, window[1] + period)
    starts = [start for start in starts if (start - shift) % period == 0]
    place = np.concatenate([one.cycles + start for start in starts])
    Y = np.tile(one.Y, len(starts))
    keep = (place >= window[0]) & (place <= window[1])
    return place[keep], Y[keep]


def _whole(ax: Axes, case: Case, run: Run) -> None:
    """The whole run, with the smallest Y of the closed forms as levels."""
    plot_history(run, scene=case.scene, ax=ax, unit="cycles", stops=False, lw=0.5)
    ax.axhline(float(case.short.y_min[0]), color=RED, lw=1.4, dashes=(4, 2))
    if case.long_exists:
        ax.axhline(float(case.long.y_min[0]), color=PINK, lw=1.4, dashes=(5, 3))
    ax.text(
        0.98, 0.02, "dashed levels: smallest Y of the closed forms", transform=ax.transAxes,
        ha="right", fontsize=9, color="0.3",
    )  # fmt: skip
    _stop(ax, case)
    ax.set_xlim(0, run.impacts.shape[0])


def _stop(ax: Axes, case: Case) -> None:
    ax.axhline(float(case.scene.stops[0].gap), color=GREEN, lw=1.8, label="stop, Y = 2")
