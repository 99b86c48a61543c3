"""The picture of `speed_accuracy.py`, and a row of its tables."""

from typing import Any, NamedTuple

from matplotlib.figure import Figure
from vi_jax.plot.colors import BLUE, GREEN, MORE_IMPACTS, ORANGE, PERIODS, RED

from .measures import LANES, MANY, TIMED
from .methods import Choice


class Row(NamedTuple):
    """A method with one drive."""

    choice: Choice
    errors: dict[str, float]
    compiling: float
    seconds: float
    wrong: float
    """Share of regimes labelled wrongly; NaN without a scan."""
    scanning: float


class About(NamedTuple):
    """Numbers of lanes with one drive."""

    calm: int
    """Lanes that hardly amplify a displacement."""
    firm: int
    """Lanes of the scan for which two accurate methods agree."""
    grid: int
    """All lanes of the scan."""


_STYLE = {
    "ExactFlight": ("k", "*"),
    "FixedStep Verner9": (PERIODS[8], "s"),
    "FixedStep Dopri8": (BLUE, "s"),
    "FixedStep Tsit5": (RED, "s"),
    "FixedStep Dopri5": (GREEN, "s"),
    "FixedStep Bosh3": (PERIODS[2], "s"),
    "Adaptive Verner9": (PERIODS[8], "o"),
    "Adaptive Dopri8": (BLUE, "o"),
    "Adaptive Tsit5": (RED, "o"),
    "Adaptive Dopri5": (GREEN, "o"),
    "Adaptive Bosh3": (PERIODS[2], "o"),
    "Taylor, 8 steps": (PERIODS[4], "s"),
    "Taylor 12": (PERIODS[5], "^"),
    "Taylor 16": (ORANGE, "^"),
    "Taylor 20": (MORE_IMPACTS, "^"),
}


def picture(results: dict[str, tuple[list[Row], About]]) -> Figure:
    """Draw run time over the error of the state, and over the share of wrong regimes."""
    figure = Figure(figsize=(11, 8.6), layout="constrained")
    panels = figure.subplots(2, len(results), squeeze=False)
    for top, bottom, (drive, found) in zip(*panels, results.items(), strict=True):
        _panels(top, bottom, *found)
        top.set(
            title=f"{drive} drive",
            xlabel=f"error of the state after {MANY:,} cycles, 95 of 100 lanes (a, a ω, ω)",
        )
        bottom.set(xlabel="share of regimes labelled wrongly (left edge: none)")
        for ax in (top, bottom):
            ax.grid(alpha=0.3)
            ax.set(ylabel=f"{LANES} lanes, {TIMED} cycles: run time (ms)")
    handles, _ = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=8)
    return figure


def _panels(top: Any, bottom: Any, rows: list[Row], about: About) -> None:
    """Draw each family of methods in its colour."""
    for family in dict.fromkeys(row.choice.family for row in rows):
        mine = [row for row in rows if row.choice.family == family]
        color, marker = _STYLE[family.removesuffix(", float32")]
        single = family.endswith("float32")
        look = {
            "color": color,
            "marker": marker,
            "ms": 11 if marker == "*" else 5,
            "mfc": "none" if single or marker == "o" else color,
            "ls": ":" if single else ("--" if marker == "o" else "-"),
            "lw": 1,
            "label": family,
        }
        time_ms = [1e3 * row.seconds for row in mine]
        top.loglog([max(row.errors["late95"], 1e-16) for row in mine], time_ms, **look)
        grid = [max(row.wrong, 0.3 / about.firm) for row in mine]  # NaN where not scanned
        bottom.loglog(grid, time_ms, **{**look, "ls": ""})
