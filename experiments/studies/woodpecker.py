# %% [markdown]
# # A woodpecker toy, over the friction of its pole
#
# A sleeve with play on a pole, and a bird on a spring at it: three contacts with friction, a sleeve
# that jams and slips, nothing that drives it but its weight (Ch. Glocker's model, 1995). The known
# cycle is set beside published numbers, and what toys settle on is scanned over the friction: where
# they fall, peck in ones and in twos, and where the laws of impact have no answer any more.
#
# Run with `python experiments/studies/woodpecker.py` (`--quick` for fewer, writes nothing).

# %%
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from vi_jax.plot.colors import BLUE, GREEN, RED

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import open_frames, panels
from tools.study import QUICK, write
from tools.tables import table

SETTLE, SEEN = (60, 8) if QUICK else (1500, 8)
FRICTIONS = np.linspace(0.2, 1.1, 46 if QUICK else 361)
# How runs end that do not go on: too many impacts in a cycle, an impact that would gain energy.
ENDS = (vi.RESULTS.chatter, vi.RESULTS.bad_impact)
WEIGHT = (3e-4 + 4.5e-3) * 9.81

# %% [markdown]
# ## What toys settle on


# %%
def settled(friction: Any) -> Any:
    toy = vi.machines.Woodpecker(friction=friction)  # pyright: ignore[reportCallIssue]
    run = vi.simulate(toy, toy.start(), SEEN, settle=SETTLE, event_log=16)
    ended = jnp.stack([run.result == why for why in ENDS])
    return run.duration, run.sections, run.impact_energy, run.event_log, run.successful, ended


# The published friction first.
every = jnp.asarray([0.3, *FRICTIONS])
duration, sections, lost, log, good, ended = vi.jit(jax.vmap(settled))(every)
duration, lost, good = (np.asarray(x) for x in (duration, lost, good))
drop = 1e3 * np.asarray(sections.drop)[:, 1:]
time = 1e3 * duration

# %% [markdown]
# ## The known cycle, event by event

# %%
NAMES = ("lower edge", "upper edge", "beak")
WORDS = {"impact": "strikes", "release": "leaves"}
# Glocker's cycle by an integration of its own from event to event (s).
KNOWN = (0.0215692, 0.0611626, 0.0669833, 0.0778724, 0.0809738, 0.0815533, 0.0834080, 0.1186964,
         0.1214251)  # fmt: skip
events = []
for kind, number, at, value in zip(
    *(np.asarray(x[0, -1]) for x in (log.kind, log.number, log.phase, log.value)), strict=True
):
    word = vi.EVENTS[int(kind)] if number >= 0 else "rest"
    if word == "rest":  # the impact before it says so
        continue
    slips = "sticks: the sleeve jams" if value == 0 else "slips"
    events.append((f"{NAMES[number]} {WORDS.get(word, slips)}", float(at)))
rows = []
for (what, at), known in zip(events, KNOWN, strict=True):
    rows.append((what, f"{1e3 * at:.4f}", f"{1e3 * known:.4f}"))
rows += [
    ("period", f"{time[0, -1]:.6f}", "145.976065"),
    ("drop (mm)", f"{drop[0, -1]:.6f}", "19.445379"),
]
cycle_table = table(["event", "ms", "reference, ms"], rows)
print(cycle_table)

# %% [markdown]
# ## Regimes


# %%
def period(row: np.ndarray) -> int:
    """In cycles: 1, 2 or 4, or 0 for what repeats after none of these."""
    for cycles in (1, 2, 4):
        if np.ptp(row.reshape(-1, cycles), axis=0).max() < 1e-3:
            return cycles
    return 0


periods = np.array([period(row) if ok else -1 for row, ok in zip(time, good, strict=True)])[1:]
pecks = FRICTIONS[good[1:]]
first, last = float(pecks.min()), float(pecks.max())
share = np.where(good, lost.sum(1) / (WEIGHT * 1e-3 * drop.sum(1)), np.nan)
speed = drop.sum(1) / duration.sum(1) / 10  # cm/s
stands = []
for value in (0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.8, 1.0):
    i = 1 + int(np.argmin(np.abs(FRICTIONS - value)))
    k = max(1, int(periods[i - 1]))
    last_ones = (", ".join(f"{x:.3f}" for x in np.sort(row[i, -k:])) for row in (time, drop))
    rates = (f"{speed[i]:.3f}", f"{share[i]:.3f}")
    stands.append([f"{FRICTIONS[i - 1]:.4g}", periods[i - 1], *last_ones, *rates])
heads = ["μ", "period", "time of a cycle, ms", "drop, mm", "way down, cm/s", "lost in impacts"]
toys = table(heads, stands)
print(toys)

# %% [markdown]
# ## Where the period doubles
#
# A start on the section with the sleeve on its lower edge has two numbers, so that the map of
# cycles is one of two numbers. Its differences give Newton's steps to the cycle, and multipliers.


# %%
def returned(friction: Any, begins: Any) -> Any:
    toy = vi.machines.Woodpecker(friction=friction)  # pyright: ignore[reportCallIssue]
    run = vi.simulate(
        toy, toy.start(speed=begins[0], bird_rate=begins[1]), 1, method=vi.Adaptive(rtol=1e-12)
    )
    return jnp.stack([run.last.speed, run.last.bird_rate])


STEPS = np.array([1e-5, 3e-4])
moves = np.concatenate([np.zeros((1, 2)), np.diag(STEPS), -np.diag(STEPS)])
lanes = vi.jit(jax.vmap(jax.vmap(returned, (None, 0))))


def multiplier(frictions: np.ndarray) -> np.ndarray:
    """The one nearest to -1 of the cycle at each friction, of those near to the published one."""
    x = np.tile([-0.3395, -7.462], (len(frictions), 1))
    slopes = np.zeros((len(x), 2, 2))
    for _ in range(9):
        ends = np.asarray(lanes(jnp.asarray(frictions), jnp.asarray(x[:, None] + moves)))
        slopes = ((ends[:, 1:3] - ends[:, 3:5]) / (2 * STEPS[:, None])).transpose(0, 2, 1)
        x = x + np.linalg.solve(np.eye(2) - slopes, (ends[:, 0] - x)[..., None])[..., 0]
    return np.linalg.eigvals(slopes).real.min(axis=1)


known = float(multiplier(np.full(6, 0.3))[0])
doubling = 0.3165
for width in (3e-3, 1e-4, 2e-6):
    ladder = doubling + width * np.linspace(-1, 1, 6)
    values = multiplier(ladder)
    assert values[0] > -1 > values[-1]
    doubling = float(np.interp(1.0, -values, ladder))
print(known, doubling)

# %% [markdown]
# ## Figure

# %%
figure, axes = panels(11, 6.4, 3, 1, sharex=True, height_ratios=(2, 2, 1.3))
for ax, rows_of, name, reference, color in (
    (axes[0], time, "time of a cycle (ms)", 145.976, BLUE),
    (axes[1], drop, "drop in a cycle (mm)", 19.4454, RED),
):
    ax.plot(np.repeat(FRICTIONS, SEEN), rows_of[1:].ravel(), ".", ms=2.5, color=color)
    ax.plot(0.3, reference, "o", ms=9, mfc="none", mec="k", label="reference, μ = 0.3")
    ax.set_ylabel(name)
    ax.axvline(doubling, color="0.5", lw=0.8, ls=":", label="the period doubles")
    ax.legend(frameon=False, loc="upper center")
axes[2].plot(FRICTIONS, speed[1:], ".", ms=2.5, color=GREEN)
axes[2].set(xlabel="friction μ", ylabel="way down (cm/s)", xlim=(FRICTIONS[0], FRICTIONS[-1]))
axes[2].set_ylim(0, 40)
for ax in axes:
    ax.axvspan(FRICTIONS[0], first, color="0.93", lw=0)
    ax.axvspan(last, FRICTIONS[-1], color="0.93", lw=0)
open_frames(axes)
for place, word in (((FRICTIONS[0] + first) / 2, "falls"), ((last + FRICTIONS[-1]) / 2, "no\nlaw")):
    axes[0].text(place, 0.5, word, ha="center", va="center", color="0.3",
                 transform=axes[0].get_xaxis_transform())  # fmt: skip

# %%
below, above = FRICTIONS < first, FRICTIONS > last
falls, gains = (
    int(x[1:][side].sum()) for x, side in zip(np.asarray(ended).T, (below, above), strict=True)
)
between = ~below & ~above
others = int((~good[1:] & between).sum())
pairs = FRICTIONS[periods == 2]
text = f"""# A woodpecker toy, over the friction of its pole

Ch. Glocker's model (Dynamik von Starrkörpersystemen mit Reibung und Stößen, 1995) with the numbers
of the example of the Siconos software, the defaults of `vi.machines.Woodpecker`: height y, sleeve
φM, bird φS; the edges of the sleeve (no restitution) and the beak (0.5) strike, stick and slip on
the pole. {len(FRICTIONS)} toys with frictions μ from {FRICTIONS[0]:g} to {FRICTIONS[-1]:g},
all from one start; {SEEN} cycles after {SETTLE}. A cycle ends where φS falls through -0.2788 rad.

![Time, drop and speed over the friction](../figures/woodpecker.png)

- **The known cycle, μ = 0.3.** Beside it an integration from event to event in other code; a time
  stepping of the same model by Siconos at 2e-5 s gives 0.14598 s and 19.445 mm. Its multipliers are
  {known:.7f} and 0: it alternates as it settles.

{cycle_table}

- **Below μ = {first:.4g} it falls.** The bird swings on in the falling sleeve without jamming it,
  and the section is passed no more: of {below.sum()} runs {falls} end for too many impacts in one
  cycle (`RESULTS.chatter`). Just above, cycles are long and irregular.
- **The period doubles** at μ = {doubling:.6f}, where a multiplier passes -1. From μ =
  {pairs.min():.4g} to {pairs.max():.4g} long and short ways down take turns, in places by longer
  patterns still; then it is one in a cycle again.
- **With more friction** it comes down more slowly and its beak and sleeve take a greater share of
  what its weight gives (the last column below); the rest is rubbed off while it slips.
- **Above μ = {last:.5g}** it is not jamming that ends it: of {above.sum()} runs {gains} end in an
  impact in which the laws of Newton and Coulomb together would gain energy
  (`RESULTS.bad_impact`).

Frictions are {FRICTIONS[1] - FRICTIONS[0]:.2g} apart; of the {between.sum()} toys between these two
{others or "none"} ended for another reason.

{toys}

Watch it with

```python
toy = vi.machines.Woodpecker()
run = vi.simulate(toy.observed_every(0.146), toy.start(), 3, samples=200)
vi.animate(run, toy, seconds=8).save("woodpecker.gif")
```
"""
numbers: dict[str, float] = {
    "period at μ = 0.3, ms": time[0, -1],
    "drop at μ = 0.3, mm": drop[0, -1],
}
for value in (0.6, 0.8, 1.0):
    i = 1 + int(np.argmin(np.abs(FRICTIONS - value)))
    numbers[f"period at μ = {value:g}, ms"] = time[i, -1]
    numbers[f"drop at μ = {value:g}, mm"] = drop[i, -1]
numbers |= {"multiplier at μ = 0.3": known, "period doubles, μ": doubling}
write("woodpecker", text, numbers, figure)
