# %% [markdown]
"""# The woodpecker toy

Ch. Glocker's model: a sleeve that jams and slips on a pole, a bird that pecks at it, three contacts
with friction. The study `woodpecker` simulates it (`vi.machines.Woodpecker`), over the friction of
the pole too, and these are its numbers; in the example the toy is followed for two cycles.
"""

# %%
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from tools.study import headlines
from tools.validated import Comparison

page = Path(__file__).parents[1] / "studies" / "woodpecker.md"
numbers = headlines(page.read_text(encoding="utf-8"))
period, drop = numbers["period at μ = 0.3, ms"], numbers["drop at μ = 0.3, mm"]

# %% A cycle ends where the angle of the bird falls through -0.2788
comparison = Comparison(
    "Siconos",
    "https://github.com/siconos/siconos-tutorials, `examples/mechanics/Woodpecker`; Ch. Glocker, "
    "Dynamik von Starrkörpersystemen mit Reibung und Stößen, VDI, 1995",
    "printed in the reference file of its test, from time stepping at 0.02 ms, the second cycle of "
    "a motion that has not quite settled; others by SciPy from event to event, to 1e-10",
    [
        ("time of a cycle (ms)", "145.98", period, 0.02),
        ("drop in a cycle (mm)", "19.445", drop, 0.002),
        ("time of a cycle by SciPy (ms)", "145.97606514", period, 2e-8),
        ("drop in a cycle by SciPy (mm)", "19.4453792847", drop, 2e-9),
        ("multiplier by SciPy", "-0.8391556", numbers["multiplier at μ = 0.3"], 1e-6),
    ],
)
print(comparison)
