# %% [markdown]
# # A relief valve, from rest to chatter
#
# The machine is autonomous. A cycle ends at a maximum of the lift, so its duration varies. The open
# valve loses its stability as the flow rate q decreases (Hopf). Then its oscillation touches the
# seat (grazing). Chaos with windows follows (Hős and Champneys, Physica D 241, 2012). Branches are
# continued through this range and compared with simulations of 600 valves.
#
# Run with `python experiments/studies/relief_valve.py` (`--quick` for fewer, writes nothing).

# %%
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.optimize import brentq

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import open_frames, panels
from tools.study import QUICK, write
from tools.tables import table

RATES = np.linspace(0.3, 8.48, 60 if QUICK else 600)
SETTLE, SEEN = (100, 16) if QUICK else (600, 64)
BOUNDS = (0.3, 9.0)

# %% [markdown]
# ## Simulations of many valves


# %%
def valve_of(rate: Any) -> vi.machines.ReliefValve:
    return vi.machines.ReliefValve(flow_rate=rate)  # pyright: ignore[reportCallIssue]


def settled(rate):
    valve = valve_of(rate)
    run = vi.simulate(valve, valve.start(), SEEN, settle=SETTLE)
    return run.sections.lift[1:], run.impacts, run.successful


lifts, impacts, good = (np.asarray(x) for x in vi.jit(jax.vmap(settled))(jnp.asarray(RATES)))
assert good.all()

# %% [markdown]
# ## Branches: the free oscillation, the one with an impact, and those of twice the period


# %%
def followed(orbit: vi.Orbit) -> vi.Branch:
    return vi.continue_orbit(orbit, parameter="flow_rate", bounds=BOUNDS)


valve = valve_of(8.3)
free = followed(vi.find_orbit(valve, vi.simulate(valve, valve.start(), 1, settle=400).last))
graze = next(p for p in free.special if p.kind == "grazing")
hopf = next(p for p in free.special if p.kind == "hopf")
hitting = followed(graze.switch())
doublings = [p for p in hitting.special if p.kind == "period-doubling"]
doubled = [followed(p.switch()) for p in doublings]


def growth(rate: float) -> float:
    """Return the greatest real part of the eigenvalues of the open valve at rest."""
    lift: Any = brentq(lambda y: rate - y * np.sqrt(y + 10), 1e-9, 50)
    root = np.sqrt(lift + 10)
    jacobian = [[0, 1, 0], [-1, -1.25, 1], [-20 * root, 0, -10 * lift / root]]
    return float(np.linalg.eigvals(np.array(jacobian)).real.max())


rest_lost: Any = brentq(growth, 8.0, 9.0, xtol=1e-12)

# %% [markdown]
# ## Table and figure

# %%
rows = []
for branch in (free, hitting, *doubled):
    for point in branch.special:
        what, duration = f"{point.kind}: {point.detail}", f"{float(point.orbit.duration):.6f}"
        rows.append((f"{point.parameter:.9f}", what, int(point.orbit.cycles), duration))
points = table(["q", "what happens", "period, in maxima of the lift", "duration"], rows)
print(points)

figure, (upper, lower) = panels(11, 5.4, 2, 1, sharex=True, height_ratios=(3, 1))
upper.plot(np.repeat(RATES, SEEN), lifts.ravel(), ",", color="0.45", rasterized=True)
upper.plot([], [], ".", color="0.45", ms=3, label="what valves settle on")
colors = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
names = ("without impact", "one impact", "twice the period, q < 1.4", "q > 5.7")
for branch, color, name in zip((free, hitting, *doubled), colors, names, strict=False):
    vi.plot_branch(branch, ax=upper, y="y_max", color=color, lw=1.3, label=name)
upper.set(xlabel="", ylabel="lift at its maxima")
upper.legend(frameon=False, fontsize=9, ncols=2, loc="upper left")
lower.plot(RATES, impacts.mean(axis=1), ".", color="0.3", ms=2.5)
lower.set(xlabel="flow rate q", ylabel="impacts in a cycle", xlim=(0, 9))
open_frames((upper, lower))

# %%
text = f"""# A relief valve, from rest to chatter

κ = 1.25, δ = 10, β = 20, r = 0.8, the setting of Hős and Champneys (Physica D 241, 2012). Grey:
the lift at its maxima, {SEEN} of them after {SETTLE}, for {len(RATES)} flow rates q from
{RATES[0]:g} to {RATES[-1]:g}, all from one start. Lines: the greatest lift of periodic motions,
broken where they are unstable.

![Lift and impacts over the flow rate](../figures/relief_valve.png)

- **Rest is lost** in a Hopf bifurcation at q = {hopf.parameter:.9f}, where the branch shrinks to
  nothing; the eigenvalues of the linearised valve give {rest_lost:.9f}.
- **The seat is touched** at q = {graze.parameter:.9f}. The stable motion without impact
  ends. The motion with one impact begins in the other direction and is unstable: one of its
  multipliers grows as 1/V⁻ without bound. Only chaos is left.
- **Below, one impact a cycle** is stable between the period doublings at
  q = {min(p.parameter for p in doublings):.9f} and {max(p.parameter for p in doublings):.9f}.

{points}
"""
numbers = {
    "Hopf, q": hopf.parameter,
    "grazing, q": graze.parameter,
    "first doubling, q": min(p.parameter for p in doublings),
    "second doubling, q": max(p.parameter for p in doublings),
}
write("relief_valve", text, numbers, figure)
