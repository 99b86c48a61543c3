# %% [markdown]
# # Long chains, compared with heyoka
#
# N masses in a row are coupled by springs and dashpots. A moving wall shakes the first one, and the
# last one strikes a stop. With linear springs the chain is a `vi.machines.Structure` with a
# closed-form solution. With cubic springs the machine is written with slices of arrays and
# integrated. heyoka solves the same equations by Taylor series with an event at the stop, in
# batches of eight, with and without its compact mode, at a tolerance of 1e-9. vi_jax uses its
# fastest setting that is at least as accurate. Both codes run on one core. Rounds are interleaved,
# and compile time is separate.
#
# Run with `python experiments/benchmarks/chains.py` (extra `bench`; `--quick` for few masses,
# writes nothing).

# %%
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

# All codes use one core, which is chosen before any library counts the cores.
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import heyoka as hy  # pyright: ignore[reportMissingImports]
import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from vi_jax.plot.colors import BLUE, GREEN, RED

# Without this, heyoka would reuse compiled code of an earlier run.
hy.llvm_state.set_diskcache_enabled(False)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.chains import AMPLITUDE, DAMPING, GAP, RESTITUTION, cubic_chain, linear_chain
from tools.pictures import open_frames, panels
from tools.study import QUICK, say, write
from tools.tables import table
from tools.timing import side_by_side

SIZES = (4,) if QUICK else (10, 50)
CYCLES, LANES, ROUNDS = (5, 8, 3) if QUICK else (20, 256, 7)
FREQUENCIES = np.linspace(0.2, 0.9, LANES)
BATCH = 8


# %%
class Code(NamedTuple):
    """One code with its settings, compiled for a chain."""

    name: str
    run: Callable[[], Any]
    """Return the final displacements of the lanes, (lanes, masses)."""
    compiling: float
    """Compile time, seconds."""


def ours(name: str, cubic: float, size: int, method: Any, cycles: int = CYCLES) -> Code:
    """Return vi_jax with a method."""

    def lane(frequency):
        machine = cubic_chain(frequency, cubic, size) if cubic else linear_chain(frequency, size)
        run = vi.simulate(machine, machine.start(), cycles, method=method, record="sections")
        return run.last.displacement, run.successful

    lanes = jnp.asarray(FREQUENCIES)
    begin = time.perf_counter()
    program = vi.jit(jax.vmap(lane)).lower(lanes).compile()
    seconds = time.perf_counter() - begin

    def run() -> np.ndarray:
        x, good = program(lanes)
        assert bool(good.all()), f"{name}: a lane did not end"
        return np.asarray(x)

    return Code(name, run, seconds)


def heyokas(name: str, cubic: float, size: int, compact: bool) -> Code:
    """Return heyoka with a terminal event at the stop."""
    x = [hy.make_vars(f"x{i}") for i in range(size)]
    v = [hy.make_vars(f"v{i}") for i in range(size)]
    omega = hy.par[0]
    # Stretch and stretch rate of each spring; the wall's motion is a force on the first mass.
    stretch = [x[0], *(x[i] - x[i - 1] for i in range(1, size))]
    rate = [v[0], *(v[i] - v[i - 1] for i in range(1, size))]
    pull = [
        e + DAMPING * r + (cubic * e * e * e if cubic else 0.0)
        for e, r in zip(stretch, rate, strict=True)
    ]
    drive = [AMPLITUDE * hy.cos(omega * hy.time), *[0.0] * (size - 1)]
    right = [
        drive[i] - pull[i] + (pull[i + 1] if i + 1 < size else 0.0) for i in range(size)
    ]  # fmt: skip
    views: dict[str, Any] = {}

    def bounce(integrator, direction, lane):
        views["memory"][2 * size - 1, lane] *= -RESTITUTION
        return True

    begin = time.perf_counter()
    integrator = hy.taylor_adaptive_batch(
        [*zip(x, v, strict=True), *zip(v, right, strict=True)],
        np.zeros((2 * size, BATCH)),
        tol=1e-9,
        t_events=[hy.t_event_batch(x[-1] - GAP, direction=hy.event_direction.positive,
                                   callback=bounce)],
        pars=np.ones((1, BATCH)),
        fast_math=True,
        compact_mode=compact,
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    views["memory"] = memoryview(integrator.state)

    def run() -> np.ndarray:
        found = []
        for part in FREQUENCIES.reshape(-1, BATCH):
            integrator.set_time(0.0)
            integrator.state[:] = 0.0
            integrator.pars[0] = part
            integrator.propagate_until(CYCLES * 2 * np.pi / part)
            found.append(integrator.state[:size].T.copy())
        return np.concatenate(found)

    return Code(name, run, seconds)


# %% [markdown]
# ## Measured
#
# The error is the median over lanes of the largest error of a final displacement. The truth is the
# closed form for linear springs, and series at a tolerance of 1e-14 for cubic ones.


# %%
def codes_of(cubic: float, size: int) -> list[Code]:
    """Return all compared codes: vi_jax's settings first, heyoka last."""
    if not cubic:
        settings: list[tuple[str, Any]] = [("vi_jax, closed form", vi.ExactFlight())]
    else:
        settings = [
            (f"vi_jax, {kind.__name__} at {tol:.0e}", kind(rtol=tol))
            for kind, tols in ((vi.Taylor, (1e-9, 1e-10, 1e-11)), (vi.Adaptive, (1e-9, 1e-11)))
            for tol in tols
        ]
    codes = [ours(name, cubic, size, method) for name, method in settings]
    return [*codes, *(heyokas(f"heyoka{', compact' * c}", cubic, size, c) for c in (False, True))]


rows, bars, numbers = [], [], {}
for cubic in (0.0, 0.3):
    for size in SIZES:
        codes = codes_of(cubic, size)
        exact = vi.ExactFlight() if not cubic else vi.Taylor(rtol=1e-14)
        truth = ours("truth", cubic, size, exact).run()
        errors = [float(np.median(np.abs(x.run() - truth).max(axis=1))) for x in codes]
        if not cubic:  # The closed form's error, measured by an integrator without modes.
            series = ours("series", 0.0, size, vi.Adaptive(rtol=1e-13)).run()
            errors[0] = float(np.median(np.abs(series - truth).max(axis=1)))
        with vi.threads(1):
            seconds = side_by_side([x.run for x in codes], ROUNDS)
        own = [i for i, x in enumerate(codes) if x.name.startswith("vi_jax")]
        asked = max(e for e, x in zip(errors, codes, strict=True) if x.name.startswith("heyoka"))
        able = [i for i in own if errors[i] <= max(asked, 1e-12)] or own
        best = min(able, key=lambda i: seconds[i])
        kind = "cubic" if cubic else "linear"
        for i, code in enumerate(codes):
            cost = 1e6 * seconds[i] / LANES / CYCLES
            ratio = seconds[i] / seconds[best]
            rows.append((kind, size, code.name, f"{cost:.1f}", f"{errors[i]:.0e}",
                         f"{code.compiling:.1f}", f"{ratio:.2f}"))  # fmt: skip
            say(rows[-1])
            if i >= len(own):
                bars.append((f"{kind} springs, N = {size}", code.name, ratio))
        end = float(np.median(np.abs(truth[:, -1])))
        numbers[f"{kind}, N = {size}: median |x| of the last mass at the end"] = end

# %% [markdown]
# ## Table

# %%
heads = ["springs", "masses", "code", "µs a lane-cycle", "error", "compile s", "time over best"]
model = platform.processor() or platform.machine()
page = f"""# Long chains compared with heyoka

{LANES} lanes of different driving frequencies (0.2 to 0.9), {CYCLES} cycles each, from rest; the \
last mass strikes a stop. heyoka {hy.__version__} in batches of {BATCH} with a tolerance of 1e-9, \
JAX {jax.__version__}, one core ({model}), medians of {ROUNDS} interleaved rounds. Ratios above 1: \
vi_jax's fastest setting that is at least as accurate is so many times as fast.

![Chains](../figures/chains.png)

{table(heads, rows)}
"""
print(page)

# %% [markdown]
# ## Figure

# %%
figure, ax = panels(7.5, 3.8)
cases = list(dict.fromkeys(case for case, *_ in bars))
for shift, name, color in ((-0.18, "heyoka", RED), (0.18, "heyoka, compact", GREEN)):
    times = [ratio for case, code, ratio in bars if code == name]
    drawn = ax.bar(np.arange(len(cases)) + shift, times, 0.34, color=color, label=name)
    ax.bar_label(drawn, fmt="%.1f", padding=2)
ax.axhline(1, color=BLUE, label="vi_jax, as accurate or more")
ax.set(ylabel="time over that of vi_jax")
ax.set_xticks(np.arange(len(cases)), cases)
ax.legend(frameon=False)
open_frames([ax])
write("chains", page, numbers, figure)
