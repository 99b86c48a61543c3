"""The picture of `motor_frequency_response.py`."""

from typing import Any

import numpy as np
import vi_jax as vi
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from vi_jax.plot.colors import RED, color_of

from .motor_forecast import HARD, IDLE, ZETAS, forecast, weakest_without_fold
from .motor_sweeps import FAR, HIGHEST, NEAR, PER_NM, Key, jump_in_kappa, special

Sweeps = dict[Key, vi.Sweep]
Branches = dict[tuple[Key, int], vi.Branch]
_COLORS = {100.0: "k", 10.0: "#0072b2", 2.0: "#56b4e9", 0.5: "#882255", 0.2: "#e69f00",
           0.1: "#d55e00", 0.05: "#332288"}  # fmt: skip
_LEGEND: dict[str, Any] = {"fontsize": 8.5, "framealpha": 0.9}


def picture(up: Sweeps, down: Sweeps, found: Branches) -> Figure:
    """Speeds, extremes, load and jumps of all motors."""
    figure = Figure(figsize=(14, 8.2), layout="constrained")
    (ax_far, ax_near, ax_load), (ax_strong, ax_weak, ax_jump) = figure.subplots(2, 3)
    far = [key for key in HIGHEST if key[1] == FAR]
    strong = [key for key in HIGHEST if key[1] == NEAR and key[0] >= 2]
    weak = [key for key in HIGHEST if key[1] == NEAR and key[0] < 2]
    for ax, keys, title in ((ax_far, far, "stop out of reach"), (ax_near, weak, "stop at 2a")):
        for key in keys:
            _motor(ax, key, (up, down, found), "frequency_ratio", "parameter")
        top = max(HIGHEST[key] for key in keys)
        ax.axline((1, 1), slope=1, color="0.6", lw=0.9, ls=":")
        ax.set(xlim=(0.5, top), ylim=(0.4, min(top, 3.2)), ylabel="mean frequency ratio ζ",
               title=f"ζ against κ, {title}")  # fmt: skip
        _explain(ax, keys, "lower right")
    for ax, keys, title in ((ax_strong, strong, "Table 1's"), (ax_weak, weak, "weak")):
        for key in keys:
            for y in ("y_min", "y_max"):
                lines = key[0] in (10.0, 0.2)
                _motor(ax, key, (up, down, found), y, "frequency_ratio", lines=lines)
        ax.set(xlim=(0.5, 1.9), xlabel="mean frequency ratio ζ", ylabel="min Y, max Y (a)",
               title=f"Extremes, {title} motors, stop at 2a")  # fmt: skip
        _explain(ax, keys, "center left")
    _load(ax_load, up, down)
    _jumps(ax_jump, up, down, found)
    figure.suptitle(
        "k = 0.5, Table 1's damping. ○ run-up, × close-down; lines: 2π motions continued in κ "
        "(dashed: unstable); dotted: ζ = κ",
        fontsize=11,
    )
    return figure


def _motor(
    ax: Any, key: Key, seen: tuple[Sweeps, Sweeps, Branches], y: str, x: str, *, lines: bool = True
) -> None:
    """A motor's sweeps and branches, in its colour."""
    up, down, found = seen
    color = _COLORS[key[0]]
    look = {"color": color, "mew": 0.7, "markevery": 6, "alpha": 0.8}
    dots = "values" if x == "parameter" else x
    for (name, _), branch in found.items():
        if name == key and lines:
            vi.plot_branch(
                branch, ax=ax, y=y, x=x, special=False, legend=False, color=color, lw=1.8, zorder=3
            )
    vi.plot_sweep(up[key], ax=ax, y=y, x=dots, marker="o", mfc="none", ms=4.5, **look)
    vi.plot_sweep(down[key], ax=ax, y=y, x=dots, marker="x", ms=3.6, **look)


def _explain(ax: Any, keys: list[Key], where: str) -> None:
    tones = sorted({key[0] for key in keys}, reverse=True)
    handles = [Line2D([], [], color=_COLORS[t], lw=2.5, label=f"T0 = {t:g} N·m") for t in tones]
    ax.legend(handles=handles, loc=where, **_LEGEND)
    ax.grid(alpha=0.3)


def _load(ax: Any, up: Sweeps, down: Sweeps) -> None:
    """What the motors gave, over what the ideal machine needs."""
    for key in HIGHEST:
        for sweep, dot in ((up[key], "o"), (down[key], "x")):
            slip = (np.asarray(sweep.values) - np.asarray(sweep.frequency_ratio)) * key[0]
            look = {"mfc": "none", "mew": 0.6, "color": _COLORS[key[0]], "markevery": 8}
            ax.plot(sweep.frequency_ratio, slip, dot, ms=4, **look)
    for needed, color, label in (
        (IDLE, "0.35", "ideal drive, no impacts"),
        (HARD, color_of(1, 1), "ideal drive, 2π with impact"),
    ):
        ax.plot(ZETAS, needed / PER_NM, color=color, lw=2.6, alpha=0.6, zorder=3, label=label)
    ax.set(yscale="log", xlim=(0.5, 1.9), ylim=(1e-3, 2), xlabel="mean frequency ratio ζ",
           ylabel="T0 (κ - ζ) (N·m)", title="Load on the motor, all sweeps")  # fmt: skip
    ax.legend(loc="upper right", **_LEGEND)
    ax.grid(alpha=0.3)


def _jumps(ax: Any, up: Sweeps, down: Sweeps, found: Branches) -> None:
    """κ of the jumps over the motor's torque: forecast, continued and swept."""
    scan = np.logspace(np.log10(0.04), 2, 120)
    limit, _ = weakest_without_fold()
    for gap, tone, name in ((NEAR, "k", "2a"), (FAR, "0.6", "20a")):
        for way, dash, swept in (("up", "-", up), ("down", "--", down)):
            reached = scan if gap == NEAR else scan[(scan > 0.4) & (scan < limit)]
            expected = [forecast(t, gap, way) for t in reached]
            label = f"{way}, stop at {name}: forecast"
            ax.plot(reached, expected, dash, color=tone, lw=1.2, label=label)
            keys = [key for key in HIGHEST if key[1] == gap]
            x, y = zip(*((key[0], special(found, key, way).parameter) for key in keys), strict=True)
            dots = {"marker": "s", "mfc": "none", "ms": 8, "ls": "", "color": tone}
            ax.plot(x, y, **dots, label="continued" if way == "up" and gap == NEAR else None)
            for key in keys:
                ax.plot(key[0], np.mean(jump_in_kappa(swept[key])), "o", ms=4, color=RED)
    ax.plot([], [], "o", ms=4, color=RED, label="swept")
    ax.set(xscale="log", ylim=(0.9, 6), xlabel="stall torque T0 (N·m)", ylabel="κ of the jump",
           title="Where the sweeps jump")  # fmt: skip
    ax.legend(loc="upper right", **_LEGEND)
    ax.grid(alpha=0.3)
