# %% [markdown]
# # When does the straight line suffice?
#
# The paper's motor gives the torque of its straight line at once. A real one has an armature whose
# current takes the time L/R to follow. Here the 2π motions of Table 1's machine are found with
# both, over κ, for four motors and a range of τe = ωL/R, and their extremes, frequency ratios and
# rates of decay are compared; and both are switched on at rest.
#
# Run with `python experiments/studies/dc_motor.py` (`--quick` for fewer motions, writes nothing).

# %%
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from vi_jax.plot.colors import BLUE, GREEN, ORANGE, RED

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import open_frames, panels
from tools.study import QUICK, write
from tools.tables import table

TORQUES = (10.0,) if QUICK else (0.2, 2.0, 10.0, 100.0)
KAPPAS = np.linspace(0.5, 1.9, 5 if QUICK else 57)
TIMES = (0.1, 1.0) if QUICK else (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
OMEGA = float(vi.Parameters().natural_frequency)
TAU = 1 / (float(vi.Parameters().inertia) * OMEGA**2)  # τ0 of 1 N·m


def machine(torque, kappa, time=None) -> vi.Scene:
    """Table 1 at k = 0.5, with an armature of τe = `time` or without one."""
    lag = None if time is None else time / OMEGA
    return vi.Parameters(
        torque=torque, control=kappa, restitution=0.5, electrical_time=lag
    ).scene()  # fmt: skip


# %% [markdown]
# ## Periodic motions with both


# %%
def settled(torque, kappa):
    scene = machine(torque, kappa)
    steps = vi.FixedStep(steps_per_cycle=24)
    return vi.simulate(scene, scene.start(), 1, settle=500, method=steps).last


def found(torque, kappa, state, time=None):
    """min Y, max Y, ζ, whether stable, impacts and the largest multiplier's modulus."""
    scene = machine(torque, kappa, time)
    orbit = vi.find_orbit(scene, scene.start(Y=state.Y, V=state.V, W=state.W))
    slowest = jnp.max(jnp.abs(orbit.multipliers))
    return (
        orbit.y_min, orbit.y_max, orbit.frequency_ratio, orbit.stable, orbit.impacts, slowest
    )  # fmt: skip


grid = [jnp.asarray(a.ravel()) for a in np.meshgrid(TORQUES, KAPPAS, indexing="ij")]
states = vi.jit(jax.vmap(settled))(*grid)
shape = len(TORQUES), len(KAPPAS)
line = [np.asarray(x).reshape(shape) for x in vi.jit(jax.vmap(found))(*grid, states)]
often = [jnp.tile(x, len(TIMES)) for x in grid]
again = jax.tree.map(lambda x: jnp.tile(x, len(TIMES)), states)
lags = jnp.repeat(jnp.asarray(TIMES), grid[0].size)
lagging = vi.jit(jax.vmap(found))(*often, again, lags)
lagging = [np.asarray(x).reshape(len(TIMES), *shape) for x in lagging]
same = line[3] & lagging[3] & (line[4] == lagging[4])
lost = int(np.sum(line[3] & ~lagging[3]))
assert same.any(axis=2).all()


def largest(which: int) -> np.ndarray:
    """The largest change over κ, for each τe and torque."""
    return np.where(same, np.abs(lagging[which] - line[which]), 0.0).max(axis=2)


low, high, ratio = (largest(which) for which in range(3))
slow = largest(5)

# %% [markdown]
# ## Switched on at rest


# %%
RUN_UP = 12  # cycles


def run_up(torque: float, time: float | None) -> vi.Run:
    scene = machine(torque, 0.9, time)
    start = scene.start(W=0.0) if time is None else scene.start(W=0.0, M=0.0)
    return vi.simulate(
        scene, start, RUN_UP, clock="time", samples=512, method=vi.Adaptive(rtol=1e-9)
    )


def speed_at(run: vi.Run, times: np.ndarray) -> np.ndarray:
    assert run.samples is not None
    return np.interp(times, np.asarray(run.samples.time), np.asarray(run.samples.state.W))


ticks = np.linspace(0.0, 40.0, 4001)
ups = {(t, time): speed_at(run_up(t, time), ticks) for t in TORQUES for time in (None, *TIMES)}
late = np.array([[np.abs(ups[t, x] - ups[t, None]).max() for t in TORQUES] for x in TIMES])
swing = np.array([[ups[t, x].max() - ups[t, None].max() for t in TORQUES] for x in TIMES])

# %% [markdown]
# ## Table and figure

# %%
heads = [
    "T0, N·m", "τe", "L/R, ms", "τe τ0/w0", "min Y", "max Y", "ζ", "largest multiplier",
    "speed from rest, at worst", "its peak",
]  # fmt: skip
rows = []
for j, torque in enumerate(TORQUES):
    for i, time in enumerate(TIMES):
        cells = [f"{x[i, j]:.1e}" for x in (low, high, ratio, slow)]
        times = (f"{time:g}", f"{1e3 * time / OMEGA:.3g}", f"{time * TAU * torque:.3g}")
        from_rest = (f"{late[i, j]:.3f}", f"{swing[i, j]:+.3f}")
        rows.append([f"{torque:g}", *times, *cells, *from_rest])
changes = table(heads, rows)
print(changes)
worst = low / np.asarray(TIMES)[:, None]
print(f"{lost} motions lost; min Y changes by at most {worst.max():.1e} τe")

figure, (left, right) = panels(11, 4.2, 1, 2)
colors = (GREEN, ORANGE, BLUE, RED)
for j, torque in enumerate(TORQUES):
    left.loglog(
        TIMES, low[:, j], "os^D"[j] + "-", color=colors[j], ms=4, label=f"T0 = {torque:g} N·m"
    )
guide = np.array([TIMES[0], TIMES[-1]])
left.loglog(guide, worst.max() * guide, color="0.6", lw=1, ls="--", label="first order")
left.set(xlabel="electrical time τe = ωL/R (1/ω)", ylabel="largest change of min Y (a)")
left.set_title("2π motions, κ from 0.5 to 1.9", fontsize=10)
left.legend(frameon=False, fontsize=9)
shown = 10.0
for time, color, style in ((None, "k", "-"), (0.1, GREEN, "--"), (1.0, BLUE, "-"), (3.0, RED, "-")):
    if (shown, time) in ups:
        name = "straight line" if time is None else f"τe = {time:g}"
        right.plot(ticks, ups[shown, time], color=color, ls=style, lw=1.4, label=name)
right.axhline(0.9, color="0.6", lw=0.8, ls=":", zorder=0, label="κ")
right.set(xlabel="time τ (1/ω)", ylabel="crank speed φ'/ω", xlim=(0, 40))
right.set_title(f"switched on at rest, T0 = {shown:g} N·m, κ = 0.9", fontsize=10)
right.legend(frameon=False, fontsize=9, loc="lower right")
open_frames((left, right))

# %%
small = max(low[i].max() for i, x in enumerate(TIMES) if x <= 0.3)
text = f"""# When does the straight line suffice?

Table 1's machine at k = 0.5 and d = 2: its stable 2π motions at {len(KAPPAS)} values of κ from 0.5
to 1.9 with the straight line of the paper's motor, and with an armature of the electrical time
constant τe = ωL/R. Largest changes over κ; lengths in a. *Largest multiplier*: how fast a motion is
approached. *From rest*: both switched on at rest at κ = 0.9, the difference in φ'/ω at worst within
40 units of time, and that of its peaks.

![Straight line or armature](../figures/dc_motor.png)

- **Steady motion hardly notices.** Over a period the armature keeps nothing, so that the *mean*
  torque and speed lie on the straight line whatever the inductance is; only the swing of the torque
  within a cycle changes. The extremes change by at most {worst.max():.1e} τe, the frequency
  ratio by {ratio.max():.0e} at worst. (Of {int(line[3].sum())} motions {lost} are not found, or
  not stable, at one of the τe.)
- **How a motion is approached** changes more than the motion itself: the largest multiplier by up
  to {slow.max():.1e}.
- **From rest it shows.** The current has to build up first, and where τe τ0/w0 is more than 1/4
  speed and current swing: the shaft overshoots. Even τe = 0.1 is seen at T0 = 100 N·m.
- So the straight line does for frequency responses, extremes and impacts: with an armature of up to
  19 ms (τe = 0.3) they are right to {small:.0e} of the crank. Where a run-up, a
  passage or the current itself matters, take `DCMotor`.

{changes}
"""
pair = [
    vi.find_orbit(
        s, vi.simulate(s, s.start(), 1, settle=500, method=vi.FixedStep(steps_per_cycle=24)).last
    )
    for s in (machine(10.0, 0.9), machine(10.0, 0.9, 0.1))
]
assert pair[1].frequency_ratio is not None
numbers = {
    "T0 = 10 N·m, κ = 0.9, straight line: min Y": float(pair[0].y_min),
    "T0 = 10 N·m, κ = 0.9, τe = 0.1: min Y": float(pair[1].y_min),
    "T0 = 10 N·m, κ = 0.9, τe = 0.1: ζ": float(pair[1].frequency_ratio),
}
write("dc_motor", text, numbers, figure)
