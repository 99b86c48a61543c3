# %% [markdown]
# # What each part of a scene costs
#
# A scene models only what it needs. Here parts are added one by one to the smallest scene, and the
# run time of a drive cycle of one lane (in a batch of 256, 200 cycles, one core) and the compile
# time are set beside those without the part. That an absent part costs nothing is seen twice: in
# the time, and in the number of operations of the compiled program's source (the jaxpr), which is
# that of the smaller scene.
#
# Run with `python experiments/benchmarks/scene_cost.py` (`--quick` for few lanes, writes nothing).

# %%
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import vi_jax as vi
from vi_jax.plot.colors import BLUE

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from headlines.jaxprs import primitives
from tools.pictures import open_frames, panels
from tools.study import QUICK, write
from tools.tables import table
from tools.timing import side_by_side

LANES, CYCLES, ROUNDS = (32, 10, 3) if QUICK else (256, 200, 7)


# %%
class Made(NamedTuple):
    """A scene, and what a run is to record."""

    name: str
    run: Callable[[Any], Any]
    beside: str = ""
    """The scene without the part."""


def lane(
    *, drive: str = "ideal", stops: int = 1, crank: str = "cosine", method: Any = None,
    clock: str = "phase", slope: bool = False, gap: float = 2.0, **asked: Any,
) -> Callable[[Any], Any]:  # fmt: skip
    """A lane as a function of ζ (or κ)."""

    def run(ratio):
        sides = ("right", "left")[:stops]
        turning = vi.IdealDrive(ratio)
        if drive == "motor":
            turning = vi.Motor(0.65, ratio, 0.0093, 0.0053)
        scene = vi.Scene(
            oscillator=vi.Oscillator(0.0448),
            drive=turning,
            stops=[vi.RigidStop(gap, 0.8, side) for side in sides],
            crank=vi.SliderCrank(1 / 3) if crank == "slider" else vi.CosineCrank(),
            clock_name=clock,
        )
        found = vi.simulate(scene, scene.start(), CYCLES, method=method or vi.FixedStep(), **asked)
        return [x for x in jax.tree_util.tree_leaves(found) if jnp.issubdtype(x.dtype, jnp.inexact)]

    if not slope:
        return run
    return lambda ratio: jax.jvp(run, (ratio,), (1.0,))


bare: dict[str, Any] = {"record": "sections"}
SCENES = [
    Made("ideal, no stop", lane(stops=0, **bare)),
    Made("ideal, one stop", lane(**bare), "ideal, no stop"),
    Made("ideal, two stops", lane(stops=2, **bare), "ideal, one stop"),
    Made("the same, may rest (d = 1)", lane(stops=2, gap=1.0, **bare), "ideal, two stops"),
    Made("ideal, exact flight", lane(method=vi.ExactFlight(), **bare), "ideal, one stop"),
    Made("ideal, slider-crank", lane(crank="slider", **bare), "ideal, one stop"),
    Made("motor, no stop", lane(drive="motor", stops=0, **bare), "ideal, no stop"),
    Made("motor", lane(drive="motor", **bare), "ideal, one stop"),
    Made("motor, slider-crank", lane(drive="motor", crank="slider", **bare), "motor"),
    Made("motor, time clock", lane(drive="motor", clock="time", **bare), "motor"),
    Made("motor, extremes and speeds", lane(drive="motor"), "motor"),
    Made("motor, impact log", lane(drive="motor", impact_log=4), "motor, extremes and speeds"),
    Made(
        "motor, 32 samples a cycle", lane(drive="motor", samples=32), "motor, extremes and speeds"
    ),
    Made("motor, one derivative", lane(drive="motor", slope=True, **bare), "motor"),
    Made("motor, error estimate", lane(drive="motor", estimate=True, **bare), "motor"),
]


# %% [markdown]
# ## Measured


# %%
ratios = jnp.linspace(0.5, 1.9, LANES)
programs, compiling, size = {}, {}, {}
for made in SCENES:
    begin = time.perf_counter()
    programs[made.name] = vi.jit(jax.vmap(made.run)).lower(ratios).compile()
    compiling[made.name] = time.perf_counter() - begin
    size[made.name] = primitives(jax.make_jaxpr(made.run)(0.9).jaxpr).total()
with vi.threads(1):
    seconds = side_by_side([lambda run=run: run(ratios) for run in programs.values()], ROUNDS)
cost = {name: 1e6 * x / LANES / CYCLES for name, x in zip(programs, seconds, strict=True)}

# %% [markdown]
# ## Table

# %%
heads = ["scene", "µs a lane-cycle", "beside", "ratio", "compile s", "operations"]
rows = []
for made in SCENES:
    ratio = f"{cost[made.name] / cost[made.beside]:.2f}" if made.beside else ""
    of_program = (f"{compiling[made.name]:.1f}", f"{size[made.name]:,}")
    rows.append((made.name, f"{cost[made.name]:.2f}", made.beside, ratio, *of_program))
page = f"""# What each part of a scene costs

10 steps of Verner9 a cycle unless it says exact flight; Table 1's damping, d = 2, k = 0.8, \
ζ or κ from 0.5 to 1.9. {LANES} lanes of {CYCLES} cycles on one core, medians of {ROUNDS} \
interleaved rounds; JAX {jax.__version__}. Operations are those of the program that JAX is given.

![Cost](../figures/scene_cost.png)

{table(heads, rows)}
"""
print(page)

# %% [markdown]
# ## Figure

# %%
figure, ax = panels(9, 4.6)
names = [made.name for made in SCENES][::-1]
ax.barh(names, [cost[name] for name in names], color=BLUE)
ax.set(xlabel="run time of a drive cycle of one lane (µs)")
open_frames([ax])
numbers = {f"operations: {name}": float(count) for name, count in size.items()}
write("scene_cost", page, numbers, figure)
