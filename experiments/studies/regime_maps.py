# %% [markdown]
# # Regime maps
#
# The maps show the motion that the ideally driven machine (d = 2) reaches from rest, over the
# planes (ζ, k) and (ζ, c). Regimes are: a period in drive cycles, chaos, transient chaos (which
# ends within some thousand cycles), or not settled within 400 cycles. Each map is 256 × 256
# simulations by `vi.scan`. The curves are computed independently. `vi.boundary` continues the
# period doubling and the fold of the 2π motion, and the second touch of the 4π motion. The 2π
# motion appears by grazing at the ζ for which the steady vibration without impacts just reaches the
# stop, 1/|1 - ζ² + 2iξζ| = d. Maps and curves check each other.
#
# Run with `python experiments/studies/regime_maps.py` (`--quick` for coarse maps).

# %%
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import vi_jax as vi
import xarray as xr
from matplotlib import patheffects
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from vi_jax.plot.colors import DASHES

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from reproduction.boundaries import CURVES, TABLE_DAMPING, follow_curves, plane_points, xi_per_c
from tools.ideal import births, closed_forms, machine
from tools.pictures import legend_below, panels
from tools.study import QUICK, say, write
from tools.tables import table

SIDE = 48 if QUICK else 256
SETTLE, RANGE = 400, (0.5, 1.9)  # drive cycles; ζ
XI_PER_C, TABLE = xi_per_c(), TABLE_DAMPING
ZETA, KS, CS = np.linspace(*RANGE, SIDE), np.linspace(0.05, 0.95, SIDE), np.linspace(0, 1.2, SIDE)
Lanes = dict[str, np.ndarray]
Curves = dict[str, list[np.ndarray]]

# %% [markdown]
# ## The curves
#
# The curves are points (ζ, k) or (ζ, c). With Table 1's damping the 4π motion with one impact
# exists at k = 0.8 but not at k = 0.5.


# %%
def undamped(other: str) -> Curves:
    """Return the curves that begin without damping."""
    return {x: [plane_points(followed[f"{x}_{other}"])] for x in ("doubling", "touch", "fold")}


def with_damping(xi: float) -> Curves:
    """Return the same curves in (ζ, k) with this damping."""
    special = {}
    for k, cycles in ((0.5, 1), (0.8, 2)):
        closed = closed_forms(np.array([[0.9, k, xi]]), cycles)
        there = machine(0.9, k, xi)
        start = there.start(Y=closed.Y[0, 0], V=closed.V[0, 0])
        orbit = vi.find_orbit(there, start, cycles=cycles, throw=True)
        branch = vi.continue_orbit(orbit, parameter="drive.frequency_ratio", bounds=RANGE)
        for point in sorted(branch.special, key=lambda point: -point.parameter):
            special[cycles, point.kind] = point
    chosen = {"doubling": (1, "period-doubling"), "touch": (2, "grazing"), "fold": (1, "fold")}
    options = {"parameter": "stops.0.restitution", "bounds": (RANGE, (0.02, 0.999))}
    return {
        name: [vi.boundary(special[key], max_step=0.03, **options).parameters]
        for name, key in chosen.items()
    }


class Plane(NamedTuple):
    """A plane of parameters, with curves by name."""

    title: str
    axes: Lanes
    """Values of ζ, k and c; one of k and c has a single value."""
    other: str
    """Name of the second parameter: "k" or "c"."""
    curves: Curves

    def lane(self, i: np.ndarray, j: np.ndarray) -> Lanes:
        """Return the axes' values at indices of the map."""
        place = {"zeta": i, self.other: j}
        return {name: x[place.get(name, np.zeros_like(i))] for name, x in self.axes.items()}


followed = follow_curves([*CURVES])
PLANES = [
    Plane("(ζ, k), without damping", {"zeta": ZETA, "k": KS, "c": np.zeros(1)}, "k",
          undamped("k")),
    Plane(f"(ζ, k), c = {TABLE:g} N·s/m (Table 1)",
          {"zeta": ZETA, "k": KS, "c": np.array([TABLE])}, "k", with_damping(TABLE * XI_PER_C)),
    Plane("(ζ, c), k = 0.5", {"zeta": ZETA, "k": np.array([0.5]), "c": CS}, "c",
          undamped("c")),
]  # fmt: skip
for plane in PLANES:
    levels = plane.axes[plane.other]
    born = births(plane.axes["c"] * XI_PER_C)
    plane.curves["birth"] = [np.stack([x + 0 * levels, levels], axis=1) for x in born]
say("curves")

# %% [markdown]
# ## The maps


# %%
def settled(axes: Lanes) -> xr.Dataset:
    """Return the regimes that machines with these ζ, k and c reach from rest."""
    return vi.scan(
        lambda zeta, k, c: machine(zeta, k, c * XI_PER_C), axes, measure="regime", settle=SETTLE,
        method=vi.ExactFlight(), lanes=768 if QUICK else 4096, workers=2, progress=False,
    )  # fmt: skip


class Seen(NamedTuple):
    """A map."""

    plane: Plane
    data: xr.Dataset
    period: np.ndarray
    """Period in cycles, or one of `vi.REGIMES`: `(SIDE, SIDE)`."""
    impacts: np.ndarray
    """Impacts in a period: `(SIDE, SIDE)`."""


maps = []
for plane in PLANES:
    data = settled(plane.axes).squeeze(drop=True)
    maps.append(Seen(plane, data, data["period"].values, data["impacts"].values))
    say(plane.title)

# %% [markdown]
# ## Checks
#
# The closed form excludes some regimes.


# %%
def impossible(seen: Seen) -> tuple[int, int, int]:
    """Count the checked lanes, those that contradict the closed form, and impossible free lanes.

    Every third lane with one impact in one or two cycles is checked: the closed form must have
    such a motion that is stable and admissible. Between the births no lane can be free of impacts.
    """
    total = wrong = 0
    for cycles in (1, 2):
        i, j = np.argwhere((seen.period == cycles) & (seen.impacts == 1))[::3].T
        if not i.size:
            continue
        lane = seen.plane.lane(i, j)
        points = np.stack([lane["zeta"], lane["k"], lane["c"] * XI_PER_C], axis=1)
        found = closed_forms(points, cycles)
        stable = np.max(np.abs(found.multipliers), axis=-1) < 1
        total += i.size
        wrong += int(np.sum(~np.any(found.admissible & stable, axis=1)))
    left, right = (points[:, 0] for points in seen.plane.curves["birth"])
    between = (ZETA[:, None] > left) & (ZETA[:, None] < right)
    return total, wrong, int(np.sum(between & (seen.impacts == 0)))


limits = [impossible(seen) for seen in maps]
say("checked")

# %% [markdown]
# ## The picture

# %%
LOOKS = {
    "birth": ("w", DASHES["grazing"], "2π: born where the free motion reaches the stop"),
    "doubling": ("w", DASHES["period-doubling"], "2π: period doubling"),
    "fold": ("w", DASHES["fold"], "2π: fold"),
    "touch": ("#ffe08a", DASHES["grazing"], "4π with one impact: touches the stop again"),
}


def rim(width: float) -> list[Any]:
    """Return a dark outline, which makes a pale line visible on a pale background."""
    return [patheffects.Stroke(linewidth=width, foreground="k"), patheffects.Normal()]


figure, axes = panels(15.5, 5.6, 1, 3)
regimes: dict[str, Patch] = {}
for ax, seen in zip(axes, maps, strict=True):
    plane = seen.plane
    vi.plot_regimes(seen.data, ax=ax, x="zeta", y=plane.other)
    legend = ax.get_legend()
    for patch in legend.get_patches():
        regimes.setdefault(patch.get_label(), patch)
    legend.remove()
    for name, curves in plane.curves.items():
        color, style, _ = LOOKS[name]
        for points in curves:
            (line,) = ax.plot(*points.T, ls=style, color=color, lw=1.7)
            line.set_path_effects(rim(3.0))
    if plane.other == "c":
        ax.axhline(TABLE, color="k", lw=0.8, ls=":")
    levels = plane.axes[plane.other]
    ax.set(xlim=RANGE, ylim=(levels[0], levels[-1]), xlabel="frequency ratio ζ")
    ax.set_ylabel("restitution k" if plane.other == "k" else "damping c (N·s/m)")
    ax.set_title(plane.title, fontsize=11)
order = {f"{2 * n}π": n for n in range(1, 9)}
names = sorted(regimes, key=lambda x: (order.get(x.partition(",")[0], 9), x))
lines = [
    Line2D([], [], color=color, ls=style, lw=2.0, label=label, path_effects=rim(3.4))
    for color, style, label in LOOKS.values()
]
legend_below(figure, [*(regimes[name] for name in names), *lines], 6)
figure.suptitle(
    f"What the machine settles on from rest within {SETTLE} cycles (ideal drive, Δ = 2a)"
)

# %% [markdown]
# ## The table


# %%
def shares(seen: Seen) -> list[float]:
    """Return the shares of the lanes in each kind of regime, in percent."""
    free, p, n, R = seen.impacts == 0, seen.period, seen.impacts, vi.REGIMES
    parts = [
        free & (p > 0), free & (p == R.unsettled), ~free & (p == 1), ~free & (p == 2) & (n == 1),
        ~free & (p == 2) & (n > 1), ~free & (p > 2), p == R.chaotic, p == R.transient,
        ~free & (p == R.unsettled),
    ]  # fmt: skip
    return [100 * float(np.mean(part)) for part in parts]


KINDS = (
    "without impacts, periodic, %", "without impacts, not periodic, %", "2π with impacts, %",
    "4π with one impact, %", "4π with more impacts, %", "longer periods, %", "chaotic, %",
    "transiently chaotic, %", "impacts, not settled, %",
)  # fmt: skip
by_kind = zip(KINDS, zip(*map(shares, maps), strict=True), strict=True)
rows: list[list[Any]] = [
    *([kind, *(f"{x:.2f}" for x in of)] for kind, of in by_kind),
    [
        "longest period with impacts, cycles",
        *(int(np.max(seen.period[seen.impacts > 0], initial=0)) for seen in maps),
    ],
    ["every third lane on a 2π or 4π motion with one impact", *(f"{x[0]:,}" for x in limits)],
    ["of these: no such stable motion in the closed form", *(x[1] for x in limits)],
    ["lanes without impacts between the births", *(x[2] for x in limits)],
]
lasting = vi.Regime().lasting
page = f"""# Regime maps

Ideal drive, d = 2, from rest, {SETTLE} cycles to settle and 128 observed; what is chaotic
there is continued for {lasting:,} cycles, and is called transiently chaotic if it is not chaotic
then. {SIDE} × {SIDE} lanes a map by `ExactFlight`.

![Maps with curves](../figures/regime_maps.png)

{table(["", *(seen.plane.title for seen in maps)], rows)}

- Curves and maps are computed independently. The 2π motion gives way to the 4π motion on the
  doubling curve, grey where it is crossed so slowly that {SETTLE} cycles do not suffice; the
  4π motion with one impact lies inside the dashed curve; no lane is free between the births; and
  of {sum(x[0] for x in limits):,} lanes on a motion with one impact that were looked at,
  {sum(x[1] for x in limits)} have no such stable motion in the closed form.
- The maps end before the fold: between the second birth and the fold the 2π impact motion and the
  free one are both stable, and the start at rest goes to the free one from some ζ on.
- Without damping the free vibration left by the start never dies out: right of ζ = √2, where it
  does not reach the stop, the motion is rightly called not periodic. From c = 0.1 on these
  lanes are periodic. The remaining chaos lies at the first birth and, up to c = 0.2, in a tongue
  about ζ = 0.55.
- Transient chaos: without damping the body hits the stop irregularly for hundreds to tens of
  thousands of cycles. Meanwhile it looks like chaos: "chaotic" means that it is still chaotic
  after {lasting:,} cycles.
"""
print(page)
# With Table 1's damping nearly all lanes settle: a test finds these shares with fewer lanes.
kept = {KINDS[i]: round(shares(maps[1])[i], 2) for i in (0, 2, 3)}
numbers = {f"{maps[1].plane.title}: {name}": value for name, value in kept.items()}
write("regime_maps", page, numbers, figure, dpi=90, colors=200)
say("done")
