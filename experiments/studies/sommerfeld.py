# %% [markdown]
# # The Sommerfeld effect of an unbalanced rotor
#
# A motor of limited power turns an unbalanced rotor on an elastic support. Turned up, its speed
# stays behind its control near the resonance, and then jumps; turned down, it jumps back
# elsewhere. Run-up and close-down are swept quasi-statically for three motors, the periodic motion
# is continued through its folds, and both are laid over the averaged response in closed form
# (first order in ε). With a stop the body is held, and the resonance with it.
#
# Run with `python experiments/studies/sommerfeld.py` (`--quick` for coarse sweeps, writes nothing).

# %%
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from vi_jax.plot.colors import BLUE, GREEN, RED, once

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import open_frames, panels
from tools.study import QUICK, write
from tools.tables import table

STRENGTHS = (0.1, 0.2, 1.0)
EPSILON, XI, GAP = 0.01, 0.05, 4.0
VALUES, SETTLE = (31, 200) if QUICK else (161, 400)
LOW, HIGH = 0.6, 1.8


def machine(strength: float, control: float = 0.8, *, stop: bool = False) -> vi.AbstractMachine:
    gap = GAP if stop else None
    return vi.machines.UnbalancedRotor(  # pyright: ignore[reportCallIssue]
        strength=strength, control=control, coupling=EPSILON, damping_ratio=XI, gap=gap
    )  # fmt: skip


# %% [markdown]
# ## Sweeps, branches, and what averaging says

# %%
grid = np.linspace(LOW, HIGH, VALUES)


def swept(stop: bool) -> vi.Sweep:
    """Up and down, every motor."""
    base = machine(0.1, stop=stop)

    def one(strength, kappas):
        rotor = eqx.tree_at(lambda r: (r.strength, r.control), base, (strength, kappas[0]))
        return vi.sweep(
            rotor, "control", kappas, settle=SETTLE, cycles=16,
            method=vi.FixedStep(steps_per_cycle=16),
        )  # fmt: skip

    strengths = jnp.asarray(STRENGTHS * 2)
    rows = np.stack([grid] * len(STRENGTHS) + [grid[::-1]] * len(STRENGTHS))
    return jax.tree.map(np.asarray, vi.jit(jax.vmap(one))(strengths, jnp.asarray(rows)))


free, held = swept(False), swept(True)


def jump(sweep: vi.Sweep, row: int) -> tuple[float, float]:
    """The two values of κ between which ζ jumps."""
    assert sweep.frequency_ratio is not None
    ratio, values = np.asarray(sweep.frequency_ratio)[row], np.asarray(sweep.values)[row]
    i = int(np.nanargmax(np.abs(np.diff(ratio))))
    low, high = sorted((float(values[i]), float(values[i + 1])))
    return low, high


def averaged(strength: float) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """ζ, κ and the κ of the folds."""
    speeds = np.linspace(0.5, 2.2, 170_001)
    rotor = machine(strength)
    assert isinstance(rotor, vi.machines.UnbalancedRotor)
    kappa = np.asarray(rotor.averaged_control(speeds))
    falls = np.flatnonzero(np.diff(kappa) < 0)
    return speeds, kappa, [float(kappa[i]) for i in (falls[0], falls[-1] + 1)] if falls.size else []


branches, folds = {}, {}
for strength in STRENGTHS:
    rotor = machine(strength)
    orbit = vi.find_orbit(rotor, vi.simulate(rotor, rotor.start(), 1, settle=300).last, throw=True)
    branches[strength] = vi.continue_orbit(orbit, parameter="control", bounds=(LOW, HIGH))
    points = [p.parameter for p in branches[strength].special if p.kind == "fold"]
    folds[strength] = sorted(points, reverse=True)

# %% [markdown]
# ## Table and figure

# %%
heads = ["τ0", "run-up jumps in κ", "fold", "averaged", "close-down jumps in κ", "fold", "averaged"]
heads += ["run-up with a stop"]
rows = []
numbers, apart = {}, []
for i, strength in enumerate(STRENGTHS):
    turns = averaged(strength)[2]
    cells = [f"{strength:g}"]
    for k, way in enumerate(("run-up", "close-down")):
        if not turns:
            cells += ["none", "none", "none"]
            continue
        low, high = jump(free, i + k * len(STRENGTHS))
        cells += [f"{low:.4f} … {high:.4f}", f"{folds[strength][k]:.5f}", f"{turns[k]:.5f}"]
        numbers[f"τ0 = {strength:g}, {way}: fold, κ"] = folds[strength][k]
        numbers[f"τ0 = {strength:g}, {way}: averaged fold, κ"] = turns[k]
        apart.append(abs(folds[strength][k] / turns[k] - 1))
    assert held.frequency_ratio is not None
    low, high = jump(held, i)
    step = np.nanmax(np.abs(np.diff(np.asarray(held.frequency_ratio)[i])))
    cells.append(f"{low:.4f} … {high:.4f}" if step > 0.05 else "none")
    rows.append(cells)
motors = table(heads, rows)
print(motors)

figure, (left, right) = panels(11, 4.4, 1, 2, sharex=True, sharey=True)
colors = (RED, BLUE, GREEN)
for i, strength in enumerate(STRENGTHS):
    speeds, kappa, _ = averaged(strength)
    inside = (kappa >= LOW) & (kappa <= HIGH)
    left.plot(
        np.where(inside, kappa, np.nan), speeds, color=colors[i], lw=5, alpha=0.25,
        label=once(left, "averaged"),
    )  # fmt: skip
    vi.plot_branch(
        branches[strength], ax=left, y="frequency_ratio", color=colors[i], lw=1.2, legend=False,
        label=f"τ0 = {strength:g}",
    )  # fmt: skip
    for ax, sweep in ((left, free), (right, held)):
        for row, marker in ((i, "^"), (i + len(STRENGTHS), "v")):
            shown = slice(None, None, 3)
            ratio = np.asarray(sweep.frequency_ratio)[row][shown]
            ax.plot(
                np.asarray(sweep.values)[row][shown], ratio, marker, color=colors[i], ms=3.5,
                mfc="none", mew=0.8, label=once(ax, "run-up" if marker == "^" else "close-down"),
            )  # fmt: skip
for ax, title in ((left, "no stop"), (right, f"a stop at {GAP:g} m r/M")):
    ax.plot([LOW, HIGH], [LOW, HIGH], color="0.6", lw=0.8, ls=":", zorder=0, label="ζ = κ")
    ax.set(xlabel="motor control κ", ylabel="mean speed ζ (ω)", xlim=(LOW, HIGH), ylim=(LOW, HIGH))
    ax.set_title(title, fontsize=10)
open_frames((left, right))
right.set_ylabel("")
left.legend(frameon=False, fontsize=8, loc="upper left")

# %%
text = f"""# The Sommerfeld effect of an unbalanced rotor

An unbalanced rotor on an elastic support, ε = {EPSILON:g}, ξ = {XI:g}, with three motors. Each
sweep: {VALUES} values of κ from {LOW:g} to {HIGH:g} or back, at each {SETTLE} turns to settle.
*Fold*: where the continued motion turns back. *Averaged*: the fold of
κ = ζ/w0 + ε ξ ζ⁵/(τ0 D), first order in ε. In the picture the averaged response is the broad line,
the continued motion the thin one (unstable: dashed).

![Sommerfeld effect](../figures/sommerfeld.png)

- Averaging gives the κ of the folds to {100 * max(apart):.1f} %. Where a motor is strong enough
  (τ0 = {STRENGTHS[-1]:g}) the line never falls, and there is no jump.
- A stop at {GAP:g} m r/M, less than half of what the free body reaches at resonance, takes the peak
  away and bends the response to higher speeds, as a hardening spring would: the run-up follows
  the impacting motion far beyond the resonance, with the strong motor too, and the close-down does
  not know of it. So a stop can bring a jump where there was none (τ0 = {STRENGTHS[-1]:g}), and hold
  a weak motor down all the way (τ0 = {STRENGTHS[0]:g}: no jump up to κ = {HIGH:g}).

{motors}
"""
write("sommerfeld", text, numbers, figure)
