"""The picture of `regime_maps.py`."""

from typing import Any

import vi_jax as vi
from matplotlib import patheffects
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from reproduction.boundaries import table_damping
from tools.pictures import legend_below
from vi_jax.plot.colors import DASHES

from .regime_checks import Seen
from .regime_planes import RANGE, SETTLE

_LOOKS = {
    "birth": ("w", DASHES["grazing"], "2π: born where the free motion reaches the stop"),
    "doubling": ("w", DASHES["period-doubling"], "2π: period doubling"),
    "fold": ("w", DASHES["fold"], "2π: fold"),
    "touch": ("#ffe08a", DASHES["grazing"], "4π with one impact: touches the stop again"),
}


def picture(maps: list[Seen]) -> Figure:
    """The maps beside each other, with their curves."""
    figure = Figure(figsize=(15.5, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    regimes: dict[str, Patch] = {}
    for ax, seen in zip(figure.subplots(1, 3), maps, strict=True):
        _panel(ax, seen, regimes)
    order = {f"{2 * n}π": n for n in range(1, 9)}
    names = sorted(regimes, key=lambda x: (order.get(x.partition(",")[0], 9), x))
    lines = [
        Line2D([], [], color=color, ls=style, lw=2.0, label=label, path_effects=_rim(3.4))
        for color, style, label in _LOOKS.values()
    ]
    legend_below(figure, [*(regimes[name] for name in names), *lines], 6)
    figure.suptitle(
        f"What the machine settles on from rest within {SETTLE} cycles (ideal drive, Δ = 2a)"
    )
    return figure


def _panel(ax: Any, seen: Seen, regimes: dict[str, Patch]) -> None:
    """One map; the entries of its legend are added to `regimes`."""
    plane = seen.plane
    vi.plot_regimes(seen.data, ax=ax, x="zeta", y=plane.other)
    legend = ax.get_legend()
    for patch in legend.get_patches():
        regimes.setdefault(patch.get_label(), patch)
    legend.remove()
    for name, parts in plane.curves.items():
        color, style, _ = _LOOKS[name]
        for points in parts:
            (line,) = ax.plot(*points.T, ls=style, color=color, lw=1.7)
            line.set_path_effects(_rim(3.0))
    if plane.other == "c":
        ax.axhline(table_damping(), color="k", lw=0.8, ls=":")
    levels = plane.axes[plane.other]
    ax.set(xlim=RANGE, ylim=(levels[0], levels[-1]), xlabel="frequency ratio ζ")
    ax.set_ylabel("restitution k" if plane.other == "k" else "damping c (N·s/m)")
    ax.set_title(plane.title, fontsize=11)


def _rim(width: float) -> list[Any]:
    """A dark rim, by which a pale line is seen on a pale ground."""
    return [patheffects.Stroke(linewidth=width, foreground="k"), patheffects.Normal()]
