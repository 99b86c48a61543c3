# %% [markdown]
# # Gradients with respect to many parameters
#
# The cost of a gradient is measured in simulations of the same lanes. One machine has a motor, and
# the gradient is with respect to its parameters. The other is an oscillator with a stop and a
# neural network, which is its spring's force or its law of restitution. The parameters are the
# weights. With more than four parameters, `jax.grad` goes backward along a tape of the recorded
# steps. For comparison, diffrax differentiates the oscillator without a stop, because its loops
# with events have no reverse mode. It has the same network, method and steps, and its default
# adjoint, recursive checkpoints. All codes run on one core. Rounds are interleaved, and compile
# time is separate.
#
# Run with `python experiments/benchmarks/gradients.py` (`--quick` for few lanes, writes nothing).

# %%
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

# All codes use one core, which is chosen before any library counts the cores.
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from vi_jax.plot.colors import BLUE, GREEN

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.networks import flat, last_places, oscillator
from tools.pictures import open_frames, panels
from tools.study import QUICK, say, write
from tools.tables import table
from tools.timing import side_by_side

LANES, CYCLES, STEPS, ROUNDS = (4, 3, 24, 1) if QUICK else (32, 50, 24, 7)
METHOD = vi.FixedStep(diffrax.Dopri8(), STEPS)
STARTS = jnp.linspace(-0.3, 0.3, LANES)


# %%
class Task(NamedTuple):
    """A sum over lanes, and the parameters of its gradient."""

    name: str
    code: str
    value: Callable[[jax.Array], jax.Array]
    numbers: jax.Array


def ours(name: str, machine: Any) -> Task:
    """Return a gradient with respect to all numbers of a machine."""
    return Task(name, "vi_jax", *last_places(machine, STARTS, CYCLES, METHOD))


def by_diffrax(name: str, width: int) -> Task:
    """Return the same oscillator without a stop in diffrax."""
    machine = oscillator(width, "without")
    numbers, whole = flat(machine)

    def rate(s, state, own):
        return state[1], own.rate(s, *state)

    def lane(numbers, Y):
        end = diffrax.diffeqsolve(
            diffrax.ODETerm(rate), diffrax.Dopri8(), 0.0, CYCLES * machine.cycle,
            machine.cycle / STEPS, (Y, 0 * Y), whole(numbers),
            saveat=diffrax.SaveAt(t1=True), max_steps=CYCLES * STEPS + 2,
        )  # fmt: skip
        return end.ys[0][-1]  # pyright: ignore

    value = lambda numbers: jnp.sum(jax.vmap(lane, (None, 0))(numbers, STARTS) ** 2)
    return Task(name, "diffrax", value, numbers)


def tasks() -> list[Task]:
    """Return the tasks with increasing number of parameters; those without a stop are last."""
    small, middle, large = (4, 5, 6) if QUICK else (8, 32, 43)
    return [
        ours("motor", vi.Parameters(torque=10.0, restitution=0.5, gap=0.05).scene()),
        ours("network as spring", oscillator(small, "spring")),
        ours("network as law", oscillator(small, "law")),
        ours("network as spring", oscillator(middle, "spring")),
        ours("network as law", oscillator(large, "law")),
        ours("network as spring, no stop", oscillator(middle, "without")),
        by_diffrax("network as spring, no stop", middle),
    ]


# %% [markdown]
# ## Measured


# %%
def compiled(function: Callable, *args: Any) -> tuple[Callable, float]:
    """Return a program, and the seconds of tracing and compiling."""
    begin = time.perf_counter()
    program = vi.jit(function).lower(*args).compile()
    return program, time.perf_counter() - begin


rows, bars, numbers = [], [], {}
for task in tasks():
    value, _ = compiled(task.value, task.numbers)
    gradient, seconds = compiled(jax.grad(task.value), task.numbers)
    runs = [partial(f, task.numbers) for f in (value, gradient)]
    with vi.threads(1):
        plain, back = side_by_side(runs, ROUNDS)
    times = f"{1e3 * plain:.2f}", f"{1e3 * back:.1f}", f"{back / plain:.1f}", f"{seconds:.1f}"
    rows.append((task.name, task.code, f"{task.numbers.size:,}", *times))
    bars.append((f"{task.name}\n{task.numbers.size:,} numbers", task.code, back / plain))
    say(rows[-1])
    if task.code == "vi_jax" and "law" in task.name:
        name = f"law of {task.numbers.size:,} weights: length of the gradient"
        numbers[name] = float(np.linalg.norm(runs[1]()))

# %% [markdown]
# ## Table

# %%
heads = [
    "machine", "code", "numbers", "value, ms", "gradient, ms", "gradient / value", "compile, s",
]  # fmt: skip
page = f"""# Gradients with respect to many parameters

{LANES} lanes of {CYCLES} cycles, {STEPS} steps of Dopri8 each, from different starts; the sum of \
the squares of their last places and its gradient. JAX {jax.__version__}, diffrax \
{diffrax.__version__}, one core, medians of {ROUNDS} interleaved rounds; times are for all lanes.

![Gradients](../figures/gradients.png)

{table(heads, rows)}
"""
print(page)

# %% [markdown]
# ## Figure

# %%
figure, ax = panels(8.5, 4)
colors = {"vi_jax": BLUE, "diffrax": GREEN}
for code, color in colors.items():
    places = [i for i, bar in enumerate(bars) if bar[1] == code]
    drawn = ax.barh(places, [bars[i][2] for i in places], 0.6, color=color, label=code)
    ax.bar_label(drawn, fmt="%.1f", padding=2)
ax.set_yticks(range(len(bars)), [bar[0] for bar in bars], fontsize=8)
ax.invert_yaxis()
ax.set(xlabel="time of the gradient over that of the value")
ax.legend(frameon=False)
open_frames([ax])
write("gradients", page, numbers, figure)
