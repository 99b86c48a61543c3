# %% [markdown]
# # Ready machines beside what is known of them
#
# A ball on a shaken table, a ball in a shaken box and the classic impact oscillator have curves in
# closed form: where motions are born, lose their symmetry, double their period or touch a stop.
# Here `vi.boundary` follows the same curves without knowing them. Of a capsule that drives itself
# along the ground no closed form is known; its branch stands beside what it settles on.
#
# Run with `python experiments/studies/known_machines.py` (`--quick` for less, writes nothing).

# %%
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from vi_jax import machines
from vi_jax.plot.colors import BLUE, GREEN, ORANGE, RED

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import open_frames, panels
from tools.study import QUICK, write
from tools.tables import table

RESTITUTIONS = (0.4, 0.6) if QUICK else (0.2, 0.8)
PI = np.pi


def sigma(e: Any) -> Any:
    """(1 - e)/(1 + e)."""
    return (1 - e) / (1 + e)


def followed(orbit: vi.Orbit, parameter: str, bounds: tuple[float, float]) -> dict[str, Any]:
    """The special points of an orbit's branch, by their kinds."""
    branch = vi.continue_orbit(orbit, parameter=parameter, bounds=bounds)
    return {point.kind: point for point in branch.special}


def curve(point: vi.SpecialPoint, second: str, first_bounds: tuple, bounds: tuple) -> np.ndarray:
    """Both parameters along the curve of a special point, as columns."""
    return vi.boundary(point, parameter=second, bounds=(first_bounds, bounds)).parameters.T


# %% [markdown]
# ## A ball on a shaken table
#
# One bounce a cycle is born at Γ = πσ and doubles at Γ² = (πσ)² + (2(1 + e²)/(1 + e)²)².

# %%
shaken = machines.BouncingBall(acceleration=1.2, restitution=0.5)  # pyright: ignore[reportCallIssue]
bounce = vi.find_orbit(shaken, shaken.start(height=6.15831535, speed=-1.06063272), throw=True)
found = followed(bounce, "acceleration", (0.05, 3.0))
wide = (0.01, 4.0)
born = curve(found["fold"], "restitution", wide, RESTITUTIONS)
doubles = curve(found["period-doubling"], "restitution", wide, RESTITUTIONS)


def doubling_of(e: Any) -> Any:
    return np.hypot(PI * sigma(e), 2 * (1 + e**2) / (1 + e) ** 2)


# %% [markdown]
# ## A ball in a shaken box
#
# The symmetric motion of one impact a wall folds at λ² = 1 + π²/4σ² and loses its symmetry at
# λ = (π/2 - 2/π)/√(4/π² + σ²).

# %%
pair = machines.ImpactPair(half_gap=2.0, restitution=0.5)  # pyright: ignore[reportCallIssue]
whole = vi.find_orbit(pair, pair.start(place=-1.137, speed=0.785), throw=True)
special = followed(whole, "half_gap", (1.05, 6.0))
folds = curve(special["fold"], "restitution", (1.0, 30.0), RESTITUTIONS)
breaks = curve(special["symmetry-breaking"], "restitution", (0.8, 3.0), RESTITUTIONS)


def fold_of(e: Any) -> Any:
    return np.sqrt(1 + (PI / (2 * sigma(e))) ** 2)


def breaking_of(e: Any) -> Any:
    return (PI / 2 - 2 / PI) / np.sqrt(4 / PI**2 + sigma(e) ** 2)


# %% [markdown]
# ## The classic impact oscillator
#
# x'' + 0.1 x' + x = A cos ωt touches its wall at x = 1 where A² = (1 - ω²)² + (0.1 ω)² (example
# 15.2 of COCO's tutorials).

# %%
classic = machines.Duffing(amplitude=0.05, two_sided=False)  # pyright: ignore[reportCallIssue]
grazes = followed(vi.find_orbit(classic, classic.start(), throw=True), "amplitude", (0.02, 0.3))
frequencies = (0.95, 1.05) if QUICK else (0.85, 1.15)
touch = curve(grazes["grazing"], "frequency", (0.02, 0.6), frequencies)


def touch_of(w: Any) -> Any:
    return np.hypot(1 - w * w, 0.1 * w)


# %% [markdown]
# ## A capsule

# %%
AMPLITUDES = np.linspace(0.6, 3.0, 25 if QUICK else 241)


def settled(amplitude):
    capsule = machines.Capsule(amplitude=amplitude)  # pyright: ignore[reportCallIssue]
    run = vi.simulate(capsule, capsule.start(), 16, settle=400)
    return run.sections.progress[1:], run.successful


progress, good = (np.asarray(x) for x in vi.jit(jax.vmap(settled))(jnp.asarray(AMPLITUDES)))
assert good.all()
capsule = machines.Capsule()  # pyright: ignore[reportCallIssue]
moving = vi.simulate(capsule, capsule.start(), 1, settle=400).last
branch = vi.continue_orbit(
    vi.find_orbit(capsule, moving, throw=True), parameter="amplitude", bounds=(0.6, 3.0)
)
along = np.array([float(branch.orbit(i).state.progress) for i in range(len(branch.parameter))])

# %% [markdown]
# ## Table and figure

# %%
CURVES = [
    ("ball on a table", "birth of one bounce, Γ(e)", born, lambda e: PI * sigma(e)),
    ("ball on a table", "its period doubling, Γ(e)", doubles, doubling_of),
    ("ball in a box", "fold, λ(e)", folds, fold_of),
    ("ball in a box", "loss of symmetry, λ(e)", breaks, breaking_of),
    ("impact oscillator", "grazing, A(ω)", touch, touch_of),
]
rows = []
for machine, name, (first, second), known in CURVES:
    apart = np.abs(first - known(second)).max()
    ends = (f"{second.min():g}", f"{second.max():g}")
    rows.append((machine, name, len(first), *ends, f"{apart:.0e}"))
numbers = {
    "birth of one bounce, e = 0.5": found["fold"].parameter,
    "its period doubling, e = 0.5": found["period-doubling"].parameter,
    "fold of the pair, e = 0.5": special["fold"].parameter,
    "its loss of symmetry, e = 0.5": special["symmetry-breaking"].parameter,
    "grazing of the oscillator, ω = 1": grazes["grazing"].parameter,
}
heads = ["machine", "curve", "points", "from", "to", "largest difference"]
followed_curves = table(heads, rows)
print(followed_curves)

figure, grid = panels(10, 7.2, 2, 2)


def drawn(ax: Any, points: np.ndarray, known: Any, color: str, name: str) -> None:
    """A curve that was followed, and the closed form as circles."""
    first, second = points
    order = np.argsort(second)
    ax.plot(second[order], first[order], color=color, lw=1.6, label=name)
    at = np.linspace(second.min(), second.max(), 12)
    ax.plot(at, known(at), "o", ms=5, mfc="none", color=color, label=f"{name}, closed form")


ball, box, oscillator, capsules = grid.flat
drawn(ball, born, CURVES[0][3], BLUE, "birth")
drawn(ball, doubles, CURVES[1][3], RED, "period doubling")
ball.set(
    title="ball on a shaken table", xlabel="restitution e", ylabel="acceleration of the table Γ (g)"
)
drawn(box, folds, CURVES[2][3], BLUE, "fold")
drawn(box, breaks, CURVES[3][3], RED, "loss of symmetry")
box.set(title="ball in a shaken box", xlabel="restitution e", ylabel="half gap λ (amplitudes)")
box.set_yscale("log")
drawn(oscillator, touch, CURVES[4][3], GREEN, "grazing")
oscillator.set(
    title="impact oscillator", xlabel="frequency ω (own frequency)", ylabel="amplitude A"
)
capsules.plot(
    np.repeat(AMPLITUDES, progress.shape[1]), progress.ravel(), ".", color="0.45", ms=2,
    label="settled, 16 cycles", rasterized=True,
)  # fmt: skip
capsules.plot(branch.parameter, along, color=ORANGE, lw=1.6, label="branch of one impact a cycle")
for point in branch.special:
    at = float(point.orbit.state.progress)
    capsules.plot(point.parameter, at, "ok", ms=5, label=None)
capsules.plot([], [], "ok", ms=5, label="its ends: events fall together")
capsules.set(title="capsule", xlabel="amplitude α (F)", ylabel="progress in a cycle (F/k)")
for ax in grid.flat:
    ax.legend(frameon=False, fontsize=8)
open_frames(grid.flat)

# %%
text = f"""# Ready machines beside what is known of them

Curves in two parameters as `vi.boundary` follows them, from a motion that was simulated, beside
their closed forms (bouncing ball and impact pair: from the flight and the impact law; oscillator:
example 15.2 of COCO). The last panel has no closed form: how far a capsule goes in a cycle, where
it settles and on the branch of one impact a cycle, which ends where two of its
events fall together.

![Four machines](../figures/known_machines.png)

{followed_curves}

- The smallest amplitude at which the oscillator touches its wall is {touch[0].min():.6f}; the
  closed form says {touch_of(np.sqrt(1 - 0.1**2 / 2)):.6f}.
- The capsule's branch of one impact a cycle runs from α = {branch.parameter.min():.6f} to
  {branch.parameter.max():.6f}, where it goes {along[np.argmax(branch.parameter)]:.4f} F/k a cycle.
"""
write("known_machines", text, numbers, figure)
