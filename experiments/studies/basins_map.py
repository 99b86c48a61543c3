# %% [markdown]
# # Basins of coexisting motions
#
# Where several motions are stable at one parameter point, the start decides. `vi.basins` simulates
# a grid of starts, finds the motions on the way and labels each start. Three machines (ideal
# drive): a lightly damped one above its natural frequency, one in which motions of 2π and 6π share
# the starts, and Table 1's above resonance, where the body may also swing free of the stop.
#
# For the first machine `vi.all_orbits` searches from random starts for motions of 1 to 6 cycles by
# Newton's method, stable or not: neither function knows of the other.
#
# The fractions of the grid are held against those of random starts with their standard error, the
# random starts' labels against `vi.FixedStep`, and the stability of each motion against its
# Lyapunov exponents.
#
# Run with `python experiments/studies/basins_map.py` (`--quick` for coarse grids and few cycles).

# %%
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import vi_jax as vi
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.study import QUICK, say, write
from tools.tables import table
from tools.timing import Clock

# One size of block for all calls: one program. Impacts lie near φ = 0; look half a turn later.
LANES, WORKERS, SECTION = (256, 2, np.pi) if QUICK else (4096, 2, np.pi)
SAMPLES, AGAIN = (400, 100) if QUICK else (8192, 1000)
GUESSES, PERIODS = (128, 2) if QUICK else (4096, 6)
# A whole number of periods of every motion found here.
WATCHED = 600
LETTERS = "ABCDEFGHIJ"


class Case(NamedTuple):
    title: str
    zeta: float
    k: float
    gap: float
    xi: float
    region: dict[str, tuple[float, float]]
    side: int
    settle: int


def region(low: float, gap: float, speed: float) -> dict[str, tuple[float, float]]:
    return {"start.Y": (low, gap), "start.V": (-speed, speed)}


TABLE_XI = float(vi.Parameters().scene(drive="ideal").damping_ratio)
CASES = [
    Case("ζ = 3.2, k = 0.9, d = 1.05, ξ = 0.002", 3.2, 0.9, 1.05, 0.002, region(-3.5, 1.05, 4.0),
         160, 3000),
    Case("ζ = 1.1, k = 0.85, d = 2, ξ = 0.005", 1.1, 0.85, 2.0, 0.005, region(-6.0, 2.0, 6.0),
         256, 800),
    Case("ζ = 1.4, k = 0.8, d = 2, Table 1's ξ = 0.0448", 1.4, 0.8, 2.0, TABLE_XI,
         region(-6.0, 2.0, 6.0), 256, 400),
]  # fmt: skip
if QUICK:
    CASES = [case._replace(side=32, settle=400) for case in CASES]


def machine_of(case: Case) -> vi.Scene:
    machine = vi.Scene.ideal(
        frequency_ratio=case.zeta, restitution=case.k, gap=case.gap, damping_ratio=case.xi
    )
    return machine.at_section(SECTION)


# %% [markdown]
# ## All motions of the first machine, by Newton's method from random starts

# %%
searched = vi.all_orbits(machine_of(CASES[0]), PERIODS, region=CASES[0].region, starts=GUESSES)
known = sorted(
    zip(searched.orbits, searched.found, strict=True),
    key=lambda x: (int(x[0].cycles), float(abs(x[0].multipliers[0]))),
)
say(searched)

# %% [markdown]
# ## Grid, random starts, another method


# %%
def matched(one: vi.Basins, other: vi.Basins) -> dict[int, int]:
    """Labels of the motions of `one` by those of `other`."""
    pairs = {}
    for a in one.attractors:
        here = np.array([a.sections["Y"][0], a.sections["V"][0]])
        for b in other.attractors:
            points = np.stack([b.sections["Y"], b.sections["V"]], axis=1)
            if a.period == b.period and np.abs(points - here).max(axis=1).min() < 1e-2:
                pairs[b.label] = a.label
    return pairs


class Found(NamedTuple):
    case: Case
    grid: vi.Basins
    clock: Clock
    random: vi.Basins
    other: int
    """Labels that `FixedStep` changed."""
    multipliers: list[float]
    """Sizes of the greatest multipliers over the period."""


everything: list[Found] = []
for case in CASES:
    machine = machine_of(case)
    options = {"settle": case.settle, "workers": WORKERS, "progress": False}
    if not everything:  # so that the clock below does not count compiling
        vi.basins(machine, case.region, resolution=4, lanes=LANES, **{**options, "settle": 10})
    with Clock() as clock:
        grid = vi.basins(machine, case.region, resolution=case.side, lanes=LANES, **options)
    say(f"{case.title}: {clock.wall:.1f} s, {clock.cpu:.1f} s of CPU time\n{grid}")
    random = vi.basins(machine, case.region, samples=SAMPLES, seed=1, lanes=LANES, **options)
    few = {"samples": AGAIN, "seed": 2, "lanes": 512}
    one = vi.basins(machine, case.region, **few, **options)
    two = vi.basins(machine, case.region, **few, method=vi.FixedStep(), **options)
    names = {**matched(one, two), -1: -1, -2: -2, -3: -3}
    labels = np.array([names.get(int(x), -9) for x in two.data["label"].values])
    other = int(np.sum(labels != one.data["label"].values))
    sizes = []
    for a in grid.attractors:
        start = machine.start(Y=a.sections["Y"][0], V=a.sections["V"][0])
        seen = vi.lyapunov(machine, start, WATCHED, settle=0, method=vi.ExactFlight())
        sizes.append(float(np.exp(a.period * seen.per_cycle[0])))
    everything.append(Found(case, grid, clock, random, other, sizes))
    say(f"random starts and FixedStep: {other} of {AGAIN} labels differ")

# %% [markdown]
# ## The picture

# %%
figure = Figure(figsize=(15.5, 5.8), layout="constrained")
FigureCanvasAgg(figure)
for ax, found in zip(figure.subplots(1, 3), everything, strict=True):
    vi.plot_basins(found.grid, ax=ax)
    handles = ax.get_legend().legend_handles
    ax.legend(
        handles=[h for h in handles if h is not None], loc="upper center", ncols=2,
        bbox_to_anchor=(0.5, -0.12), frameon=False, fontsize=10,
    )  # fmt: skip
    ax.set(title=found.case.title, xlabel="Y at the start (φ = π), a")
    ax.set_ylabel("V at the start, a ω")
first = figure.axes[0]
for i, (orbit, _) in enumerate(known):
    Y, V = np.asarray(orbit.sections.Y), np.asarray(orbit.sections.V)
    if not bool(orbit.stable):
        first.plot(Y, V, "kX", ms=6, mec="w", mew=0.6, zorder=6)
    look = {"xytext": (5, 4), "textcoords": "offset points", "fontsize": 9, "zorder": 7}
    for place in zip(Y, V, strict=True):
        first.annotate(LETTERS[i], place, **look)
figure.suptitle(
    "Which start settles on which motion; section points: circles, stable; crosses (left), unstable"
)

# %% [markdown]
# ## The table

# %%
motions, times = [], []
for found in everything:
    size = found.case.side**2
    pairs = {mine: theirs for theirs, mine in matched(found.grid, found.random).items()}
    rows = []
    for a, multiplier in zip(found.grid.attractors, found.multipliers, strict=True):
        twin = found.random.attractors[pairs[a.label]] if a.label in pairs else None
        there = twin.fraction if twin else 0.0
        where = f"({a.sections['Y'][0]:.5f}, {a.sections['V'][0]:.5f})"
        rows.append((f"{2 * a.period}π", f"{a.impacts:g}", where, a.fraction, there, multiplier))
    for name, part in found.grid.irregular.items():
        if part or found.random.irregular[name]:
            rows.append((name, "–", "–", part, found.random.irregular[name], None))
    for i, (period, impacts, where, here, there, multiplier) in enumerate(rows):
        p = (here * size + there * SAMPLES) / (size + SAMPLES)
        error = (there * (1 - there) / SAMPLES) ** 0.5
        both = (p * (1 - p) * (1 / size + 1 / SAMPLES)) ** 0.5
        off = f"{(here - there) / both:+.1f}" if both else "–"
        shown = "–" if multiplier is None else f"{multiplier:.4f}"
        title = "" if i else found.case.title
        parts = (f"{100 * here:.2f}", f"{100 * there:.2f} ± {100 * error:.2f}")
        motions.append((title, period, impacts, where, *parts, off, shown))
    case, clock = found.case, found.clock
    taken = (f"{clock.wall:.1f}", f"{clock.cpu:.1f}", f"{found.other} of {AGAIN:,}")
    times.append((case.title, f"{case.side}² × {case.settle + 128:,}", *taken))
heads = ["machine", "period", "impacts", "section (Y, V)", "grid, %", "random, %", "off"]
motions = table([*heads, "multiplier"], motions)
rows = []
for i, (orbit, counts) in enumerate(known):
    where = f"({float(orbit.state.Y):.6f}, {float(orbit.state.V):.6f})"
    size, periods = float(abs(orbit.multipliers[0])), np.flatnonzero(counts) + 1
    rows.append([
        LETTERS[i], f"{2 * int(orbit.cycles)}π", int(orbit.impacts), where, f"{size:.6f}",
        "yes" if bool(orbit.stable) else "no",
        f"{int(np.sum(counts)):,} (n = {', '.join(map(str, periods))})",
    ])  # fmt: skip
heads = ["motion", "period", "impacts", "section (Y, V)", "largest multiplier", "stable"]
orbits = table([*heads, "searches that found it"], rows)
heads = ["machine", "starts × cycles", "wall, s", "CPU, s", "labels that `FixedStep` changes"]
page = f"""# Basins of coexisting motions

Ideal drive, section at φ = π. *Grid* and *random* are parts of all starts (grid: cell
centres; random: {SAMPLES:,} starts with standard error); *off* is their difference in
standard errors of both together; *multiplier* the size of the greatest one over the period,
from Lyapunov exponents over {WATCHED} cycles.

{motions}

{table(heads, times)}

The periodic motions of 1 to {PERIODS} cycles of the first machine that `vi.all_orbits` finds from
{GUESSES:,} random starts for each period:

{orbits}

- Nothing was listed beforehand. In the first machine `vi.basins` finds the four stable motions of
  that list with their multipliers, and one more, of 15 cycles with 6 impacts, which a search for
  periods up to 6 cannot find. One in a hundred starts settles on it.
- The basins of the 4π motion and of the free one have whole parts; elsewhere the basins are mixed
  down to single cells. There the label of a start depends on the last digits, and `FixedStep`
  changes some labels while the fractions stay. In the other two machines the borders are smooth and
  it changes none.
- The multiplier of the free motion is e^(-2πξ/ζ): it is the slowest to be reached, and its late
  arrivals are what is called unsettled after 3,000 cycles.
- Random starts agree with the grid within their error. A grid's own error is smaller than that of
  as many random starts, where the basins have whole parts.
- In the third machine the body of Table 1's machine, above resonance, keeps hitting the stop or
  swings free, by its start; from rest it swings free.
"""
print(page)
numbers = {
    f"{found.case.title}: multiplier of the {2 * a.period}π motion, {a.impacts:g} impacts": size
    for found in everything
    for a, size in zip(found.grid.attractors, found.multipliers, strict=True)
}
for i, (orbit, _) in enumerate(known):
    numbers[f"largest multiplier of {LETTERS[i]}"] = float(abs(orbit.multipliers[0]))
write("basins_map", page, numbers, figure, dpi=85)
say("done")
