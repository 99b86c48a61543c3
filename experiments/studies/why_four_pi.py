# %% [markdown]
# # Why the motion takes 4π
#
# Between two lines of the paper's Figure 2, BB' and CC', the analysis by one drive cycle disagrees
# with the simulation, which takes two. What happens at BB' and at CC', and where is the 4π motion?
#
# At BB' the vibration without impact comes to touch the stop. `vi.grazing` says from derivatives
# alone whether something near it attracts. The 2π motion with an impact, which is born there, is
# followed to CC', where it doubles its period; from there the doubled motion, to where it loses one
# of its two impacts by a grazing; from there the 4π motion with one impact, to its ends. And
# simulations from rest, which know of none of it, say what is seen.
#
# Run with `python experiments/studies/why_four_pi.py` (`--quick` for one machine, writes nothing).

# %%
import sys
from pathlib import Path

import jax
import numpy as np
import vi_jax as vi
from vi_jax.plot.colors import BLUE, GREEN, RED

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import legend_below, open_frames, panels
from tools.study import QUICK, say, write
from tools.tables import table

GAP, TABLE_1 = 2.0, float(vi.Parameters(restitution=0.5).scene().oscillator.damping_ratio)
ZETA = "drive.frequency_ratio"
CASES = [(0.5, 0.0), (0.8, 0.0), (0.5, TABLE_1), (0.8, TABLE_1)][: 1 if QUICK else None]
VALUES, SETTLE = (40, 400) if QUICK else (600, 3000)
BEHIND = 1e-3
"""How far behind BB', in ζ, the multiplier of the 2π motion is given."""


def machine(zeta, k: float, xi: float) -> vi.Scene:
    """The paper's machine with an ideal drive."""
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=GAP, damping_ratio=xi)


def followed(k: float, xi: float, zeta: float, *, impacts: bool) -> vi.Branch:
    """The branch of the motion with one impact, or with none, that is at `zeta`."""
    here = machine(zeta, k, xi)
    start = here.start(Y=1 / (1 - zeta**2), V=0.0)
    if impacts:
        known = vi.closed_form_orbits(here, cycles=1)
        start = here.start(Y=float(known.Y[0]), V=float(known.V[0]))
    return onward(vi.find_orbit(here, start, throw=True))


def onward(orbit: vi.Orbit) -> vi.Branch:
    """The branch of a motion."""
    return vi.continue_orbit(orbit, parameter=ZETA, bounds=(0.6, 1.2), progress=False)


def point(branch: vi.Branch, kind: str, words: str = "") -> vi.SpecialPoint:
    """The first special point of a kind."""
    return next(x for x in branch.special if x.kind == kind and words in x.detail)


def greatest(branch: vi.Branch) -> np.ndarray:
    """The greatest modulus of the multipliers along a branch."""
    return np.abs(np.asarray(branch.multipliers)).max(axis=-1)


# %% [markdown]
# ## The grazing, the branches, the simulations

# %%
rows, counts, numbers, pictures = [], [], {}, []
for k, xi in CASES:
    name = f"k = {k}, ξ = {xi:.4f}"
    smooth, one = followed(k, xi, 0.65, impacts=False), followed(k, xi, 1.1, impacts=True)
    touch, doubling = point(smooth, "grazing"), point(one, "period-doubling")
    follows = vi.grazing(touch, progress=False)
    near = vi.closed_form_orbits(machine(touch.parameter + BEHIND, k, xi), cycles=1)
    steep = float(np.min(np.real(near.multipliers[0])))
    doubled = onward(doubling.switch())
    lost = point(doubled, "grazing", "is lost")
    four = onward(lost.switch())
    low, high = float(np.min(four.parameter)), float(np.max(four.parameter))
    gone = "nothing near" if follows.outcome == vi.SCENARIOS.jump else "a motion near"
    rows.append((k, f"{xi:.4f}", f"{touch.parameter:.8f}", gone, f"{steep:.2f}",
                 f"{doubling.parameter:.8f}", f"{lost.parameter:.8f}",
                 f"{low:.6f} … {high:.6f}"))  # fmt: skip
    say(rows[-1])
    numbers |= {
        f"{name}: BB'": touch.parameter,
        f"{name}: CC'": doubling.parameter,
        f"{name}: least ζ of 4π": low,
        f"{name}: greatest ζ of 4π": high,
    }
    ratios = np.linspace(touch.parameter, doubling.parameter, VALUES + 2)[1:-1]
    data = vi.scan(
        machine(0.9, k, xi), {ZETA: ratios}, measure=("regime", "extremes"), settle=SETTLE,
        progress=False,
    )  # fmt: skip
    period, impacts = np.asarray(data["period"]), np.asarray(data["impacts"])
    seen = [np.mean((period == 2) & (impacts == n)) for n in (1, 2)]
    seen += [np.mean((period == 2) & (impacts > 2)), np.mean(period > 2), np.mean(period == 1)]
    seen.append(np.mean(period < 1))
    counts.append((k, f"{xi:.4f}", *(f"{100 * x:.1f} %" for x in seen)))
    say(counts[-1])
    pictures.append((name, (smooth, one, doubled, four), ratios, np.asarray(data["y_min"])))

# %% [markdown]
# ## Table

# %%
heads = ["k", "ξ", "BB'", "what attracts there", f"multiplier at BB' + {BEHIND:g}", "CC'",
         "impact lost", "4π, one impact"]  # fmt: skip
kinds = ["k", "ξ", "4π, one impact", "4π, two", "4π, more", "longer", "2π", "no period"]
page = f"""# Why the motion takes 4π

The paper's machine with an ideal drive, d = {GAP:g}; ξ = {TABLE_1:.4f} is that of its Table 1.

1. At BB' the vibration without impact touches the stop, and nothing near it attracts any more
   (`vi.grazing`): the machine leaves.
2. The 2π motion with one impact is born there, but unstable: a grazing gives it a multiplier that
   is unbounded at first. It is what the analysis by one cycle finds, and no simulation stays on it.
3. It becomes stable only at CC', by a period doubling. The doubled motion has two impacts in 4π.
   Not far from there it loses one of them by a grazing of its own ("impact lost").
4. What goes on is the 4π motion with one impact, between two grazings. Below the lower one mostly a
   4π motion with two impacts is seen (grey, not followed here), and none of 2π anywhere.

So the 4π motion does not come from the grazing at BB': it hangs together with CC'. With Table 1's
damping and k = 0.5 the doubled motion, with two impacts, fills most of the interval; where it loses
one of them the branch leads back to BB'.

{table(heads, rows)}

What {VALUES} simulations from rest settle on between BB' and CC', after {SETTLE} cycles:

{table(kinds, counts)}

![Branches and what is seen](../figures/why_four_pi.png)
"""
print(page)

# %% [markdown]
# ## Figure

# %%
figure, axes = panels(9.0, 6.4, 2, 2, sharey=True, squeeze=False)
STYLES = [("0.3", "no impact"), (RED, "2π, one impact"), (GREEN, "4π, two impacts"),
          (BLUE, "4π, one impact")]  # fmt: skip
handles = {}
for ax, (name, branches, ratios, lowest) in zip(axes.flat, pictures, strict=False):
    handles["from rest"] = ax.plot(ratios, lowest, ".", color="0.7", ms=2)[0]
    for (color, label), branch in zip(STYLES, branches, strict=True):
        stable = greatest(branch) < 1 + 1e-9
        y_min, zeta = np.asarray(branch.y_min), np.asarray(branch.parameter)
        handles[label] = ax.plot(zeta, np.where(stable, y_min, np.nan), color=color, lw=1.8)[0]
        handles["unstable"] = ax.plot(zeta, y_min, ":", color=color, lw=1.0)[0]
    ax.set(title=name, xlabel="frequency ratio ζ", ylabel="smallest Y (a)", xlim=(0.66, 1.05))
    ax.set_ylim(-4, -1.4)
for label, handle in handles.items():
    handle.set_label(label)
legend_below(figure, handles.values(), 6)
open_frames(axes.flat)
write("why_four_pi", page, numbers, figure)
