# %% [markdown]
# # Fitting the 4π motion: Newton against optax
#
# A periodic motion is a zero of the residual "state two cycles on, less the state". Newton's method
# and gradient descent by an optax optimiser search for it from the closed form of the ideal,
# undamped machine displaced by 5 %, from rest, and from random guesses; beside them the transient
# is simulated until it has died out. Two machines (k = 0.5 undamped; k = 0.8 with Table 1's
# damping), each driven ideally at ζ = 0.9 and by motors of T0 = 100, 10 and 2 N·m at κ = 0.9; and,
# because the transients of these are short, a third one that loses little (k = 0.95, undamped).
#
# Run with `python experiments/studies/fit_4pi_orbit.py` (`--quick` for two scenes and few guesses).

# %%
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
import vi_jax as vi
from vi_jax.plot.colors import color_of

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import panels
from tools.study import QUICK, write

KAPPA, TRANSIENT = 0.9, 1000
# The rate falls from 0.02 to zero, as it does by default.
NEWTON, ADAM = vi.Newton(), vi.Gradient(optax.adam(optax.cosine_decay_schedule(0.02, 1000)))
# Random guesses; Adam gets the first of them only, because it takes so much longer.
GUESSES, ADAM_IDEAL, ADAM_MOTOR = (6, 3, 2) if QUICK else (48, 48, 6)

# %% [markdown]
# ## Scenes
#
# With a motor everything runs by `FixedStep` with 16 steps, one program for every torque. (With 12
# the strongest motor's orbit is off by 1e-6, which `find_orbit` does not let pass after a descent.)

# %%
MACHINES = {
    "k = 0.5, undamped": {"restitution": 0.5, "damping": 0.0},
    "k = 0.8, Table 1": {"restitution": 0.8, "damping": 0.5},
    "k = 0.95, undamped": {"restitution": 0.95, "damping": 0.0},
}
FIRST, SECOND, THIRD = MACHINES
SCENES: list[tuple[str, float | None]] = [
    *((FIRST, torque) for torque in (None, 100.0, 10.0, 2.0)),
    *((SECOND, torque) for torque in (None, 100.0, 10.0, 2.0)),
    *((THIRD, torque) for torque in (None, 10.0)),
]
if QUICK:
    SCENES = [(FIRST, None), (SECOND, 10.0)]


def make(machine: str, torque: float | None) -> vi.Scene:
    """The scene with the ideal drive (no torque given) or the motor."""
    values = MACHINES[machine]
    table = vi.Parameters(
        control=KAPPA, gap=0.08, torque=10.0 if torque is None else torque, **values
    )
    return table.scene(drive="ideal" if torque is None else "motor")


def flow(scene: vi.Scene) -> vi.AbstractMethod:
    """How the scene is carried, in searches and transients alike."""
    return (
        vi.ExactFlight()
        if isinstance(scene.drive, vi.IdealDrive)
        else vi.FixedStep(steps_per_cycle=16)
    )


def search(scene: vi.Scene, guess: Any, method: vi.AbstractRootFinder, section=0.0) -> vi.Orbit:
    """A search for the 4π motion."""
    return vi.find_orbit(
        scene, guess, cycles=2, root_finder=method, method=flow(scene), section=section
    )


def timed(work: Callable[[], Any], rounds: int = 5) -> tuple[Any, float]:
    """A result and the fewest seconds it takes once compiled."""
    result, seconds = jax.block_until_ready(work()), []
    for _ in range(rounds):
        begin = time.perf_counter()
        jax.block_until_ready(work())
        seconds.append(time.perf_counter() - begin)
    return result, min(seconds)


def kind(orbit: vi.Orbit) -> str:
    """What a search found, in a word."""
    if bool(orbit.successful):
        return f"{2 * int(orbit.cycles)}π"
    return str(orbit.to_xarray()["result"].item())


def found(orbit: vi.Orbit) -> str:
    """The same with the stability of a motion and the steps of the search."""
    steps = int(orbit.iterations)
    if bool(orbit.successful):
        return f"{kind(orbit)} {'stable' if bool(orbit.stable) else 'unstable'}, {steps}"
    walked = int(np.isfinite(np.asarray(orbit.history)).sum())
    if walked < steps:
        return f"{kind(orbit)}: beyond the stop after {walked}"
    return f"{kind(orbit)}, {steps}, residual {float(orbit.residual):.0e}"


# %% [markdown]
# ## Transients
#
# A transient is over at the first section from which on every section comes back within 1e-6 after
# the period of the motion. Its time is that share of a compiled run of 1,000 cycles.


# %%
def transient(scene: vi.Scene) -> tuple[int, int, float, np.ndarray]:
    """Period it settles to (0: none), cycles until then, their seconds, and the last section."""
    run, seconds = timed(
        lambda: vi.simulate(scene, scene.start(), TRANSIENT, method=flow(scene), record="sections")
    )
    sections = np.stack(jax.tree.leaves(run.sections), axis=1)
    for period in range(1, 9):
        apart = np.abs(sections[period:] - sections[:-period]).max(axis=1)
        late = np.flatnonzero(~(apart < 1e-6))
        cycles = int(late[-1]) + 1 if late.size else 0
        if cycles < TRANSIENT - 20:
            return period, cycles, seconds * cycles / TRANSIENT, sections[-1]
    return 0, TRANSIENT, seconds, sections[-1]


def same(orbit: vi.Orbit, section: np.ndarray) -> bool:
    """Whether a motion is the one that the transient settled to."""
    states = np.stack(jax.tree.leaves(orbit.sections), axis=1)
    return bool(orbit.successful) and bool(np.abs(states - section).max(axis=1).min() < 1e-4)


# %% [markdown]
# ## Searches of one scene
#
# The closed form is that of the ideal drive; a motor's guess begins at its no-load speed. At
# k = 0.8 the body is so near the stop on the section that 5 % more is beyond it: so Y is taken 5 %
# smaller and V 5 % larger. The random guesses are on the section φ = π, where the body is far from
# the stop.


# %%
def searches(machine: str, torque: float | None) -> dict[str, Any]:
    """Everything measured for one scene."""
    scene = make(machine, torque)
    ideal = torque is None
    form = vi.closed_form_orbits(make(machine, None), cycles=2)
    guesses = {
        "displaced": scene.start(Y=0.95 * form.Y[0], V=1.05 * form.V[0]),
        "rest": scene.start(),
    }
    row: dict[str, Any] = {"machine": machine, "torque": torque, "transient": transient(scene)}
    for name, method in (("newton", NEWTON), ("adam", ADAM)):
        for where, guess in guesses.items():
            rounds = 5 if name == "newton" else 1
            result = timed(lambda m=method, g=guess: search(scene, g, m), rounds)
            row[f"{name}, {where}"] = result
    random = np.random.default_rng(1)
    tally: dict[str, list[vi.Orbit]] = {"newton": [], "adam": []}
    for i in range(GUESSES):
        Y, V, W = random.uniform((-3.5, -3.0, 0.8), (2.0, 3.0, 0.95))
        guess = scene.start(Y=Y, V=V) if ideal else scene.start(Y=Y, V=V, W=W)
        tally["newton"].append(search(scene, guess, NEWTON, np.pi))
        if i < (ADAM_IDEAL if ideal else ADAM_MOTOR):
            tally["adam"].append(search(scene, guess, ADAM, np.pi))
    row["tally"] = tally
    return row


def title(row: dict[str, Any]) -> str:
    torque = row["torque"]
    return f"{row['machine']}, " + ("ideal" if torque is None else f"T0 = {torque:g}")


begin, rows = time.perf_counter(), []
for machine, torque in SCENES:
    rows.append(searches(machine, torque))
    print(
        f"{title(rows[-1])}: Newton {found(rows[-1]['newton, displaced'][0])}; from rest "
        f"{found(rows[-1]['newton, rest'][0])} ({time.perf_counter() - begin:.0f} s)",
        flush=True,
    )


# %% [markdown]
# ## Tables


# %%
SEARCHES = [f"{name}, {where}" for name in ("newton", "adam") for where in ("displaced", "rest")]


def share(orbits: list[vi.Orbit]) -> str:
    """How often a 4π motion, a 2π motion and none was found."""
    kinds = [kind(orbit) for orbit in orbits]
    counts = [kinds.count("4π"), kinds.count("2π")]
    return " / ".join(map(str, [*counts, len(kinds) - sum(counts)])) + f" of {len(kinds)}"


lines = [
    "| scene | transient: cycles | transient, ms | Newton, displaced | ms (saved) | "
    "Newton, from rest | ms (saved) | Adam, displaced | ms | Adam, from rest | ms |",
    "|" + "---|" * 11,
]
for row in rows:
    period, cycles, seconds, section = row["transient"]
    cells = [title(row), f"{cycles} to the {2 * period}π motion", f"{1e3 * seconds:.1f}"]
    for name in SEARCHES:
        orbit, taken = row[name]
        cells += [found(orbit), f"{1e3 * taken:.{1 if 'newton' in name else 0}f}"]
        if "newton" in name:
            saved = 1e3 * (seconds - taken)
            cells[-1] += f" ({saved:+.1f})" if same(orbit, section) else " (–)"
    lines.append("| " + " | ".join(cells) + " |")
lines += [
    "",
    "| scene | Newton: 4π / 2π / none | median steps | Adam: 4π / 2π / none | median steps |",
    "|---|---|---|---|---|",
]
for row in rows:
    cells = [title(row)]
    for orbits in row["tally"].values():
        cells += [share(orbits), f"{np.median([int(o.iterations) for o in orbits]):.0f}"]
    lines.append("| " + " | ".join(cells) + " |")
table = "\n".join(lines)
print(table)

# %% [markdown]
# ## Figure

# %%
COLORS = {"newton": "0.2", "adam": "#cc79a7"}
figure, ((first, second), (bars, times)) = panels(11, 8, 2, 2)
shown = [rows[0], next(r for r in rows if r["machine"] == SECOND and r["torque"] == 10.0)]
for axes, row in zip((first, second), shown, strict=True):
    for name in SEARCHES:
        method, where = name.split(", ")
        orbit = row[name][0]
        history = np.asarray(orbit.history)
        style = ("." if method == "newton" else "") + ("-" if where == "displaced" else ":")
        label = f"{method.capitalize()}, {where}: {kind(orbit).replace('_', ' ')}"
        steps = np.arange(1, history.size + 1)
        axes.loglog(steps, history, style, color=COLORS[method], lw=1.3, label=label)
    axes.set_title(title(row))
    axes.set_xlabel("step of the search")
    axes.set_ylabel("largest residual component (a, a ω, ω)")
    axes.set_ylim(1e-16, 10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8.5, loc="lower right")

place = np.arange(len(rows))[::-1]
names = [title(row) for row in rows]
for shift, method, alpha in ((0.2, "newton", 1.0), (-0.2, "adam", 0.5)):
    start = np.zeros(len(rows))
    for wanted, color in (("4π", color_of(2)), ("2π", color_of(1)), ("none", "0.7")):
        part = np.zeros(len(rows))
        for i, row in enumerate(rows):
            orbits = row["tally"][method]
            kinds = [kind(o) if kind(o) in ("4π", "2π") else "none" for o in orbits]
            part[i] = 100 * kinds.count(wanted) / len(kinds)
        label = wanted if method == "newton" else None
        bars.barh(place + shift, part, 0.36, start, color=color, alpha=alpha, label=label)
        start += part
bars.set_yticks(place, names, fontsize=8)
bars.set_xlabel("random guesses, % (upper bars Newton, pale ones Adam)")
bars.set_title("what is found from random guesses")
bars.legend(fontsize=8, loc="upper center", ncols=3, bbox_to_anchor=(0.5, -0.14))

for name in ("transient", *SEARCHES):
    method, _, where = name.partition(", ")
    color = COLORS.get(method, "k")
    marker = {"": "|", "displaced": "o", "rest": "s"}[where]
    for i, row in enumerate(rows):
        seconds = row[name][2 if method == "transient" else 1]
        hit = method == "transient" or same(row[name][0], row["transient"][3])
        dots = {"color": color, "mfc": color if hit else "none", "mew": 1.5}
        times.plot(1e3 * seconds, place[i], marker, ms=14 if not where else 6, **dots)
    times.plot([], [], marker, color=color, label=name.capitalize())
times.set_xscale("log")
times.set_yticks(place, [])
times.set_ylim(bars.get_ylim())
times.grid(alpha=0.3)
times.set_xlabel("ms, once compiled (hollow: not the motion of the transient)")
times.set_title("time to the motion")
times.legend(fontsize=8, loc="upper center", ncols=3, bbox_to_anchor=(0.5, -0.14))
text = f"""# Fitting the 4π motion: Newton and optax

ζ or κ = {KAPPA}, gap 0.08 m. *Displaced*: the ideal, undamped or damped closed form with Y 5 %
smaller and V 5 % larger; *rest*: Y = V = 0, for the transient too. Found: period and stability, or
why not, and the steps. Times are once compiled, the fastest of five (Adam: one), to be read as
orders of magnitude; *saved* is the transient's time less the search's, where both are the same
motion. A transient is over when the section repeats within 1e-6.

{table}

- A stable 4π motion exists in all these scenes, and every transient from rest ends on it. From the
  displaced closed form Newton finds it in five or six steps with any drive (16 in the ideal scene
  with k = 0.95), to rounding: the ideal drive's closed form is a good guess for a motor too.
- From rest Newton mostly does not find what the transient does: it falls on the unstable 2π motion,
  which is a zero of the same residual (`smaller_period`), or stops between motions.
- Adam needs over two hundred steps for seven digits where Newton needs four, and takes ten to a
  hundred times as long. From random guesses it finds fewer motions within its thousand steps, and
  with the weakest motor hardly any. Where a step takes it beyond the stop it is lost, for there is
  no residual there.
- Skipping the transient saves cycles but not always time. The 4π motions with k = 0.5 and 0.8
  contract so fast that 31 to 57 cycles of transient take no longer than a search, multipliers
  included. With k = 0.95 the transient takes hundreds of cycles and Newton wins.
- At k = 0.95 half of the random guesses lead Newton nowhere: the map over two cycles has many
  jumps there, where the motion gains or loses an impact, and the residual falls towards them.
"""
numbers = {
    f"{title(row)}: cycles of the transient": float(row["transient"][1])
    for row in rows
    if row["torque"] is None
}
write("fit_4pi_orbit", text, numbers, figure)
