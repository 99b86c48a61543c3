# %% [markdown]
# # Three machines that are shaken at random
#
# A harvester in a vehicle, two gears under a torque that trembles, a relief valve in a noisy flow:
# what noise costs or brings, beside closed forms where there are some.
#
# Run with `python experiments/studies/noise.py` (`--quick` for fewer, writes nothing).

# %%
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.linalg import solve_continuous_lyapunov

jax.config.update("jax_enable_x64", True)

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))
from tools.pictures import gridded, open_frames, panels
from tools.study import QUICK, say, write
from tools.tables import table

PATHS = 16 if QUICK else 128
CYCLES = 50 if QUICK else 300
CYCLE = 2 * np.pi


def scanned(machine: Any, axes: dict, measure: Any, amplitude: dict, start: Any, **options: Any):
    """Lanes of their own paths at each point of the axes."""
    given: dict[str, Any] = {"settle": 40, "cycles": CYCLES, "progress": False, **options}
    noise = vi.WhiteNoise(amplitude, impulses=16)
    axes = {**axes, "noise.path": np.arange(PATHS)}
    return vi.scan(
        machine, axes, start=start, measure=measure, noise=noise, key=jax.random.key(7), **given
    )


def mean_of(lanes: Any) -> tuple[Any, Any]:
    """The mean over paths, and its standard error from the scatter of theirs."""
    count = lanes.sizes["noise.path"]
    return (
        lanes.mean("noise.path").values,
        lanes.std("noise.path", ddof=1).values / count**0.5,
    )


# %% [markdown]
# ## A harvester under band-limited vibration
#
# A mass on a spring, its electrical damper, and two stops. Its base is accelerated by a band of
# noise: white noise through a filter, two states of the machine, of centre Ω and width 2β.


# %%
class Harvester(vi.AbstractMachine):
    """x'' + 2(ζm + ζe) x' + x = -w between the stops at ±gap; z' = w, w' = -Ω² z - 2β w + noise."""

    centre: jax.Array
    gap: jax.Array
    width: float = 0.1
    restitution: float = 0.6
    mechanical: float = 0.01
    electrical: float = 0.03

    @property
    def cycle(self) -> float:
        """That of the mass on its spring."""
        return CYCLE

    @property
    def contacts(self) -> tuple[vi.RigidStop, ...]:  # pyright: ignore
        return tuple(vi.RigidStop(self.gap, self.restitution, side) for side in ("right", "left"))

    def field(self, s: Any, x: Any) -> Any:
        loss = 2 * (self.mechanical + self.electrical)
        filtered = -(self.centre**2) * x["z"] - 2 * self.width * x["w"]
        return {"Y": x["V"], "V": -x["Y"] - loss * x["V"] - x["w"], "z": x["w"], "w": filtered}

    def averages(self, s: Any, x: Any) -> dict[str, Any]:
        loss = 2 * (self.mechanical + self.electrical)
        power = {"power": 2 * self.electrical * x["V"] ** 2}
        return {**power, "taken": -x["w"] * x["V"], "damped": loss * x["V"] ** 2}

    def position(self, state: Any) -> Any:
        return state["Y"]

    def velocity(self, state: Any) -> Any:
        return state["V"]

    def placed(self, state: Any, Y: Any, V: Any) -> Any:
        return {**state, "Y": Y, "V": V}


def linear_power(machine: Harvester, centre: float) -> float:
    """Without stops, by Lyapunov's equation."""
    loss = 2 * (machine.mechanical + machine.electrical)
    flow = np.array(
        [[0, 1, 0, 0], [-1, -loss, 0, -1], [0, 0, 0, 1], [0, 0, -(centre**2), -2 * machine.width]]
    )
    brought = np.zeros((4, 4))
    brought[3, 3] = 4 * machine.width  # so that w has the variance 1
    return 2 * machine.electrical * solve_continuous_lyapunov(flow, -brought)[1, 1]


harvester = Harvester(  # pyright: ignore[reportCallIssue]
    centre=jnp.array(1.0), gap=jnp.array(2.0)
)
centres = np.linspace(0.6, 1.8, 3 if QUICK else 13)
gaps = np.array([2.0, 4.0, 1000.0])
zero = jnp.array(0.0)
still = {"Y": zero, "V": zero, "z": zero, "w": zero}
names = ("power", "taken", "damped", "impact_energy")
shaken = scanned(
    harvester, {"gap": gaps, "centre": centres}, tuple(vi.Statistics(x) for x in names),
    {"w": (4 * harvester.width) ** 0.5}, still,
)  # fmt: skip
power, power_error = mean_of(shaken.power_mean)
linear = np.array([linear_power(harvester, x) for x in centres])
off_theory = np.abs(power[-1] - linear) / power_error[-1]
left = shaken.taken_mean - shaken.damped_mean - shaken.impact_energy_mean / CYCLE
balance, balance_error = mean_of(left)
off_balance = np.abs(balance) / balance_error
say("harvester")

# %% [markdown]
# ## Gears that rattle
#
# A load presses one tooth on its flank, across a play of 1; the torque trembles. With a loss at
# impacts there is no closed form, without it there is the barometric law.


# %%
class Gears(vi.AbstractMachine):
    """x'' = -load - 0.2 x' + noise between the flanks at x = 0, which carries the load, and 1."""

    restitution: jax.Array
    load: float = 1.0

    @property
    def cycle(self) -> float:
        """A unit to count by."""
        return CYCLE

    @property
    def contacts(self) -> tuple[vi.RigidStop, ...]:  # pyright: ignore
        flanks = ((0.0, "left"), (1.0, "right"))
        return tuple(vi.RigidStop(place, self.restitution, side) for place, side in flanks)

    def field(self, s: Any, x: Any) -> Any:
        return vi.OscillatorState(x.V, -self.load - 0.2 * x.V)


def crosses(machine: Any, run: Any) -> Any:
    """Whether the far flank is hit in a cycle."""
    return jnp.where(run.y_max > 1.0 - 1e-9, 1.0, 0.0)


def barometric(temperature: Any) -> tuple[Any, Any]:
    """Impacts per unit time on both flanks of elastic gears, and on the far one."""
    near = 1 / temperature / -np.expm1(-1 / temperature) * np.sqrt(temperature / (2 * np.pi))
    far = near * np.exp(-1 / temperature)
    return near + far, far


trembles = np.geomspace(0.2, 0.6, 3 if QUICK else 7)
losses = np.array([0.7, 0.9, 1.0])
gears = scanned(
    Gears(restitution=jnp.array(0.7)),  # pyright: ignore[reportCallIssue]
    {"restitution": losses, "noise.V": trembles},
    (vi.Statistics("impacts"), vi.Statistics(crosses)), {"V": 1.0},
    vi.OscillatorState(jnp.array(0.01), zero),
)  # fmt: skip
hits, hits_error = (x / CYCLE for x in mean_of(gears.impacts_mean))
rattle, rattle_error = mean_of(gears.crosses_mean)
temperature = trembles**2 / 0.4
both, _ = barometric(temperature)
off_law = np.abs(hits[-1] - both) / hits_error[-1]
say("gears")

# %% [markdown]
# ## A relief valve whose flow trembles
#
# Above the flow rate q = 7.557 the open valve oscillates without touching its seat. Noise makes it
# do so now and then: how often, and how long it goes on.

# %%
INTERVAL = 2.5
rates = np.array([7.7, 7.9, 8.1])
levels = np.geomspace(0.25, 1.0, 3 if QUICK else 7)
plain = vi.machines.ReliefValve(flow_rate=7.8)  # pyright: ignore[reportCallIssue]
open_valve = vi.simulate(plain, plain.start(), 1, settle=400).last
valves = scanned(
    plain.observed_every(INTERVAL), {"flow_rate": rates, "noise.speed": levels},
    (vi.Escape("impacts", high=0.5), vi.Statistics("impacts")), {"speed": 1.0}, open_valve,
    settle=100,
)  # fmt: skip
escapes = vi.escape_rate(valves, "noise.path")
seat, _ = mean_of(valves.impacts_mean)
say("valve")

# %% [markdown]
# ## Tables and figure

# %%
first = table(
    ["centre Ω", *(f"gap {x:g}" for x in gaps[:-1]), "no stops", "Lyapunov's equation"],
    [
        [f"{x:.2f}", *(f"{a:.5f} ± {b:.5f}" for a, b in zip(p, e, strict=True)), f"{t:.5f}"]
        for x, p, e, t in zip(centres, power.T, power_error.T, linear, strict=True)
    ],
)
second = table(
    ["σ", *(f"e = {x:g}" for x in losses), "barometric law, e = 1"],
    [
        [f"{x:.3f}", *(f"{a:.4f} ± {b:.4f}" for a, b in zip(p, e, strict=True)), f"{t:.4f}"]
        for x, p, e, t in zip(trembles, hits.T, hits_error.T, both, strict=True)
    ],
)
third = table(
    ["σ", *(f"q = {x:g}: first touch, all" for x in rates)],
    [
        [f"{x:.3f}", *(f"{a:.5f}, {b:.5f}" for a, b in zip(p, h, strict=True))]
        for x, p, h in zip(levels, escapes.rate.values.T / INTERVAL, seat.T / INTERVAL, strict=True)
    ],
)
print(first, second, third, sep="\n\n")
print(off_theory, off_balance.max(), off_law)

colors = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
figure, (left_pane, middle, right) = panels(12.5, 4.2, 1, 3)
for i, color in zip((2, 1, 0), colors[:3], strict=True):
    label = "no stops" if gaps[i] > 100 else f"stops at ±{gaps[i]:g}"
    left_pane.errorbar(
        centres, power[i], 2 * power_error[i], fmt="o", ms=4, color=color, label=label
    )
fine = np.linspace(centres[0], centres[-1], 200)
theory = [linear_power(harvester, x) for x in fine]
left_pane.plot(fine, theory, "-", lw=1, color=colors[0], label="Lyapunov's equation")
left_pane.set(xlabel="centre of the band Ω", ylabel="harvested power", yscale="log")
for i, color in zip(range(len(losses)), colors, strict=False):
    label = f"e = {losses[i]:g}"
    middle.errorbar(
        1 / temperature, rattle[i], 2 * rattle_error[i], fmt="o-", ms=4, lw=0.8, color=color,
        label=label,
    )  # fmt: skip
middle.set(
    xlabel="0.4/σ², load × play over temperature", yscale="log", ylim=(1e-4, 1.3),
    ylabel="share of cycles in which the far flank is hit",
)  # fmt: skip
for i, color in zip(range(len(rates)), colors, strict=False):
    x = levels**-2.0
    low, best, high = (escapes[k].values[i] / INTERVAL for k in ("rate_low", "rate", "rate_high"))
    seen = best > 0
    right.errorbar(
        x[seen], best[seen], [(best - low)[seen], (high - best)[seen]], fmt="o-", ms=4, lw=0.8,
        color=color, label=f"q = {rates[i]:g}",
    )  # fmt: skip
right.set(xlabel="1/σ²", yscale="log", ylabel="first touches of the seat per unit time")
gridded((left_pane, middle, right), ("Harvester", "Gears", "Relief valve"))
open_frames((left_pane, middle, right))
for pane in (left_pane, middle, right):
    pane.legend(frameon=False, fontsize=8)

# %%
peak, gain = int(np.argmax(power[-1])), int(np.argmax(power[0] / power[-1]))
mechanical, electrical, width = (
    f"{x:g}" for x in (harvester.mechanical, harvester.electrical, 2 * harvester.width)
)
some = len(trembles) // 2
range_of = [x.max() / x.min() for x in power]
text = f"""# Three machines that are shaken at random

White noise as 16 impulses in each cycle, {PATHS} paths of {CYCLES} cycles at each point; ± are
standard errors from the scatter of paths.

![Harvested power, rattling gears, a valve that touches its seat](../figures/noise.png)

## A harvester under band-limited vibration

A mass on a spring between stops at ±gap (restitution {harvester.restitution:g}), ζ = {mechanical}
and, of the generator, {electrical}; its base has the acceleration w of variance 1, in a band of the
centre Ω and the width {width}: white noise through a filter, z' = w,
w' = -Ω² z - {width} w + noise. Units are those of the mass on its spring.

- Without stops the power agrees with Lyapunov's equation: the largest of {len(centres)} differences
  is {off_theory.max():.1f} standard errors. With them, what the base gives is what dampers and
  impacts take, at all {balance.size} points: the largest difference is {off_balance.max():.1f}
  standard errors.
- Stops cost power where the band holds the resonance: at Ω = {centres[peak]:g} those at
  ±{gaps[0]:g} leave {power[0][peak] / power[-1][peak]:.0%} of it. But they make the machine care
  less where the band lies: over all centres its power varies by a factor of {range_of[0]:.1f},
  without stops of {range_of[-1]:.0f}.
- Above the resonance stops bring power, as motions with impacts are faster: at
  Ω = {centres[gain]:g} those at ±{gaps[0]:g} give {power[0][gain] / power[-1][gain]:.2f} times what
  is had without.

Harvested power:

{first}

## Gears that rattle

x'' = -1 - 0.2 x' + σ dW between two flanks, 1 apart, of which the one at 0 carries the load.

- Elastic flanks obey the barometric law, exp(-x/D) with D = σ²/0.4: impacts per unit time within
  {off_law.max():.1f} standard errors at {len(trembles)} intensities.
- The far flank is hit at a rate that falls like exp(-load × play / D) without loss. With it the
  body is cooler, and the teeth cross far more rarely: at σ = {trembles[some]:.3f} in
  {rattle[-1][some]:.1%} of the cycles with e = 1, in {rattle[0][some]:.2%} with e = {losses[0]:g}.

Impacts per unit time (with loss they still grow with the number of impulses, see
[the limits](../../docs/limits.md)):

{second}

## A relief valve whose flow trembles

κ = 1.25, δ = 10, β = 20, r = 0.8; its lift oscillates above the seat, which it touches without
noise below q = 7.557 only ([relief_valve](relief_valve.md)). White noise acts on the speed of the
lift, 16 impulses in each {INTERVAL:g} units of time.

- At q = 7.9 and 8.1 the first touch comes at a rate that falls nearly like exp(-c/σ²). At q = 7.7,
  so near to the grazing, all of these intensities are large ones.
- The valve does not stay at its seat: it goes back to its oscillation, and comes again. There are
  hardly more touches in all than first ones per unit time.

First touches per unit time, and all impacts per unit time:

{third}
"""
at_one = int(np.argmin(np.abs(centres - 1)))
numbers = {
    "harvester, no stops, Ω = 1, power": float(power[-1][at_one]),
    "the same by Lyapunov's equation": linear_power(harvester, 1.0),
    f"gears, e = 1, σ = {trembles[-1]:g}, impacts per unit time": float(hits[-1][-1]),
}
write("noise", text, numbers, figure)
