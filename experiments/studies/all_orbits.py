# %% [markdown]
# # Periodic motions at one parameter point
#
# Above its natural frequency the lightly damped machine (ideal drive, ζ = 3.2, k = 0.9, d = 1.05,
# ξ = 0.002) has several stable motions at once. `all_orbits` searches from 4,096 random starts for
# each period of 1 to 6 drive cycles by Newton's method, one compiled call per period, and merges
# what is found into one list. It holds what random starts find of these periods, not all that
# there is: `basins_map.py` meets a stable motion of 15 cycles here. Every motion is then tested by
# simulation, which knows nothing of the search: a stable one must draw a disturbed start back at
# the rate of its multiplier, and from an unstable one the start must leave at that rate.
#
# Run with `python experiments/studies/all_orbits.py`; `--quick` takes few starts and writes
# nothing.

# %%
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from studies.parts.orbits_picture import Kind, picture
from tools.study import QUICK, write
from tools.tables import table

GUESSES, GRID, SETTLE = (128, 12, 600) if QUICK else (4096, 96, 3000)
PERIODS = 2 if QUICK else 6
ZETA, K, GAP, XI = 3.2, 0.9, 1.05, 0.002
# Impacts lie near φ = 0. There the map jumps, so everything is looked at half a turn later.
SECTION = np.pi
LOW, HIGH = np.array([-3.5, -4.0]), np.array([GAP, 4.0])


def ideal(zeta: float, k: float) -> vi.Scene:
    """The machine at these numbers."""
    return vi.Scene.ideal(frequency_ratio=zeta, restitution=k, gap=GAP, damping_ratio=XI)


SCENE = ideal(ZETA, K).at_section(SECTION)

# %% [markdown]
# ## The search
#
# The period is part of the program, so each n compiles once; all other numbers are arguments of it.
# Compilations are counted, so that "no second one" is a measurement.

# %%
COMPILED: list[str] = []
jax.monitoring.register_event_duration_secs_listener(  # pyright: ignore[reportArgumentType]
    lambda event, *_, **__: COMPILED.append(event) if "backend_compile" in event else None
)


def searched(scene: vi.Scene) -> tuple[vi.AllOrbits, float]:
    """The motions from random starts, and the seconds that it took."""
    begin = time.perf_counter()
    region = {"start.Y": (LOW[0], HIGH[0]), "start.V": (LOW[1], HIGH[1])}
    found = vi.all_orbits(scene, PERIODS, region=region, starts=GUESSES)
    return found, time.perf_counter() - begin


found, seconds = searched(SCENE)
print(f"{found}\n{seconds:.1f} s")
built = len(COMPILED)
_, repeated = searched(ideal(3.15, 0.88).at_section(SECTION))
built = len(COMPILED) - built
again = (
    f"The search took {seconds:.1f} s with its compilations. With other parameters (ζ = 3.15, "
    f"k = 0.88) it took {repeated:.1f} s and compiled {built} programs."
)
print(again)
kinds = [Kind(*both) for both in zip(found.orbits, found.found, strict=True)]
kinds.sort(key=lambda kind: (len(kind.path), kind.size))

# %% [markdown]
# ## Simulation as the judge
#
# Two starts off each motion by 1e-8, to either side, are simulated. What takes a disturbance of one
# period to that of the next, while it is between rounding and where the flow is no longer linear,
# is fitted by a matrix, whose eigenvalue is set beside the multiplier of the search.


# %%
@vi.jit
@jax.vmap
def followed(Y: jax.Array, V: jax.Array) -> jax.Array:
    """Sections (Y, V) of the simulated motion."""
    start = SCENE.start(Y=Y, V=V)
    run = vi.simulate(SCENE, start, SETTLE, method=vi.ExactFlight(), record="sections")
    return jnp.stack([run.sections.Y, run.sections.V], axis=-1)


def arrived(paths: np.ndarray, within: float = 0.03) -> np.ndarray:
    """Index of the stable motion at which each simulated path ends, or -1."""
    end = np.full(len(paths), -1)
    for j, kind in enumerate(kinds):
        if bool(kind.orbit.stable):
            # Two periods at the end must run along the motion, one of whose phases fits.
            period = len(kind.path)
            last = paths[:, -2 * period :]
            for shift in range(period):
                away = last - np.tile(np.roll(kind.path, -shift, axis=0), (2, 1))
                end[np.abs(away).max(axis=(1, 2)) < within] = j
    return end


def growth(paths: np.ndarray, kind: Kind) -> float:
    """Largest |multiplier| of the linear map that fits the simulated disturbances."""
    before, after = [], []
    for path in paths:
        off = path[:: len(kind.path)] - kind.path[0]
        size = np.linalg.norm(off, axis=1, keepdims=True)
        outside = np.append((size[:, 0] > 1e-5) | (size[:, 0] < 1e-10), True)
        stop = int(np.argmax(outside))
        before.append(off[: stop - 1] / size[: stop - 1])
        after.append(off[1:stop] / size[: stop - 1])
    fitted = np.linalg.lstsq(np.concatenate(before), np.concatenate(after))[0]
    return float(np.abs(np.linalg.eigvals(fitted)).max())


# The disturbed starts and the grid of the basins share one program.
side = [np.linspace(low, high, GRID + 1) for low, high in zip(LOW, HIGH, strict=True)]
grid = np.stack(np.meshgrid(*[0.5 * (x[1:] + x[:-1]) for x in side]), axis=-1).reshape(-1, 2)
offset = 1e-8 * np.array([0.6, 0.8])
starts = np.concatenate([[k.path[0] + s * offset for k in kinds for s in (1, -1)], grid])
begin = time.perf_counter()
# Only the ends of the basins' paths are kept, batch by batch: whole ones would fill the memory.
ends, paths = [], np.zeros((0, SETTLE + 1, 2))
for chunk in np.array_split(starts, max(1, round(len(starts) / 1024))):
    padded = np.pad(chunk, ((0, -len(chunk) % 1024), (0, 0)), mode="edge")[: max(len(chunk), 1024)]
    path = np.asarray(followed(*jnp.asarray(padded).T))[: len(chunk)]
    ends.append(arrived(path))
    if not len(paths):
        paths = path[: 2 * len(kinds)]
ends = np.concatenate(ends)
print(f"basins and tests: {time.perf_counter() - begin:.1f} s")
basin = ends[2 * len(kinds) :].reshape(GRID, GRID)
measured = [growth(paths[2 * j : 2 * j + 2], kind) for j, kind in enumerate(kinds)]

# %% [markdown]
# ## Table


# %%
def row(j: int, kind: Kind) -> list[str]:
    o = kind.orbit
    named = [f"{chr(65 + i)}" if i >= 0 else "none" for i in ends[2 * j : 2 * j + 2]]
    clear = float(o.clearance)
    return [
        chr(65 + j),
        str(len(kind.path)),
        str(int(o.impacts)),
        f"({float(o.state.Y):.6f}, {float(o.state.V):.6f})",
        f"{float(o.y_min):.4f} … {float(o.y_max):.4f}",
        f"{kind.size:.6f}",
        f"{measured[j]:.6f}",
        vi.STABILITY[o.stability].split(":")[-1].strip(),
        "∞" if np.isinf(clear) else f"{clear:.3f}",
        "–" if not int(o.impacts) else f"{float(o.slowest_impact):.3f}",
        f"{kind.counts.sum():,} (n = {', '.join(map(str, np.flatnonzero(kind.counts) + 1))})",
        " / ".join(named),
        f"{100 * np.mean(basin == j):.1f} %",
    ]


heads = [
    "motion", "period, cycles", "impacts", "section (Y, V) at φ = π", "Y over the period",
    "largest multiplier", "simulated growth", "stability", "clearance", "slowest V⁻",
    "searches that found it", "disturbed start ends at", "basin",
]  # fmt: skip
motions = table(heads, [row(j, kind) for j, kind in enumerate(kinds)])
searches = table(
    [
        "n", "searches that found an orbit", "distinct orbits", "found once",
        "would likely be found: more than",
    ],
    [
        [s.cycles, f"{s.converged:,} of {s.starts:,}", s.motions, s.once,
         f"{100 * s.detectable:.2g} % of such searches"]
        for s in found.searched
    ],
)  # fmt: skip
report = f"""{GUESSES:,} starts each, uniform over Y = {LOW[0]:g} … {HIGH[0]:g}, V = ±{HIGH[1]:g} \
at φ = π; ζ = {ZETA:g}, k = {K:g}, d = {GAP:g}, ξ = {XI:g}. Two cores.

{motions}

{searches}

{again}

Basins: {GRID}² starts, {SETTLE:,} cycles each; {100 * np.mean(basin < 0):.1f} % ended at none of \
the listed motions. They are on a fifth stable motion at least, with 6 impacts in 15 cycles (30π), \
which `basins_map.md` names: the list holds the motions of 1 to {PERIODS} cycles that \
{GUESSES:,} random starts for each period find, and neither longer ones nor, surely, all of \
these."""
print(report)

# %% [markdown]
# ## Figure: sections over the basins, and a phase portrait of each motion

# %%
numbers = {f"largest multiplier of {chr(65 + j)}": kind.size for j, kind in enumerate(kinds)}
figure = picture(kinds, basin, side)
write("all_orbits", f"# Periodic motions at one point\n\n{report}", numbers, figure)
