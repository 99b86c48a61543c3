# %% [markdown]
# # From the 4π motion to chaos, and how
#
# The paper's k = 0.8 without damping (ideal drive, d = 2), between ζ = 0.94, where the 4π motion
# with one impact is stable, and ζ = 1, where the 2π motion is. In between the 4π motion doubles its
# period. What comes then is seen twice: as a brute-force bifurcation diagram (two starting states
# for each ζ, thousands of drive cycles thrown away, one compiled call for all), and as the branches
# that `continue_orbit` follows. Neither knows of the other, but for the orbits at which the
# branches begin.
#
# Shown is the speed V⁻ of every impact: a motion with n impacts in its period is n points, and an
# impact that is born in a grazing begins at zero. The section is at φ = π, because impacts lie near
# φ = 0.
#
# Run with `python experiments/studies/bifurcation_diagram.py` (`--quick` for few values and short
# runs).

# %%
import itertools
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.optimize import brentq
from vi_jax.plot.colors import RED, color_of, mark_of, mark_style

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.ideal import GAP, machine
from tools.study import QUICK, say, write
from tools.tables import table
from tools.timing import Clock

K = 0.8
# Ranges of ζ: the whole, and three stretches of it that are magnified.
PARTS = {
    "wide": (0.94, 1.0), "left": (0.9540, 0.9547), "middle": (0.9920, 0.9934),
    "right": (0.9936, 0.9940),
}  # fmt: skip
STARTS = np.array([[-2.0, 0.0], [-1.948, 1.207]])  # (Y, V) at φ = π: near a 2π, near a 4π motion
CHUNK, SEEN, SMALL = 100, 256, 1e-9
CHUNKS, ROUNDS, VALUES = (10, 50, (64, 32, 32, 32)) if QUICK else (200, 400, (480, 160, 160, 160))


def at_half_turn(zeta: Any) -> vi.Scene:
    """Return the undamped machine with its section at φ = π."""
    return machine(zeta, K, 0.0).at_section(np.pi)


# %% [markdown]
# ## Brute force


# %%
@vi.jit
def settled(zeta: Any, start: Any, chunks: Any, rounds: Any) -> tuple[Any, ...]:
    """Let every lane settle, and observe it and a neighbour 1e-9 away.

    The neighbour's distance is set back to 1e-9 every two cycles: its mean growth (without the
    first quarter, in which it turns into the direction that grows most) is the largest Lyapunov
    exponent.

    Returns sections Y and V, `(lanes, SEEN)`, impact speeds, `(lanes, SEEN, 3)`, and exponents.
    """

    def one(lane):
        there = at_half_turn(lane[0])

        def go(state, cycles):
            return vi.simulate(
                there, state, cycles, method=vi.ExactFlight(), record="sections"
            ).last  # fmt: skip

        # In chunks: a run keeps all its sections, and only the last few are wanted.
        state = there.start(Y=lane[1][0], V=lane[1][1])
        state = jax.lax.fori_loop(0, chunks, lambda _, state: go(state, CHUNK), state)
        seen = vi.simulate(there, state, SEEN, method=vi.ExactFlight(), impact_log=3)
        assert seen.impact_log is not None

        def two_cycles(i, carried):
            here, near, total = carried
            here, near = go(here, 2), go(near, 2)
            far = jnp.hypot(near.Y - here.Y, near.V - here.V)
            near = jax.tree.map(lambda x, y: x + (y - x) * SMALL / far, here, near)
            return here, near, total + jnp.where(4 * i >= rounds, jnp.log(far / SMALL), 0.0)

        near = there.start(Y=seen.last.Y + SMALL, V=seen.last.V)
        carried = (seen.last, near, jnp.zeros(()))
        total = jax.lax.fori_loop(0, rounds, two_cycles, carried)[2]
        sections = seen.sections
        return sections.Y[1:], sections.V[1:], seen.impact_log.speed, total / (1.5 * rounds)

    return jax.lax.map(one, (zeta, start), batch_size=256)


grids = [np.linspace(*r, n) for r, n in zip(PARTS.values(), VALUES, strict=True)]
zeta = np.tile(np.concatenate(grids), 2)
start = np.repeat([0, 1], len(zeta) // 2)
part = np.tile(np.repeat(list(PARTS), VALUES), 2)
arguments = (jnp.asarray(zeta), jnp.asarray(STARTS[start]), CHUNKS, ROUNDS)
compiled = settled.lower(*arguments).compile()
with Clock() as clock:
    Y, V, speed, exponent = map(np.asarray, compiled(*arguments))
say(f"{len(zeta)} lanes of {CHUNKS * CHUNK} cycles and more: {clock.wall:.1f} s")
period = np.full(len(zeta), int(vi.REGIMES.unsettled))
for p in (8, 4, 2, 1):
    period[np.abs(Y[:, p:] - Y[:, :-p]).max(axis=1) < 1e-6] = p


def in_bands(count: int) -> np.ndarray:
    """Return whether a motion visits this many regions of the section in turn, apart in Y or V."""
    found = np.ones(len(Y), bool)
    for i, j in itertools.combinations(range(count), 2):
        separate = np.zeros(len(Y), bool)
        for a in (Y, V):
            one, other = a[:, i::count], a[:, j::count]
            separate |= one.max(axis=1) < other.min(axis=1)
            separate |= other.max(axis=1) < one.min(axis=1)
        found &= separate
    return found


# %% [markdown]
# ## The branches
#
# They begin at two motions that brute force settled on and go on from the special points: from the
# doublings of the 4π motion to its 8π motion, from where that touches the stop a second time to the
# 8π motion with three impacts, and from the doubling of the 2π motion to its 4π motion.


# %%
def orbit_near(ratio: float, which: int, cycles: int) -> vi.Orbit:
    """Return the orbit on which the lane of a start that is nearest to this ζ ended."""
    mine = np.flatnonzero(start == which)
    i = mine[np.argmin(np.abs(zeta[mine] - ratio))]
    there = at_half_turn(zeta[i])
    guess = there.start(Y=float(Y[i, -1]), V=float(V[i, -1]))
    return vi.find_orbit(there, guess, cycles, throw=True)


def follow(orbit: vi.Orbit, max_step: float) -> vi.Branch:
    """Return the branch of an orbit."""
    bounds = PARTS["wide"]
    found = vi.continue_orbit(
        orbit, parameter="drive.frequency_ratio", bounds=bounds, step=0.005, max_step=max_step
    )
    say(found)
    return found


def of(branch: vi.Branch, kind: str) -> list[vi.Point]:
    """Return the special points of a kind, by ζ."""
    return sorted((p for p in branch.special if p.kind == kind), key=lambda p: p.parameter)


def from_two_pi() -> list[vi.Branch]:
    branch = follow(orbit_near(0.999, 0, 1), 0.05)
    return [branch, follow(of(branch, "period-doubling")[0].switch(distance=0.003), 0.02)]


def from_four_pi() -> list[vi.Branch]:
    branch = follow(orbit_near(0.945, 1, 2), 0.05)
    doubled = [follow(p.switch(distance=0.003), 0.02) for p in of(branch, "period-doubling")]
    touch = of(doubled[0], "grazing")[0]
    return [branch, *doubled, follow(touch.switch(distance=0.003), 0.02)]


with ThreadPoolExecutor(2) as threads:  # what takes the time is compiling
    jobs = [threads.submit(from_two_pi), threads.submit(from_four_pi)]
    (two_pi, paired), (four_pi, *eight, three) = (job.result() for job in jobs)
# Each branch with its name (none: it is in the legend already) and its colour.
DRAWN = [
    (two_pi, "2π, 1 impact", color_of(1, 1)), (paired, "4π, 2 impacts", color_of(2, 2)),
    (four_pi, "4π, 1 impact", color_of(2, 1)), (eight[0], "8π, 2 impacts", color_of(4)),
    (eight[1], "", color_of(4)), (three, "8π, 3 impacts", "#2e7d99"),
]  # fmt: skip

# %% [markdown]
# ## Witnesses
#
# The closed form's multipliers know nothing of the continuation: where one is -1 a period doubles.
# Brute force knows of neither: beyond a doubling the square of the distance between the two halves
# of the 8π motion grows in proportion to ζ, so that a line through the squares tells where it is
# zero, which no run is long enough to show.

# %%
exact = [jax.jit(lambda z, n=n: vi.closed_form_orbits(at_half_turn(z), cycles=n)) for n in (1, 2)]


def closed_doubling(cycles: int, low: float, high: float) -> float:
    """Return the ζ at which a multiplier of the closed form is -1."""

    def test(zeta: float) -> float:
        return float(np.real(np.prod(np.asarray(exact[cycles - 1](zeta).multipliers[0]) + 1)))

    return float(brentq(test, low, high, xtol=1e-13))  # pyright: ignore[reportArgumentType]


def largest(zetas: np.ndarray) -> np.ndarray:
    """Return the growth per cycle near the 4π motion, from the closed form's multipliers."""
    multipliers = np.asarray(jax.vmap(exact[1])(jnp.asarray(zetas)).multipliers)[:, 0]
    return np.log(np.abs(multipliers).max(axis=1)) / 2


def span(values: np.ndarray, form: str = ".6f") -> tuple[str, str]:
    """Return the least and the greatest value in words."""
    ends = (values.min(), values.max()) if values.size else (np.nan, np.nan)
    return f"{ends[0]:{form}}", f"{ends[1]:{form}}"


def median_of(values: np.ndarray, form: str) -> str:
    """Return the median and the range in words."""
    return f"{np.median(values):{form}} ({' … '.join(span(values, form))})"


closed = [closed_doubling(2, 0.95, 0.96), closed_doubling(2, 0.99, 0.9935)]
closed += [closed_doubling(1, 0.99, 0.999)]
first, second = (p.parameter for p in of(four_pi, "period-doubling"))
born, dies = (of(branch, "grazing")[0].parameter for branch in eight)
fold, four_ends = of(paired, "fold")[0].parameter, of(four_pi, "grazing")[0].parameter
two_doubles = of(two_pi, "period-doubling")[0].parameter
halves = np.abs(Y[:, -1] - Y[:, -3])
fit = (part == "left") & (period == 4) & (halves > 0.02)
split, left = np.nan, PARTS["left"][0]
if fit.sum() >= 3:
    slope, offset = np.polyfit(zeta[fit] - left, halves[fit] ** 2, 1)
    split = left - offset / slope
chaotic = (exponent > 0.003) & (period == vi.REGIMES.unsettled)
onset, end = span(zeta[chaotic])
inside = (zeta >= zeta[chaotic].min()) & (zeta <= zeta[chaotic].max())
regular = (zeta < first - 0.002) & (period == 2)
off = np.abs(exponent[regular] - largest(zeta[regular]))
extra = np.isfinite(speed).sum(axis=(1, 2)) - SEEN // 2
two, four = in_bands(2)[chaotic], in_bands(4)[chaotic]
merged, stray = span(zeta[chaotic][~four], ".4f"), inside & ~chaotic
met = span(zeta[(part == "right") & (extra == SEEN // 2)])[0]
held = span(zeta[(period == 2) & (extra == 0) & (zeta > 0.9935)])[1]

# %% [markdown]
# ## What was found

# %%
places = table(
    ["ζ at which", "continuation", "witness"],
    [
        [
            "4π motion doubles", f"{first:.10f}",
            f"closed form {closed[0]:.10f}; simulated, squares: {split:.7f}",
        ],
        ["8π motion touches the stop", f"{born:.10f}", f"simulated: first chaotic value {onset}"],
        ["8π motion touches the stop", f"{dies:.10f}", f"simulated: last chaotic value {end}"],
        ["4π motion doubles", f"{second:.10f}", f"closed form {closed[1]:.10f}"],
        ["4π motion with 2 impacts folds", f"{fold:.10f}", f"simulated: first seen at {met}"],
        ["2π motion doubles", f"{two_doubles:.10f}", f"closed form {closed[2]:.10f}"],
        ["4π motion touches the stop", f"{four_ends:.10f}", f"simulated: last seen at {held}"],
    ],
)  # fmt: skip
chaos = table(
    ["runs from the first to the last chaotic value", str(inside.sum())],
    [
        ["of them chaotic (no period up to 8, exponent above 0.003)", chaotic.sum()],
        ["exponent per cycle, median (range)", median_of(exponent[chaotic], ".3f")],
        ["soft impacts per 100 cycles, median (range)",
         median_of(extra[chaotic] / SEEN * 100, ".1f")],
        ["in two bands; in four", f"{two.sum()}; {four.sum()}"],
        [f"exponent less the closed form's, {regular.sum()} stable 4π runs, median (worst)",
         f"{np.median(off):.1e} ({off.max():.1e})"],
    ],
)  # fmt: skip
report = f"""# From the 4π motion to chaos

Ideal drive, undamped, k = {K}, d = {GAP:g}; {len(zeta)} runs (two starts at each of {sum(VALUES)}
values) of {CHUNKS * CHUNK:,} cycles, then {SEEN} observed, in one compiled call
({clock.cpu:.0f} s of CPU time).

![Bifurcation diagram](../figures/bifurcation_diagram.png)

{places}

{chaos}

- There is no cascade. The 4π motion doubles once, and the 8π motion that comes of it is stable for
  {born - first:.1e} in ζ only. Then a turn of it touches the stop, and chaos is there at once. The
  motion with that impact more exists on the whole stretch, but its largest multiplier is never
  below {np.abs(three.multipliers).max(axis=1).min():.0f} in 8π and has no bound at either end.
- Coming from the other side it is the same, but there the 8π motion lives for
  {second - dies:.0e} in ζ: no simulation shows it, and on a diagram chaos seems to begin at the
  doubling.
- No periodic window was met. {stray.sum()} of the {inside.sum()} runs did not count as chaotic, at
  ζ = {", ".join(f"{z:.6f}" for z in zeta[stray]) or "–"}: in the cycles given to settle, a
  disturbance of the unstable 4π motion grows there by
  e^{span(largest(zeta[stray]) * CHUNKS * CHUNK, ".1f")[1]} only.
- The chaos keeps the 4π motion's order: bands visited in turn, one hard impact in two cycles, and a
  soft one now and then. Four bands are seen up to {merged[0]} and from {merged[1]} on, beside the
  8π motions.
- The growth rate jumps above zero where the 8π motion touches the stop. In the stable stretches it
  falls on the multipliers, which were had without simulating.
- Beside a doubling {CHUNKS * CHUNK:,} cycles do not settle. So the square of the 8π motion's
  amplitude was drawn on to zero: it meets the located doubling to {abs(split - first):.0e}.
- From {fold:.7f} to {four_ends:.7f} the 4π motion coexists with the 2π motion, or, below
  {two_doubles:.7f}, with what that doubles into. The two starts show both; from {held} on the
  second start, the same for all ζ, goes to the other motion before the 4π motion ends.
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
#
# A stretch of a branch ends at the special point at which stability changes, not at the branch's
# next point, which may lie farther off than a magnified panel is wide.


# %%
class Piece(NamedTuple):
    """A stretch of a branch that is stable or unstable all along."""

    parameter: np.ndarray
    speeds: np.ndarray
    growth: np.ndarray
    stable: bool


def growth(multipliers: Any, cycles: int) -> np.ndarray:
    """Return the growth rate per cycle."""
    return np.log(np.abs(np.asarray(multipliers)).max(axis=-1, keepdims=True)) / cycles


def pieces(branch: vi.Branch) -> list[Piece]:
    """Return the stretches of a branch."""
    rates = growth(branch.multipliers, branch.cycles)
    rows = np.column_stack([branch.parameter, branch.impact_speed, rates])
    turns = np.array([
        [p.parameter, *np.resize(np.asarray(p.orbit.impact_speed), branch.impact_speed.shape[1]),
         *growth(p.orbit.multipliers, branch.cycles)]
        for p in branch.special if p.kind != "grazing"
    ])  # fmt: skip
    found, begin = [], 0
    before: list[np.ndarray] = []
    for cut in [*(np.flatnonzero(np.diff(branch.stable.astype(int))) + 1), len(rows)]:
        after = []
        if cut < len(rows):
            middle = (rows[cut - 1] + rows[cut]) / 2
            after = [turns[np.argmin(np.abs(turns - middle)[:, :-1].sum(axis=1))]]
        here = np.stack([*before, *rows[begin:cut], *after])
        found.append(Piece(here[:, 0], here[:, 1:-1], here[:, -1:], bool(branch.stable[begin])))
        begin, before = cut, after
    return found


def draw_branches(ax: Axes, what: str, bounds: tuple[float, float]) -> None:
    """Draw impact speeds or growth of all branches: stable solid, unstable dashed."""
    for branch, _, color in DRAWN:
        for piece in pieces(branch):
            look = {"ls": "-" if piece.stable else (0, (2.5, 1.2)), "lw": 2.6, "alpha": 0.6}
            ax.plot(piece.parameter, getattr(piece, what), color=color, zorder=1, **look)
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
    draw_branches(ax, "speeds", PARTS[name])
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
draw_branches(ax, "growth", PARTS["wide"])
ax.set(ylim=(-0.2, 0.35), ylabel="growth rate per cycle")
ax.set_title("dots: growth of a 1e-9 perturbation; lines: ln |largest multiplier| per cycle")
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
