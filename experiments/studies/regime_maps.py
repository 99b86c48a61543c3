# %% [markdown]
# # Regime maps
#
# What the ideally driven machine (d = 2) settles on from rest, at every point of the planes (ζ, k)
# and (ζ, c): the period in drive cycles, chaos, transient chaos (what was chaotic, and is not any
# more some thousand cycles later), or not settled within 400 cycles. Each map is
# 256 × 256 simulations by `vi.scan`. The curves laid over come from elsewhere: `vi.boundary`
# continues the period doubling and the fold of the 2π motion and the second touch of the 4π motion,
# and the births by grazing lie where the steady vibration without impacts just reaches the stop,
# 1/|1 - ζ² + 2iξζ| = d. So each checks the other. Random lanes are simulated again with
# `vi.Adaptive(rtol=1e-9)`.
#
# Without damping a motion without impacts never settles: the free vibration that the start left
# stays for good. The map says "unsettled" (or a period, where free and driven vibration happen to
# have one in common), and rightly so.
#
# Run with `python experiments/studies/regime_maps.py` (`--quick` for coarse maps and fewer curves).

# %%
import sys
from pathlib import Path

import jax
import numpy as np
import vi_jax as vi

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from studies.parts.regime_checks import (
    LATE,
    SAMPLE,
    Seen,
    again_by_adaptive,
    impossible,
    over_later,
)
from studies.parts.regime_picture import picture
from studies.parts.regime_planes import KS, SETTLE, SIDE, ZETA, planes, settled
from tools.study import say, write
from tools.tables import table
from tools.timing import Clock

# %% [markdown]
# ## The curves, and the maps
#
# A first small map compiles the program, which the clock is not to count.

# %%
drawn = planes()
settled({"zeta": ZETA[:16], "k": KS[:16], "c": np.zeros(1)}, vi.ExactFlight())
maps = []
for plane in drawn:
    with Clock() as clock:
        data = settled(plane.axes, vi.ExactFlight()).squeeze(drop=True)
    maps.append(Seen(plane, data, clock))
    say(f"{plane.title}: {clock.wall:.1f} s, {clock.cpu:.1f} s of CPU time")

# %% [markdown]
# ## Checks
#
# What cannot be, by the closed form; whether chaos lasts (while a chaotic transient lasts nothing
# tells it from chaos); and random lanes of each map again by another method.

# %%
limits = [impossible(seen) for seen in maps]
over = [over_later(seen) for seen in maps]
differing = again_by_adaptive(maps)

# %% [markdown]
# ## The picture

# %%
figure = picture(maps)

# %% [markdown]
# ## The table


# %%
def shares(seen: Seen) -> list[float]:
    """Parts of the lanes (percent) by what they settle on."""
    free, p, n, R = seen.impacts == 0, seen.period, seen.impacts, vi.REGIMES
    parts = [
        free & (p > 0), free & (p == R.unsettled), ~free & (p == 1), ~free & (p == 2) & (n == 1),
        ~free & (p == 2) & (n > 1), ~free & (p > 2), p == R.chaotic, p == R.transient,
        ~free & (p == R.unsettled),
    ]  # fmt: skip
    return [100 * float(np.mean(part)) for part in parts]


KINDS = (
    "without impacts, periodic, %", "without impacts, not periodic, %", "2π with impacts, %",
    "4π with one impact, %", "4π with more impacts, %", "longer periods, %", "chaotic, %",
    "transiently chaotic, %", "impacts, not settled, %",
)  # fmt: skip
longest = [int(np.max(seen.period[seen.impacts > 0], initial=0)) for seen in maps]
by_kind = zip(*map(shares, maps), strict=True)
rows: list[list[str]] = [
    ["wall time, s", *(f"{seen.clock.wall:.1f}" for seen in maps)],
    ["CPU time, s", *(f"{seen.clock.cpu:.1f}" for seen in maps)],
    *([kind, *(f"{x:.2f}" for x in of)] for kind, of in zip(KINDS, by_kind, strict=True)),
    ["longest period with impacts, cycles", *map(str, longest)],
    [
        f"of so many chaotic lanes: not chaotic after {LATE:,} cycles",
        *(f"{gone} of {size}" for size, gone in over),
    ],
    [
        "every third lane on a 2π or 4π motion with one impact",
        *(f"{total:,}" for total, *_ in limits),
    ],
    ["of these: no such stable motion in the closed form", *(str(x[1]) for x in limits)],
    ["lanes without impacts between the births", *(str(x[2]) for x in limits)],
    [
        f"of {SAMPLE:,} random lanes: another regime by Adaptive",
        *(str(x.all) for x in differing),
    ],
    ["of these: chaotic or unsettled by one of the two", *(str(x.irregular) for x in differing)],
    ["regular, with a neighbour of another regime", *(str(x.border) for x in differing)],
    ["neither", *(str(x.rest) for x in differing)],
]
lasting, irregular = vi.Regime().lasting, sum(x.irregular for x in differing)
page = f"""# Regime maps

Ideal drive, d = 2, from rest, {SETTLE} cycles to settle and 128 observed; what is chaotic
there is continued for {lasting:,} cycles, and is called transiently chaotic if it is not chaotic
then. {SIDE} × {SIDE} lanes a map by `ExactFlight`, 2 workers on 2 cores, compiled before.

{table(["", *(seen.plane.title for seen in maps)], rows)}

- The curves and the maps know nothing of each other. The 2π motion gives way to the 4π motion on
  the doubling curve, grey where it is crossed so slowly that {SETTLE} cycles do not suffice; the
  4π motion with one impact lies inside the dashed curve; no lane is free between the births; and
  of {sum(x[0] for x in limits):,} lanes on a motion with one impact that were looked at,
  {sum(x[1] for x in limits)} have no such stable motion in the closed form.
- The maps end before the fold: between the second birth and the fold the 2π impact motion and the
  free one are both stable, and the start at rest goes to the free one from some ζ on.
- Without damping the free vibration left by the start never dies out: right of ζ = √2, where it
  does not reach the stop, the motion is rightly called not periodic (vertical lines: ζ at which it
  is, by chance). Left of the first birth the same vibration leads to rare impacts. With
  c = 0.1 and more all that is gone; the chaos that remains lies at the first birth and, up to
  c = 0.2, in a tongue about ζ = 0.55.
- Transient chaos: without damping the body hits the stop irregularly for hundreds to tens of
  thousands of cycles; what is left in the end mostly stays off the stop for good, or meets it a few
  times in some hundred cycles, or is periodic. With damping some lanes at the first birth do so
  too. While it lasts nothing tells it from chaos: {over[0][1]} of {over[0][0]} lanes called chaotic
  without damping are not after {LATE:,} cycles. So "chaotic" says: still so after some {lasting:,}
  cycles.
- Left of the paper's range of interest Table 1's machine hits the stop in a small island near
  ζ = 0.6 (k above 0.85), and along the birth it has motions of longer periods and chaos.
- `Adaptive` gives {sum(x.all for x in differing)} of {SAMPLE * len(maps):,} random lanes another
  regime; {irregular} of these are chaotic or unsettled by one of the two: long
  transients and chaos, where each method goes its own way.
"""
print(page)
# With Table 1's damping nearly all lanes settle, so that a test finds these parts on fewer lanes.
table_map = next(seen for seen in maps if seen.plane.title.endswith("(Table 1)"))
numbers = {
    f"{table_map.plane.title}: {name}": round(value, 2)
    for name, value in zip(KINDS, shares(table_map), strict=True)
    if name in ("without impacts, periodic, %", "2π with impacts, %", "4π with one impact, %")
}
write("regime_maps", page, numbers, figure, dpi=90, colors=200)
say("done")
