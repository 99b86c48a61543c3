# %% [markdown]
# # How long an integrator stays on an unstable motion
#
# The undamped, ideally driven machine (ζ = 0.9, k = 0.5, d = 2) has a 2π motion that is known in
# closed form and is unstable: its Floquet multiplier -1.166036 makes every error grow by a sixth in
# each cycle. Started on it, a run stays within 0.05 for about ln(0.05/error)/ln(1.166) cycles,
# where "error" is what the method adds in one cycle.
#
# Run with `python experiments/studies/escape_from_2pi.py` (`--quick` for a few settings only).

# %%
import sys
import warnings
from pathlib import Path

import diffrax
import jax
import numpy as np
import vi_jax as vi

jax.config.update("jax_enable_x64", True)
# Single precision is one of the things compared here.
warnings.filterwarnings("ignore", message="vi_jax is running in single precision")

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.study import QUICK, write
from tools.tables import table

CYCLES, NEAR = 600, 0.05
SOLVERS = {"Dopri8": diffrax.Dopri8(), "Tsit5": diffrax.Tsit5()}


def machine() -> vi.Scene:
    """Return the machine in the precision that is switched on."""
    return vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)


form = vi.closed_form_orbits(machine(), cycles=1)
ON_ORBIT = np.array([float(form.Y[0]), float(form.V[0])])
MULTIPLIER = float(np.min(np.real(form.multipliers[0])))
# One Newton step takes the closed form's own rounding off the start.
orbit = vi.find_orbit(machine(), machine().start(Y=ON_ORBIT[0], V=ON_ORBIT[1]), throw=True)
POLISHED = np.array([float(orbit.state.Y), float(orbit.state.V)])


def law(error: float) -> float:
    """Return the cycles in which an error grows to `NEAR`."""
    return float(np.log(NEAR / error) / np.log(abs(MULTIPLIER)))


# %% [markdown]
# ## One run, and what is counted
#
# The distance to the motion is the larger of |ΔY| and |ΔV| on the section. The one-cycle error is
# that distance after the first cycle; in single precision it holds the rounding of the start too.

# %%
rows, beyond = [], {}


def escape(group: str, setting: str, method: vi.AbstractMethod, shift=0.0, on=ON_ORBIT) -> None:
    """Start on the motion, or displaced from it in Y, and count."""
    scene = machine()
    start = scene.start(Y=on[0] - shift, V=on[1])
    run = vi.simulate(scene, start, CYCLES, method=method, record="sections")
    sections = np.stack([run.sections.Y, run.sections.V], axis=1).astype(float)
    apart = np.abs(sections - on).max(axis=1)
    away = np.flatnonzero(~(apart <= NEAR))
    error = shift or apart[1]
    kind = "displaced starts" if shift else "single precision" if "32" in group else "double"
    counted = f"none in {CYCLES}"
    if away.size:
        counted = str(away[0])
        beyond.setdefault(kind, []).append(away[0] - law(error))
    elif np.all(sections[-7:] == sections[-9:-2]):
        counted += " (repeats bit for bit)"
    rows.append([group, setting, f"{error:.1e}", counted, f"{law(error):.0f}"])
    print(*rows[-1], flush=True)


def escapes(suffix: str, exponents: range, steps: tuple[int, ...]) -> None:
    """Count with all methods in the precision that is switched on."""
    escape("ExactFlight" + suffix, "–", vi.ExactFlight())
    for name, solver in SOLVERS.items():
        for n in exponents:
            method = vi.Adaptive(solver, rtol=10.0**-n)
            escape(f"Adaptive {name}{suffix}", f"rtol 1e-{n:02d}", method)
        for n in steps:  # another number of steps is another program
            method = vi.FixedStep(solver, steps_per_cycle=n)
            escape(f"FixedStep {name}{suffix}", f"{n} steps", method)


for n in range(2, 13, 5 if QUICK else 1):
    escape("displaced start", f"{10.0**-n:.0e}", vi.ExactFlight(), shift=10.0**-n)
displaced = {row[1]: row[3] for row in rows}
escape("ExactFlight", "polished", vi.ExactFlight(), on=POLISHED)
escapes("", range(3, 14, 5 if QUICK else 1), (8,) if QUICK else (8, 12, 16, 24, 32, 48, 64, 128))
with jax.enable_x64(False):
    escapes(", float32", range(3, 8, 4 if QUICK else 1), (12,) if QUICK else (12, 24))

# %% [markdown]
# ## Table

# %%
spread = [
    [kind, len(x), f"{np.median(x):.1f} ({min(x):.1f} … {max(x):.1f})"]
    for kind, x in beyond.items()
]
heads = ["runs that left", "number", "cycles beyond the law: median (range)"]
columns = ["method", "setting", "one-cycle error", "cycles counted", "law"]
text = f"""# Cycles spent near the unstable 2π motion

Ideal drive, undamped, ζ = 0.9, k = 0.5, d = 2. Each run of {CYCLES} cycles starts on the closed
form's state. *Counted*: the first cycle that ends more than {NEAR} away. *Law*:
ln({NEAR}/error)/ln {abs(MULTIPLIER):.6f}, with the error measured over one cycle.

{table(heads, spread)}

- The count follows the multiplier over twelve decades. It lies some cycles above the law, because a
  part of the error lies along the stable direction.
- `ExactFlight` leaves when the finest fixed steps do. That is the rounding of the closed form's
  state. One Newton step (*polished*) takes it off.
- `Adaptive(Tsit5)` errs by about its tolerance. `Adaptive(Dopri8)` has a floor of 1e-6 at loose
  tolerances, since no step is longer than a fifth of a cycle.
- Single precision is good for about seventy cycles, unless its rounding holds the motion on
  sections that repeat to the last bit. So staying is no proof of accuracy.

{table(columns, rows)}
"""
numbers = {"multiplier of the 2π motion": MULTIPLIER}
if not QUICK:
    numbers["cycles near the 2π motion, displaced by 1e-7"] = float(displaced["1e-07"])
write("escape_from_2pi", text, numbers)
