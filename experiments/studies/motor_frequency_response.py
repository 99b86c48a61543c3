# %% [markdown]
# # Frequency response with a motor of limited power
#
# The paper's Figure 2 belongs to an ideal drive, which turns at the frequency ratio ζ whatever the
# machine does to it. A motor obeys its control κ only as far as its torque goes: ζ is an outcome.
# Here κ is run up and closed down, value by value, for the torques of Table 1 (T0 = 2, 10 and
# 100 N·m) and for motors that are far too weak, with the stop at 2a and with the stop out of reach.
# The 2π motions are continued in κ through their folds and laid over the sweeps. Both are compared
# with a forecast that knows no motor motion at all: the load that the ideal machine puts on its
# drive at each ζ, from the closed form, met with the motor's line (Kononenko's method).
#
# Run with `python experiments/studies/motor_frequency_response.py` (`--quick` for fewer and coarser
# sweeps, two branches, and no files).

# %%
import sys
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from vi_jax.plot.colors import RED, color_of

jax.config.update("jax_enable_x64", True)

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/studies")
sys.path.insert(0, str(HERE.parent))
from headlines import keep

QUICK = "--quick" in sys.argv
BEGIN = time.perf_counter()
K, NEAR, FAR = 0.5, 0.08, 0.8  # restitution; gaps in metres, 2a and 20a: the free motion needs 11a
# (T0 in N·m, gap in m): the largest κ of the sweeps, beyond each jump.
LANES = {
    (100.0, NEAR): 1.9, (10.0, NEAR): 1.9, (2.0, NEAR): 1.9,
    (0.2, NEAR): 2.6, (0.1, NEAR): 3.6, (0.05, NEAR): 5.6,
    (2.0, FAR): 1.9, (0.5, FAR): 3.0,
}  # fmt: skip
VALUES, SETTLE = (41, 300) if QUICK else (181, 400)
BOUNDS = (0.5, 6.0)
COLORS = {100.0: "k", 10.0: "#0072b2", 2.0: "#56b4e9", 0.5: "#882255", 0.2: "#e69f00",
          0.1: "#d55e00", 0.05: "#332288"}  # fmt: skip
if QUICK:
    LANES = {key: LANES[key] for key in ((10.0, NEAR), (0.2, NEAR), (2.0, FAR))}


def say(text: object) -> None:
    print(f"[{time.perf_counter() - BEGIN:5.1f} s] {text}", flush=True)


def machine(torque: float, gap: float, kappa: float) -> vi.Scene:
    return vi.Parameters(torque=torque, control=kappa, restitution=K, gap=gap).scene(drive="motor")


SCENE = machine(1.0, NEAR, 1.0)
assert isinstance(SCENE.drive, vi.Motor)
PER_NM = float(SCENE.drive.strength)  # τ0 for 1 N·m
XI, LOAD = float(SCENE.damping_ratio), float(SCENE.drive.coupling)

# %% [markdown]
# ## Run-up and close-down, all motors in one compiled call
#
# 24 steps a cycle instead of the default 12: the strongest motor pulls its shaft back at the rate
# τ0/κ per radian, 13 at T0 = 100 and κ = 0.5, and an explicit solver with 12 steps diverges there.


# %%
def one_sweep(torque, gap, kappas):
    scene = eqx.tree_at(
        lambda s: (s.drive.strength, s.drive.control, s.stops[0].gap),
        SCENE,
        (PER_NM * torque, kappas[0], gap / 0.04),
    )
    return vi.sweep(
        scene, "drive.control", kappas, settle=SETTLE, cycles=32,
        method=vi.FixedStep(steps_per_cycle=24),
    )  # fmt: skip


grid = np.stack([np.linspace(0.5, high, VALUES) for high in LANES.values()])
torques, gaps = (np.tile(a, 2) for a in np.array(list(LANES)).T)
begin = time.perf_counter()
both_of = vi.jit(jax.vmap(one_sweep)).lower(torques, gaps, np.concatenate([grid, grid[:, ::-1]]))
both_of = both_of.compile()
say(f"sweeps compiled in {time.perf_counter() - begin:.1f} s")
begin = time.perf_counter()
both = jax.tree.map(np.asarray, both_of(torques, gaps, np.concatenate([grid, grid[:, ::-1]])))
say(f"{grid.size * 2} values of κ swept in {time.perf_counter() - begin:.1f} s")
up = {key: jax.tree.map(lambda x, i=i: x[i], both) for i, key in enumerate(LANES)}
down = {key: jax.tree.map(lambda x, i=i: x[i + len(LANES)], both) for i, key in enumerate(LANES)}


# The strong motors close down once more, in steps sixty times as fine below κ = 1.235, where their
# free motion comes near the stop. The rows of the other motors are filled with the same.
FINE = tuple(torque for torque in (100.0, 10.0) if (torque, NEAR) in LANES)
near_stop = np.concatenate([np.linspace(1.9, 1.24, VALUES // 3), np.linspace(
    1.235, 1.217, VALUES - VALUES // 3)])  # fmt: skip
rows_of = np.resize(FINE, len(torques))
begin = time.perf_counter()
slow = jax.tree.map(
    np.asarray, both_of(rows_of, np.full_like(gaps, NEAR), np.tile(near_stop, (len(torques), 1)))
)
slow = {torque: jax.tree.map(lambda x, i=i: x[i], slow) for i, torque in enumerate(FINE)}
say(f"fine close-down in {time.perf_counter() - begin:.1f} s")


def jump(sweep: vi.Sweep) -> int:
    """The pair of neighbouring values between which the motion changes most."""
    return int(np.nanargmax(np.abs(np.diff(np.asarray(sweep.y_min)))))


def restless(sweep: vi.Sweep) -> tuple[int, int, int]:
    """Values that failed, that still drift, and that are observed but do not repeat."""
    W = np.asarray(sweep.sections.W)
    early, late = np.split(W, 2, axis=1)
    lost = ~np.isfinite(W).all(axis=1)
    loose = (np.asarray(sweep.period) == vi.REGIMES.unsettled) & ~lost
    drift = np.abs(late.mean(axis=1) - early.mean(axis=1)) > 0.25 * np.ptp(W, axis=1)
    return int(lost.sum()), int((loose & drift).sum()), int((loose & ~drift).sum())


# %% [markdown]
# ## Branches of 2π motions in κ
#
# Two sorts, with one impact and with none; each is one program for all torques. They begin at
# motions that the sweeps met: just before the jump of the run-up, and at the top of the close-down.


# %%
def start(key: tuple[float, float], impacts: int) -> vi.Orbit:
    sweep = up[key] if impacts else down[key]
    fits = (np.asarray(sweep.period) == 1) & (np.asarray(sweep.impacts) == impacts)
    fits &= np.asarray(sweep.values) > 1
    i = int(np.flatnonzero(fits)[-1 if impacts else 0])
    guess = jax.tree.map(lambda x: x[i, -1], sweep.sections)
    orbit = vi.find_orbit(machine(*key, float(sweep.values[i])), guess, 1)
    assert bool(orbit.successful), (key, impacts)
    return orbit


branches: dict[tuple[tuple[float, float], int], vi.Branch] = {}
for key, impacts in [(key, 1) for key in LANES if key[1] == NEAR] + [(key, 0) for key in LANES]:
    branches[key, impacts] = vi.continue_orbit(
        start(key, impacts), parameter="drive.control", bounds=BOUNDS, max_step=0.2
    )
    say(f"T0 = {key[0]:g} N·m, gap {key[1]:g} m: {branches[key, impacts]}")


def special(key: tuple[float, float], way: str) -> vi.SpecialPoint:
    """Where the continued branches say that the sweep must jump."""
    if way == "up":  # the fold at which the motion that it follows turns back
        folds = branches[key, 1 if key[1] == NEAR else 0].special
        return max((p for p in folds if p.kind == "fold"), key=lambda p: p.parameter)
    points = branches[key, 0].special  # a fold if there is one; or else the touch of the stop
    folds = [p for p in points if p.kind == "fold"]
    return min(folds or points, key=lambda p: p.parameter)


# %% [markdown]
# ## The forecast from the ideal machine
#
# The shaft's energy returns after a cycle, so that the motor's mean torque pays for the mean load
# ε <Y sin φ>, which is a first Fourier coefficient of Y. With an ideal drive the projection of
# ζ² Y'' + 2ξζ Y' + Y = cos φ - (1+k) V⁻ ζ δ(φ - φ0) on exp(-iφ) gives it in closed form. A motor
# then runs at κ = ζ + L(ζ)/τ0 if its speed hardly varies within a cycle; a sweep can follow this
# curve only while κ moves one way.


# %%
def load(zeta: np.ndarray, speed: Any = 0.0, phase: Any = 0.0) -> np.ndarray:
    """Mean load torque on the shaft in units of Jω²; without impacts if no speed is given."""
    kick = (1 + K) * speed * zeta * np.exp(-1j * phase) / (2 * np.pi)
    return -LOAD * np.imag((0.5 - kick) / (1 - zeta**2 + 2j * XI * zeta))


def ideal(zeta):
    return vi.closed_form_orbits(vi.Scene.ideal(
        frequency_ratio=zeta, restitution=K, gap=NEAR / 0.04, damping_ratio=XI))  # fmt: skip


# In batches of 256: batched LAPACK calls of two thousand matrices may wait for each other forever
# where XLA has only two threads.
zetas = np.sort(np.concatenate([np.linspace(0.4, 3.0, 2601), np.linspace(1.40, 1.45, 501)]))
exact = jax.jit(lambda z: jax.lax.map(ideal, z, batch_size=256))(jnp.asarray(zetas))
exact = jax.tree.map(np.asarray, exact)
hard = load(zetas, exact.impact_speed[:, 0], exact.impact_phase[:, 0])
hard = np.where(exact.admissible[:, 0], hard, np.nan)  # the faster of two motions
idle = load(zetas)
reach = 1 / np.abs(1 - zetas**2 + 2j * XI * zetas)
say("ideal motions")


def forecast(torque: float, gap: float, way: str) -> float:
    """κ of the jump."""
    tau = PER_NM * torque
    if way == "up":
        part = zetas < 1.05 if gap == FAR else np.isfinite(hard)
        return float(np.nanmax((zetas + (idle if gap == FAR else hard) / tau)[part]))
    part = (zetas > 1.0) if gap == FAR else (zetas > 1.0) & (reach < NEAR / 0.04)
    return float(np.min((zetas + idle / tau)[part]))


def misfit(key: tuple[float, float], impacts: int) -> float:
    """Largest error of the forecast κ - ζ along a continued branch, as a part of the largest."""
    branch = branches[key, impacts]
    turn = int(np.argmax(branch.parameter)) if impacts else len(branch.parameter)
    keep = np.arange(len(branch.parameter)) <= turn
    if impacts and branch.parameter[0] > branch.parameter[-1]:
        keep = np.arange(len(branch.parameter)) >= turn
    zeta, kappa = branch.frequency_ratio[keep], branch.parameter[keep]
    expected = np.interp(zeta, zetas, hard if impacts else idle)
    slip = kappa - zeta
    return float(np.nanmax(np.abs(slip - expected / (PER_NM * key[0]))) / np.nanmax(np.abs(slip)))


# %% [markdown]
# ## Figures measured

# %%
rows = [
    "| T0, N·m | gap | run-up jumps in κ | special point | forecast | ζ before → after | "
    "close-down jumps in κ | special point | forecast | ζ before → after | "
    "misfit of κ - ζ | lost, drifting, irregular |",
    "|" + "---|" * 12,
]
inside = []
for key in LANES:
    cells = [f"{key[0]:g}", f"{key[1] / 0.04:g}a"]
    for way, sweep in (("up", up[key]), ("down", down[key])):
        i, point = jump(sweep), special(key, way)
        pair = sorted((float(sweep.values[i]), float(sweep.values[i + 1])))
        inside.append(pair[0] <= point.parameter <= pair[1])
        assert sweep.frequency_ratio is not None
        z = sweep.frequency_ratio[i : i + 2]
        cells += [
            f"{pair[0]:.4f} … {pair[1]:.4f}", f"{point.kind} {point.parameter:.5f}",
            f"{forecast(*key, way):.4f}", f"{z[0]:.3f} → {z[1]:.3f}",
        ]  # fmt: skip
    cells.append(f"{100 * misfit(key, 1 if key[1] == NEAR else 0):.1f} %")
    counts = np.add(restless(up[key]), restless(down[key]))
    cells.append(", ".join(str(n) for n in counts))
    rows.append("| " + " | ".join(cells) + " |")
table = "\n".join(rows)
print(table)
say(f"{sum(inside)} of {len(inside)} special points lie between the two values of the jump")

points = {(key, way): special(key, way).parameter for key in LANES for way in ("up", "down")}
missed = max(abs(forecast(*key, way) / value - 1) for (key, way), value in points.items())


def fine_jump(torque: float) -> str:
    """Where the close-down in fine steps jumps, and the special point there."""
    i = jump(slow[torque])
    pair = sorted(float(x) for x in slow[torque].values[i : i + 2])
    point = special((torque, NEAR), "down")
    return (
        f"T0 = {torque:g} N·m between {pair[0]:.4f} and {pair[1]:.4f} ({point.kind} at "
        f"{point.parameter:.4f})"
    )


fine_jumps = "; ".join(fine_jump(torque) for torque in FINE)
say(fine_jumps)
outside = [
    f"T0 = {key[0]:g} {'run-up' if way == 'up' else 'close-down'}"
    for (key, way), within in zip(points, inside, strict=True)
    if not within
]


def held(key: tuple[float, float], low: float, high: float) -> str:
    """The κ over which the run-up's ζ goes from one value to another, before its jump."""
    sweep, last = up[key], jump(up[key])
    ratio, kappa = np.asarray(sweep.frequency_ratio)[: last + 1], np.asarray(sweep.values)
    return " to ".join(f"{np.interp(z, ratio, kappa[: last + 1]):.2f}" for z in (low, high))


ideal_fold = float(zetas[np.isfinite(hard)].max())
slope = float(hard[np.isfinite(hard)][-1]) / PER_NM
fine = np.linspace(0.9, 3.0, 200_001)
steepest = -np.gradient(load(fine), fine)
limits = [steepest[part].max() / PER_NM for part in (fine < 3, 1 / np.abs(
    1 - fine**2 + 2j * XI * fine) < NEAR / 0.04)]  # fmt: skip
say(f"fold of the ideal drive {ideal_fold:.4f}, slope {slope:.4f} N·m; torques {limits}; {outside}")

numbers = {"ideal drive: 2π motion folds, ζ": ideal_fold}
for (key, way), value in points.items():
    name = (
        f"T0 = {key[0]:g} N·m, gap {key[1] / 0.04:g}a, {'run-up' if way == 'up' else 'close-down'}"
    )
    numbers[f"{name}: {special(key, way).kind}, κ"] = value
    numbers[f"{name}: forecast, κ"] = forecast(*key, way)

text = ""
if not QUICK:
    folds = [points[(torque, NEAR), "up"] for torque in (10.0, 100.0)]
    measured = (folds[0] - folds[1]) / (1 / 10 - 1 / 100)
    i, last = jump(down[0.05, NEAR]), down[0.05, NEAR].values
    weakest = sorted((float(last[i]), float(last[i + 1])))
    text = f"""# Frequency response with a motor of limited power

k = 0.5, Table 1's damping, cosine kinematics. Each sweep: {VALUES} values of κ from 0.5 up or down
to it, at each {SETTLE} drive cycles to settle and 32 observed. *Special point*: where the
continued 2π motion ends or turns. *Forecast* of that point: κ = ζ + L(ζ)/τ0 with the ideal
machine's load L in closed form. *Misfit*: largest error of that formula's κ - ζ along the
continued branch, as a part of the largest κ - ζ. Last column:
values of both sweeps that failed, that still drift, and that do neither but do not repeat
within 1e-6 in up to 16 cycles.

{table}

- **Jumps.** {sum(inside)} of {len(inside)} special points lie between the two values of κ where the
  sweep jumps; the others miss by less than two steps of κ
  ({", ".join(outside)}).
  Where strong motors close down, it is the coarse step of κ that sets off a transient which reaches
  the stop too early. In steps of {1e4 * (1.235 - 1.217) / (VALUES - VALUES // 3 - 1):.1f}e-4 they
  jump at their grazings, to one step: {fine_jumps}.
  The weakest motor passes its fold (T0 = 0.05 N·m, close-down at
  {points[(0.05, NEAR), "down"]:.3f}) and jumps only at {weakest[0]:.3f} … {weakest[1]:.3f}: it
  needs the cycles of several values to leave it.
- **Forecast.** It is about special points, not about jumps: the load of the ideal machine gives
  the κ of all {len(inside)} of them to {100 * missed:.2f} %, from T0 = 0.05 to 100 N·m, although
  it leaves out that the shaft's speed varies within a cycle. Where a sweep jumps it tells as well
  as that point does (see above).
- **T0 to infinity.** The ideal drive's 2π motion folds at ζ = {ideal_fold:.4f}; the motor's fold in
  κ lies about {slope:.2f} N·m / T0 above it, since κ - ζ = L/τ0
  ({measured:.3f} N·m from T0 = 10 and 100, both continued; the load is steep at the fold, so that
  the grid of ζ limits the forecast there). Strong motors so obey κ:
  at T0 = 100 N·m the response is that of the ideal drive.
- **Sommerfeld effect, stop out of reach.** With T0 = 0.5 N·m the run-up hangs at resonance: ζ takes
  κ from {held((0.5, FAR), 0.95, 0.995)} to go from 0.95 to 0.995, then jumps to 2.6. Already
  Table 1's weakest motor (T0 = 2 N·m) hangs, from κ = {held((2.0, FAR), 0.95, 0.995)}.
  By the forecast such a fold exists for every T0 below {limits[0]:.1f} N·m; between the two
  folds the continued branch is unstable.
- **With the stop at 2a** the motor does not hang at ζ = 1: the impact motion carries on beyond it,
  and ζ climbs slowly, from 1.0 to 1.4 over κ = {held((0.2, NEAR), 1.0, 1.4)} for T0 = 0.2 N·m and
  κ = {held((0.1, NEAR), 1.0, 1.4)} for 0.1 N·m, until that motion folds. The stop takes up
  less power than resonance would, and so needs a far weaker motor for the effect.
  On the way down the free motion of strong motors ends by touching the stop; below
  T0 = {limits[1]:.2f} N·m, by the forecast, it folds before.
- **What does not settle.** At T0 = 0.05 N·m the shaft's time constant is
  1/τ0 = {1 / (0.05 * PER_NM):.0f}, or {5 / (0.05 * PER_NM) / (2 * np.pi):.0f} cycles at ζ = 5, so
  that the upper end of its sweeps lags behind κ (ζ > κ on the way down).
  Most irregular values lie near the grazing and the period doublings between
  ζ = 0.71 and 0.85, where multipliers near -1 or repeated light impacts decay slowly or not at
  all; they were
  not followed further.
"""

# %% [markdown]
# ## Figure

# %%
figure = Figure(figsize=(14, 8.2), layout="constrained")
(ax_far, ax_near, ax_load), (ax_strong, ax_weak, ax_jump) = figure.subplots(2, 3)
LEGEND: dict[str, Any] = {"fontsize": 8.5, "framealpha": 0.9}


def draw(ax: Any, key: tuple[float, float], y: str, x: str, *, lines: bool = True) -> None:
    """A motor's sweeps and branches, in its colour."""
    look = {"color": COLORS[key[0]], "mew": 0.7, "markevery": 6, "alpha": 0.8}
    dots = "values" if x == "parameter" else x
    for (name, _), branch in branches.items():
        if name == key and lines:
            color = COLORS[key[0]]
            vi.plot_branch(
                branch, ax=ax, y=y, x=x, special=False, legend=False, color=color, lw=1.8, zorder=3
            )
    vi.plot_sweep(up[key], ax=ax, y=y, x=dots, marker="o", mfc="none", ms=4.5, **look)
    vi.plot_sweep(down[key], ax=ax, y=y, x=dots, marker="x", ms=3.6, **look)


def explain(ax: Any, keys: list[tuple[float, float]], where: str) -> None:
    tones = sorted({key[0] for key in keys}, reverse=True)
    handles = [Line2D([], [], color=COLORS[t], lw=2.5, label=f"T0 = {t:g} N·m") for t in tones]
    ax.legend(handles=handles, loc=where, **LEGEND)
    ax.grid(alpha=0.3)


far = [key for key in LANES if key[1] == FAR]
strong = [key for key in LANES if key[1] == NEAR and key[0] >= 2]
weak = [key for key in LANES if key[1] == NEAR and key[0] < 2]
for ax, keys, title in ((ax_far, far, "stop out of reach"), (ax_near, weak, "stop at 2a")):
    for key in keys:
        draw(ax, key, "frequency_ratio", "parameter")
    top = max(LANES[key] for key in keys)
    ax.axline((1, 1), slope=1, color="0.6", lw=0.9, ls=":")
    ax.set(xlim=(0.5, top), ylim=(0.4, min(top, 3.2)), ylabel="mean frequency ratio ζ",
           title=f"ζ against κ, {title}")  # fmt: skip
    explain(ax, keys, "lower right")
for ax, keys, title in ((ax_strong, strong, "Table 1's"), (ax_weak, weak, "weak")):
    for key in keys:
        for y in ("y_min", "y_max"):
            draw(ax, key, y, "frequency_ratio", lines=key[0] in (10.0, 0.2))
    ax.set(xlim=(0.5, 1.9), xlabel="mean frequency ratio ζ", ylabel="min Y, max Y (a)",
           title=f"Extremes, {title} motors, stop at 2a")  # fmt: skip
    explain(ax, keys, "center left")
for key in LANES:
    for sweep, dot in ((up[key], "o"), (down[key], "x")):
        slip = (np.asarray(sweep.values) - np.asarray(sweep.frequency_ratio)) * key[0]
        look = {"mfc": "none", "mew": 0.6, "color": COLORS[key[0]], "markevery": 8}
        ax_load.plot(sweep.frequency_ratio, slip, dot, ms=4, **look)
for needed, color, label in (
    (idle, "0.35", "ideal drive, no impacts"),
    (hard, color_of(1, 1), "ideal drive, 2π with impact"),
):
    ax_load.plot(zetas, needed / PER_NM, color=color, lw=2.6, alpha=0.6, zorder=3, label=label)
ax_load.set(yscale="log", xlim=(0.5, 1.9), ylim=(1e-3, 2), xlabel="mean frequency ratio ζ",
            ylabel="T0 (κ - ζ) (N·m)", title="Load on the motor, all sweeps")  # fmt: skip
ax_load.legend(loc="upper right", **LEGEND)
ax_load.grid(alpha=0.3)
scan = np.logspace(np.log10(0.04), 2, 120)
for gap, tone, name in ((NEAR, "k", "2a"), (FAR, "0.6", "20a")):
    for way, dash in (("up", "-"), ("down", "--")):
        reached = scan if gap == NEAR else scan[(scan > 0.4) & (scan < limits[0])]
        expected = [forecast(t, gap, way) for t in reached]
        ax_jump.plot(
            reached, expected, dash, color=tone, lw=1.2, label=f"{way}, stop at {name}: forecast"
        )
        keys = [key for key in LANES if key[1] == gap]
        x, y = zip(*((key[0], special(key, way).parameter) for key in keys), strict=True)
        dots = {"marker": "s", "mfc": "none", "ms": 8, "ls": "", "color": tone}
        ax_jump.plot(x, y, **dots, label="continued" if way == "up" and gap == NEAR else None)
        for key in keys:
            sweep = (up if way == "up" else down)[key]
            i = jump(sweep)
            middle = float(np.mean(np.asarray(sweep.values)[i : i + 2]))
            ax_jump.plot(key[0], middle, "o", ms=4, color=RED)
ax_jump.plot([], [], "o", ms=4, color=RED, label="swept")
ax_jump.set(xscale="log", ylim=(0.9, 6), xlabel="stall torque T0 (N·m)", ylabel="κ of the jump",
            title="Where the sweeps jump")  # fmt: skip
ax_jump.legend(loc="upper right", **LEGEND)
ax_jump.grid(alpha=0.3)
figure.suptitle(
    "k = 0.5, Table 1's damping. ○ run-up, × close-down; lines: 2π motions continued in κ "
    "(dashed: unstable); dotted: ζ = κ",
    fontsize=11,
)
if not QUICK:
    keep(HERE, "motor_frequency_response", text, numbers, figure)
say(f"done; {time.process_time():.0f} s of processor time")
