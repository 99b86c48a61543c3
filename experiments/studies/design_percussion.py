# %% [markdown]
# # Designing an impact machine by gradient
#
# A body on a spring is shaken by an ideal crank and strikes a stop. What a striking machine is
# built for is the energy that its impacts leave in the stop: ½ m_C (1 - k²) (V⁻)² each, here per
# second of the cycle. Which drive frequency ζ, gap Δ and damping c make this power the greatest,
# if the motion must stay stable with something in hand (largest |Floquet multiplier| ≤ 0.8)?
#
# Power and stability are functions of a periodic orbit, and the orbit is a function of the design.
# `find_orbit` is differentiable by the implicit function theorem, so that one compiled
# `value_and_grad` gives the power, the multipliers and their slopes. Each step starts its search
# from the orbit of the step before.
#
# Run with `python experiments/studies/design_percussion.py` (`--quick` for fewer steps).

# %%
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import vi_jax as vi
from matplotlib.figure import Figure
from vi_jax.plot import motion_path
from vi_jax.plot.colors import BLUE, ORANGE, RED

jax.config.update("jax_enable_x64", True)

HERE = Path(__file__).parent if "__file__" in globals() else Path("experiments/studies")
sys.path.insert(0, str(HERE.parent))
from headlines import keep

QUICK = "--quick" in sys.argv
STEPS = 60 if QUICK else 300
BEGUN = time.perf_counter()

MACHINE = vi.Parameters(restitution=0.5)  # Table 1 of the paper in SI units
NAMES = ("ζ", "Δ", "c")
LOW, HIGH = np.array([0.5, 0.0, 0.2]), np.array([1.9, 0.12, 1.0])  # -, m, N·s/m
START = np.array([0.9, 0.08, 0.5])  # the paper's machine
# Largest |multiplier| allowed, and largest gap as a part of the amplitude of the free motion.
DESIGNS = {"A": (0.8, np.inf), "B": (0.5, np.inf), "C": (0.8, 0.95)}

# %% [markdown]
# ## Power and stability of a design
#
# A design is a point of the unit cube between the bounds. The modulus of a multiplier has a kink
# where two real ones become a complex pair, and its slope is infinite there. Jury's conditions say
# the same without it: both multipliers lie within radius r if and only if
# |trace|/r ≤ 1 + det/r² and det ≤ r². Here det = k² exp(-2ξT) < 0.25, so that only the first can
# bind, once for each sign of the trace.
#
# A stable orbit is of no use to a machine that never gets there. With a gap wider than the
# amplitude of the free motion the body can go on for ever without a single impact. So there is a
# third condition, that the gap is at most a part of this amplitude. Design A does without it, B
# asks for more stability instead, and C is to start by itself.


# %%
def parameters(design: Any) -> vi.Parameters:
    numbers = LOW + (HIGH - LOW) * design
    return eqx.tree_at(lambda p: (p.control, p.gap, p.damping), MACHINE, tuple(numbers))


def impact_power(machine: vi.Parameters, orbit: vi.Orbit) -> Any:
    """Energy lost in the impacts of one period over its duration, W."""
    speed = jnp.where(orbit.impact_stop >= 0, orbit.impact_speed, 0.0)
    square = jnp.sum(machine.metres_per_second(speed) ** 2)
    energy = 0.5 * machine.body_mass * (1 - machine.restitution**2) * square
    return energy / machine.seconds(orbit.duration)


class Force(NamedTuple):
    """The state of the augmented Lagrangian: numbers only, so that nothing recompiles."""

    limit: Any
    """Largest modulus allowed."""
    reach: Any
    """Largest gap allowed, as a part of the amplitude of the free motion."""
    price: Any
    """Multiplier of each of the three conditions, W."""
    weight: Any
    """Weight of the quadratic penalty, W."""


def lagrangian(design: Any, guess: Any, force: Force) -> tuple[Any, tuple]:
    machine = parameters(design)
    scene = machine.scene(drive="ideal")
    orbit = vi.find_orbit(scene, guess, cycles=1)
    power = impact_power(machine, orbit)
    trace = jnp.trace(orbit.monodromy) / force.limit
    det = jnp.linalg.det(orbit.monodromy) / force.limit**2
    free = jnp.hypot(1 - machine.control**2, 2 * scene.damping_ratio * machine.control)
    gap = scene.stops[0].gap * free / force.reach
    excess = jnp.stack([trace - det, -trace - det, gap]) - 1  # to be ≤ 0
    pushed = jnp.maximum(0.0, force.price + force.weight * excess)
    penalty = jnp.sum(pushed**2 - force.price**2) / (2 * force.weight)
    allowed = (orbit.result == vi.ORBIT_RESULTS.successful) & orbit.admissible
    modulus = jnp.max(jnp.abs(orbit.multipliers))
    return penalty - power, Outcome(power, modulus, excess, allowed, orbit)


class Outcome(NamedTuple):
    power: Any
    modulus: Any
    excess: Any
    allowed: Any
    """An orbit was found, and nowhere is its clearance negative."""
    orbit: vi.Orbit


evaluate = jax.jit(jax.value_and_grad(lagrangian, has_aux=True))


# %% [markdown]
# ## The start, and its gradient beside central differences
#
# The start is found by letting the paper's machine run: its 2π motion is stable.


# %%
def settled(design: Any, cycles: int = 300) -> vi.OscillatorState:
    scene = parameters(design).scene(drive="ideal")
    run = vi.simulate(scene, scene.start(), cycles, method=vi.ExactFlight(), record="sections")
    return jax.tree.map(lambda x: x[-1], run.sections)


first = jnp.asarray((START - LOW) / (HIGH - LOW))
origin = settled(first)
none = Force(*(jnp.array(x, float) for x in (*DESIGNS["A"], np.zeros(3), 5.0)))


def check_gradient(design: Any, guess: Any) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the Lagrangian (power and penalty together) by the two ways, W per unit."""
    # Prices that let every condition take part, whether it is met or not.
    force = none._replace(reach=jnp.array(0.95, float), price=jnp.full(3, 50.0, float))
    slope = np.asarray(evaluate(design, guess, force)[1])
    h = 1e-5
    ends = [
        [float(evaluate(design.at[i].add(s), guess, force)[0][0]) for s in (h, -h)]
        for i in range(3)
    ]
    return slope, np.array([(up - down) / (2 * h) for up, down in ends])


slope, differences = check_gradient(first, origin)
gradient_error = float(np.max(np.abs(slope - differences)) / np.max(np.abs(slope)))
compile_seconds = time.perf_counter() - BEGUN
print(f"gradient {slope}, central differences {differences}, relative error {gradient_error:.1e}")

# %% [markdown]
# ## Ascent
#
# Adam on the augmented Lagrangian, clipped to the bounds. A step to a design without an admissible
# orbit of one cycle (beyond a fold, or where the body would pass through the stop) is halved until
# there is one. Every 20 steps the prices of the conditions are brought up to date.


# %%
OPTIMISER = optax.adam(optax.cosine_decay_schedule(0.02, STEPS))
propose = jax.jit(OPTIMISER.update)


class Ascent(NamedTuple):
    design: Any
    end: Outcome
    power: list[float]
    modulus: list[float]
    rejected: int


def climb(limit: float, reach: float) -> Ascent:
    force = none._replace(limit=jnp.array(limit, float), reach=jnp.array(reach, float))
    design, memory = first, OPTIMISER.init(first)
    (_, now), gradient = evaluate(design, origin, force)
    powers, moduli, rejected = [float(now.power)], [float(now.modulus)], 0
    for step in range(STEPS):
        if step % 20 == 19:
            price = jnp.maximum(0.0, force.price + force.weight * now.excess)
            force = force._replace(price=price)
        update, memory = propose(gradient, memory, design)
        for _ in range(12):
            trial = jnp.clip(design + update, 0.0, 1.0)
            (_, there), slope = evaluate(trial, now.orbit.state, force)
            if there.allowed and np.isfinite(slope).all():
                design, now, gradient = trial, there, slope
                break
            update, rejected = 0.5 * update, rejected + 1
        else:
            raise RuntimeError("No admissible orbit beside the last one.")
        powers.append(float(now.power))
        moduli.append(float(now.modulus))
    return Ascent(design, now, powers, moduli, rejected)


begun = time.perf_counter()
before = evaluate(first, origin, none)[0][1]
ascents = {name: climb(*limits) for name, limits in DESIGNS.items()}
tried = sum(STEPS + ascent.rejected for ascent in ascents.values())
per_step = (time.perf_counter() - begun) / tried
rejected = sum(ascent.rejected for ascent in ascents.values())
print(f"{tried} steps of {per_step * 1e3:.1f} ms, {rejected} of them rejected")

# %% [markdown]
# ## Two checks that use neither the search nor the gradient
#
# Direct simulation over 500 cycles, from rest and from random starts: do they come to the orbit,
# and is its power the one that was promised? And the closed form of all motions with one impact
# per cycle, on a grid of designs: is there a better one that the ascent did not see?


# %%
def loss(machine: vi.Parameters, speed: Any) -> Any:
    return 0.5 * machine.body_mass * (1 - machine.restitution**2) * speed**2


@jax.jit
def simulated(design: Any, Y: Any, V: Any) -> tuple[Any, Any, Any]:
    """State after 500 cycles, the power over the last 100 of them, and whether it got there."""
    machine = parameters(design)
    scene = machine.scene(drive="ideal")
    start = scene.start(Y=Y * (scene.stops[0].gap + 4.0) - 4.0, V=8.0 * V - 4.0)
    run = vi.simulate(scene, start, 500, method=vi.ExactFlight(), impact_log=4)
    assert run.impact_log is not None and run.duration is not None
    speed = machine.metres_per_second(jnp.nan_to_num(run.impact_log.speed[-100:]))
    last = jnp.stack([run.sections.Y[-1], run.sections.V[-1]])
    power = jnp.sum(loss(machine, speed)) / machine.seconds(jnp.sum(run.duration[-100:]))
    return last, power, run.successful


@jax.jit
def grid_power(force: Force, gap: Any, zetas: Any) -> Any:
    """Power of the best motion allowed at each frequency, at the least damping allowed."""

    def one(zeta):
        machine = eqx.tree_at(
            lambda p: (p.control, p.gap, p.damping), MACHINE, (zeta, gap, jnp.asarray(LOW[2]))
        )
        scene = machine.scene(drive="ideal")
        orbits = vi.closed_form_orbits(scene)
        power = loss(machine, machine.metres_per_second(orbits.impact_speed))
        power *= machine.radians_per_second(zeta) / (2 * jnp.pi)
        free = jnp.hypot(1 - zeta**2, 2 * scene.damping_ratio * zeta)
        good = orbits.admissible & (jnp.max(jnp.abs(orbits.multipliers), -1) <= force.limit)
        good = good & (scene.stops[0].gap * free <= force.reach)
        return jnp.max(jnp.where(good, power, -jnp.inf))

    return jax.vmap(one)(zetas)


lanes = jax.jit(jax.vmap(simulated, (None, 0, 0)))
STARTS = 32 if QUICK else 512
spread = jax.random.uniform(jax.random.key(0), (2, STARTS))
gaps = np.linspace(LOW[1], HIGH[1], 5 if QUICK else 61)
zetas = jnp.linspace(LOW[0], HIGH[0], 281)


def at_rest(design: Any) -> tuple[Any, Any]:
    """The place of Y = V = 0 among the random starts."""
    gap = parameters(design).scene(drive="ideal").stops[0].gap
    return 4.0 / (4.0 + gap), jnp.asarray(0.5)


def row(name: str, design: Any, end: Outcome) -> str:
    """One line of the table, with the checks made for it."""
    Y, V = at_rest(design)
    last, power, followed = lanes(design, spread[0].at[0].set(Y), spread[1].at[0].set(V))
    last, power, followed = np.asarray(last), np.asarray(power), np.asarray(followed)
    goal = np.array([end.orbit.state.Y, end.orbit.state.V])
    arrived = followed & (np.max(np.abs(last - goal), axis=1) < 1e-6)
    errors.append(float(np.max(np.abs(power[arrived] / float(end.power) - 1), initial=0.0)))
    machine, grid = parameters(design), ""
    if name in DESIGNS:
        limit, reach = (jnp.array(x, float) for x in DESIGNS[name])
        force = none._replace(limit=limit, reach=reach)
        best = max(float(jnp.max(grid_power(force, jnp.asarray(gap), zetas))) for gap in gaps)
        beaten.append(best > float(end.power))
        grid = f"{best:.3f}"
    speed = float(machine.metres_per_second(end.orbit.slowest_impact))
    room = float(machine.metres(end.orbit.clearance)) * 1e3
    cells = [
        name,
        f"{float(machine.control):.4f}",
        f"{float(machine.gap) * 1e3:.1f}",
        f"{float(machine.damping):.3f}",
        f"{float(end.power):.4f}",
        f"{float(end.modulus):.3f}",
        "no turn" if np.isinf(room) else f"{room:.2f}",
        f"{speed:.2f}",
        "yes" if arrived[0] else "no",
        f"{arrived.mean():.1%}",
        f"{np.mean(followed & (power == 0)):.1%}",
        f"{np.mean(~followed):.1%}",
        grid,
    ]
    return "| " + " | ".join(cells) + " |"


errors: list[float] = []
beaten: list[bool] = []
heads = [
    *("design", "ζ", "Δ, mm", "c, N·s/m", "power, W", "largest modulus", "clearance, mm"),
    *("V⁻, m/s", "from rest", "random starts", "never strike", "chatter", "grid, W"),
]
rows = [row("start", first, before)]
rows += [row(name, ascent.design, ascent.end) for name, ascent in ascents.items()]
table = "\n".join(["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads), *rows])
total = time.perf_counter() - BEGUN
print(table)

end_a, end_c = ascents["A"].end, ascents["C"].end
# Where the motion of A ends if the drive turns faster: the closed form finds it no more.
machine_a = parameters(ascents["A"].design)
faster = jnp.linspace(float(machine_a.control), LOW[0] + 1.0, zetas.size)
power_there = grid_power(none._replace(limit=jnp.array(np.inf)), jnp.asarray(machine_a.gap), faster)
fold = float(jnp.max(jnp.where(jnp.isfinite(power_there), faster, 0.0)))
gain = float(end_a.power / before.power)
report = f"""# Designing an impact machine by gradient

{table}

Ideal drive, k = {float(MACHINE.restitution):g}, masses and spring of Table 1; bounds ζ = \
{LOW[0]:g}…{HIGH[0]:g}, Δ = {LOW[1]:g}…{HIGH[1] * 1e3:g} mm, c = {LOW[2]:g}…{HIGH[2]:g} N·s/m. \
Motions have one impact per drive cycle; "no turn" says that the body turns back nowhere on its \
way to the stop. A: largest modulus of a multiplier at most 0.8. B: at most 0.5. C: at most 0.8, \
and the gap at most 95 % of the amplitude of the free motion. "Random starts" is the part of \
{STARTS} starts (Y from -4 to the stop, V from -4 to 4) that are within 1e-6 of the orbit after \
500 cycles of plain simulation; the others never strike, or end in chatter, which the simulator \
does not follow. "Grid" is the best motion of the closed form on {gaps.size} x {zetas.size} \
designs of the least damping.

The derivative of power and conditions through `find_orbit` differs from central differences by \
{gradient_error:.0e} of its size. {STEPS} steps take the paper's machine, whose multiplier of \
{float(before.modulus):.3f} breaks the condition at first, to {gain:.1f} times its power (A), with \
{rejected} steps rejected in all three ascents. The power over the last 100 of the 500 simulated \
cycles agrees with the promised one to {max(errors):.0e}, and the grid has a better design than \
A, B and C in {sum(beaten)} cases. Δ and c end on their bounds in A; only ζ is a compromise: \
towards ζ = {fold:.3f}, where the motion meets an unstable one in a fold and ends, the impacts \
weaken faster than they become more frequent. \
Motions with another number of impacts or another period were not searched.

Stability costs next to nothing here: at the optimum of A the modulus is \
{float(end_a.modulus):.3f}, so that the condition of 0.8 does not bind at all, and even 0.5 (B) \
costs {100 * float(1 - ascents["B"].end.power / end_a.power):.1g} % of the power. The price is \
paid elsewhere. A and B stand beside a motion that never touches the stop; from rest they go \
there, and the multipliers say nothing of it. Asked to start by itself (C) the machine gives \
{100 * float(end_c.power / end_a.power):.0f} % of the power of A, with a gap of \
{float(parameters(ascents["C"].design).gap) * 1e3:.0f} mm, and starts from everywhere it was \
tried but for the few that chatter.
"""
print(f"{total:.0f} s in all, {compile_seconds:.0f} s before the first step")

# %%
figure = Figure(figsize=(11.5, 3.9), layout="constrained")
power_axes, modulus_axes, portrait = figure.subplots(1, 3)
colours = {"start": "0.35", "A": RED, "B": ORANGE, "C": BLUE}
notes = {"A": "A: |μ| ≤ 0.8", "B": "B: |μ| ≤ 0.5", "C": "C: |μ| ≤ 0.8, self-starting"}
for name, ascent in ascents.items():
    style: dict[str, Any] = {"color": colours[name], "ls": "--" if name == "B" else "-"}
    power_axes.plot(ascent.power, label=notes[name], **style)
    modulus_axes.plot(ascent.modulus, **style)
power_axes.set(xlabel="step", ylabel="impact power (W)")
power_axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.72), fontsize=9)
for limit in sorted({limit for limit, _ in DESIGNS.values()}):
    modulus_axes.axhline(limit, color="0.6", lw=1, ls=":")
modulus_axes.set(xlabel="step", ylabel="largest |μ| (dimensionless)", ylim=(0.3, 0.95))
orbits = {"start": before.orbit, "A": ascents["A"].end.orbit, "C": ascents["C"].end.orbit}
for name, orbit in orbits.items():
    motion = vi.simulate(
        orbit.machine, orbit.state, 1, method=vi.ExactFlight(), samples=200, impact_log=4
    )  # fmt: skip
    path = motion_path(motion, machine=orbit.machine)
    portrait.plot(path.Y, path.V, color=colours[name], lw=1.3)
    gap = float(orbit.machine.stops[0].gap)
    portrait.axvline(gap, color=colours[name], lw=2.0, ls=(0, (4, 1.5)))
    portrait.text(
        gap, 0.98, f"stop of {name} ", transform=portrait.get_xaxis_transform(), rotation=90,
        ha="right", va="top", fontsize=8.5, color=colours[name],
    )  # fmt: skip
    left, inside = int(np.argmin(path.Y)), name == "start"
    portrait.annotate(
        name, (float(path.Y[left]), float(path.V[left])), (5 if inside else -5, 0),
        textcoords="offset points", ha="left" if inside else "right", va="center",
        color=colours[name],
    )  # fmt: skip
portrait.margins(x=0.1)
portrait.set(xlabel="Y = y/a", ylabel="V = dY/dτ (a ω)", ylim=(-4.6, 8.2))
for axes, title in zip(
    figure.axes, ("power", "stability (dotted: limits)", "motions and their stops"), strict=True
):
    axes.set_title(title)
    axes.grid(alpha=0.3)
numbers = {}
for name, design, end in (
    ("start", first, before),
    *((name, ascent.design, ascent.end) for name, ascent in ascents.items()),
):
    machine = parameters(design)
    numbers |= {
        f"{name}: ζ": float(machine.control),
        f"{name}: Δ, mm": float(machine.gap) * 1e3,
        f"{name}: c, N·s/m": float(machine.damping),
        f"{name}: power, W": float(end.power),
        f"{name}: largest modulus": float(end.modulus),
    }
if not QUICK:
    keep(HERE, "design_percussion", report.replace("\\\n", ""), numbers, figure)
