"""Drawing of Figures 3 and 4: three panels each, the undamped system above the damped one."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tools.pictures import save_picture
from vi_jax.flow import Run
from vi_jax.plot import STOP, angle_axis, color_of, motion_path, plot_history

from .motions import Case

# Dots per inch: a choice.
_DPI = 110
# The colour of a simulated motion is neutral, because the picture is to show its regime.
_INK = "0.2"


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
    common_legend(figure, grid[0, :2], ncols=7)  # the undamped panels have every curve
    save_picture(figure, path, dpi=_DPI, colors=64)


def common_legend(figure: Figure, axes: np.ndarray, *, ncols: int) -> None:
    """Draw one legend below the figure with the entries of all these axes."""
    named = [pair for ax in axes for pair in zip(*ax.get_legend_handles_labels(), strict=True)]
    handles, labels = zip(*named, strict=True)
    look = {"loc": "outside lower center", "frameon": False, "fontsize": 11}
    figure.legend(handles, labels, ncols=ncols, **look)


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
    """Draw a few cycles of the run with the closed forms on top.

    **Arguments:** `number` of the figure; `window`, the first and the last cycle.
    """
    plot_history(
        run, machine=case.scene, ax=ax, window=window, stops=False, lw=3.2,
        color=_INK, alpha=0.55, label="simulation",
    )  # fmt: skip
    for period, dash in ((1, (4, 2)), (2, (5, 3))):
        color = color_of(period, 1)
        if period == 2 and not case.long_exists:
            continue
        # In Figure 4 the run starts on the section of the closed form.
        shift = case.long_shift if number == 3 and period == 2 else 0
        place, Y = _tiled(case, period, shift, window)
        ax.plot(2 * place, Y, color=color, lw=1.8, dashes=dash, label=f"{2 * period}π closed form")
    _stop(ax, case, label=True)
    angle_axis(ax, every=1 if window[1] - window[0] < 3 else 2)
    ax.set_xlim(2 * window[0], 2 * window[1])


def _tiled(
    case: Case, period: int, shift: int, window: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed form over the cycles of a window, with the corners at the impacts."""
    run = case.on_short if period == 1 else case.from_long
    one = motion_path(run, machine=case.scene, window=(0, period))
    starts = range(window[0] - 2 * period + shift % period, window[1] + period)
    starts = [start for start in starts if (start - shift) % period == 0]
    place = np.concatenate([one.cycles + start for start in starts])
    Y = np.tile(one.Y, len(starts))
    keep = (place >= window[0]) & (place <= window[1])
    return place[keep], Y[keep]


def _whole(ax: Axes, case: Case, run: Run) -> None:
    """Draw the smallest Y of each cycle of the run, with those of the closed forms as levels."""
    assert run.y_min is not None
    cycle = np.arange(run.impacts.shape[0]) + 0.5
    dots = {"ls": "none", "ms": 4.5, "mew": 0, "color": _INK, "alpha": 0.55}
    ax.plot(cycle, np.asarray(run.y_min), "o", label="simulation: smallest Y of each cycle", **dots)
    forms = [(1, case.on_short)] + [(2, case.from_long)] * case.long_exists
    for period, motion in forms:
        color, dash = color_of(period, 1), (4, 2) if period == 1 else (5, 3)
        assert motion.y_min is not None
        for Y in np.asarray(motion.y_min)[:period]:
            ax.axhline(float(Y), color=color, lw=1.4, dashes=dash, zorder=3)
    _stop(ax, case)
    ax.set_xlabel("drive cycles φ/(2π)")
    ax.set_xlim(0, run.impacts.shape[0])


def _stop(ax: Axes, case: Case, *, label: bool = False) -> None:
    name = "stop, Y = 2" if label else None
    ax.axhline(float(case.scene.stops[0].gap), color=STOP, lw=1.8, label=name)
