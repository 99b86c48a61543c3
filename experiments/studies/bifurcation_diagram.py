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
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.optimize import brentq
from vi_jax.plot.colors import color_of

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from studies.parts.bifurcation_picture import Drawn, picture
from studies.parts.bifurcation_runs import (
    CHUNK,
    CHUNKS,
    LARGE,
    PARTS,
    SEEN,
    SMALL,
    VALUES,
    K,
    at_half_turn,
    settled,
)
from tools.ideal import GAP
from tools.study import say, write
from tools.tables import table

# %% [markdown]
# ## Brute force

# %%
seen = settled()
zeta, Y, exponent, clock = seen.zeta, seen.Y, seen.exponent, seen.clock
period = np.select([seen.repeats(p) for p in (1, 2, 4, 8)], (1, 2, 4, 8), int(vi.REGIMES.unsettled))

# %% [markdown]
# ## The branches
#
# They begin at two motions that brute force settled on and go on from the special points: from the
# doublings of the 4π motion to its 8π motion, from where that touches the stop a second time to the
# 8π motion with three impacts, and from the doubling of the 2π motion to its 4π motion.


# %%
def follow(orbit: vi.Orbit, max_step: float) -> vi.Branch:
    found = vi.continue_orbit(
        orbit, parameter="drive.frequency_ratio", bounds=PARTS["wide"],
        step=0.005, max_step=max_step,
    )  # fmt: skip
    say(found)
    return found


def of(branch: vi.Branch, kind: str) -> list[vi.SpecialPoint]:
    special = sorted(branch.special, key=lambda p: p.parameter)
    return [p for p in special if p.kind == kind]


def from_two_pi() -> list[vi.Branch]:
    branch = follow(seen.orbit(0.999, 0, 1), 0.05)
    return [branch, follow(of(branch, "period-doubling")[0].switch(distance=0.003), 0.02)]


def from_four_pi() -> list[vi.Branch]:
    branch = follow(seen.orbit(0.945, 1, 2), 0.05)
    doubled = [follow(p.switch(distance=0.003), 0.02) for p in of(branch, "period-doubling")]
    touch = of(doubled[0], "grazing")[0]
    return [branch, *doubled, follow(touch.switch(distance=0.003), 0.02)]


with ThreadPoolExecutor(2) as threads:  # what takes the time is compiling
    jobs = [threads.submit(from_two_pi), threads.submit(from_four_pi)]
    (two_pi, paired), (four_pi, *eight, three) = (job.result() for job in jobs)
doubling = of(four_pi, "period-doubling")
touches = [of(branch, "grazing")[0] for branch in eight]
drawn = [
    Drawn(two_pi, "2π, 1 impact", color_of(1, 1)),
    Drawn(paired, "4π, 2 impacts", color_of(2, 2)),
    Drawn(four_pi, "4π, 1 impact", color_of(2, 1)),
    Drawn(eight[0], "8π, 2 impacts", color_of(4)),
    Drawn(eight[1], "", color_of(4)),
    Drawn(three, "8π, 3 impacts", "#2e7d99"),
]

# %% [markdown]
# ## Witnesses
#
# The closed form's multipliers know nothing of the continuation: where one is -1 a period doubles.
# Brute force knows of neither: beyond a doubling the square of the distance between the two halves
# of the 8π motion grows in proportion to ζ, so that a line through the squares tells where it is
# zero, which no run is long enough to show.

# %%
exact = [jax.jit(lambda z, n=n: vi.closed_form_orbits(at_half_turn(z), cycles=n)) for n in (1, 2)]


def closed_doubling(cycles: int, low: float, high: float) -> float:
    def test(zeta: float) -> float:
        return float(np.real(np.prod(np.asarray(exact[cycles - 1](zeta).multipliers[0]) + 1)))

    return float(brentq(test, low, high, xtol=1e-13))  # pyright: ignore[reportArgumentType]


closed = [closed_doubling(2, 0.95, 0.96), closed_doubling(2, 0.99, 0.9935)]
closed += [closed_doubling(1, 0.99, 0.999)]
halves = np.abs(Y[:, -1] - Y[:, -3])
fit = (seen.part == "left") & (period == 4) & (halves > 0.02)
split, left = np.nan, PARTS["left"][0]
if fit.sum() >= 3:
    slope, offset = np.polyfit(zeta[fit] - left, halves[fit] ** 2, 1)
    split = left - offset / slope
chaotic = (exponent > 0.003) & (period == vi.REGIMES.unsettled)
inside = (zeta >= zeta[chaotic].min()) & (zeta <= zeta[chaotic].max())
regular = (zeta < doubling[0].parameter - 0.002) & (period == 2)


def largest(zetas: np.ndarray) -> np.ndarray:
    """Growth per cycle near the 4π motion, from the closed form's multipliers."""
    multipliers = np.asarray(jax.vmap(exact[1])(jnp.asarray(zetas)).multipliers)[:, 0]
    return np.log(np.abs(multipliers).max(axis=1)) / 2


off = np.abs(exponent[regular] - largest(zeta[regular]))
extra = seen.impacts.sum(axis=1) - SEEN // 2
left_alone = chaotic & (seen.escaped > 0)
waited = seen.escaped[left_alone] * exponent[left_alone] / np.log(LARGE / SMALL)

# %% [markdown]
# ## What was found


# %%
def span(values: np.ndarray, form: str = ".6f") -> tuple[str, str]:
    ends = (values.min(), values.max()) if values.size else (np.nan, np.nan)
    return f"{ends[0]:{form}}", f"{ends[1]:{form}}"


def median_of(values: np.ndarray, form: str) -> str:
    return f"{np.median(values):{form}} ({' … '.join(span(values, form))})"


two, four = seen.bands(2)[chaotic], seen.bands(4)[chaotic]
onset, end = span(zeta[chaotic])
merged = span(zeta[chaotic][~four], ".4f")
stray = inside & ~chaotic
not_left = largest(zeta[stray]) * CHUNKS * CHUNK
met = span(zeta[(seen.part == "right") & (extra == SEEN // 2)])[0]
held = span(zeta[(period == 2) & (extra == 0) & (zeta > 0.9935)])[1]
apart = np.ptp(PARTS["right"]) / (VALUES[-1] - 1)
first, second = (p.parameter for p in doubling)
born, dies = (p.parameter for p in touches)
fold, four_ends = of(paired, "fold")[0].parameter, of(four_pi, "grazing")[0].parameter
two_doubles = of(two_pi, "period-doubling")[0].parameter
steepest = np.abs(three.multipliers).max(axis=1).min()
places = table(
    ["ζ at which", "continuation", "witness"],
    [
        [
            "4π motion doubles", f"{first:.10f}",
            f"closed form {closed[0]:.10f}; simulated, squares: {split:.7f}",
        ],
        ["8π motion touches the stop", f"{born:.10f}", f"simulated: first chaotic value {onset}"],
        ["8π motion touches the stop", f"{dies:.10f}", f"simulated: last chaotic value {end}"],
        ["4π motion doubles", f"{second:.10f}", f"closed form {closed[1]:.10f}"],
        [
            "4π motion with 2 impacts folds", f"{fold:.10f}",
            f"simulated: first seen at {met} (step {apart:.1e})",
        ],
        ["2π motion doubles", f"{two_doubles:.10f}", f"closed form {closed[2]:.10f}"],
        ["4π motion touches the stop", f"{four_ends:.10f}", f"simulated: last seen at {held}"],
    ],
)  # fmt: skip
chaos = table(
    ["runs from the first to the last chaotic value", str(inside.sum())],
    [
        ["of them chaotic (no period up to 8, exponent above 0.003)", chaotic.sum()],
        ["exponent per cycle, median (range)", median_of(exponent[chaotic], ".3f")],
        [
            "cycles in which 1e-9 grows to 0.01, median",
            f"{np.median(seen.escaped[left_alone]):.0f}",
        ],
        ["the same, as a multiple of what the exponent says", f"{np.median(waited):.2f}"],
        [
            "soft impacts per 100 cycles, median (range)",
            median_of(extra[chaotic] / SEEN * 100, ".1f"),
        ],
        ["in two bands; in four", f"{two.sum()}; {four.sum()}"],
        [
            f"exponent less the closed form's, {regular.sum()} stable 4π runs, median (worst)",
            f"{np.median(off):.1e} ({off.max():.1e})",
        ],
    ],
)
report = f"""# From the 4π motion to chaos

Ideal drive, undamped, k = {K}, d = {GAP:g}; {len(zeta)} runs (two starts at each of {sum(VALUES)}
values) of {CHUNKS * CHUNK:,} cycles, then {SEEN} observed, in one compiled call: {clock.wall:.0f} s
({clock.cpu:.0f} s of CPU time).

{places}

{chaos}

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

# %% [markdown]
# ## The picture

# %%
write("bifurcation_diagram", report, numbers, picture(seen, drawn), colors=200)
say("done")
