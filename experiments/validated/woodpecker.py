# %% [markdown]
"""# A woodpecker toy

A sleeve with play slides down a pole and carries a bird on a spring. There are three contacts with
friction; the sleeve jams and slips; weight alone drives the toy. Its periodic motion is compared.
"""

# %%
import jax
import numpy as np
import vi_jax as vi
from _comparison import Comparison

jax.config.update("jax_enable_x64", True)

# %% The friction coefficient is 0.3, as in the published model
toy = vi.machines.Woodpecker()
run = vi.simulate(toy, toy.start(), 1, settle=150, event_log=16)
assert run.duration is not None and run.event_log is not None
log = run.event_log
kind, number = np.asarray(log.kind[0]), np.asarray(log.number[0])
shown = (number >= 0) & (kind != vi.EVENTS.index("rest"))  # an impact comes before each rest
times = np.asarray(log.phase[0])[shown]
names = (
    "sleeve jams", "slips", "leaves its lower edge", "upper edge strikes", "beak strikes",
    "upper edge strikes", "leaves", "lower edge strikes", "lower edge strikes again",
)  # fmt: skip
theirs = (
    "0.0215692", "0.0611626", "0.0669833", "0.0778724", "0.0809738", "0.0815533", "0.0834080",
    "0.1186964", "0.1214251",
)  # fmt: skip
comparison = Comparison(
    "Siconos",
    "https://github.com/siconos/siconos-tutorials, `examples/mechanics/Woodpecker` (Ch. Glocker, "
    "Dynamik von Starrkörpersystemen mit Reibung und Stößen, 1995)",
    "from the model's equations by an independent integration from event to event; Siconos' time "
    "stepping at 2e-5 s gives 0.14598 s and 19.445 mm",
    [
        ("period (s)", "0.145976065", run.duration[0]),
        ("drop in a cycle (mm)", "19.445379", 1e3 * run.averages["descent"][0] * run.duration[0]),
        *((f"{name} (s)", *pair) for name, *pair in zip(names, theirs, times, strict=True)),
    ],
)
print(comparison)
