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
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
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
    xi_per_c,
)
from vi_jax.plot.colors import color_of

jax.config.update("jax_enable_x64", True)

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/studies")
sys.path.insert(0, str(HERE.parent))
from headlines import keep

QUICK = "--quick" in sys.argv
BEGIN = time.perf_counter()
GAP, RESTITUTION, ZETA = 2.0, 0.5, 0.9
# How far beside a curve to simulate, in plane units: 1 in k and c is as long as 0.34 in ζ.
ASIDE, SPANS = 0.006, np.array([0.34, 1.0])
BESIDE, SETTLE = (6, 1000) if QUICK else (12, 4000)
SIZE = 512  # points in one call of the closed form: one program for any number


def say(text: object) -> None:
    print(f"[{time.perf_counter() - BEGIN:5.1f} s] {text}", flush=True)


def machine(x: Any) -> vi.Scene:
    """The ideal scene of (ζ, k, ξ)."""
    return vi.Scene.ideal(frequency_ratio=x[0], restitution=x[1], gap=GAP, damping_ratio=x[2])


def numbers(plane: str, points: np.ndarray) -> np.ndarray:
    """(ζ, k, ξ) of points of the plane (ζ, k) or (ζ, c)."""
    zeta, other = points.T
    if plane == "k":
        return np.stack([zeta, other, np.zeros_like(zeta)], axis=1)
    return np.stack([zeta, np.full_like(zeta, RESTITUTION), other * xi_per_c()], axis=1)


# %% [markdown]
# ## The curves

# %%
curves = boundary_curves(quick=QUICK)
described = describe_boundaries(curves)
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
def closed_all(cycles: int) -> Any:
    lane = jax.jit(jax.vmap(lambda x: vi.closed_form_orbits(machine(x), cycles=cycles)))

    def call(points: np.ndarray) -> vi.ClosedFormOrbits:
        full = np.concatenate([points, np.repeat(points[-1:], -len(points) % SIZE, axis=0)])
        parts = [lane(jnp.asarray(part)) for part in full.reshape(-1, SIZE, 3)]
        return jax.tree.map(lambda *a: np.concatenate(a)[: len(points)], *parts)

    return call


closed = {1: closed_all(1), 2: closed_all(2)}


class Curve(NamedTuple):
    name: str
    plane: str
    points: np.ndarray
    cycles: int
    """Period of the motion that the curve is about."""
    kind: str


born = birth_without_damping(curves)
levels = np.linspace(0.05, 0.95, 40)
checked = [Curve("2π birth", "k", np.stack([np.full(40, born), levels], axis=1), 1, "birth")]
for field, name, cycles, kind in (
    ("doubling_k", "2π period doubling", 1, "doubling"),
    ("fold_k", "2π fold", 1, "fold"),
    ("touch_k", "4π touch", 2, "touch"),
    ("long_doubling_k", "4π period doubling", 2, "doubling"),
    ("birth_c", "2π birth", 1, "birth"),
    ("doubling_c", "2π period doubling", 1, "doubling"),
    ("fold_c", "2π fold", 1, "fold"),
    ("touch_c", "4π touch", 2, "touch"),
):
    curve = getattr(curves, field)
    if curve is not None:
        checked.append(Curve(name, field[-1], plane_points(curve), cycles, kind))


def miss(curve: Curve) -> float:
    """How far the curve is from what it should be, at worst, by the closed form."""
    # Towards k = 1 at ζ = 1 the free motion is all but resonant, and digits go.
    x = numbers(curve.plane, curve.points)
    x = x[x[:, 1] < 0.99]
    if curve.kind == "birth":
        return float(np.max(np.abs(1 / np.abs(1 - x[:, 0] ** 2 + 2j * x[:, 2] * x[:, 0]) - GAP)))
    if curve.kind == "fold":
        # Beyond the fold by 1e-6 in ζ there is nothing, before it there are two motions.
        steps = [np.sum(closed[1](x + np.array([s, 0, 0])).exists, axis=1) for s in (-1e-6, 1e-6)]
        return 1e-6 if np.all(steps[0] == 2) and np.all(steps[1] == 0) else np.inf
    found = closed[curve.cycles](x)
    if curve.kind == "doubling":
        return float(np.max(np.nanmin(np.abs(found.multipliers + 1), axis=(1, 2))))
    return float(np.max(np.nanmin(np.abs(found.clearance), axis=1)))


misses = [miss(curve) for curve in checked]
# The damping at which the 2π motion of Figure 3 becomes stable, by the closed form alone.
near = np.linspace(0.2705, 0.2717, 200)
found = closed[1](numbers("c", np.stack([np.full(200, ZETA), near], axis=1)))
least = np.min(found.multipliers[:, 0].real, axis=1)
stable_from = float(np.interp(-1.0, least, near))
# The closed form knows every 4π motion with one impact, of other families too.
scan = np.linspace(0.5, 1.5, SIZE)
found = closed[2](numbers("c", np.stack([scan, np.full(SIZE, table_damping())], axis=1)))
table_ratios = scan[np.any(found.admissible, axis=1)]
say(f"4π with one impact at Table 1's c: {len(table_ratios)} of {SIZE} ζ: {table_ratios}")
say(f"on the curves: {max(misses):.1e} at worst; period doubling at c = {stable_from:.7f}")

# %% [markdown]
# ## Beside the curves, and everywhere: simulations
#
# On either side of a curve a simulation begins near the motion that the curve is about, and either
# stays with it or does not. At a touch the first four cycles decide: two impacts, or more. One
# compiled call does all of them and the map from rest.


# %%
@vi.jit
def settle_all(x: jax.Array, Y: jax.Array, V: jax.Array) -> tuple[jax.Array, ...]:
    """Period and impacts in it of what each start settles on, and impacts in four cycles."""

    def one(lane):
        x, Y, V = lane
        scene = machine(x)
        start = scene.start(Y=Y, V=V)
        early = vi.simulate(scene, start, 4, method=vi.ExactFlight())
        late = vi.sweep(
            scene, "drive.frequency_ratio", x[:1], start=start, settle=SETTLE, cycles=32,
            method=vi.ExactFlight(),
        )  # fmt: skip
        return late.period[0], late.impacts[0], jnp.sum(early.impacts)

    return jax.lax.map(one, (x, Y, V), batch_size=256)


class Start(NamedTuple):
    x: np.ndarray
    Y: np.ndarray
    V: np.ndarray
    stays: np.ndarray
    """Whether the curve says that the motion is there and stable (at a touch: is there)."""


def beside(curve: Curve) -> Start:
    """Starts on both sides of a curve, and what the curve says of them.

    Disturbed towards smaller Y: the section may lie close to the stop, and a start beyond it is
    none.
    """
    points = curve.points
    along = np.gradient(points / SPANS, axis=0)
    keep = np.linalg.norm(along, axis=1) > 0
    if curve.kind == "touch" or curve.cycles == 2:
        # Where the two sides are not yet at the edge of the plane, nor past the next curve.
        keep &= (points[:, 0] < 0.98) & (points[:, 1] > 0.01)
    keep &= (points[:, 1] < 0.97) | (curve.plane == "c")
    keep &= (points[:, 1] > 0.01) & (points[:, 0] < 1.85)
    length = np.cumsum(np.linalg.norm(along, axis=1))
    places = np.linspace(length[keep][0], length[keep][-1], BESIDE)
    chosen = np.flatnonzero(keep)[np.argmin(np.abs(length[keep] - places[:, None]), axis=1)]
    across = along[chosen] @ np.array([[0.0, -1.0], [1.0, 0.0]])
    across *= np.sign(across[:, :1]) * ASIDE / np.linalg.norm(across, axis=1, keepdims=True)
    left, right = points[chosen] - across * SPANS, points[chosen] + across * SPANS
    both = np.concatenate([left, right])
    x, on_right = numbers(curve.plane, both), np.repeat([False, True], len(left))
    if curve.kind == "birth":
        gain = 1 / (1 - x[:, 0] ** 2 + 2j * x[:, 2] * x[:, 0])
        # Without damping it is highest on the section itself, and must not begin in the stop.
        Y = np.minimum(gain.real, GAP - 1e-6)
        return Start(x, Y, (1j * x[:, 0] * gain).real, ~on_right)
    motion = closed[curve.cycles](x)
    Y, V = motion.Y[:, 0].copy(), motion.V[:, 0].copy()
    if curve.cycles == 2:
        inside = Polygon(points / SPANS).contains_points(both / SPANS)
        if curve.kind == "touch":  # inadmissible motions come by speed: take the same one
            nearest = np.nanargmin(np.abs(motion.clearance), axis=1)
            Y, V = (np.take_along_axis(a, nearest[:, None], 1)[:, 0] for a in (motion.Y, motion.V))
            return Start(x, Y, V, inside)
        return Start(x, Y - 1e-4, V, ~inside)
    if curve.kind == "fold":  # beyond it nothing is there to begin on but what was before it
        Y[on_right], V[on_right] = Y[~on_right], V[~on_right]
        return Start(x, Y - 1e-4, V, ~on_right)
    return Start(x, Y - 1e-3, V, on_right)


starts = [beside(curve) for curve in checked]
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
for i, (curve, start) in enumerate(zip(checked, starts, strict=True)):
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


def shares(plane: str, points: np.ndarray, kinds: np.ndarray) -> list[str]:
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
        f"| {where} | {name} | {np.sum(part)} | "
        + " | ".join(str(np.sum(part & (kinds == kind))) for kind in range(5))
        + " |"
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
figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize=9)

# %% [markdown]
# ## The table

# %%
short = "(ζ, k), undamped"
lines = [
    "# Where the paper's discrepancy lives",
    "",
    "Ideal drive, d = 2 (a gap of 0.08 m). Curves by `vi.boundary` in (ζ, k) without damping and",
    "in (ζ, c) for k = 0.5, c in N·s/m. *Miss*: worst residual of the closed form on the curve",
    "(multiplier + 1, clearance in a, or, at a birth, 1/|1 - ζ² + 2iξζ| - d; at a fold the",
    "distance in ζ to either side at which there are two motions and none). *Beside it*:",
    "simulations 0.006 of the plane to either side, of which the curve foretold this many.",
    "",
    "| curve | plane | points | miss | simulated | beside it |",
    "|---|---|---|---|---|---|",
]
for curve, test, value, right, total in rows:
    plane = short if curve.plane == "k" else "(ζ, c), k = 0.5"
    count = "exact line" if (curve.kind, curve.plane) == ("birth", "k") else len(curve.points)
    lines.append(
        f"| {curve.name} | {plane} | {count} | {value:.0e} | {test} | {right} of {total} |"
    )
lines += [
    "",
    f"What {across * up} simulations from rest in each plane settle on within {SETTLE} cycles:",
    "",
    "| plane | part | all | 2π, one impact | 4π, one impact | 4π, more | other | no impact |",
    "|---|---|---|---|---|---|---|---|",
    *tallies,
    "",
    "| number | value |",
    "|---|---|",
    *(f"| {name} | {'none' if x is None else f'{x:.5f}'} |" for name, x in described.items()),
    f"| doubling at ζ = 0.9, k = 0.5, c, by the closed form alone | {stable_from:.7f} |",
    f"| greatest c of the map at which a 4π motion is seen | {highest:.3f} |",
    "| ζ of any 4π motion with one impact at Table 1's c, k = 0.5, by the closed form | "
    f"{table_ratios.min():.3f} … {table_ratios.max():.3f} |",
]
birth_table, doubling_table = (
    described[f"{name} at Table 1's c, k = 0.5, ζ"] for name in ("birth", "doubling")
)
lines.append(
    f"""
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
)
kept = {name: x for name, x in described.items() if x is not None}
if not QUICK:
    keep(HERE, "boundaries", "\n".join(lines), kept, figure, dpi=100)
print("\n".join(lines[9:]))
say(f"done, {time.process_time():.0f} s of CPU time")
