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
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

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

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/studies")
sys.path.insert(0, str(HERE.parent))
from headlines import keep

QUICK = "--quick" in sys.argv
BEGIN = time.perf_counter()
K, GAP, NAME = 0.8, 2.0, "drive.frequency_ratio"
WIDE, LEFT, MIDDLE, RIGHT = (0.94, 1.0), (0.9540, 0.9547), (0.9920, 0.9934), (0.9936, 0.9940)
PARTS = {"wide": WIDE, "left": LEFT, "middle": MIDDLE, "right": RIGHT}
STARTS = np.array([[-2.0, 0.0], [-1.948, 1.207]])  # (Y, V) at φ = π: near a 2π, near a 4π motion
CHUNK, SEEN = 100, 256
CHUNKS, ROUNDS, VALUES = (10, 50, (64, 32, 32, 32)) if QUICK else (200, 400, (480, 160, 160, 160))
SMALL, LARGE = 1e-9, 1e-2


def say(text: object) -> None:
    used = time.process_time()
    print(f"[{time.perf_counter() - BEGIN:5.1f} s, CPU {used:5.1f} s] {text}", flush=True)


def machine(zeta) -> vi.Scene:
    scene = vi.Scene.ideal(frequency_ratio=zeta, restitution=K, gap=GAP, damping_ratio=0.0)
    return scene.at_section(np.pi)


# %% [markdown]
# ## Brute force
#
# Each lane settles, is observed for 256 cycles, and is then run beside two neighbours 1e-9 away.
# The distance of one is set back to 1e-9 every two cycles: its mean growth (without the first
# quarter, in which it turns into the direction that grows most) is the largest Lyapunov exponent.
# The other is left alone, and the cycles are counted until it is 0.01 away.


# %%
def lane(zeta, start, chunks, rounds):
    scene = machine(zeta)

    def go(state, cycles):
        return vi.simulate(scene, state, cycles, method=vi.ExactFlight(), record="sections")

    def last(run):
        return jax.tree.map(lambda x: x[-1], run.sections)

    def apart(a, b):
        return jnp.hypot(b.Y - a.Y, b.V - a.V)

    # In chunks: a run keeps all its sections, and only the last few are wanted.
    state = scene.start(Y=start[0], V=start[1])
    state = jax.lax.fori_loop(0, chunks, lambda _, state: last(go(state, CHUNK)), state)
    seen = vi.simulate(scene, state, SEEN, method=vi.ExactFlight(), impact_log=3)
    state, log = last(seen), seen.impact_log
    assert log is not None
    beside = scene.start(Y=state.Y + SMALL, V=state.V)

    def two_cycles(i, carried):
        here, near, free, total, escaped = carried
        here, near, free = (last(go(x, 2)) for x in (here, near, free))
        far = apart(here, near)
        near = jax.tree.map(lambda x, y: x + (y - x) * SMALL / far, here, near)
        total += jnp.where(4 * i >= rounds, jnp.log(far / SMALL), 0.0)
        escaped = jnp.where((escaped < 0) & (apart(here, free) > LARGE), 2.0 * (i + 1), escaped)
        return here, near, free, total, escaped

    carried = (state, beside, beside, jnp.zeros(()), -jnp.ones(()))
    *_, total, escaped = jax.lax.fori_loop(0, rounds, two_cycles, carried)
    Y, V = seen.sections.Y[1:], seen.sections.V[1:]
    return Y, V, log.speed, seen.impacts, total / (1.5 * rounds), escaped


grids = [np.linspace(*r, n) for r, n in zip(PARTS.values(), VALUES, strict=True)]
zetas = np.concatenate(grids)
lanes = (np.tile(zetas, 2), np.repeat(STARTS, len(zetas), axis=0))


@vi.jit
def brute(zeta, start, chunks, rounds):
    return jax.lax.map(lambda x: lane(x[0], x[1], chunks, rounds), (zeta, start), batch_size=256)


arguments = (*map(jnp.asarray, lanes), CHUNKS, ROUNDS)
compiled = brute.lower(*arguments).compile()
say("compiled the brute-force program")
clock, used = time.perf_counter(), time.process_time()
Y, V, speed, impacts, exponent, escaped = (np.asarray(x) for x in compiled(*arguments))
clock, used = time.perf_counter() - clock, time.process_time() - used
say(f"{len(lanes[0])} lanes of {CHUNKS * CHUNK} cycles and more: {clock:.1f} s, CPU {used:.1f} s")


def repeats(period: int) -> np.ndarray:
    """Whether a lane's sections repeat after a number of cycles."""
    return np.abs(Y[:, period:] - Y[:, :-period]).max(axis=1) < 1e-6


def bands(count: int) -> np.ndarray:
    """Whether a motion visits this many regions of the section in turn, apart in Y or in V."""
    found = np.ones(len(Y), bool)
    for i, j in itertools.combinations(range(count), 2):
        separate = np.zeros(len(Y), bool)
        for a in (Y, V):
            one, other = a[:, i::count], a[:, j::count]
            separate |= one.max(axis=1) < other.min(axis=1)
            separate |= other.max(axis=1) < one.min(axis=1)
        found &= separate
    return found


period = np.select([repeats(p) for p in (1, 2, 4, 8)], (1, 2, 4, 8), int(vi.REGIMES.unsettled))

# %% [markdown]
# ## The branches
#
# They begin at two motions that brute force settled on and go on from the special points: from the
# doublings of the 4π motion to its 8π motion, from where that touches the stop a second time to the
# 8π motion with three impacts, and from the doubling of the 2π motion to its 4π motion.


# %%
def settled(zeta: float, start: int, cycles: int) -> vi.Orbit:
    """The orbit beside the section state on which the lane nearest to ζ ended."""
    half = slice(start * len(zetas), (start + 1) * len(zetas))
    i = half.start + int(np.argmin(np.abs(lanes[0][half] - zeta)))
    scene = machine(lanes[0][i])
    guess = scene.start(Y=float(Y[i, -1]), V=float(V[i, -1]))
    return vi.find_orbit(scene, guess, cycles, throw=True)


def follow(orbit: vi.Orbit, max_step: float) -> vi.Branch:
    found = vi.continue_orbit(orbit, parameter=NAME, bounds=WIDE, step=0.005, max_step=max_step)
    say(found)
    return found


def of(branch: vi.Branch, kind: str) -> list[vi.SpecialPoint]:
    special = sorted(branch.special, key=lambda p: p.parameter)
    return [p for p in special if p.kind == kind]


def from_two_pi() -> list[vi.Branch]:
    branch = follow(settled(0.999, 0, 1), 0.05)
    return [branch, follow(of(branch, "period-doubling")[0].switch(distance=0.003), 0.02)]


def from_four_pi() -> list[vi.Branch]:
    branch = follow(settled(0.945, 1, 2), 0.05)
    doubled = [follow(p.switch(distance=0.003), 0.02) for p in of(branch, "period-doubling")]
    touch = of(doubled[0], "grazing")[0]
    return [branch, *doubled, follow(touch.switch(distance=0.003), 0.02)]


with ThreadPoolExecutor(2) as threads:  # what takes the time is compiling
    jobs = [threads.submit(from_two_pi), threads.submit(from_four_pi)]
    (two_pi, paired), (four_pi, *eight, three) = (job.result() for job in jobs)
doubling = of(four_pi, "period-doubling")
touches = [of(branch, "grazing")[0] for branch in eight]
BRANCHES = [
    (two_pi, "2π, 1 impact", color_of(1, 1)),
    (paired, "4π, 2 impacts", color_of(2, 2)),
    (four_pi, "4π, 1 impact", color_of(2, 1)),
    (eight[0], "8π, 2 impacts", color_of(4)),
    (eight[1], "", color_of(4)),
    (three, "8π, 3 impacts", "#2e7d99"),
]

# %% [markdown]
# ## Witnesses
#
# The closed form's multipliers know nothing of the continuation: where one is -1 a period doubles.
# Brute force knows of neither: beyond a doubling the square of the distance between the two halves
# of the 8π motion grows in proportion to ζ, so that a line through the squares tells where it is
# zero, which no run is long enough to show.

# %%
exact = [jax.jit(lambda z, n=n: vi.closed_form_orbits(machine(z), cycles=n)) for n in (1, 2)]


def closed_doubling(cycles: int, low: float, high: float) -> float:
    def test(zeta: float) -> float:
        return float(np.real(np.prod(np.asarray(exact[cycles - 1](zeta).multipliers[0]) + 1)))

    return float(brentq(test, low, high, xtol=1e-13))  # pyright: ignore[reportArgumentType]


closed = [closed_doubling(2, 0.95, 0.96), closed_doubling(2, 0.99, 0.9935)]
closed += [closed_doubling(1, 0.99, 0.999)]
zeta = lanes[0]
part = np.tile(np.repeat(list(PARTS), VALUES), 2)
halves = np.abs(Y[:, -1] - Y[:, -3])
fit = (part == "left") & (period == 4) & (halves > 0.02)
split = np.nan
if fit.sum() >= 3:
    slope, offset = np.polyfit(zeta[fit] - LEFT[0], halves[fit] ** 2, 1)
    split = LEFT[0] - offset / slope
chaotic = (exponent > 0.003) & (period == vi.REGIMES.unsettled)
inside = (zeta >= zeta[chaotic].min()) & (zeta <= zeta[chaotic].max())
regular = (zeta < doubling[0].parameter - 0.002) & (period == 2)


def largest(zetas: np.ndarray) -> np.ndarray:
    """Growth per cycle near the 4π motion, from the closed form's multipliers."""
    multipliers = np.asarray(jax.vmap(exact[1])(jnp.asarray(zetas)).multipliers)[:, 0]
    return np.log(np.abs(multipliers).max(axis=1)) / 2


off = np.abs(exponent[regular] - largest(zeta[regular]))
extra = impacts.sum(axis=1) - SEEN // 2
left_alone = chaotic & (escaped > 0)
waited = escaped[left_alone] * exponent[left_alone] / np.log(LARGE / SMALL)

# %%
COLORS = ("0.25", RED)
KINDS = ("period-doubling", "fold", "grazing")


def pieces(branch: vi.Branch) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, bool]]:
    """Parameter, impact speeds and growth of each stable or unstable stretch.

    Each ends at the special point at which stability changes, not at the branch's next point, which
    may lie farther off than a magnified panel is wide.
    """

    def growth(multipliers: np.ndarray) -> np.ndarray:
        return np.log(np.abs(multipliers).max(axis=-1, keepdims=True)) / branch.cycles

    rows = np.column_stack(
        [branch.parameter, branch.impact_speed, growth(np.asarray(branch.multipliers))]
    )
    turns = np.array(
        [
            [
                p.parameter,
                *np.resize(np.asarray(p.orbit.impact_speed), branch.impact_speed.shape[1]),
                *growth(np.asarray(p.orbit.multipliers)),
            ]
            for p in branch.special
            if p.kind != "grazing"
        ]
    )
    found, begin = [], 0
    before: list[np.ndarray] = []
    for cut in [*(np.flatnonzero(np.diff(branch.stable.astype(int))) + 1), len(rows)]:
        after = []
        if cut < len(rows):
            middle = (rows[cut - 1] + rows[cut]) / 2
            after = [turns[np.argmin(np.abs(turns - middle)[:, :-1].sum(axis=1))]]
        here = np.stack([*before, *rows[begin:cut], *after])
        found.append((here[:, 0], here[:, 1:-1], here[:, -1:], bool(branch.stable[begin])))
        begin, before = cut, after
    return found


def draw(axes: Axes, which: int, bounds: tuple[float, float]) -> None:
    """Impact speeds (1) or growth (2) of all branches: stable solid, unstable dashed."""
    for branch, _, color in BRANCHES:
        for piece in pieces(branch):
            style = "-" if piece[3] else (0, (2.5, 1.2))
            axes.plot(piece[0], piece[which], ls=style, color=color, lw=2.6, alpha=0.6, zorder=1)
    axes.set_xlim(*bounds)
    axes.set_xlabel("frequency ratio ζ")


figure = Figure(figsize=(10, 10.5), layout="constrained")
panels = figure.subplot_mosaic(
    [["wide"] * 3, ["exponent"] * 3, ["left", "middle", "right"]], height_ratios=[1.5, 0.8, 1.3]
)
for name, bounds in PARTS.items():
    axes = panels[name]
    for start, color in enumerate(COLORS):
        mine = (part == name) & (np.arange(len(zeta)) // len(zetas) == start)
        hits = speed[mine, -64:].reshape(mine.sum(), -1)
        across = np.repeat(zeta[mine], hits.shape[1])
        axes.plot(across, hits.ravel(), ".", ms=1.4, mew=0, color=color)
    draw(axes, 1, bounds)
    for point in (point for branch, *_ in BRANCHES for point in branch.special):
        hits = np.asarray(point.orbit.impact_speed)
        across = np.full(len(hits), point.parameter)
        axes.plot(across, hits, zorder=4, **mark_style(point.kind))
    axes.ticklabel_format(useOffset=False)
axes = panels["exponent"]
axes.axhline(0, color="k", lw=0.8)
for start, color in enumerate(COLORS):
    mine = (part == "wide") & (np.arange(len(zeta)) // len(zetas) == start)
    axes.plot(zeta[mine], exponent[mine], ".", ms=3, color=color)
draw(axes, 2, WIDE)
axes.set_ylim(-0.2, 0.35)
axes.set_ylabel("growth rate per cycle")
for name in ("wide", "left"):
    panels[name].set_ylabel("impact speed V⁻ (a ω)")
panels["wide"].set_ylim(-0.1, 3.75)
panels["left"].set_ylim(3.03, 3.36)
panels["middle"].set_ylim(3.38, 3.46)
panels["right"].set_ylim(-0.1, 3.75)
panels["wide"].set_title(f"k = {K}, d = {GAP:g}, undamped: every impact of the settled motion")
panels["exponent"].set_title(
    "dots: growth of a 1e-9 perturbation; lines: ln |largest multiplier| per cycle"
)
panels["left"].set_title("4π doubles; 8π touches the stop")
panels["middle"].set_title("and at the other end")
panels["right"].set_title("4π and 2π motion coexist")
for name in ("left", "middle", "right"):
    panels[name].locator_params(axis="x", nbins=4)
handles = [
    Line2D([], [], color=color, lw=2.6, alpha=0.6, label=label)
    for _, label, color in BRANCHES
    if label
]
handles += [
    Line2D([], [], color="k", ls=ls, label=x) for x, ls in (("stable", "-"), ("unstable", "--"))
]
handles += [mark_of(kind) for kind in KINDS]
handles += [
    Line2D([], [], marker=".", color=c, ls="none", label=f"simulated, start {i + 1}")
    for i, c in enumerate(COLORS)
]
figure.legend(handles=handles, loc="outside lower center", ncols=6, fontsize=9)

# %% [markdown]
# ## What was found


# %%
def span(values: np.ndarray, form: str = ".6f") -> tuple[str, str]:
    ends = (values.min(), values.max()) if values.size else (np.nan, np.nan)
    return f"{ends[0]:{form}}", f"{ends[1]:{form}}"


two, four = bands(2)[chaotic], bands(4)[chaotic]
onset, end = span(zeta[chaotic])
merged = span(zeta[chaotic][~four], ".4f")
stray = inside & ~chaotic
not_left = largest(zeta[stray]) * CHUNKS * CHUNK
met = span(zeta[(part == "right") & (extra == SEEN // 2)])[0]
held = span(zeta[(period == 2) & (extra == 0) & (zeta > 0.9935)])[1]
apart = (RIGHT[1] - RIGHT[0]) / (VALUES[-1] - 1)
first, second = (p.parameter for p in doubling)
born, dies = (p.parameter for p in touches)
fold, four_ends = of(paired, "fold")[0].parameter, of(four_pi, "grazing")[0].parameter
two_doubles = of(two_pi, "period-doubling")[0].parameter
steepest = np.abs(three.multipliers).max(axis=1).min()
rates, extras = span(exponent[chaotic], ".3f"), span(extra[chaotic] / SEEN * 100, ".1f")
report = f"""# From the 4π motion to chaos

Ideal drive, undamped, k = {K}, d = {GAP:g}; {len(zeta)} runs (two starts at each of {len(zetas)}
values) of {CHUNKS * CHUNK:,} cycles, then {SEEN} observed, in one compiled call: {clock:.0f} s
({used:.0f} s of CPU time).

| ζ at which | continuation | witness |
|---|---|---|
| 4π motion doubles | {first:.10f} | closed form {closed[0]:.10f}; simulated, squares: {split:.7f} |
| 8π motion touches the stop | {born:.10f} | simulated: first chaotic value {onset} |
| 8π motion touches the stop | {dies:.10f} | simulated: last chaotic value {end} |
| 4π motion doubles | {second:.10f} | closed form {closed[1]:.10f} |
| 4π motion with 2 impacts folds | {fold:.10f} | simulated: first seen at {met} (step {apart:.1e}) |
| 2π motion doubles | {two_doubles:.10f} | closed form {closed[2]:.10f} |
| 4π motion touches the stop | {four_ends:.10f} | simulated: last seen at {held} |

| runs from the first to the last chaotic value | {inside.sum()} |
|---|---|
| of them chaotic (no period up to 8, exponent above 0.003) | {chaotic.sum()} |
| exponent per cycle, median (range) | {np.median(exponent[chaotic]):.3f} ({" … ".join(rates)}) |
| cycles in which 1e-9 grows to 0.01, median | {np.median(escaped[left_alone]):.0f} |
| the same, as a multiple of what the exponent says | {np.median(waited):.2f} |
| soft impacts per 100 cycles, median (range) | \
{np.median(extra[chaotic]) / SEEN * 100:.1f} ({" … ".join(extras)}) |
| in two bands; in four | {two.sum()}; {four.sum()} |
| exponent less the closed form's, {regular.sum()} stable 4π runs, median (worst) | \
{np.median(off):.1e} ({off.max():.1e}) |

- There is no cascade. The 4π motion doubles once, and the 8π motion that comes of it is stable for
  {born - first:.1e} in ζ only. Then a turn of it touches the stop, and chaos is there at once. The
  motion with that impact more exists on the whole stretch, but its largest multiplier is never
  below {steepest:.0f} in 8π and has no bound at either end.
- Coming from the other side it is the same, but there the 8π motion lives for
  {second - dies:.0e} in ζ: no simulation shows it, and on a diagram chaos seems to begin at the
  doubling.
- No periodic window was met. {stray.sum()} of the {inside.sum()} runs did not count as chaotic, at
  ζ = {", ".join(f"{z:.6f}" for z in zeta[stray]) or "–"}: in the cycles given to settle, a
  disturbance of the unstable 4π motion grows there by e^{span(not_left, ".1f")[1]} only.
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
if not QUICK:
    keep(HERE, "bifurcation_diagram", report, numbers, figure, colors=200)
say("done")
