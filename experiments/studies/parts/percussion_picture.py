"""The picture of `design_percussion.py`."""

from typing import Any

import numpy as np
import vi_jax as vi
from matplotlib.figure import Figure
from tools.pictures import gridded
from vi_jax.plot import motion_path
from vi_jax.plot.colors import BLUE, ORANGE, RED

from .percussion import DESIGNS, Ascent

_COLOURS = {"start": "0.35", "A": RED, "B": ORANGE, "C": BLUE}
_NOTES = {"A": "A: |μ| ≤ 0.8", "B": "B: |μ| ≤ 0.5", "C": "C: |μ| ≤ 0.8, self-starting"}


def picture(before: vi.Orbit, ascents: dict[str, Ascent]) -> Figure:
    """Power and stability along the ascents; the motions at their ends and at the start."""
    figure = Figure(figsize=(11.5, 3.9), layout="constrained")
    power_axes, modulus_axes, portrait = figure.subplots(1, 3)
    for name, ascent in ascents.items():
        style: dict[str, Any] = {"color": _COLOURS[name], "ls": "--" if name == "B" else "-"}
        power_axes.plot(ascent.power, label=_NOTES[name], **style)
        modulus_axes.plot(ascent.modulus, **style)
    power_axes.set(xlabel="step", ylabel="impact power (W)")
    power_axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.72), fontsize=9)
    for limit in sorted({limit for limit, _ in DESIGNS.values()}):
        modulus_axes.axhline(limit, color="0.6", lw=1, ls=":")
    modulus_axes.set(xlabel="step", ylabel="largest |μ| (dimensionless)", ylim=(0.3, 0.95))
    orbits = {"start": before, "A": ascents["A"].end.orbit, "C": ascents["C"].end.orbit}
    for name, orbit in orbits.items():
        _motion(portrait, name, orbit)
    portrait.margins(x=0.1)
    portrait.set(xlabel="Y = y/a", ylabel="V = dY/dτ (a ω)", ylim=(-4.6, 8.2))
    gridded(figure.axes, ("power", "stability (dotted: limits)", "motions and their stops"))
    return figure


def _motion(ax: Any, name: str, orbit: vi.Orbit) -> None:
    """A motion in the plane of Y and V, and its stop."""
    run = vi.simulate(
        orbit.machine, orbit.state, 1, method=vi.ExactFlight(), samples=200, impact_log=4
    )
    path, color = motion_path(run, machine=orbit.machine), _COLOURS[name]
    ax.plot(path.Y, path.V, color=color, lw=1.3)
    gap = float(orbit.machine.stops[0].gap)
    ax.axvline(gap, color=color, lw=2.0, ls=(0, (4, 1.5)))
    ax.text(
        gap, 0.98, f"stop of {name} ", transform=ax.get_xaxis_transform(), rotation=90,
        ha="right", va="top", fontsize=8.5, color=color,
    )  # fmt: skip
    left, inside = int(np.argmin(path.Y)), name == "start"
    ax.annotate(
        name, (float(path.Y[left]), float(path.V[left])), (5 if inside else -5, 0),
        textcoords="offset points", ha="left" if inside else "right", va="center", color=color,
    )  # fmt: skip
