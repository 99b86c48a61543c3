# %% [markdown]
# # Where the paper's discrepancy lives
#
# Between the lines BB' and CC' of the paper's Figure 2 the analytical 2π motion is unstable and the
# simulated motion has the period 4π. Here the borders of that region are followed in two
# parameters at once: in the plane (ζ, k) without damping, and in the plane (ζ, c) for k = 0.5, with
# c the damping of Table 1's machine in N·s/m. The dots say what a simulation from rest settles on;
# it knows nothing of the curves. Each curve is checked in two more ways: against the closed form
# on it, and by a simulation on either side of it.
#
# Run with `python experiments/studies/boundaries.py` (`--quick` for fewer curves and dots).

# %%
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.path import Path as Polygon
from vi_jax.paper.boundaries import (
    LONG_LINE,
    birth_without_damping,
    boundary_curves,
    describe_boundaries,
    draw_boundaries,
    plane_points,
    table_damping,
)
from vi_jax.plot.colors import color_of

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from studies.parts.boundary_checks import (
    SETTLE,
    SPANS,
    beside,
    checked,
    miss,
    numbers,
    settle_all,
)
from tools.ideal import closed_forms
from tools.pictures import legend_below
from tools.study import QUICK, say, write
from tools.tables import table

# %% [markdown]
# ## The curves

# %%
curves = boundary_curves(quick=QUICK)
described = describe_boundaries(curves)
born, tested = birth_without_damping(curves), checked(curves)
say(f"{sum(len(c.parameters) for c in curves if c)} points on {sum(c is not None for c in curves)}")
for name, value in described.items():
    print(f"  {name}: {value if value is None else round(value, 6)}")

# %% [markdown]
# ## On the curves: the closed form
#
# It shares nothing with the continuation, which flies from impact to impact. A period doubling must
# have a multiplier -1, a touch a clearance of zero, a fold two motions that are one, and at
# the birth the steady vibration without impacts must reach the stop: 1/|1 - ζ² + 2iξζ| = d.

# %%
misses = [miss(curve) for curve in tested]
# The damping at which the 2π motion of Figure 3 becomes stable, by the closed form alone.
near = np.linspace(0.2705, 0.2717, 200)
found = closed_forms(numbers("c", np.stack([np.full(200, 0.9), near], axis=1)), 1)
least = np.min(found.multipliers[:, 0].real, axis=1)
stable_from = float(np.interp(-1.0, least, near))
# The closed form knows every 4π motion with one impact, of other families too.
scan = np.linspace(0.5, 1.5, 512)
found = closed_forms(numbers("c", np.stack([scan, np.full(512, table_damping())], axis=1)), 2)
table_ratios = scan[np.any(found.admissible, axis=1)]
say(f"4π with one impact at Table 1's c: {len(table_ratios)} of {scan.size} ζ: {table_ratios}")
say(f"on the curves: {max(misses):.1e} at worst; period doubling at c = {stable_from:.7f}")

# %% [markdown]
# ## Beside the curves, and everywhere: simulations
#
# On either side of a curve a simulation begins near the motion that the curve is about, and either
# stays with it or does not. At a touch the first four cycles decide: two impacts, or more. One
# compiled call does all of them and the map from rest.

# %%
starts = [beside(curve) for curve in tested]
across, up = (9, 5) if QUICK else (33, 17)
ranges = {"k": (0.06, 0.98), "c": (0.01, 1.16)}
maps = {}
for plane, (low, high) in ranges.items():
    zeta, other = np.meshgrid(np.linspace(0.69, 1.01, across), np.linspace(low, high, up))
    maps[plane] = np.stack([zeta.ravel(), other.ravel()], axis=1)
lanes = [(s.x, s.Y, s.V) for s in starts]
lanes += [(numbers(p, m), np.zeros(len(m)), np.zeros(len(m))) for p, m in maps.items()]
packed = [jnp.asarray(np.concatenate(part)) for part in zip(*lanes, strict=True)]
assert all(bool(jnp.all(jnp.isfinite(part))) for part in packed)
seen = [np.asarray(part) for part in settle_all(*packed)]
edges = np.cumsum([len(lane[1]) for lane in lanes])[:-1]
period, impacts, early = (np.split(part, edges) for part in seen)
say(f"{len(packed[1])} simulations of {SETTLE + 32} cycles")

rows = []
for i, (curve, start) in enumerate(zip(tested, starts, strict=True)):
    if curve.kind == "touch":
        stays, test = early[i] == 2, "two impacts in the first 8π"
    elif curve.kind == "birth":
        stays, test = early[i] == 0, "the steady vibration has no impact in 8π"
    else:
        stays = (period[i] == curve.cycles) & (impacts[i] == 1)
        off = 1e-3 if (curve.kind, curve.cycles) == ("doubling", 1) else 1e-4
        test = f"a start {off:g} off settles on it"
    right = int(np.sum(stays == start.stays))
    for x, a, b in zip(start.x, stays, start.stays, strict=True):
        if a != b:
            say(f"disagrees: {curve.name} {curve.plane} at {x}, simulation {a}, curve {b}")
    rows.append((curve, test, misses[i], right, len(stays)))
    say(f"{curve.name} ({curve.plane}): miss {misses[i]:.1e}, {right}/{len(stays)} beside it")


# %% [markdown]
# ## What is seen from rest, inside and outside


# %%
def seen_as(period: np.ndarray, impacts: np.ndarray) -> np.ndarray:
    """0: 2π with one impact; 1: 4π with one; 2: 4π with more; 3: anything else; 4: no impact."""
    kinds = np.full(len(period), 3)
    kinds[(period == 2) & (impacts > 1)] = 2
    kinds[(period == 2) & (impacts == 1)] = 1
    kinds[(period == 1) & (impacts == 1)] = 0
    kinds[impacts == 0] = 4
    return kinds


def shares(plane: str, points: np.ndarray, kinds: np.ndarray) -> list[list[Any]]:
    """Counts of what is seen in the parts into which the curves divide a plane."""
    doubling, touch = (
        plane_points(getattr(curves, f"{name}_{plane}")) for name in ("doubling", "touch")
    )
    order = np.argsort(doubling[:, 1])
    right = np.interp(points[:, 1], doubling[order, 1], doubling[order, 0])
    birth = plane_points(curves.birth_c)
    order = np.argsort(birth[:, 1])
    left = np.interp(points[:, 1], birth[order, 1], birth[order, 0])
    left = np.full(len(points), born) if plane == "k" else left
    unstable = (points[:, 0] > left) & (points[:, 0] < right)
    inside = Polygon(touch / SPANS).contains_points(points / SPANS)
    parts = {
        "2π unstable, 4π with one impact exists": unstable & inside,
        "2π unstable, no such 4π motion": unstable & ~inside,
        "2π stable": points[:, 0] >= right,
    }
    where = "(ζ, k)" if plane == "k" else "(ζ, c)"
    return [
        [where, name, np.sum(part), *(np.sum(part & (kinds == kind)) for kind in range(5))]
        for name, part in parts.items()
    ]


figure = draw_boundaries(curves)
LOOKS = [
    ("o", color_of(1, 1), "2π, one impact"),
    ("o", LONG_LINE, "4π, one impact"),
    ("s", color_of(2, 2), "4π, more impacts"),
    ("x", "0.3", "longer, or no period"),
    ("_", "0.5", "no impact"),
]
tallies, highest = [], 0.0
for i, (plane, points) in enumerate(maps.items()):
    kinds = seen_as(period[len(starts) + i], impacts[len(starts) + i])
    tallies += shares(plane, points, kinds)
    if plane == "c":
        highest = float(np.max(points[(kinds == 1) | (kinds == 2), 1]))
    ax = figure.axes[2 * i + 1]
    for kind, (marker, color, _) in enumerate(LOOKS):
        ax.plot(*points[kinds == kind].T, marker, color=color, ms=3, mew=0.8, ls="none", zorder=2.5)
old = figure.legends[0]
handles = [h for h in old.legend_handles if h is not None]
handles += [
    Line2D([], [], marker=marker, color=color, ls="none", ms=5, label=f"from rest: {label}")
    for marker, color, label in LOOKS
]
old.remove()
legend_below(figure, handles, 4)

# %% [markdown]
# ## The table

# %%
PLANES = {"k": "(ζ, k), undamped", "c": "(ζ, c), k = 0.5"}
checks = []
for curve, test, value, right, total in rows:
    exact = (curve.kind, curve.plane) == ("birth", "k")
    count = "exact line" if exact else len(curve.points)
    cells = [curve.name, PLANES[curve.plane], count, f"{value:.0e}", test]
    checks.append([*cells, f"{right} of {total}"])
heads = ["curve", "plane", "points", "miss", "simulated", "beside it"]
others = ["2π, one impact", "4π, one impact", "4π, more", "other", "no impact"]
values = [
    *((name, "none" if x is None else f"{x:.5f}") for name, x in described.items()),
    ("doubling at ζ = 0.9, k = 0.5, c, by the closed form alone", f"{stable_from:.7f}"),
    ("greatest c of the map at which a 4π motion is seen", f"{highest:.3f}"),
    (
        "ζ of any 4π motion with one impact at Table 1's c, k = 0.5, by the closed form",
        f"{table_ratios.min():.3f} … {table_ratios.max():.3f}",
    ),
]
birth_table, doubling_table = (
    described[f"{name} at Table 1's c, k = 0.5, ζ"] for name in ("birth", "doubling")
)
page = f"""# Where the paper's discrepancy lives

Ideal drive, d = 2 (a gap of 0.08 m). Curves by `vi.boundary` in (ζ, k) without damping and
in (ζ, c) for k = 0.5, c in N·s/m. *Miss*: worst residual of the closed form on the curve
(multiplier + 1, clearance in a, or, at a birth, 1/|1 - ζ² + 2iξζ| - d; at a fold the
distance in ζ to either side at which there are two motions and none). *Beside it*:
simulations 0.006 of the plane to either side, of which the curve foretold this many.

{table(heads, checks)}

What {across * up} simulations from rest in each plane settle on within {SETTLE} cycles:

{table(["plane", "part", "all", *others], tallies)}

{table(["number", "value"], values)}

- The discrepancy of Figure 2 is the whole strip between the birth of the 2π motion (BB') and its
  period doubling (CC'): no simulation from rest keeps to the 2π motion in there, and most settle
  on a 4π motion. The 4π motion with one impact, which the paper computes and Figures 3 and 4 show,
  fills only the right part of the strip. Left of it the 4π motions seen have more impacts, and
  further left the periods are longer or there is none.
- Without damping that motion needs k > {described["4π motion, undamped, from k"]:.3f}; the figures'
  ζ = 0.9, k = 0.5 lies well inside. From k = 0.71 on it is itself unstable in a part of its region,
  where no simulation shows it.
- With k = 0.5 it ends at c = {described["4π motion at k = 0.5, up to c"]:.3f} N·s/m,
  two thirds of Table 1's c. At ζ = 0.9 the 2π motion is stable from c = {stable_from:.4f} on, so
  that the figures cannot be had with Table 1's c = 0.5: the simulations around that point are on
  the 2π motion.
- Blue is the region of this family of 4π motions with one impact, the paper's; the dots show that
  there is another one outside of it (see below).
- The strip itself goes on. At Table 1's c it reaches from ζ = {birth_table:.3f} to
  {doubling_table:.3f}, and 4π motions with more than one impact are seen in it.
- Motions coexist: the touch curve runs a little outside the doubling curve near ζ = 0.9; inside it,
  with some damping, starts from rest may find a 4π motion with two impacts instead; and beside the
  birth there is another family of one-impact 4π motions, seen with c above 0.7, which the curves,
  begun without damping, do not bound. With Table 1's c it ends before the 2π motion is born.
"""
print(page)
kept = {name: x for name, x in described.items() if x is not None}
write("boundaries", page, kept, figure, dpi=100)
say("done")
