"""The picture of `bifurcation_diagram.py`."""

from typing import Any, NamedTuple

import numpy as np
import vi_jax as vi
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from tools.ideal import GAP
from vi_jax.plot.colors import RED, mark_of, mark_style

from .bifurcation_runs import PARTS, K, Settled

_COLORS = ("0.25", RED)
_KINDS = ("period-doubling", "fold", "grazing")


class Drawn(NamedTuple):
    """A branch with its name (none: it is in the legend already) and its colour."""

    branch: vi.Branch
    name: str
    color: str


def picture(seen: Settled, drawn: list[Drawn]) -> Figure:
    """Every impact of the settled motions, growth rates, and three stretches magnified."""
    figure = Figure(figsize=(10, 10.5), layout="constrained")
    panels = figure.subplot_mosaic(
        [["wide"] * 3, ["exponent"] * 3, ["left", "middle", "right"]], height_ratios=[1.5, 0.8, 1.3]
    )
    for name in PARTS:
        _impacts(panels[name], seen, drawn, name)
    axes = panels["exponent"]
    axes.axhline(0, color="k", lw=0.8)
    for start, color in enumerate(_COLORS):
        mine = (seen.part == "wide") & (seen.start == start)
        axes.plot(seen.zeta[mine], seen.exponent[mine], ".", ms=3, color=color)
    _branches(axes, drawn, "growth", PARTS["wide"])
    axes.set_ylim(-0.2, 0.35)
    axes.set_ylabel("growth rate per cycle")
    axes.set_title("dots: growth of a 1e-9 perturbation; lines: ln |largest multiplier| per cycle")
    for name in ("wide", "left"):
        panels[name].set_ylabel("impact speed V⁻ (a ω)")
    titles = {
        "wide": f"k = {K}, d = {GAP:g}, undamped: every impact of the settled motion",
        "left": "4π doubles; 8π touches the stop",
        "middle": "and at the other end",
        "right": "4π and 2π motion coexist",
    }
    heights = {"wide": (-0.1, 3.75), "left": (3.03, 3.36), "middle": (3.38, 3.46)}
    for name, title in titles.items():
        panels[name].set_title(title)
        panels[name].set_ylim(*heights.get(name, (-0.1, 3.75)))
        if name != "wide":
            panels[name].locator_params(axis="x", nbins=4)
    figure.legend(handles=_handles(drawn), loc="outside lower center", ncols=6, fontsize=9)
    return figure


def _impacts(axes: Axes, seen: Settled, drawn: list[Drawn], name: str) -> None:
    """Impact speeds in one of the stretches."""
    for start, color in enumerate(_COLORS):
        mine = (seen.part == name) & (seen.start == start)
        hits = seen.speed[mine, -64:].reshape(mine.sum(), -1)
        across = np.repeat(seen.zeta[mine], hits.shape[1])
        axes.plot(across, hits.ravel(), ".", ms=1.4, mew=0, color=color)
    _branches(axes, drawn, "speeds", PARTS[name])
    for point in (point for branch, *_ in drawn for point in branch.special):
        hits = np.asarray(point.orbit.impact_speed)
        across = np.full(len(hits), point.parameter)
        axes.plot(across, hits, zorder=4, **mark_style(point.kind))
    axes.ticklabel_format(useOffset=False)


class _Piece(NamedTuple):
    """A stretch of a branch that is stable or unstable all along."""

    parameter: np.ndarray
    speeds: np.ndarray
    growth: np.ndarray
    stable: bool


def _pieces(branch: vi.Branch) -> list[_Piece]:
    """Each ends at the special point at which stability changes, not at the branch's next point,
    which may lie farther off than a magnified panel is wide.
    """

    def growth(multipliers: Any) -> np.ndarray:
        sizes = np.abs(np.asarray(multipliers)).max(axis=-1, keepdims=True)
        return np.log(sizes) / branch.cycles

    rows = np.column_stack([branch.parameter, branch.impact_speed, growth(branch.multipliers)])
    turns = []
    for p in branch.special:
        if p.kind != "grazing":
            speeds = np.resize(np.asarray(p.orbit.impact_speed), branch.impact_speed.shape[1])
            turns.append([p.parameter, *speeds, *growth(p.orbit.multipliers)])
    turns = np.array(turns)
    found, begin = [], 0
    before: list[np.ndarray] = []
    for cut in [*(np.flatnonzero(np.diff(branch.stable.astype(int))) + 1), len(rows)]:
        after = []
        if cut < len(rows):
            middle = (rows[cut - 1] + rows[cut]) / 2
            after = [turns[np.argmin(np.abs(turns - middle)[:, :-1].sum(axis=1))]]
        here = np.stack([*before, *rows[begin:cut], *after])
        found.append(_Piece(here[:, 0], here[:, 1:-1], here[:, -1:], bool(branch.stable[begin])))
        begin, before = cut, after
    return found


def _branches(axes: Axes, drawn: list[Drawn], what: str, bounds: tuple[float, float]) -> None:
    """Impact speeds or growth of all branches: stable solid, unstable dashed."""
    for branch, _, color in drawn:
        for piece in _pieces(branch):
            style = "-" if piece.stable else (0, (2.5, 1.2))
            values = getattr(piece, what)
            axes.plot(piece.parameter, values, ls=style, color=color, lw=2.6, alpha=0.6, zorder=1)
    axes.set_xlim(*bounds)
    axes.set_xlabel("frequency ratio ζ")


def _handles(drawn: list[Drawn]) -> list[Line2D]:
    """Of the legend."""
    return [
        *(
            Line2D([], [], color=color, lw=2.6, alpha=0.6, label=name)
            for _, name, color in drawn
            if name
        ),
        *(
            Line2D([], [], color="k", ls=ls, label=x)
            for x, ls in (("stable", "-"), ("unstable", "--"))
        ),
        *(mark_of(kind) for kind in _KINDS),
        *(
            Line2D([], [], marker=".", color=c, ls="none", label=f"simulated, start {i + 1}")
            for i, c in enumerate(_COLORS)
        ),
    ]
