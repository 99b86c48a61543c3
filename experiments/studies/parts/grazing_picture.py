"""The picture of `grazing_forecast.py`."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from tools.pictures import legend_below, open_frames
from vi_jax.plot.colors import BLUE, GREEN, ORANGE, RED

_COLOURS = {1: BLUE, 2: GREEN, 3: ORANGE}


def picture(shown: dict[str, Any]) -> Figure:
    """Lanes of one machine for each verdict: how far from the motion that grazes, and which period
    (1, 2, 3, more, none)."""
    figure = Figure(figsize=(11.0, 6.2), layout="constrained")
    axes = figure.subplots(2, 4).ravel()
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    for ax, (verdict, (label, parameter, lanes)) in zip(axes, shown.items(), strict=False):
        for word, color, part in _parts(lanes.period):
            ax.loglog(lanes.offset[part], lanes.distance[part], ".", ms=3, color=color, label=word)
        ax.set_title(f"{verdict}\n({label})", fontsize=9)
        ax.set_xlabel(f"distance in {parameter}", fontsize=8)
        ax.tick_params(labelsize=8)
        for axis, values in ((ax.xaxis, lanes.offset), (ax.yaxis, lanes.distance)):
            axis.set_minor_formatter(NullFormatter())  # else labels overlap within a decade
            low, high = values.min(), values.max()
            axis.set_view_interval(min(low / 1.3, 0.2 * high), max(high * 1.3, 5 * low))
    axes[0].set_ylabel("distance of the motion", fontsize=8)
    open_frames(axes)
    handles = [
        axes[0].plot([], [], "o", ms=4, color=color, label=word)[0]
        for word, color, _ in _parts(np.zeros(1))
    ]
    legend_below(figure, handles, 5)
    return figure


def _parts(period: np.ndarray) -> list[tuple[str, str, np.ndarray]]:
    """Words, colour and which lanes, by period."""
    few = [(f"period {n}", color, period == n) for n, color in _COLOURS.items()]
    return [*few, ("longer", RED, period > 3), ("none", "0.6", period == 0)]
