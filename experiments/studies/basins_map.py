# %% [markdown]
# # Basins of coexisting motions
#
# If several motions are stable for the same parameters, the start decides between them. `vi.basins`
# simulates a grid of starts, finds the motions and labels each start. Does it find all of them? For
# comparison, `vi.all_orbits` searches for motions of 1 to 6 cycles, stable or not, by Newton's
# method from random starts. The shares of the grid are compared with those of random starts. The
# stability of each motion is compared with its Lyapunov exponents.
#
# Run with `python experiments/studies/basins_map.py` (`--quick` for a coarse grid and few cycles).

# %%
import sys
from pathlib import Path
from typing import Any

import numpy as np
import vi_jax as vi
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.study import QUICK, say, write
from tools.tables import table

SIDE, SETTLE, SAMPLES = (32, 400, 400) if QUICK else (160, 3000, 8192)
GUESSES, PERIODS = (128, 2) if QUICK else (4096, 6)
WATCHED = 600  # a whole number of periods of every motion found here
LETTERS = "ABCDEFGHIJ"
# Impacts lie near φ = 0, so the section is half a turn later.
MACHINE = vi.Scene.ideal(
    frequency_ratio=3.2, restitution=0.9, gap=1.05, damping_ratio=0.002
).at_section(np.pi)
REGION = {"start.Y": (-3.5, 1.05), "start.V": (-4.0, 4.0)}

# %% [markdown]
# ## Grid, random starts, and Newton's method

# %%
options: dict[str, Any] = {
    "settle": SETTLE, "lanes": 256 if QUICK else 4096, "workers": 2, "progress": False
}  # fmt: skip
grid = vi.basins(MACHINE, REGION, resolution=SIDE, **options)
say(grid)
random = vi.basins(MACHINE, REGION, samples=SAMPLES, seed=1, **options)
searched = vi.all_orbits(MACHINE, PERIODS, region=REGION, starts=GUESSES)
known = sorted(
    zip(searched.orbits, searched.found, strict=True),
    key=lambda x: (int(x[0].cycles), float(abs(x[0].multipliers[0]))),
)
say(searched)


def twin(one: vi.Attractor, others: Any) -> vi.Attractor | None:
    """Return the same motion among others; `None` if it is not there."""
    here = np.array([one.sections["Y"][0], one.sections["V"][0]])
    for other in others:
        points = np.stack([other.sections["Y"], other.sections["V"]], axis=1)
        if one.period == other.period and np.abs(points - here).max(axis=1).min() < 1e-2:
            return other
    return None


def size_of(one: vi.Attractor) -> float:
    """Return the modulus of the largest multiplier over the period, from Lyapunov exponents."""
    start = MACHINE.start(Y=one.sections["Y"][0], V=one.sections["V"][0])
    seen = vi.lyapunov(MACHINE, start, WATCHED, settle=0, method=vi.ExactFlight())
    return float(np.exp(one.period * seen.per_cycle[0]))


# %% [markdown]
# ## The picture

# %%
figure = Figure(figsize=(8.6, 5.8), layout="constrained")
FigureCanvasAgg(figure)
ax = figure.subplots()
vi.plot_basins(grid, ax=ax)
for i, (orbit, _) in enumerate(known):
    Y, V = np.asarray(orbit.sections.Y), np.asarray(orbit.sections.V)
    if not bool(orbit.stable):
        ax.plot(Y, V, "kX", ms=6, mec="w", mew=0.6, zorder=6)
    look = {"xytext": (5, 4), "textcoords": "offset points", "fontsize": 9, "zorder": 7}
    for place in zip(Y, V, strict=True):
        ax.annotate(LETTERS[i], place, **look)
ax.set(xlabel="Y at the start (φ = π), a", ylabel="V at the start, a ω")
ax.set_title("Which start settles on which motion; crosses: unstable motions")

# %% [markdown]
# ## The tables

# %%
rows, numbers = [], {}


def row_of(name: str, impacts: str, place: str, here: float, there: float, size: str) -> None:
    """Add a row with both shares and their difference."""
    p = (here * SIDE**2 + there * SAMPLES) / (SIDE**2 + SAMPLES)
    error = (there * (1 - there) / SAMPLES) ** 0.5
    both = (p * (1 - p) * (1 / SIDE**2 + 1 / SAMPLES)) ** 0.5
    shares = f"{100 * here:.2f}", f"{100 * there:.2f} ± {100 * error:.2f}"
    rows.append((name, impacts, place, *shares, f"{(here - there) / both:+.1f}", size))


for a in grid.attractors:
    other, size = twin(a, random.attractors), size_of(a)
    place = f"({a.sections['Y'][0]:.5f}, {a.sections['V'][0]:.5f})"
    name = f"{2 * a.period}π"
    share = other.fraction if other else 0.0
    row_of(name, f"{a.impacts:g}", place, a.fraction, share, f"{size:.4f}")
    numbers[f"multiplier of the {name} motion, {a.impacts:g} impacts"] = size
for name, part in grid.irregular.items():
    if part or random.irregular[name]:
        row_of(name, "–", "–", part, random.irregular[name], "–")
listed = []
for i, (orbit, counts) in enumerate(known):
    size, periods = float(abs(orbit.multipliers[0])), np.flatnonzero(counts) + 1
    numbers[f"largest multiplier of {LETTERS[i]}"] = size
    listed.append((
        LETTERS[i], f"{2 * int(orbit.cycles)}π", int(orbit.impacts),
        f"({float(orbit.state.Y):.6f}, {float(orbit.state.V):.6f})", f"{size:.6f}",
        "yes" if bool(orbit.stable) else "no",
        f"{int(np.sum(counts)):,} (n = {', '.join(map(str, periods))})",
    ))  # fmt: skip
heads = ["period", "impacts", "section (Y, V)", "grid, %", "random, %", "off", "multiplier"]
found = ["motion", "period", "impacts", "section (Y, V)", "largest multiplier", "stable"]
page = f"""# Basins of coexisting motions

![Which start settles on which motion](../figures/basins_map.png)

Ideal drive, ζ = 3.2, k = 0.9, d = 1.05, ξ = 0.002, section at φ = π. *Grid* and *random* are shares
of all starts (grid: {SIDE}² cell centres; random: {SAMPLES:,} starts with standard error); *off* is
their difference in standard errors of both together; *multiplier* the size of the greatest one over
the period, from Lyapunov exponents over {WATCHED} cycles.

{table(heads, rows)}

The periodic motions of 1 to {PERIODS} cycles that `vi.all_orbits` finds from {GUESSES:,} random
starts for each period:

{table([*found, "searches that found it"], listed)}

- `vi.basins` finds the four stable motions of that list with their multipliers, and one more, of 15
  cycles with 6 impacts, which a search for periods up to 6 cannot find. One in a hundred starts
  settles on it.
- The basins of the 4π motion and of the free motion have solid parts. Elsewhere the basins are
  mixed down to single cells, and the motion of a start depends on its last digits.
- The multiplier of the free motion is e^(-2πξ/ζ), so motions settle on it most slowly. Starts that
  have not reached it count as unsettled after {SETTLE:,} cycles.
- Random starts agree with the grid within their error. A grid's own error is smaller than that of
  as many random starts, where the basins have whole parts.
"""
print(page)
write("basins_map", page, numbers, figure, dpi=100)
say("done")
