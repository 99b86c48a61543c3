# %% [markdown]
# # Regime maps
#
# What the ideally driven machine (d = 2) settles on from rest, at every point of the planes (ζ, k)
# and (ζ, c): the period in drive cycles, chaos, transient chaos (what was chaotic, and is not any
# more some thousand cycles later), or not settled within 400 cycles. Each map is
# 256 × 256 simulations by `vi.scan`. The curves laid over come from elsewhere: `vi.boundary`
# continues the period doubling and the fold of the 2π motion and the second touch of the 4π motion,
# and the births by grazing lie where the steady vibration without impacts just reaches the stop,
# 1/|1 - ζ² + 2iξζ| = d. So each checks the other. Random lanes are simulated again with
# `vi.Adaptive(rtol=1e-9)`.
#
# Without damping a motion without impacts never settles: the free vibration that the start left
# stays for good. The map says "unsettled" (or a period, where free and driven vibration happen to
# have one in common), and rightly so.
#
# Run with `python experiments/studies/regime_maps.py` (`--quick` for coarse maps and fewer curves).

# %%
import itertools
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import vi_jax as vi
import xarray as xr
from matplotlib import patheffects
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from vi_jax.plot.colors import DASHES

jax.config.update("jax_enable_x64", True)

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/studies")
sys.path.insert(0, str(HERE.parent))
from headlines import keep

QUICK = "--quick" in sys.argv
BEGIN = time.perf_counter()
SIDE, SAMPLE, LANES = (48, 200, 768) if QUICK else (256, 2000, 4096)
SETTLE, WORKERS, GAP = 400, 2, 2.0
LASTING = vi.Regime().lasting
LATE, LOOKED_AT = (4000, 50) if QUICK else (20_000, 500)
TABLE_C = float(vi.Parameters().damping)
XI_PER_C = float(vi.Parameters(damping=1.0).scene(drive="ideal").damping_ratio)
RATIO, K, XI = "drive.frequency_ratio", "stops.0.restitution", "oscillator.damping_ratio"
RANGE = (0.5, 1.9)
ZETA, KS = np.linspace(*RANGE, SIDE), np.linspace(0.05, 0.95, SIDE)
CS = np.linspace(0.0, 1.2, SIDE)


def say(text: object) -> None:
    print(f"[{time.perf_counter() - BEGIN:5.1f} s] {text}", flush=True)


def machine(zeta, k, c) -> vi.Scene:
    """The ideal scene of Table 1's machine with c in N·s/m. One for all maps: one program."""
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=GAP, damping_ratio=c * XI_PER_C)


def settled(
    axes: dict,
    method: vi.AbstractMethod,
    *,
    paired: bool = False,
    lanes: int = LANES,
    settle: int = SETTLE,
) -> xr.Dataset:
    """What the lanes settle on from rest."""
    return vi.scan(
        machine, axes, measure="regime", settle=settle, method=method, paired=paired,
        workers=WORKERS, lanes=lanes, progress=False,
    )  # fmt: skip


# %% [markdown]
# ## The closed form
#
# It knows all motions with one impact in so many cycles, and shares nothing with a simulation.

# %%
CHUNK = 2048  # points in one call: one program for any number


@partial(jax.jit, static_argnames="cycles")
def closed_form(zeta, k, c, *, cycles: int) -> vi.ClosedFormOrbits:
    """Two motions, or less, at every point."""
    return jax.vmap(lambda *x: vi.closed_form_orbits(machine(*x), cycles=cycles))(zeta, k, c)


def known(lanes: dict[str, np.ndarray], cycles: int) -> np.ndarray:
    """Whether there is a stable admissible motion at these points."""
    out = []
    size = lanes["zeta"].size
    for i in range(0, size, CHUNK):
        place = np.minimum(np.arange(i, i + CHUNK), size - 1)
        found = closed_form(*(lanes[name][place] for name in ("zeta", "k", "c")), cycles=cycles)
        stable = np.max(np.abs(found.multipliers), axis=-1) < 1
        out.append(np.any(found.admissible & stable, axis=1))
    return np.concatenate([*out, np.zeros(0, bool)])[:size]


# %% [markdown]
# ## The curves
#
# What takes their time is tracing and compiling; meanwhile the map's program is compiled too.


# %%
def branch(k: float, c: float, cycles: int) -> vi.Branch:
    """The motions with one impact in so many cycles, in ζ, by continuation from ζ = 0.9."""
    scene = machine(0.9, k, c)
    point = (np.full(CHUNK, x) for x in (0.9, k, c))
    closed = closed_form(*point, cycles=cycles)
    start = scene.start(Y=closed.Y[0, 0], V=closed.V[0, 0])
    orbit = vi.find_orbit(scene, start, cycles=cycles, throw=True)
    return vi.continue_orbit(orbit, parameter=RATIO, bounds=RANGE)


def curve(of: vi.Branch, kind: str, parameter: str) -> np.ndarray:
    """Points (ζ, k) or (ζ, c) of the first special point of a kind, followed both ways."""
    point = min((p for p in of.special if p.kind == kind), key=lambda p: p.parameter)
    other = (0.02, 0.999) if parameter == K else (0.0, CS[-1] * XI_PER_C)
    found = vi.boundary(point, parameter=parameter, bounds=(RANGE, other), max_step=0.03)
    points = found.parameters.copy()
    if parameter == XI:
        points[:, 1] /= XI_PER_C
    return points


def births(c: np.ndarray) -> list[np.ndarray]:
    """Points (ζ, c) at which the vibration without impacts just reaches the stop."""
    xi = c * XI_PER_C
    middle, half = 1 - 2 * xi**2, np.sqrt((1 - 2 * xi**2) ** 2 - 1 + GAP**-2)
    return [np.stack([np.sqrt(middle + s * half), c], axis=1) for s in (-1, 1)]


class Plane(NamedTuple):
    title: str
    axes: dict[str, np.ndarray]
    other: str
    curves: dict[str, list[np.ndarray]]

    def lane(self, i: np.ndarray, j: np.ndarray) -> dict[str, np.ndarray]:
        """The axes' values of lanes of the map."""
        place = {"zeta": i, self.other: j}
        return {name: x[place.get(name, np.zeros_like(i))] for name, x in self.axes.items()}


def followed(threads: ThreadPoolExecutor) -> list[Plane]:
    """The planes with their curves."""
    grid = {"zeta": ZETA, "k": KS}
    whole = np.array([0.0, 1.0])
    undamped, long = threads.map(lambda n: branch(0.5, 0.0, n), (1, 2))
    jobs = {
        ("k", "doubling"): (undamped, "period-doubling", K),
        ("k", "touch"): (long, "grazing", K),
        ("k", "fold"): (undamped, "fold", K),
    }
    if not QUICK:
        jobs |= {
            ("c", "doubling"): (undamped, "period-doubling", XI),
            ("c", "touch"): (long, "grazing", XI),
            ("c", "fold"): (undamped, "fold", XI),
        }
    found = dict(zip(jobs, threads.map(lambda job: [curve(*job)], jobs.values()), strict=True))
    # With damping the programs are the same; the 4π motion with one impact is found at k = 0.8.
    damped, damped_long = branch(0.5, TABLE_C, 1), branch(0.8, TABLE_C, 2)
    table = {
        "doubling": [curve(damped, "period-doubling", K)],
        "touch": [curve(damped_long, "grazing", K)],
        "fold": [curve(damped, "fold", K)],
    }
    planes = []
    for c, title, own in (
        (0.0, "without damping", {n: x for (plane, n), x in found.items() if plane == "k"}),
        (TABLE_C, f"c = {TABLE_C:g} N·s/m (Table 1)", table),
    ):
        own["birth"] = [np.stack([points[:, 0], whole], axis=1) for points in births(c + 0 * whole)]
        planes.append(Plane(f"(ζ, k), {title}", {**grid, "c": np.array([c])}, "k", own))
    own = {n: x for (plane, n), x in found.items() if plane == "c"} | {"birth": births(CS)}
    axes = {"zeta": ZETA, "k": np.array([0.5]), "c": CS}
    return [*planes, Plane("(ζ, c), k = 0.5", axes, "c", own)]


with ThreadPoolExecutor(2) as threads:
    few = {"zeta": ZETA[:16], "k": KS[: LANES // 16], "c": np.zeros(1)}
    pairs = {"zeta": ZETA[:16], "k": KS[:16], "c": np.full(16, 0.5)}
    tasks = [
        threads.submit(settled, few, vi.ExactFlight()),
        threads.submit(settled, pairs, vi.Adaptive(rtol=1e-9), paired=True, lanes=256),
    ]
    with ThreadPoolExecutor(2) as others:
        planes = followed(others)
    for task in tasks:
        task.result()
say("compiled")
for plane in planes:
    for name, parts in plane.curves.items():
        low, high = np.min(parts[0], axis=0), np.max(parts[0], axis=0)
        say(f"{plane.title}: {name} from {np.round(low, 4)} to {np.round(high, 4)}")

# %% [markdown]
# ## The maps


# %%
class Seen(NamedTuple):
    plane: Plane
    data: xr.Dataset
    period: np.ndarray
    impacts: np.ndarray
    wall: float
    cpu: float


maps = []
for plane in planes:
    begin = os.times()
    data = settled(plane.axes, vi.ExactFlight()).squeeze(drop=True)
    end = os.times()
    wall, cpu = end.elapsed - begin.elapsed, sum(end[:2]) - sum(begin[:2])
    seen = Seen(plane, data, data["period"].values, data["impacts"].values, wall, cpu)
    maps.append(seen)
    say(f"{plane.title}: {wall:.1f} s, {cpu:.1f} s of CPU time")

# %% [markdown]
# ## What cannot be
#
# A lane said to be on a motion with one impact in one or two cycles must have such a motion, stable
# and admissible, in the closed form (every third lane is looked at); and no lane can be free
# between the births.


# %%
def impossible(seen: Seen) -> tuple[int, int, int]:
    """Lanes on a motion with one impact; those of them that should not be; free ones likewise."""
    total = wrong = 0
    for cycles in (1, 2):
        i, j = np.argwhere((seen.period == cycles) & (seen.impacts == 1))[::3].T
        total += i.size
        wrong += int(np.sum(~known(seen.plane.lane(i, j), cycles)))
    levels = seen.plane.axes[seen.plane.other]
    left, right = (np.interp(levels, *x[:, ::-1].T) for x in seen.plane.curves["birth"])
    between = (ZETA[:, None] > left) & (ZETA[:, None] < right)
    return total, wrong, int(np.sum(between & (seen.impacts == 0)))


limits = [impossible(seen) for seen in maps]
for seen, found in zip(maps, limits, strict=True):
    say(f"{seen.plane.title}: {found[0]} lanes of one impact, impossible {found[1]}, {found[2]}")

# %% [markdown]
# ## Chaos that lasts
#
# While a chaotic transient lasts nothing tells it from chaos. Some of the lanes called chaotic are
# looked at again, much later.


# %%
rng = np.random.default_rng(0)


def over_later(seen: Seen) -> tuple[int, int]:
    """Of so many lanes called chaotic, those that are no longer so."""
    chaotic = np.argwhere(seen.period == vi.REGIMES.chaotic)
    i, j = rng.permutation(chaotic)[:LOOKED_AT].T
    late = settled(seen.plane.lane(i, j), vi.ExactFlight(), paired=True, settle=LATE)
    return i.size, int(np.sum(late["period"].values != vi.REGIMES.chaotic))


over = [over_later(seen) for seen in maps]
for seen, (size, gone) in zip(maps, over, strict=True):
    say(f"{seen.plane.title}: of {size} chaotic lanes {gone} are not after {LATE:,} cycles")

# %% [markdown]
# ## Again by Adaptive
#
# Random lanes of each map. A lane lies at a border if one of its eight neighbours in the map has
# another regime.


# %%
def borders(seen: Seen) -> np.ndarray:
    """Which lanes have a neighbour of another regime."""
    kind = np.stack([seen.period, np.where(seen.period > 0, seen.impacts, -1)])
    wide = np.pad(kind, ((0, 0), (1, 1), (1, 1)), mode="edge")
    size = kind.shape[1]
    shifted = [
        wide[:, a : a + size, b : b + size] for a, b in itertools.product(range(3), repeat=2)
    ]
    return np.any([np.any(kind != s, axis=0) for s in shifted], axis=0)


picked = rng.integers(0, SIDE, (len(maps), 2, SAMPLE))
lanes = [seen.plane.lane(*place) for seen, place in zip(maps, picked, strict=True)]
begin = os.times()
again = settled(
    {name: np.concatenate([lane[name] for lane in lanes]) for name in lanes[0]},
    vi.Adaptive(rtol=1e-9),
    paired=True,
    lanes=256,
)
say(f"{again.sizes['sample']} lanes by Adaptive in {os.times().elapsed - begin.elapsed:.1f} s")
differing = []
for seen, (i, j), part in zip(maps, picked, range(len(maps)), strict=True):
    one = again.isel(sample=slice(part * SAMPLE, (part + 1) * SAMPLE))
    period, impacts = one["period"].values, one["impacts"].values
    was, had = seen.period[i, j], seen.impacts[i, j]
    other = (period != was) | ((period > 0) & (impacts != had))
    irregular = other & ((was <= 0) | (period <= 0))
    edge = other & ~irregular & borders(seen)[i, j]
    rest = other & ~irregular & ~edge
    differing.append((int(other.sum()), int(irregular.sum()), int(edge.sum()), int(rest.sum())))
    for n in np.flatnonzero(other):
        where = ", ".join(f"{name} = {x[n]:.4f}" for name, x in lanes[part].items())
        say(
            f"{where}: ExactFlight {was[n]} ({had[n]:.4g}), Adaptive {period[n]} ({impacts[n]:.4g})"
        )

# %% [markdown]
# ## The picture

# %%
LOOKS = {
    "birth": (
        "w",
        DASHES["grazing"],
        "2π: born where the free motion reaches the stop",
    ),
    "doubling": ("w", DASHES["period-doubling"], "2π: period doubling"),
    "fold": ("w", DASHES["fold"], "2π: fold"),
    "touch": ("#ffe08a", DASHES["grazing"], "4π with one impact: touches the stop again"),
}
figure = Figure(figsize=(15.5, 5.6), layout="constrained")
FigureCanvasAgg(figure)
names: dict[str, Patch] = {}
for ax, seen in zip(figure.subplots(1, 3), maps, strict=True):
    other = seen.plane.other
    vi.plot_regimes(seen.data, ax=ax, x="zeta", y=other)
    legend = ax.get_legend()
    for patch in legend.get_patches():
        names.setdefault(patch.get_label(), patch)
    legend.remove()
    levels = seen.plane.axes[other]
    for name, parts in seen.plane.curves.items():
        color, style, _ = LOOKS[name]
        for points in parts:
            (line,) = ax.plot(*points.T, ls=style, color=color, lw=1.7)
            line.set_path_effects(
                [patheffects.Stroke(linewidth=3.0, foreground="k"), patheffects.Normal()]
            )
    if other == "c":
        ax.axhline(TABLE_C, color="k", lw=0.8, ls=":")
    ax.set(xlim=RANGE, ylim=(levels[0], levels[-1]), xlabel="frequency ratio ζ")
    ax.set_ylabel("restitution k" if other == "k" else "damping c (N·s/m)")
    ax.set_title(f"{seen.plane.title}", fontsize=11)

order = {f"{2 * n}π": n for n in range(1, 9)}
patches = [names[x] for x in sorted(names, key=lambda x: (order.get(x.partition(",")[0], 9), x))]
lines = [
    Line2D([], [], color=color, ls=style, lw=2.0, label=label, path_effects=[
        patheffects.Stroke(linewidth=3.4, foreground="k"), patheffects.Normal()
    ])
    for color, style, label in LOOKS.values()
]  # fmt: skip
figure.legend(
    handles=[*patches, *lines], loc="outside lower center", ncols=6, frameon=False, fontsize=9
)
figure.suptitle(
    f"What the machine settles on from rest within {SETTLE} cycles (ideal drive, Δ = 2a)"
)

# %% [markdown]
# ## The table


# %%
def shares(seen: Seen) -> list[float]:
    """Parts of the lanes (percent) by what they settle on."""
    free, p, n, R = seen.impacts == 0, seen.period, seen.impacts, vi.REGIMES
    parts = [
        free & (p > 0), free & (p == R.unsettled), ~free & (p == 1), ~free & (p == 2) & (n == 1),
        ~free & (p == 2) & (n > 1), ~free & (p > 2), p == R.chaotic, p == R.transient,
        ~free & (p == R.unsettled),
    ]  # fmt: skip
    return [100 * float(np.mean(part)) for part in parts]


longest = [int(np.max(seen.period[seen.impacts > 0], initial=0)) for seen in maps]
head = [seen.plane.title for seen in maps]
rows: list[tuple[str, list[str]]] = [
    ("wall time, s", [f"{seen.wall:.1f}" for seen in maps]),
    ("CPU time, s", [f"{seen.cpu:.1f}" for seen in maps]),
]
kinds = (
    "without impacts, periodic, %", "without impacts, not periodic, %", "2π with impacts, %",
    "4π with one impact, %", "4π with more impacts, %", "longer periods, %", "chaotic, %",
    "transiently chaotic, %", "impacts, not settled, %",
)  # fmt: skip
for name, values in zip(kinds, zip(*map(shares, maps), strict=True), strict=True):
    rows.append((name, [f"{value:.2f}" for value in values]))
rows.append(("longest period with impacts, cycles", [str(n) for n in longest]))
rows.append(
    (
        f"of so many chaotic lanes: not chaotic after {LATE:,} cycles",
        [f"{gone} of {size}" for size, gone in over],
    )
)
rows += [
    ("every third lane on a 2π or 4π motion with one impact", [f"{x[0]:,}" for x in limits]),
    ("of these: no such stable motion in the closed form", [str(x[1]) for x in limits]),
    ("lanes without impacts between the births", [str(x[2]) for x in limits]),
    (f"of {SAMPLE:,} random lanes: another regime by Adaptive", [str(x[0]) for x in differing]),
    ("of these: chaotic or unsettled by one of the two", [str(x[1]) for x in differing]),
    ("regular, with a neighbour of another regime", [str(x[2]) for x in differing]),
    ("neither", [str(x[3]) for x in differing]),
]
table = [
    "# Regime maps",
    "",
    f"Ideal drive, d = 2, from rest, {SETTLE} cycles to settle and 128 observed; what is chaotic",
    f"there is continued for {LASTING:,} cycles, and is called transiently chaotic if it is not "
    "chaotic",
    f"then. {SIDE} × {SIDE} lanes a map by `ExactFlight`, {WORKERS} workers on {WORKERS} cores, "
    "compiled before.",
    "",
    f"| | {' | '.join(head)} |",
    "|---|---|---|---|",
    *(f"| {name} | {' | '.join(values)} |" for name, values in rows),
]
table.append(
    f"""
- The curves and the maps know nothing of each other. The 2π motion gives way to the 4π motion on
  the doubling curve, grey where it is crossed so slowly that {SETTLE} cycles do not suffice; the
  4π motion with one impact lies inside the dashed curve; no lane is free between the births; and
  of {sum(x[0] for x in limits):,} lanes on a motion with one impact that were looked at,
  {sum(x[1] for x in limits)} have no such stable motion in the closed form.
- The maps end before the fold: between the second birth and the fold the 2π impact motion and the
  free one are both stable, and the start at rest goes to the free one from some ζ on.
- Without damping the free vibration left by the start never dies out: right of ζ = √2, where it
  does not reach the stop, the motion is rightly called not periodic (vertical lines: ζ at which it
  is, by chance). Left of the first birth the same vibration leads to rare impacts. With
  c = 0.1 and more all that is gone; the chaos that remains lies at the first birth and, up to
  c = 0.2, in a tongue about ζ = 0.55.
- Transient chaos: without damping the body hits the stop irregularly for hundreds to tens of
  thousands of cycles; what is left in the end mostly stays off the stop for good, or meets it a few
  times in some hundred cycles, or is periodic. With damping some lanes at the first birth do so
  too. While it lasts nothing tells it from chaos: {over[0][1]} of {over[0][0]} lanes called chaotic
  without damping are not after {LATE:,} cycles. So "chaotic" says: still so after some {LASTING:,}
  cycles.
- Left of the paper's range of interest Table 1's machine hits the stop in a small island near
  ζ = 0.6 (k above 0.85), and along the birth it has motions of longer periods and chaos.
- `Adaptive` gives {sum(x[0] for x in differing)} of {SAMPLE * len(maps):,} random lanes another
  regime; {sum(x[1] for x in differing)} of these are chaotic or unsettled by one of the two: long
  transients and chaos, where each method goes its own way.
"""
)
print("\n".join(table))
# With Table 1's damping nearly all lanes settle, so that a test finds these parts on fewer lanes.
table_map = next(seen for seen in maps if seen.plane.title.endswith("(Table 1)"))
numbers = {
    f"{table_map.plane.title}: {name}": round(value, 2)
    for name, value in zip(kinds, shares(table_map), strict=True)
    if name in ("without impacts, periodic, %", "2π with impacts, %", "4π with one impact, %")
}
if not QUICK:
    keep(HERE, "regime_maps", "\n".join(table), numbers, figure, dpi=90, colors=200)
say(f"done, {time.process_time():.0f} s of CPU time")
