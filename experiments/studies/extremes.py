# %% [markdown]
# # The envelope: what holds at the extremes
#
# Each row is a corner of parameter space with an expectation that owes nothing to the package: a
# closed form, an energy, a limit, a symmetry, or a run by SciPy (matrix exponentials between
# impacts for the ideal drive, `solve_ivp` with events for the motor). What is measured is the
# largest deviation from it, beside what is promised. The tests run the same rows.
#
# Run with `python experiments/studies/extremes.py` (`--quick` leaves out the longest rows).

# %%
import sys
import time
from collections.abc import Callable
from math import pi
from pathlib import Path
from typing import Any

import diffrax
import jax
import numpy as np
import vi_jax as vi

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/studies")
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1] / "tests")]
from tools.tables import table
from tools.timing import repeated

from envelope import CASES
from envelope.case import QUICK
from envelope.scenes import MOTOR, ideal, machine, sections

# %% [markdown]
# ## Stiff motors
#
# What a strong motor costs with explicit steps, with an implicit diffrax solver (Kvaerno5, on the
# same machine without its stop), and how far the ideal drive is from it.


# %%
def stiff() -> str:
    """A table: ten cycles of a motor without a stop, by three ways."""

    def clocked(run: Callable[[], Any]) -> tuple[Any, float]:
        found, times = repeated(run)
        return found, float(np.median(times))

    still = ideal(0.9, 0.05, [])
    limit = sections(still, still.start(), 10, vi.ExactFlight())[-1]
    heads = [
        "τ0", "Adaptive(1e-9): steps a cycle", "ms", "Kvaerno5(1e-9): steps a cycle", "ms",
        "they differ by", "ideal drive off by",
    ]  # fmt: skip
    rows = []

    @jax.jit
    def implicit(scene, start):
        term = diffrax.ODETerm(lambda s, y, scene: scene.field(s, y))
        return diffrax.diffeqsolve(
            term, diffrax.Kvaerno5(), 0.0, 20 * pi, 1e-4, start, scene, max_steps=10**6,
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
        )  # fmt: skip

    method = vi.Adaptive(diffrax.Dopri8(), rtol=1e-9)
    for tau0 in (1e1, 1e2, 1e3, 1e4):
        scene, _ = machine(**{**MOTOR, "tau0": tau0}, stops=())
        start = scene.start()
        run, ours = clocked(lambda s=scene, x=start: vi.simulate(s, x, 10, method=method))
        solved, theirs = clocked(lambda s=scene, x=start: implicit(s, x))
        state = np.array([float(run.last.Y), float(run.last.V)])
        other = np.array([float(solved.ys.Y[-1]), float(solved.ys.V[-1])])
        count = int(solved.stats["num_steps"])
        apart = (f"{np.abs(state - x).max():.0e}" for x in (other, limit))
        mine = (f"{int(run.steps) / 10:.0f}", f"{1e3 * ours:.1f}")
        rows.append((f"{tau0:.0e}", *mine, f"{count / 10:.0f}", f"{1e3 * theirs:.1f}", *apart))
    return table(heads, rows)


# %% [markdown]
# ## The table


# %%
def main() -> None:
    """Measure every row and write the table."""
    jax.config.update("jax_enable_x64", True)
    rows, broken = [], 0
    for row in CASES:
        if QUICK and row.long:
            continue
        begin = time.perf_counter()
        try:
            found = row.measure()
        except (RuntimeError, AssertionError) as error:
            found = {name: np.inf for name in row.promise}
            print(f"  {row.range}: {error!r}", file=sys.stderr)
        measured = []
        for name, promise in row.promise.items():
            broken += not found[name] <= promise
            measured.append(f"{name}: {found[name]:.1e} ({promise:.0e})")
        rows.append((row.range, row.expected, "<br>".join(measured), row.beyond))
        took = time.perf_counter() - begin
        print(f"{took:6.1f} s  {row.range}: {'; '.join(measured)}", file=sys.stderr, flush=True)
    envelope = table(["range", "expected", "method: measured (promised)", "beyond"], rows)
    page = f"# The envelope\n\n{envelope}\n\nPromises broken: {broken}.\n\n"
    page += f"## Stiff motors, ten cycles\n\n{stiff()}\n"
    print(page)
    if not QUICK:
        (HERE / "extremes.md").write_text(page)


if __name__ == "__main__":
    main()
