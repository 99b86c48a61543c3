# %% [markdown]
# # The 2π and the 4π motion before a stop that gives way
#
# Undamped, ideally driven at ζ = 0.9 with d = 2 and k = 0.5, the machine has a 2π motion that is
# unstable and a 4π motion that attracts, if its stop is rigid and an impact takes no time. Here the
# stop is compliant: it pushes back while the body penetrates, with a dashpot that belongs to the
# same restitution. From what stiffness on is it the same as with the rigid stop?
#
# Run with `python experiments/studies/soft_stop.py` (`--quick` for a few stiffnesses only).

# %%
import sys
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from vi_jax.plot.colors import BLUE, GREEN, RED

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import panels
from tools.study import QUICK, write
from tools.tables import table

STIFFNESS = np.logspace(1, 6, 11 if QUICK else 51)
NEAR = np.logspace(1.8, 2.4, 6 if QUICK else 61)  # where the two motions part


# %% [markdown]
# ## The laws
#
# A dashpot may pull at the end of its stroke; or the stop lets go where its force has fallen to
# zero, and keeps a higher speed with the same dashpot. Here each has the one that makes the
# restitution 0.5, which neither law changes with the speed.


# %%
def kept(damping: float, exponent: float) -> float:
    """Restitution of a stop that lets go where its force is zero, in units of its own."""

    def force(depth, rate):
        depth = max(depth, 0.0)
        return depth**exponent + damping * depth ** (0.5 * (exponent - 1)) * rate

    def released(t, x):
        return force(*x) if t > 1e-3 else 1.0

    setattr(released, "terminal", True)  # noqa: B010
    flight = solve_ivp(
        lambda t, x: [x[1], -force(*x)], (0, 20), [0.0, 1.0], method="DOP853", rtol=1e-12,
        atol=1e-13, events=released,
    )  # fmt: skip
    return -float(flight.y[1, -1])


def damping(exponent: float) -> float:
    """The dashpot that gives it a restitution of one half."""
    half = brentq(lambda x: kept(x, exponent) - 0.5, 0.1, 2.0, xtol=1e-12)
    return float(half)  # pyright: ignore[reportArgumentType]


LAWS = {
    "spring and dashpot": {"restitution": 0.5},
    "the same, never pulling": {"damping": damping(1.0), "adhesive": False},
    "Hertz, never pulling": {"damping": damping(1.5), "adhesive": False, "exponent": 1.5},
}
COLOURS = dict(zip(LAWS, (BLUE, GREEN, RED), strict=True))

rigid = vi.Scene.ideal(frequency_ratio=0.9, restitution=0.5, gap=2.0, damping_ratio=0.0)
CLOSED = {cycles: vi.closed_form_orbits(rigid, cycles=cycles) for cycles in (1, 2)}


def machine(law: str, stiffness: float) -> vi.Scene:
    """The machine with a compliant stop, its stiffness in units of the body's own spring."""
    stop = vi.SoftStop(2.0, stiffness, **LAWS[law])
    return vi.Scene(oscillator=vi.Oscillator(0.0), drive=vi.IdealDrive(0.9), soft_stops=(stop,))


# %% [markdown]
# ## Both motions, from the rigid stop to soft ones
#
# Beginning with the closed forms, each motion is a guess for the next softer stop. Where the 4π
# motion grazes the stop and so changes quickly, the guess is what a run from rest comes to.


# %%
class Found(NamedTuple):
    stiffness: float
    state: np.ndarray
    multipliers: np.ndarray
    depth: float
    """Greatest penetration (unit: a)."""


def motions(law: str, cycles: int) -> list[Found]:
    """One motion at falling stiffnesses, as far as it goes; the 4π motion to its grazing."""
    closed, found = CLOSED[cycles], []
    guess = rigid.start(Y=float(closed.Y[0]), V=float(closed.V[0]))
    for stiffness in STIFFNESS[::-1]:
        if cycles == 2 and stiffness < NEAR[-1]:
            break
        orbit = vi.find_orbit(machine(law, stiffness), guess, cycles=cycles, throw=True)
        guess = orbit.state
        found.append(described(stiffness, orbit))
    return found[::-1]


def described(stiffness: float, orbit: vi.Orbit) -> Found:
    state = np.array([float(orbit.state.Y), float(orbit.state.V)])
    return Found(stiffness, state, np.asarray(orbit.multipliers), float(orbit.y_max) - 2)


def attracted(law: str) -> list[Found]:
    """The 4π motion near where it parts from the 2π motion."""

    @jax.jit
    @jax.vmap
    def last(stiffness):
        there = machine(law, stiffness)
        run = vi.simulate(there, there.start(), 2, settle=1000, method="reference")
        # Of the two sections of the motion the one with the greater Y.
        place = jnp.argmax(run.sections.Y[:2])
        return jax.tree.map(lambda x: x[place], run.sections)

    states, found = last(jnp.asarray(NEAR)), []
    for i, stiffness in enumerate(NEAR):
        guess = rigid.start(Y=float(states.Y[i]), V=float(states.V[i]))
        orbit = vi.find_orbit(machine(law, stiffness), guess, cycles=2)
        if bool(orbit.successful) and int(orbit.cycles) == 2:
            found.append(described(stiffness, orbit))
    return found


def doubling(law: str, found: list[Found]) -> float:
    """Stiffness at which the 2π motion's least multiplier is -1."""
    least = np.array([np.min(np.real(x.multipliers)) for x in found])
    place = int(np.flatnonzero(least > -1)[-1])
    guess = rigid.start(Y=found[place].state[0], V=found[place].state[1])

    def excess(exponent):
        orbit = vi.find_orbit(machine(law, 10.0**exponent), guess, throw=True)
        return float(np.min(np.real(orbit.multipliers))) + 1

    low, high = (np.log10(found[i].stiffness) for i in (place, place + 1))
    root = brentq(excess, low, high, xtol=1e-12)
    return 10.0 ** float(root)  # pyright: ignore[reportArgumentType]


begin = time.perf_counter()
orbits = {(law, cycles): motions(law, cycles) for law in LAWS for cycles in (1, 2)}
for law in LAWS:
    orbits[law, 2] = attracted(law) + orbits[law, 2]
limit = {law: doubling(law, orbits[law, 1]) for law in LAWS}
print(f"motions: {time.perf_counter() - begin:.0f} s", limit, flush=True)

# %% [markdown]
# ## Where the machine goes from rest


# %%
@partial(jax.jit, static_argnames="law")
def from_rest(law: str, stiffness: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whether a run from rest ends in a 2π motion, and whether it repeats after two cycles."""

    def one(stiffness):
        there = machine(law, stiffness)
        run = vi.simulate(there, there.start(), 4, settle=400, method="reference")
        far = [jnp.abs(run.sections.Y[n:] - run.sections.Y[:-n]).max() for n in (1, 2)]
        return run.successful & (far[0] < 1e-6), run.successful & (far[1] < 1e-6)

    return jax.vmap(one)(stiffness)


CHECKED = [20.0, 50.0, 150.0, 500.0, 2e3, 1e4]
ends = {law: [np.asarray(x) for x in from_rest(law, jnp.asarray(CHECKED))] for law in LAWS}


def seen(law: str, i: int) -> str:
    once, twice = (bool(x[i]) for x in ends[law])
    return "2π" if once else "4π" if twice else "neither"


# %% [markdown]
# ## Tables


# %%
def critical(law: str) -> tuple[np.ndarray, np.ndarray]:
    found = orbits[law, 1]
    return (
        np.array([x.stiffness for x in found]),
        np.array([np.min(np.real(x.multipliers)) for x in found]),
    )


MULTIPLIER = float(np.min(np.real(CLOSED[1].multipliers[0])))
rows = []
slopes = {}
for law in LAWS:
    K = critical(law)[0]
    place = np.array([x.state[0] for x in orbits[law, 1]])
    away = np.log(np.abs(place - float(CLOSED[1].Y[0])))
    slopes[law] = float(np.polyfit(np.log(K[K >= 1e4]), away[K >= 1e4], 1)[0])
    depths = [x.depth for x in orbits[law, 1]]
    depth = float(np.interp(np.log(limit[law]), np.log(K), depths))
    rows.append((law, f"{limit[law]:.4f}", f"{depth:.3f}", f"{slopes[law]:.3f}"))
heads = ["law", "2π loses its stability at K", "its depth there", "slope of the change in Y by K"]
doublings = table(heads, rows)
runs = table(
    ["from rest", *(f"K = {K:g}" for K in CHECKED)],
    [(law, *(seen(law, i) for i in range(len(CHECKED)))) for law in LAWS],
)
print(doublings, runs, sep="\n")

# %% [markdown]
# ## Figure

# %%
figure, (left, right) = panels(10.5, 4.4, 1, 2)
for law, colour in COLOURS.items():
    K, least = critical(law)
    left.semilogx(K, least, color=colour, label=law)
    left.plot(limit[law], -1, "o", color=colour)
    left.semilogx(
        [x.stiffness for x in orbits[law, 2]],
        [np.abs(x.multipliers).max() for x in orbits[law, 2]],
        color=colour, ls=":",
    )  # fmt: skip
    place = np.array([x.state[0] for x in orbits[law, 1]])
    holds = least > -1
    right.semilogx(np.where(holds, K, np.nan), place, color=colour, label=law)
    right.semilogx(np.where(holds, np.nan, K), place, color=colour, ls="--")
    twice = orbits[law, 2]
    right.semilogx([x.stiffness for x in twice], [x.state[0] for x in twice], color=colour)
    right.plot(limit[law], np.interp(limit[law], K, place), "o", color=colour)
left.axhline(-1, color="0.5", lw=0.8)
left.axhline(MULTIPLIER, color="k", lw=0.8, ls="--")
left.set_ylabel("multiplier")
left.set_title("2π: the least multiplier; dotted: 4π, the largest modulus", fontsize=10)
for axes in (left, right):
    axes.set_xlabel("stiffness K of the stop (unit: the body's own spring)")
    axes.grid(alpha=0.3)
for cycles, kind in ((1, "--"), (2, "-")):
    right.axhline(float(CLOSED[cycles].Y[0]), color="k", lw=0.8, ls=kind)
right.set_ylabel("Y on the section φ = 0 (unit: a)")
right.set_title("2π (upper) and 4π; dashed: unstable; black: rigid stop", fontsize=10)
left.legend(fontsize=9, loc="center right")

greatest, linear = max(limit.values()), limit["spring and dashpot"]
text = f"""# The 2π and the 4π motion before a stop that gives way

Ideal drive, undamped, ζ = 0.9, d = 2; a compliant stop with the force K δᵖ and a dashpot that
makes the restitution k = 0.5; K in units of the body's own spring. With the rigid stop the 2π
motion is unstable (least multiplier {MULTIPLIER:.6f}) and the 4π motion attracts.

![multipliers and sections](../figures/soft_stop.png)

{doublings}

- The rigid stop's result holds for stops stiffer than about {greatest:.0f} (in these units), by
  whichever law: the 2π motion is unstable there, the 4π motion exists and attracts. At the
  stiffness in the table the two meet in a period doubling; before a softer stop the 2π motion
  attracts, and no 4π motion was found beside it. Near there the 4π motion changes quickly, before
  linear stops up to K ≈ 85 and before Hertz's up to 150; beyond, it is the rigid stop's.
- What compliance changes (Y on the section of the 2π motion, K > 10⁴) falls with the time in
  contact, as K^(-1/2) for the spring and dashpot and
  as K^(-2/5) for Hertz's contact.
- A compliant stop so explains a 2π motion in the place of the 4π motion only if it is that soft:
  with the spring of Table 1 (88.8 N/m), below {linear * 88.8 / 1000:.1f} kN/m for a linear stop,
  where the body penetrates by more than the depth in the table (unit: the crank's radius).
- Runs from rest, 400 cycles later, say the same:

{runs}
"""
numbers = {f"K at the doubling, {law}": limit[law] for law in LAWS}
numbers["multiplier of the 2π motion at K = 1000, spring and dashpot"] = float(
    np.interp(3.0, np.log10(critical("spring and dashpot")[0]), critical("spring and dashpot")[1])
)
print(f"all: {time.perf_counter() - begin:.0f} s")
write("soft_stop", text, numbers, figure)
