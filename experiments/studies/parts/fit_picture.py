"""The picture of `fit_4pi_orbit.py`, and what a search found in words."""

from typing import Any

import jax
import numpy as np
import vi_jax as vi
from matplotlib.figure import Figure
from tools.pictures import panels
from vi_jax.plot.colors import color_of

SEARCHES = [f"{name}, {where}" for name in ("newton", "adam") for where in ("displaced", "rest")]
_COLORS = {"newton": "0.2", "adam": "#cc79a7"}


def kind(orbit: vi.Orbit) -> str:
    """What a search found, in a word."""
    if bool(orbit.successful):
        return f"{2 * int(orbit.cycles)}π"
    return str(orbit.to_xarray()["result"].item())


def same(orbit: vi.Orbit, section: np.ndarray) -> bool:
    """Whether a motion is the one that the transient settled to."""
    states = np.stack(jax.tree.leaves(orbit.sections), axis=1)
    return bool(orbit.successful) and bool(np.abs(states - section).max(axis=1).min() < 1e-4)


def title(row: dict[str, Any]) -> str:
    """A machine and its drive."""
    torque = row["torque"]
    return f"{row['machine']}, " + ("ideal" if torque is None else f"T0 = {torque:g}")


def picture(rows: list[dict[str, Any]], shown: list[dict[str, Any]]) -> Figure:
    """Residuals along the searches of two of the rows; what is found from random guesses; times."""
    figure, (above, (bars, times)) = panels(11, 8, 2, 2)
    for axes, row in zip(above, shown, strict=True):
        _residuals(axes, row)
    place = np.arange(len(rows))[::-1]
    _shares(bars, rows, place)
    _times(times, rows, place)
    times.set_ylim(bars.get_ylim())
    return figure


def _residuals(axes: Any, row: dict[str, Any]) -> None:
    for name in SEARCHES:
        method, where = name.split(", ")
        orbit = row[name][0]
        history = np.asarray(orbit.history)
        style = ("." if method == "newton" else "") + ("-" if where == "displaced" else ":")
        label = f"{method.capitalize()}, {where}: {kind(orbit).replace('_', ' ')}"
        steps = np.arange(1, history.size + 1)
        axes.loglog(steps, history, style, color=_COLORS[method], lw=1.3, label=label)
    axes.set_title(title(row))
    axes.set_xlabel("step of the search")
    axes.set_ylabel("largest residual component (a, a ω, ω)")
    axes.set_ylim(1e-16, 10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8.5, loc="lower right")


def _shares(axes: Any, rows: list[dict[str, Any]], place: np.ndarray) -> None:
    for shift, method, alpha in ((0.2, "newton", 1.0), (-0.2, "adam", 0.5)):
        start = np.zeros(len(rows))
        for wanted, color in (("4π", color_of(2)), ("2π", color_of(1)), ("none", "0.7")):
            part = np.zeros(len(rows))
            for i, row in enumerate(rows):
                kinds = [kind(orbit) for orbit in row["tally"][method]]
                kinds = [x if x in ("4π", "2π") else "none" for x in kinds]
                part[i] = 100 * kinds.count(wanted) / len(kinds)
            label = wanted if method == "newton" else None
            axes.barh(place + shift, part, 0.36, start, color=color, alpha=alpha, label=label)
            start += part
    axes.set_yticks(place, [title(row) for row in rows], fontsize=8)
    axes.set_xlabel("random guesses, % (upper bars Newton, pale ones Adam)")
    axes.set_title("what is found from random guesses")
    axes.legend(fontsize=8, loc="upper center", ncols=3, bbox_to_anchor=(0.5, -0.14))


def _times(axes: Any, rows: list[dict[str, Any]], place: np.ndarray) -> None:
    for name in ("transient", *SEARCHES):
        method, _, where = name.partition(", ")
        color = _COLORS.get(method, "k")
        marker = {"": "|", "displaced": "o", "rest": "s"}[where]
        for i, row in enumerate(rows):
            seconds = row[name][2 if method == "transient" else 1]
            hit = method == "transient" or same(row[name][0], row["transient"][3])
            dots = {"color": color, "mfc": color if hit else "none", "mew": 1.5}
            axes.plot(1e3 * seconds, place[i], marker, ms=14 if not where else 6, **dots)
        axes.plot([], [], marker, color=color, label=name.capitalize())
    axes.set_xscale("log")
    axes.set_yticks(place, [])
    axes.grid(alpha=0.3)
    axes.set_xlabel("ms, once compiled (hollow: not the motion of the transient)")
    axes.set_title("time to the motion")
    axes.legend(fontsize=8, loc="upper center", ncols=3, bbox_to_anchor=(0.5, -0.14))
