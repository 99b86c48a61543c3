# %% [markdown]
# # Motors of limited power
#
# The paper's Figure 2 has an ideal drive, which turns at the frequency ratio ζ under any load. The
# torque of a motor is limited: its control κ is a parameter, and ζ is a result.
#
# For Table 1's machine κ is swept up and down with strong and weak motors. The stop is at 2a or out
# of reach. The 2π motions are continued in κ through their folds. Both are compared with a forecast
# from the closed-form load of the ideal machine (Kononenko's method).
#
# Run with `python experiments/studies/motors.py` (`--quick` for coarser sweeps, and no files).

# %%
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from vi_jax.plot.colors import BLUE

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.ideal import vibration
from tools.pictures import gridded, panels
from tools.study import QUICK, say, write
from tools.tables import table

Key = tuple[float, float]
"""A motor's stall torque T0 in N·m, and the gap in m."""

# %% [markdown]
# ## Run-up and close-down, all motors in one compiled call

# %%
K, NEAR, FAR = 0.5, 0.08, 0.8  # restitution; gaps in metres, 2a and 20a: the free motion needs 11a
# The largest κ of each sweep; every jump lies below it.
HIGHEST: dict[Key, float] = {
    (100.0, NEAR): 1.9, (10.0, NEAR): 1.9, (2.0, NEAR): 1.9,
    (0.2, NEAR): 2.6, (0.1, NEAR): 3.6, (0.05, NEAR): 5.6,
    (2.0, FAR): 1.9, (0.5, FAR): 3.0,
}  # fmt: skip
if QUICK:
    HIGHEST = {key: HIGHEST[key] for key in ((10.0, NEAR), (0.2, NEAR), (2.0, FAR))}
VALUES, SETTLE = (41, 300) if QUICK else (181, 400)
WAYS = ("run-up", "close-down")


def machine(torque: Any, kappa: Any, gap: float = NEAR) -> vi.Scene:
    """Return Table 1's machine with k = 0.5."""
    return vi.Parameters(torque=torque, control=kappa, restitution=K, gap=gap).scene()


BASE = machine(1.0, 1.0)
assert isinstance(BASE.drive, vi.Motor)
PER_NM, XI = float(BASE.drive.strength), float(BASE.damping_ratio)  # τ0 of 1 N·m; ξ
COUPLING = float(BASE.drive.coupling)


def one_sweep(torque, gap, kappas):
    """Sweep κ. The speed of the strongest motor relaxes at the rate τ0/κ per radian, which is 13 at
    T0 = 100 and κ = 0.5. An explicit solver with 12 steps per cycle diverges there."""
    swept = eqx.tree_at(
        lambda s: (s.drive.strength, s.drive.control, s.stops[0].gap),
        BASE,
        (PER_NM * torque, kappas[0], gap / 0.04),
    )
    steps = vi.FixedStep(steps_per_cycle=24)
    return vi.sweep(swept, "drive.control", kappas, settle=SETTLE, cycles=32, method=steps)


grid = np.stack([np.linspace(0.5, high, VALUES) for high in HIGHEST.values()])
torques, gaps = (np.tile(a, 2) for a in np.array(list(HIGHEST)).T)
swept = vi.jit(jax.vmap(one_sweep))(torques, gaps, np.concatenate([grid, grid[:, ::-1]]))
swept = jax.tree.map(np.asarray, swept)
say(f"{grid.size * 2} values of κ swept")
sweeps = {
    (key, way): jax.tree.map(lambda x, i=i: x[i], swept)
    for i, (way, key) in enumerate((way, key) for way in WAYS for key in HIGHEST)
}


def jump(sweep: vi.Sweep) -> tuple[float, float]:
    """Return the smaller and the larger κ between which the motion changes most."""
    i = int(np.nanargmax(np.abs(np.diff(np.asarray(sweep.y_min)))))
    low, high = sorted(float(x) for x in sweep.values[i : i + 2])
    return low, high


# %% [markdown]
# ## The 2π motions in κ, with one impact and with none
#
# The branches begin at motions that the sweeps found.

# %%
branches: dict[tuple[Key, int], vi.Branch] = {}
for key, impacts in [(key, n) for n in (1, 0) for key in HIGHEST if n == 0 or key[1] == NEAR]:
    sweep = sweeps[key, WAYS[0] if impacts else WAYS[1]]
    fits = (np.asarray(sweep.period) == 1) & (np.asarray(sweep.impacts) == impacts)
    i = int(np.flatnonzero(fits & (np.asarray(sweep.values) > 1))[-1 if impacts else 0])
    guess = jax.tree.map(lambda x, i=i: x[i, -1], sweep.sections)
    orbit = vi.find_orbit(machine(key[0], float(sweep.values[i]), key[1]), guess, throw=True)
    branches[key, impacts] = vi.continue_orbit(
        orbit, parameter="drive.control", bounds=(0.5, 6.0), max_step=0.2
    )
    say(f"T0 = {key[0]:g} N·m, gap {key[1]:g} m: {branches[key, impacts]}")


def special(key: Key, way: str) -> vi.Point:
    """Return the point at which a branch ends or folds, so that a sweep must jump there."""
    up = way == WAYS[0]
    points = branches[key, 1 if up and key[1] == NEAR else 0].special
    folds = [p for p in points if p.kind == "fold"]
    if up:
        return max(folds, key=lambda p: p.parameter)
    return min(folds or points, key=lambda p: p.parameter)


# %% [markdown]
# ## The forecast from the ideal machine
#
# The shaft's energy is the same after a cycle. The mean torque of the motor therefore equals the
# mean load ε <Y sin φ>, a first Fourier coefficient of Y. With an ideal drive,
# ζ² Y'' + 2ξζ Y' + Y = cos φ - (1+k) V⁻ ζ δ(φ - φ0). Its projection on exp(-iφ) gives the load L in
# closed form. A motor with nearly constant speed runs at κ = ζ + L(ζ)/τ0.


# %%
def load(zeta: np.ndarray, speed: Any = 0.0, phase: Any = 0.0) -> np.ndarray:
    """Return the mean load torque in units of Jω²; the default speed 0 means no impacts."""
    kick = (1 + K) * speed * zeta * np.exp(-1j * phase) / (2 * np.pi)
    return -COUPLING * np.imag((0.5 - kick) * vibration(zeta, XI))


def ideal(zeta: Any) -> vi.ClosedFormOrbits:
    """Return the 2π motions with one impact, in closed form."""
    return vi.closed_form_orbits(
        vi.Scene.ideal(frequency_ratio=zeta, restitution=K, gap=NEAR / 0.04, damping_ratio=XI)
    )


ZETAS = np.sort(np.concatenate([np.linspace(0.4, 3.0, 2601), np.linspace(1.40, 1.45, 501)]))
# Batches of 256 are needed: with only two threads of XLA, batched LAPACK calls of two thousand
# matrices may deadlock.
exact = jax.jit(lambda z: jax.lax.map(ideal, z, batch_size=256))(jnp.asarray(ZETAS))
exact = jax.tree.map(np.asarray, exact)
HARD = load(ZETAS, exact.impact_speed[:, 0], exact.impact_phase[:, 0])
HARD = np.where(exact.admissible[:, 0], HARD, np.nan)  # the faster of two motions
IDLE, REACH = load(ZETAS), np.abs(vibration(ZETAS, XI))


def forecast(key: Key, way: str) -> float:
    """Return the κ at which the motion ends."""
    torque, gap = key
    if way == WAYS[0]:
        part = ZETAS < 1.05 if gap == FAR else np.isfinite(HARD)
        return float(np.nanmax((ZETAS + (IDLE if gap == FAR else HARD) / (PER_NM * torque))[part]))
    part = (ZETAS > 1.0) & ((gap == FAR) | (REACH < NEAR / 0.04))
    return float(np.min((ZETAS + IDLE / (PER_NM * torque))[part]))


numbers = {"ideal drive: 2π motion folds, ζ": float(ZETAS[np.isfinite(HARD)].max())}
rows, missed, inside = [], [], 0
for key in HIGHEST:
    cells = [f"{key[0]:g}", f"{key[1] / 0.04:g}a"]
    for way in WAYS:
        point, (low, high), told = special(key, way), jump(sweeps[key, way]), forecast(key, way)
        cells += [f"{low:.4f} … {high:.4f}", f"{point.kind} {point.parameter:.5f}", f"{told:.4f}"]
        missed.append(abs(told / point.parameter - 1))
        inside += low <= point.parameter <= high
        name = f"T0 = {key[0]:g} N·m, gap {key[1] / 0.04:g}a, {way}"
        numbers[f"{name}: {point.kind}, κ"] = point.parameter
        numbers[f"{name}: forecast, κ"] = told
    rows.append(cells)
heads = ["T0, N·m", "gap"]
heads += [f"{way}{x}" for way in WAYS for x in (" jumps in κ", ": special point", ": forecast")]
motors = table(heads, rows)
print(motors)

# %% [markdown]
# ## Picture

# %%
figure, axes = panels(14.0, 4.4, 1, 3)
COLORS = dict(zip((100.0, 10.0, 2.0, 0.5, 0.2, 0.1, 0.05), "k #0072b2 #56b4e9 #882255 #e69f00 "
                  "#d55e00 #332288".split(), strict=True))  # fmt: skip
MARKS = {WAYS[0]: {"marker": "o", "mfc": "none", "ms": 4.5}, WAYS[1]: {"marker": "x", "ms": 3.6}}


def draw(ax: Any, keys: list[Key]) -> None:
    """Draw the branches and sweeps of some motors."""
    for key in keys:
        for (name, _), branch in branches.items():
            if name == key:
                look = {"color": COLORS[key[0]], "lw": 1.8, "special": False, "legend": False}
                vi.plot_branch(branch, ax=ax, y="frequency_ratio", **look)
        for way in WAYS:
            look = {"color": COLORS[key[0]], "mew": 0.7, "markevery": 6, "alpha": 0.8}
            vi.plot_sweep(sweeps[key, way], ax=ax, y="frequency_ratio", **look, **MARKS[way])
        ax.plot([], [], color=COLORS[key[0]], lw=2.5, label=f"T0 = {key[0]:g} N·m")


far, near = ([key for key in HIGHEST if key[1] == gap] for gap in (FAR, NEAR))
for ax, keys in ((axes[0], far), (axes[1], [key for key in near if key[0] < 2])):
    draw(ax, keys)
    ax.axline((1, 1), slope=1, color="0.6", lw=0.9, ls=":")
    ax.set(xlim=(0.5, max(HIGHEST[key] for key in keys)), ylim=(0.4, 3.2))
    ax.set_ylabel("mean frequency ratio ζ")
for (key, way), sweep in sweeps.items():
    slip = (np.asarray(sweep.values) - np.asarray(sweep.frequency_ratio)) * key[0]
    look = {"color": COLORS[key[0]], "ls": "none", "markevery": 8, "mew": 0.6, **MARKS[way]}
    axes[2].plot(sweep.frequency_ratio, slip, **look)
for needed, color, label in ((IDLE, "0.35", "no impacts"), (HARD, BLUE, "2π with impact")):
    look = {"lw": 2.6, "alpha": 0.6, "zorder": 3, "label": f"ideal drive, {label}"}
    axes[2].plot(ZETAS, needed / PER_NM, color=color, **look)
axes[2].set(yscale="log", xlim=(0.5, 1.9), ylim=(1e-3, 2), xlabel="mean frequency ratio ζ",
               ylabel="T0 (κ - ζ) (N·m)")  # fmt: skip
gridded(axes, ("ζ against κ, stop out of reach", "ζ against κ, stop at 2a", "Load on the motor"))
for ax in axes:
    handles, labels = ax.get_legend_handles_labels()
    named = dict(zip(labels, handles, strict=True))  # each label once
    ax.legend(named.values(), named, fontsize=8.5, framealpha=0.9)
figure.suptitle("○ run-up, × close-down; lines: 2π motions continued in κ (dashed: unstable)")

# %%
text = f"""# Motors of limited power

![Sweeps, branches and load](../figures/motors.png)

Table 1's machine with k = 0.5. Each sweep: {VALUES} values of κ from 0.5 up or down to it, at each
{SETTLE} drive cycles to settle and 32 observed. *Special point*: where the continued 2π motion ends
or turns. *Forecast* of that point: κ = ζ + L(ζ)/τ0 with the ideal machine's load L in closed form.

{motors}

- {inside} of {len(missed)} special points lie between the two values of κ where the sweep jumps.
  Strong motors close down a little too early, because a coarse step of κ sets off a transient that
  reaches the stop. The weakest motor needs the cycles of several values to leave its fold.
- The forecast gives the κ of all special points to {100 * max(missed):.2f} %, from T0 = 0.05 to
  100 N·m, although it leaves out that the shaft's speed varies within a cycle.
- Sommerfeld effect: with the stop out of reach the run-up of a weak motor hangs at resonance, where
  ζ hardly rises with κ, and then jumps.
- With the stop at 2a the motor does not hang at ζ = 1. The impact motion carries on beyond it until
  it folds, so that the effect needs a far weaker motor.
"""
write("motors", text, numbers, figure)
say("done")
