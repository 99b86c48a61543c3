"""The picture of the study of learned laws."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from vi_jax.plot.colors import BLUE, ORANGE, RED, STOP, paler

RAISED = 0.08


def picture(record: Any, laws: Any, speeds: Any) -> Figure:
    """One record above; law, force and their errors below.

    **Arguments:** `record`: its times, positions, those of the first guess and of the fit, and the
    gap; `laws`: of law and force each its places, first guess, fit, truth and standard errors;
    `speeds`: those of the impacts.
    """
    figure = Figure(figsize=(11, 6.4), layout="constrained")
    axes = figure.subplot_mosaic([["record"] * 3, ["law", "force", "off"]], height_ratios=[1, 1.4])
    _record(axes["record"], *record)
    labels = (
        ("speed of approach v (marks: impacts)", "restitution k"),
        ("position Y", "spring's force f"),
    )
    for i, (name, law, words) in enumerate(zip(("law", "force"), laws, labels, strict=True)):
        at, guess, found, true, errors = (np.asarray(x) for x in law)
        band, ax = 1.96 * errors, axes[name]
        ax.fill_between(at, found - band, found + band, color=paler(BLUE), label="±1.96 errors")
        ax.plot(at, guess, "--", color=ORANGE, label="first guess")
        ax.plot(at, found, color=BLUE, label="learned")
        ax.plot(at, true, ":", color=RED, lw=2, label="true")
        ax.set(xlabel=words[0], ylabel=words[1])
        share, raised = (at - at[0]) / (at[-1] - at[0]), RAISED * (1 - i)
        off, color = raised + found - true, (RED, BLUE)[i]
        axes["off"].fill_between(share, off - band, off + band, color=paler(color))
        axes["off"].plot(share, off, color=color, label=("k, raised by 0.08", "f")[i])
        axes["off"].axhline(raised, color="0.5", lw=0.6)
    low = axes["law"].get_ylim()[0]
    axes["law"].plot(speeds, np.full(len(speeds), low), "|", color="0.4", clip_on=False)
    axes["off"].set(xlabel="place in the range of v or Y", ylabel="learned less true")
    for name in ("law", "force", "off"):
        axes[name].legend(fontsize=9)
    return figure


def _record(ax: Any, times: Any, positions: Any, guess: Any, fit: Any, gap: float) -> None:
    ax.plot(times[1:], positions, ".", color="0.4", label="record")
    ax.plot(times, guess, "--", color=ORANGE, label="first guess")
    ax.plot(times, fit, color=BLUE, label="fit")
    ax.axhline(gap, color=STOP, lw=1.5, label="stop", zorder=0)
    ax.set(xlabel="time (1/ω)", ylabel="position Y (dimensionless)", xlim=(0, times[-1]))
    ax.set_ylim(-3.3, 0.9)  # room for the legend
    ax.legend(ncol=4, fontsize=9, loc="lower right")
