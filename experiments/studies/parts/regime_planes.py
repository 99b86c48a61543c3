"""The planes of `regime_maps.py`: their machines, and the curves that are laid over the maps."""

from typing import NamedTuple

import numpy as np
import vi_jax as vi
import xarray as xr
from reproduction.boundaries import (
    CURVES,
    BoundaryCurves,
    follow_curves,
    plane_points,
    table_damping,
    xi_per_c,
)
from tools.ideal import births, closed_forms, machine
from tools.study import QUICK

SIDE = 48 if QUICK else 256
SETTLE = 400  # drive cycles
RANGE = (0.5, 1.9)
XI_PER_C = xi_per_c()  # a number: it cannot be asked for while a program is traced
ZETA, KS, CS = np.linspace(*RANGE, SIDE), np.linspace(0.05, 0.95, SIDE), np.linspace(0, 1.2, SIDE)


class Plane(NamedTuple):
    """A plane of parameters, with curves by name."""

    title: str
    axes: dict[str, np.ndarray]
    """Values of ζ, k and c; one of k and c has a single value."""
    other: str
    """What is varied beside ζ: "k" or "c"."""
    curves: dict[str, list[np.ndarray]]
    """Points (ζ, k) or (ζ, c), of the shape `(n, 2)`."""

    def lane(self, i: np.ndarray, j: np.ndarray) -> dict[str, np.ndarray]:
        """The axes' values at places of the map."""
        place = {"zeta": i, self.other: j}
        return {name: x[place.get(name, np.zeros_like(i))] for name, x in self.axes.items()}


def settled(
    axes: dict[str, np.ndarray],
    method: vi.AbstractMethod,
    *,
    paired: bool = False,
    lanes: int = 768 if QUICK else 4096,
    settle: int = SETTLE,
) -> xr.Dataset:
    """What the machines with these ζ, k and c settle on from rest."""
    return vi.scan(
        lambda zeta, k, c: machine(zeta, k, c * XI_PER_C), axes, measure="regime", settle=settle,
        method=method, paired=paired, workers=2, lanes=lanes, progress=False,
    )  # fmt: skip


def planes() -> list[Plane]:
    """(ζ, k) without damping and with Table 1's, and (ζ, c) at k = 0.5."""
    undamped, both, table = (
        BoundaryCurves(**follow_curves(CURVES)),
        np.array([0.0, 1.0]),
        table_damping(),
    )
    grid = {"zeta": ZETA, "k": KS}
    found = []
    for c, title, curves in (
        (0.0, "without damping", _undamped(undamped, "k")),
        (table, f"c = {table:g} N·s/m (Table 1)", _with_damping(table * XI_PER_C)),
    ):
        born = births(c * XI_PER_C)
        curves["birth"] = [np.stack([np.full(2, zeta), both], axis=1) for zeta in born]
        found.append(Plane(f"(ζ, k), {title}", {**grid, "c": np.array([c])}, "k", curves))
    curves = _undamped(undamped, "c")
    curves["birth"] = [np.stack([zeta, CS], axis=1) for zeta in births(CS * XI_PER_C)]
    axes = {"zeta": ZETA, "k": np.array([0.5]), "c": CS}
    return [*found, Plane("(ζ, c), k = 0.5", axes, "c", curves)]


def _undamped(curves: BoundaryCurves, other: str) -> dict[str, list[np.ndarray]]:
    """Those that begin without damping."""
    named = {name: getattr(curves, f"{name}_{other}") for name in ("doubling", "touch", "fold")}
    return {name: [plane_points(x)] for name, x in named.items()}


def _with_damping(xi: float) -> dict[str, list[np.ndarray]]:
    """With damping the 4π motion with one impact is found at k = 0.8, not at 0.5."""
    parameter, bounds = "stops.0.restitution", (RANGE, (0.02, 0.999))
    special = {}
    for k, cycles in ((0.5, 1), (0.8, 2)):
        closed = closed_forms(np.array([[0.9, k, xi]]), cycles)
        there = machine(0.9, k, xi)
        start = there.start(Y=closed.Y[0, 0], V=closed.V[0, 0])
        orbit = vi.find_orbit(there, start, cycles=cycles, throw=True)
        branch = vi.continue_orbit(orbit, parameter="drive.frequency_ratio", bounds=RANGE)
        for point in sorted(branch.special, key=lambda point: -point.parameter):
            special[cycles, point.kind] = point
    chosen = {
        "doubling": special[1, "period-doubling"],
        "touch": special[2, "grazing"],
        "fold": special[1, "fold"],
    }
    return {
        name: [vi.boundary(x, parameter=parameter, bounds=bounds, max_step=0.03).parameters]
        for name, x in chosen.items()
    }
