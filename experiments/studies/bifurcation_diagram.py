# %% [markdown]
# # From the 4π motion to chaos, and how
#
# The machine has the paper's k = 0.8 and no damping (ideal drive, d = 2). At ζ = 0.94 the 4π motion
# with one impact is stable, at ζ = 1 the 2π motion. In between, the 4π motion doubles its period.
# The motions that follow are computed in two ways. A brute-force bifurcation diagram uses two
# starts for each ζ, discards thousands of drive cycles, and is one compiled call. `continue_orbit`
# follows the branches.
#
# The figure shows the speed V⁻ of every impact: a motion with n impacts per period gives n points.
# An impact that appears in a grazing begins at zero speed. The section is at φ = π, because impacts
# lie near φ = 0.
#
# Run with `python experiments/studies/bifurcation_diagram.py` (`--quick` for few values and short
# runs).

# %%
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.optimize import brentq
from vi_jax.plot.colors import RED, color_of, mark_of, mark_style

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.ideal import GAP, machine
from tools.study import QUICK, say, write
from tools.tables import table

K = 0.8
# Ranges of ζ: the whole range, and three parts of it that are magnified.
PARTS = {
    "wide": (0.94, 1.0), "left": (0.9540, 0.9547), "middle": (0.9920, 0.9934),
    "right": (0.9936, 0.9940),
}  # fmt: skip
STARTS = np.array([[-2.0, 0.0], [-1.948, 1.207]])  # (Y, V) at φ = π: near a 2π, near a 4π motion
SEEN = 256
SETTLE, GROWN, VALUES = (
    (1000, 100, (64, 32, 32, 32)) if QUICK else (20_000, 800, (480, 160, 160, 160))
)


def at_half_turn(zeta: Any) -> vi.Scene:
    """Return the undamped machine with its section at φ = π."""
    return machine(zeta, K, 0.0).at_section(np.pi)


# %% [markdown]
# ## Brute force


# %%
def settled(zeta: Any, start: Any) -> tuple[Any, ...]:
    """Return the sections Y, impact speeds, last state and largest Lyapunov exponent of a lane."""
    there, exact = at_half_turn(zeta), vi.ExactFlight()
    begin = there.start(Y=start[0], V=start[1])
    seen = vi.simulate(there, begin, SEEN, settle=SETTLE, method=exact, impact_log=3)
    grows = vi.lyapunov(there, seen.last, GROWN, settle=0, number=1, method=exact)
    assert seen.impact_log is not None
    return seen.sections.Y[1:], seen.impact_log.speed, seen.last, grows.per_cycle[0]


grids = [np.linspace(*r, n) for r, n in zip(PARTS.values(), VALUES, strict=True)]
zeta = np.tile(np.concatenate(grids), 2)
start = np.repeat([0, 1], len(zeta) // 2)
part = np.tile(np.repeat(list(PARTS), VALUES), 2)
lanes = vi.jit(jax.vmap(settled))(jnp.asarray(zeta), jnp.asarray(STARTS[start]))
Y, speed, last, exponent = jax.tree.map(np.asarray, lanes)
say(f"{len(zeta)} lanes of {SETTLE} cycles and more")
period = np.full(len(zeta), int(vi.REGIMES.unsettled))
for p in (8, 4, 2, 1):
    period[np.abs(Y[:, p:] - Y[:, :-p]).max(axis=1) < 1e-6] = p

# %% [markdown]
# ## The branches
#
# The first two branches begin at motions that brute force found. The others begin at special
# points: the 8π motion at the doublings of the 4π motion; the 8π motion with three impacts at the
# second touch of the stop by the 8π motion; the 4π motion with two impacts at the doubling of the
# 2π motion.


# %%
def orbit_near(ratio: float, which: int, cycles: int) -> vi.Orbit:
    """Return the orbit reached from start `which` in the lane whose ζ is nearest to `ratio`."""
    mine = np.flatnonzero(start == which)
    i = mine[np.argmin(np.abs(zeta[mine] - ratio))]
    guess = jax.tree.map(lambda x: x[i], last)
    return vi.find_orbit(at_half_turn(zeta[i]), guess, cycles, throw=True)


def follow(orbit: vi.Orbit, max_step: float = 0.02) -> vi.Branch:
    """Return the branch of an orbit."""
    found = vi.continue_orbit(
        orbit, parameter="drive.frequency_ratio", bounds=PARTS["wide"], step=0.005,
        max_step=max_step,
    )  # fmt: skip
    say(found)
    return found


def of(branch: vi.Branch, kind: str) -> list[vi.Point]:
    """Return the special points of a kind, sorted by ζ."""
    return sorted((p for p in branch.special if p.kind == kind), key=lambda p: p.parameter)


two_pi = follow(orbit_near(0.999, 0, 1), 0.05)
paired = follow(of(two_pi, "period-doubling")[0].switch(distance=0.003))
four_pi = follow(orbit_near(0.945, 1, 2), 0.05)
eight = [follow(p.switch(distance=0.003)) for p in of(four_pi, "period-doubling")]
three = follow(of(eight[0], "grazing")[0].switch(distance=0.003))
# Each branch with its name in the legend (empty if the name is there already) and its colour.
DRAWN = [
    (two_pi, "2π, 1 impact", color_of(1, 1)), (paired, "4π, 2 impacts", color_of(2, 2)),
    (four_pi, "4π, 1 impact", color_of(2, 1)), (eight[0], "8π, 2 impacts", color_of(4)),
    (eight[1], "", color_of(4)), (three, "8π, 3 impacts", "#2e7d99"),
]  # fmt: skip

# %% [markdown]
# ## Results
#
# The closed form's multipliers are independent of the continuation: at -1 the period doubles.


# %%
def closed_doubling(cycles: int, low: float, high: float) -> float:
    """Return the ζ at which a multiplier of the closed form is -1."""

    def test(zeta: float) -> float:
        found = vi.closed_form_orbits(at_half_turn(zeta), cycles=cycles)
        return float(np.real(np.prod(np.asarray(found.multipliers[0]) + 1)))

    return float(brentq(test, low, high, xtol=1e-13))  # pyright: ignore[reportArgumentType]


closed = [closed_doubling(2, 0.95, 0.96), closed_doubling(2, 0.99, 0.9935)]
closed += [closed_doubling(1, 0.99, 0.999)]
first, second = (p.parameter for p in of(four_pi, "period-doubling"))
born, dies = (of(branch, "grazing")[0].parameter for branch in eight)
fold, four_ends = of(paired, "fold")[0].parameter, of(four_pi, "grazing")[0].parameter
two_doubles = of(two_pi, "period-doubling")[0].parameter
chaotic = (exponent > 0.003) & (period == vi.REGIMES.unsettled)
inside = (zeta >= zeta[chaotic].min()) & (zeta <= zeta[chaotic].max())
extra = np.isfinite(speed).sum(axis=(1, 2)) - SEEN // 2
met = zeta[(part == "right") & (extra == SEEN // 2)].min(initial=np.inf)
held = zeta[(period == 2) & (extra == 0) & (zeta > 0.9935)].max(initial=0.0)


def in_words(values: np.ndarray, form: str) -> str:
    """Return the median and the range as text."""
    return f"{np.median(values):{form}} ({values.min():{form}} … {values.max():{form}})"


places = table(
    ["ζ at which", "continuation", "compared with"],
    [
        ["4π motion doubles", f"{first:.10f}", f"closed form {closed[0]:.10f}"],
        ["8π motion touches the stop", f"{born:.10f}",
         f"simulated: first chaotic value {zeta[chaotic].min():.6f}"],
        ["8π motion touches the stop", f"{dies:.10f}",
         f"simulated: last chaotic value {zeta[chaotic].max():.6f}"],
        ["4π motion doubles", f"{second:.10f}", f"closed form {closed[1]:.10f}"],
        ["4π motion with 2 impacts folds", f"{fold:.10f}", f"simulated: first seen at {met:.6f}"],
        ["2π motion doubles", f"{two_doubles:.10f}", f"closed form {closed[2]:.10f}"],
        ["4π motion touches the stop", f"{four_ends:.10f}", f"simulated: last seen at {held:.6f}"],
    ],
)  # fmt: skip
report = f"""# From the 4π motion to chaos

Ideal drive, undamped, k = {K}, d = {GAP:g}; {len(zeta)} runs (two starts at each of {sum(VALUES)}
values) of {SETTLE:,} cycles, then {SEEN} observed, in one compiled call.

![Bifurcation diagram](../figures/bifurcation_diagram.png)

{places}

Of the {inside.sum()} runs from the first to the last chaotic value {(inside & chaotic).sum()} are
chaotic (no period up to 8, exponent above 0.003). Their exponent per cycle is
{in_words(exponent[chaotic], ".3f")}, median and range; they have
{in_words(extra[chaotic] / SEEN * 100, ".1f")} soft impacts in 100 cycles.

- There is no cascade. The 4π motion doubles once, and the 8π motion that comes of it is stable for
  {born - first:.1e} in ζ only. Then a turn of it touches the stop, and chaos is there at once. The
  motion with one more impact exists on the whole interval, but its largest multiplier is never
  below {np.abs(three.multipliers).max(axis=1).min():.0f} in 8π and has no bound at either end.
- From the other side the same happens, but there the 8π motion is stable for
  {second - dies:.0e} in ζ: no simulation shows it, and on a diagram chaos seems to begin at the
  doubling.
- The chaos keeps the 4π motion's order: one hard impact in two cycles, and a soft one now and then.
- The growth rate jumps above zero where the 8π motion touches the stop. In the stable stretches it
  falls on the multipliers of the branches.
- From {fold:.7f} to {four_ends:.7f} the 4π motion coexists with the 2π motion, or, below
  {two_doubles:.7f}, with what that doubles into. The two starts show both.
"""
print(report)
numbers = {
    "4π motion doubles": first,
    "8π motion touches the stop": born,
    "8π motion touches the stop, upper end": dies,
    "4π motion doubles, upper end": second,
    "4π motion with 2 impacts folds": fold,
    "2π motion doubles": two_doubles,
    "4π motion touches the stop": four_ends,
}

# %% [markdown]
# ## The picture


# %%
def draw_branches(ax: Axes, growth: bool, bounds: tuple[float, float]) -> None:
    """Draw the impact speeds or the growth rates of all branches: stable solid, unstable dashed."""
    for branch, _, color in DRAWN:
        size = np.abs(np.asarray(branch.multipliers)).max(axis=1)[:, None]
        what = np.log(size) / branch.cycles if growth else np.asarray(branch.impact_speed)
        stable = size < 1 + 1e-6  # stability changes at points of the branch
        beside = ~stable | np.roll(~stable, 1) | np.roll(~stable, -1)
        for mask, style in ((stable, "-"), (beside, (0, (2.5, 1.2)))):
            look = {"ls": style, "lw": 2.6, "alpha": 0.6, "color": color, "zorder": 1}
            ax.plot(branch.parameter, np.where(mask, what, np.nan), **look)
    ax.set(xlim=bounds, xlabel="frequency ratio ζ")


TITLES = {
    "wide": f"k = {K}, d = {GAP:g}, undamped: every impact of the settled motion",
    "left": "4π doubles; 8π touches the stop",
    "middle": "and at the other end",
    "right": "4π and 2π motion coexist",
}
HEIGHTS = {"left": (3.03, 3.36), "middle": (3.38, 3.46)}
COLORS = ("0.25", RED)
figure = Figure(figsize=(10, 10.5), layout="constrained")
panels = figure.subplot_mosaic(
    [["wide"] * 3, ["exponent"] * 3, ["left", "middle", "right"]], height_ratios=[1.5, 0.8, 1.3]
)
for name, title in TITLES.items():
    ax = panels[name]
    for which, color in enumerate(COLORS):
        mine = (part == name) & (start == which)
        hits = speed[mine, -64:].reshape(mine.sum(), -1)
        across = np.repeat(zeta[mine], hits.shape[1])
        ax.plot(across, hits.ravel(), ".", ms=1.4, mew=0, color=color)
    draw_branches(ax, False, PARTS[name])
    for point in (point for branch, *_ in DRAWN for point in branch.special):
        hits = np.asarray(point.orbit.impact_speed)
        ax.plot(np.full(len(hits), point.parameter), hits, zorder=4, **mark_style(point.kind))
    ax.ticklabel_format(useOffset=False)
    ax.set(title=title, ylim=HEIGHTS.get(name, (-0.1, 3.75)))
    if name != "wide":
        ax.locator_params(axis="x", nbins=4)
for name in ("wide", "left"):
    panels[name].set_ylabel("impact speed V⁻ (a ω)")
ax = panels["exponent"]
ax.axhline(0, color="k", lw=0.8)
for which, color in enumerate(COLORS):
    mine = (part == "wide") & (start == which)
    ax.plot(zeta[mine], exponent[mine], ".", ms=3, color=color)
draw_branches(ax, True, PARTS["wide"])
ax.set(ylim=(-0.2, 0.35), ylabel="growth rate per cycle")
ax.set_title("dots: largest Lyapunov exponent; lines: ln |largest multiplier| per cycle")
handles = [
    *(Line2D([], [], color=c, lw=2.6, alpha=0.6, label=x) for _, x, c in DRAWN if x),
    *(Line2D([], [], color="k", ls=s, label=x) for x, s in (("stable", "-"), ("unstable", "--"))),
    *(mark_of(kind) for kind in ("period-doubling", "fold", "grazing")),
    *(
        Line2D([], [], marker=".", color=c, ls="none", label=f"simulated, start {i + 1}")
        for i, c in enumerate(COLORS)
    ),
]
figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=9)
write("bifurcation_diagram", report, numbers, figure, colors=200)
say("done")
