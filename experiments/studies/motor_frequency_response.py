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
from pathlib import Path

import jax
import numpy as np
import vi_jax as vi

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from studies.parts.motor_forecast import HARD, ZETAS, forecast, misfit, weakest_without_fold
from studies.parts.motor_picture import picture
from studies.parts.motor_sweeps import (
    FAR,
    FINE_STEP,
    HIGHEST,
    NEAR,
    PER_NM,
    SETTLE,
    VALUES,
    Key,
    branches,
    jump,
    jump_in_kappa,
    restless,
    special,
    sweeps,
)
from tools.study import QUICK, say, write
from tools.tables import table

# %% [markdown]
# ## Run-up and close-down, all motors in one compiled call; then the 2π motions in κ

# %%
up, down, slow = sweeps()
found = branches(up, down)
points = {(key, way): special(found, key, way) for key in HIGHEST for way in ("up", "down")}

# %% [markdown]
# ## The forecast from the ideal machine
#
# The shaft's energy returns after a cycle, so that the motor's mean torque pays for the mean load
# ε <Y sin φ>, which is a first Fourier coefficient of Y. With an ideal drive the projection of
# ζ² Y'' + 2ξζ Y' + Y = cos φ - (1+k) V⁻ ζ δ(φ - φ0) on exp(-iφ) gives it in closed form. A motor
# then runs at κ = ζ + L(ζ)/τ0 if its speed hardly varies within a cycle; a sweep can follow this
# curve only while κ moves one way.

# %%
missed = max(abs(forecast(*key, way) / x.parameter - 1) for (key, way), x in points.items())
limits = weakest_without_fold()
ideal_fold = float(ZETAS[np.isfinite(HARD)].max())
slope = float(HARD[np.isfinite(HARD)][-1]) / PER_NM

# %% [markdown]
# ## The table


# %%
def cells(key: Key, way: str, sweep: vi.Sweep) -> list[str]:
    """Of one sweep: its jump, the special point, the forecast, and ζ before and after."""
    i, point, (low, high) = jump(sweep), points[key, way], jump_in_kappa(sweep)
    assert sweep.frequency_ratio is not None
    z = sweep.frequency_ratio[i : i + 2]
    return [
        f"{low:.4f} … {high:.4f}", f"{point.kind} {point.parameter:.5f}",
        f"{forecast(*key, way):.4f}", f"{z[0]:.3f} → {z[1]:.3f}",
    ]  # fmt: skip


def row(key: Key) -> list[str]:
    """Of one motor."""
    impacts = 1 if key[1] == NEAR else 0
    counts = np.add(restless(up[key]), restless(down[key]))
    return [
        f"{key[0]:g}",
        f"{key[1] / 0.04:g}a",
        *cells(key, "up", up[key]),
        *cells(key, "down", down[key]),
        f"{100 * misfit(key, impacts, found[key, impacts]):.1f} %",
        ", ".join(str(n) for n in counts),
    ]


heads = ["T0, N·m", "gap"]
for way in ("run-up", "close-down"):
    heads += [f"{way} jumps in κ", "special point", "forecast", "ζ before → after"]
heads += ["misfit of κ - ζ", "lost, drifting, irregular"]
motors = table(heads, [row(key) for key in HIGHEST])
print(motors)

# %% [markdown]
# ## What the table says


# %%
def fine_jump(torque: float) -> str:
    """Where the close-down in fine steps jumps, and the special point there."""
    low, high = jump_in_kappa(slow[torque])
    point = points[(torque, NEAR), "down"]
    between = f"T0 = {torque:g} N·m between {low:.4f} and {high:.4f}"
    return f"{between} ({point.kind} at {point.parameter:.4f})"


def held(key: Key, low: float, high: float) -> str:
    """The κ over which the run-up's ζ goes from one value to another, before its jump."""
    sweep, last = up[key], jump(up[key])
    ratio, kappa = np.asarray(sweep.frequency_ratio)[: last + 1], np.asarray(sweep.values)
    return " to ".join(f"{np.interp(z, ratio, kappa[: last + 1]):.2f}" for z in (low, high))


def named(key: Key, way: str) -> str:
    """A sweep in words."""
    return f"T0 = {key[0]:g} {'run-up' if way == 'up' else 'close-down'}"


outside = []
for (key, way), point in points.items():
    low, high = jump_in_kappa((up if way == "up" else down)[key])
    if not low <= point.parameter <= high:
        outside.append(named(key, way))
inside = len(points) - len(outside)
fine_jumps = "; ".join(fine_jump(torque) for torque in slow)
say(f"{inside} of {len(points)} special points lie between the values of the jump; {fine_jumps}")
page = motors
if not QUICK:  # with fewer motors there is less to say
    folds = [points[(torque, NEAR), "up"].parameter for torque in (10.0, 100.0)]
    measured = (folds[0] - folds[1]) / (1 / 10 - 1 / 100)
    passed, weakest = points[(0.05, NEAR), "down"].parameter, jump_in_kappa(down[0.05, NEAR])
    page = f"""# Frequency response with a motor of limited power

k = 0.5, Table 1's damping, cosine kinematics. Each sweep: {VALUES} values of κ from 0.5 up or down
to it, at each {SETTLE} drive cycles to settle and 32 observed. *Special point*: where the
continued 2π motion ends or turns. *Forecast* of that point: κ = ζ + L(ζ)/τ0 with the ideal
machine's load L in closed form. *Misfit*: largest error of that formula's κ - ζ along the
continued branch, as a part of the largest κ - ζ. Last column:
values of both sweeps that failed, that still drift, and that do neither but do not repeat
within 1e-6 in up to 16 cycles.

{motors}

- **Jumps.** {inside} of {len(points)} special points lie between the two values of κ where the
  sweep jumps; the others miss by less than two steps of κ
  ({", ".join(outside)}).
  Where strong motors close down, it is the coarse step of κ that sets off a transient which reaches
  the stop too early. In steps of {1e4 * FINE_STEP:.1f}e-4 they
  jump at their grazings, to one step: {fine_jumps}.
  The weakest motor passes its fold (T0 = 0.05 N·m, close-down at
  {passed:.3f}) and jumps only at {weakest[0]:.3f} … {weakest[1]:.3f}: it
  needs the cycles of several values to leave it.
- **Forecast.** It is about special points, not about jumps: the load of the ideal machine gives
  the κ of all {len(points)} of them to {100 * missed:.2f} %, from T0 = 0.05 to 100 N·m, although
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
numbers = {"ideal drive: 2π motion folds, ζ": ideal_fold}
for (key, way), point in points.items():
    name = (
        f"T0 = {key[0]:g} N·m, gap {key[1] / 0.04:g}a, {'run-up' if way == 'up' else 'close-down'}"
    )
    numbers[f"{name}: {point.kind}, κ"] = point.parameter
    numbers[f"{name}: forecast, κ"] = forecast(*key, way)

# %% [markdown]
# ## The picture

# %%
write("motor_frequency_response", page, numbers, picture(up, down, found))
say("done")
