# %% [markdown]
"""# A relief valve

The valve stands open above a Hopf bifurcation of its flow rate q, hums below it, and chatters on
its seat at small q. The bifurcation is taken from the study `relief_valve`.
"""

# %%
from pathlib import Path

import jax
import vi_jax as vi
from _comparison import Comparison
from tools.study import headlines

jax.config.update("jax_enable_x64", True)


# %% A cycle ends at a maximum of the lift, as in the tutorial
def settled(flow_rate):
    valve = vi.machines.ReliefValve(flow_rate=flow_rate)  # pyright: ignore[reportCallIssue]
    return vi.find_orbit(valve, vi.simulate(valve, valve.start(), 1, settle=300).last)


chatters, hums = settled(3.0), settled(7.8)
page = Path(__file__).parents[1] / "studies" / "relief_valve.md"
hopf = headlines(page.read_text(encoding="utf-8"))["Hopf, q"]

# %% The search finds these orbits to 1e-10
comparison = Comparison(
    "MPGOS",
    "https://github.com/FerencHegedus/Massively-Parallel-GPU-ODE-Solver, tutorial T6; "
    "C. Hős and A. R. Champneys, Physica D 241, 2068 (2012)",
    "from the equations of the tutorial, by SciPy's DOP853 from event to event; the Hopf "
    "bifurcation by eigenvalues",
    [
        ("greatest lift, q = 3, one impact a cycle", "2.49359468", chatters.y_max),
        ("pressure there", "1.53423438", chatters.state.pressure),
        ("time of a cycle", "1.7168295579", chatters.duration, 1e-9),
        ("greatest lift, q = 7.8, no impact", "7.38552969", hums.y_max),
        ("time of a cycle", "2.5286141188", hums.duration, 1e-9),
        ("q of the Hopf bifurcation", "8.49111763518", hopf, 1e-10),
    ],
)
print(comparison)
