# %% [markdown]
# # Points of codimension two of the paper's machine
#
# Curves in two parameters meet, turn or change their sense at points of codimension two. Here those
# of the 2π motion with one impact are looked for: in the plane (ζ, ξ) for k = 0.5, on the curve of
# its grazing, the fold and the period doubling, and in (ζ, k) with Table 1's damping. All of them
# are found by the curves themselves (`Boundary.special`). They are checked where closed forms say
# where they are, and by the motions of twice the period that begin beside them.
#
# Run with `python experiments/studies/codimension_two.py` (`--quick` for fewer curves).

# %%
import sys
from pathlib import Path

import jax
import numpy as np
import vi_jax as vi
from matplotlib.lines import Line2D

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from reproduction.boundaries import table_damping, xi_per_c
from tools.ideal import GAP
from tools.pictures import gridded, legend_below, panels
from tools.study import QUICK, say, write
from tools.tables import table
from vi_jax.plot import DASHES, mark_of

ZETA, K, XI = "drive.frequency_ratio", "stops.0.restitution", "oscillator.damping_ratio"
TABLE = table_damping() * xi_per_c()
RANGES = {XI: (0.0, 0.3), K: (0.02, 0.99)}
FREE = (0.5, 2.0)

# %% [markdown]
# ## The branch at Table 1's damping, and the curves from its special points


# %%
def branch_at(zeta: float, xi: float, k: float = 0.5) -> vi.Branch:
    """The 2π motion with one impact, followed in ζ."""
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=GAP, damping_ratio=xi)
    closed = vi.closed_form_orbits(scene)
    orbit = vi.find_orbit(scene, scene.start(Y=closed.Y[0], V=closed.V[0]), throw=True)
    return vi.continue_orbit(orbit, parameter=ZETA, bounds=FREE)


branch = branch_at(0.9, TABLE)
first = {}
for point in branch.special:
    first.setdefault(point.kind, point)
wanted = [("grazing", XI), ("period-doubling", XI), ("fold", XI)]
wanted += [] if QUICK else [("period-doubling", K), ("fold", K)]
curves = {
    (kind, other): vi.boundary(first[kind], parameter=other, bounds=(FREE, RANGES[other]))
    for kind, other in wanted
}
say(f"{len(curves)} curves, {sum(len(curve.steps) for curve in curves.values())} points")
for curve in curves.values():
    say(curve)

# %% [markdown]
# ## Beside closed forms
#
# The motion without impacts grazes where 1/|1 - ζ² + 2iξζ| = d. An impact there adds to the
# distance n periods later what is proportional to sin(2πn √(1 - ξ²)/ζ): there is a resonance at
# ζ = 2n √(1 - ξ²)/m.


# %%
def resonance(n: int, m: int) -> np.ndarray:
    """(ζ, ξ) of the resonant grazing, of which ξ² solves a quadratic equation."""
    share = (2 * n / m) ** 2
    # ζ² = share (1 - ξ²) in (1 - ζ²)² + 4 ξ² ζ² = 1/d².
    roots = np.roots([
        share**2 - 4 * share, 4 * share + 2 * share * (1 - share), (1 - share) ** 2 - GAP**-2
    ])  # fmt: skip
    xi = np.sqrt(min(root.real for root in roots if root.real > 0))
    return np.array([np.sqrt(share * (1 - xi**2)), xi])


closed = {(n, m): resonance(n, m) for n, m in ((1, 2), (2, 5), (3, 7))}
resonant = [p for p in curves["grazing", XI].special if p.kind == "resonant-grazing"]
misses = {
    pair: min(np.abs(place - p.parameters).max() for p in resonant)
    for pair, place in closed.items()
}
ends = {
    kind: next(p for p in curves[kind, XI].special if p.kind == "grazing")
    for kind in ("fold", "period-doubling")
}
meets = {kind: np.abs(p.parameters - closed[1, 2]).max() for kind, p in ends.items()}
say(f"resonances miss by {max(misses.values()):.1e}, the ends by {max(meets.values()):.1e}")

# %% [markdown]
# ## Beside a degenerate doubling: where the motion of twice the period begins, and how


# %%
degenerate = [
    (other, point)
    for (kind, other), curve in curves.items()
    for point in curve.special
    if kind == "period-doubling" and point.kind == "degenerate-doubling"
]


def beside(other: str, value: float) -> tuple[float, str, str]:
    """ζ of the doubling of a machine, the side on which the motion of twice the period begins, and
    the word for its stability there."""
    xi, k = (value, 0.5) if other == XI else (TABLE, value)
    (doubling,) = (p for p in branch_at(0.9, xi, k).special if p.kind == "period-doubling")
    orbit = doubling.switch(distance=1e-3)
    side = float(np.asarray(orbit.frequency_ratio)) - doubling.parameter
    return (
        doubling.parameter,
        "above" if side > 0 else "below",
        "stable" if orbit.stable else "unstable",
    )


rows = []
for other, point in degenerate:
    value = point.parameters[1]
    for shift in (-0.02, 0.02):
        found = beside(other, value + shift)
        rows.append([("ξ" if other == XI else "k"), f"{value + shift:.4f}", f"{found[0]:.5f}",
                     *found[1:]])  # fmt: skip
        say(rows[-1])

# %% [markdown]
# ## Picture and tables

# %%
figure, axes = panels(11.0, 5.2, 1, 2)
for ax, other in zip(axes, (XI, K), strict=True):
    for (_, plane), curve in curves.items():
        if plane == other:
            vi.plot_boundary(curve, ax=ax, legend=False)
titles = (f"k = 0.5, d = {GAP:g}", f"Table 1's damping, ξ = {TABLE:.4f}, d = {GAP:g}")
gridded(axes, titles)
kinds = sorted({point.kind for curve in curves.values() for point in curve.special})
handles = [
    *(
        Line2D([], [], color="#0072b2", ls=DASHES[kind], label=f"2π: {kind}")
        for kind in ("grazing", "period-doubling", "fold")
    ),
    *map(mark_of, kinds),
]
legend_below(figure, handles, 6)

listed = [
    [f"(ζ, {'ξ' if other == XI else 'k'})", kind, point.kind,
     f"{point.parameters[0]:.8f}", f"{point.parameters[1]:.8f}"]
    for (kind, other), curve in curves.items()
    for point in curve.special
]  # fmt: skip
checks = [
    *(
        [f"resonant grazing, n = {n}, m = {m}", f"{place[0]:.8f}", f"{place[1]:.8f}",
         f"{misses[n, m]:.0e}"]
        for (n, m), place in closed.items()
    ),
    *(
        [f"{kind} that grazes, n = 1, m = 2", *(f"{x:.8f}" for x in closed[1, 2]),
         f"{miss:.0e}"]
        for kind, miss in meets.items()
    ),
]  # fmt: skip
top = np.sqrt((1 - np.sqrt(1 - GAP**-2)) / 2)
page = f"""# Points of codimension two of the paper's machine

Ideal drive, d = {GAP:g}. The 2π motion with one impact is followed in ζ at k = 0.5 and Table 1's
damping, ξ = {TABLE:.6f} (c = {table_damping():g} N·s/m, ξ = {xi_per_c():.6f} for each N·s/m). From
there `vi.boundary` follows its grazing, period doubling and fold in (ζ, ξ) and in (ζ, k). Each
curve lists its points of codimension two:

{table(["plane", "curve", "point", "ζ", "ξ or k"], listed)}

![Curves and points of codimension two](../figures/codimension_two.png)

Beside closed forms: the motion without impacts touches the stop where 1/|1 - ζ² + 2iξζ| = d, and
there an impact changes nothing n periods later where ζ = 2n√(1 - ξ²)/m.

{table(["point", "ζ", "ξ", "largest difference"], checks)}

Beside the degenerate doublings, the motion of twice the period where it begins:

{table(["number", "its value", "doubling at ζ", "4π motion begins", "and is"], rows)}

- The period doubling and the fold of the 2π motion end on its grazing in one point, the resonant
  grazing at ζ = √(1 - ξ²), ξ = {closed[1, 2][1]:.4f}: what is between the birth of the 2π motion
  and its period doubling, where it is unstable, ends there. Above ξ = {top:.4f} the vibration
  without impacts does not reach the stop.
- Along the period doubling the motion of twice the period changes the side on which it begins: up
  to such a point the 2π motion gives way to a stable one beside it, beyond it to one far away. With
  Table 1's damping and k = 0.8 it is the latter.
"""
print(page)
kept = {}
for (n, m), place in closed.items():
    kept[f"resonant grazing n = {n}, m = {m}, ζ"] = float(place[0])
    kept[f"resonant grazing n = {n}, m = {m}, ξ"] = float(place[1])
for other, point in degenerate:
    name = "ξ" if other == XI else "k"
    kept[f"degenerate doubling in (ζ, {name}), ζ"] = float(point.parameters[0])
    kept[f"degenerate doubling in (ζ, {name}), {name}"] = float(point.parameters[1])
for kind, point in ends.items():
    kept[f"{kind} that grazes, ζ"], kept[f"{kind} that grazes, ξ"] = map(float, point.parameters)
write("codimension_two", page, kept, figure, dpi=100)
say("done")
