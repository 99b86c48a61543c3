# %% [markdown]
# # Regimes beside long runs
#
# The measure `"regime"` names the motion of 1,000 random lanes: 200 of each of five machines. Each
# lane is then run for another 20,000 cycles. A chaotic motion grows by e²⁰ and more in that time. A
# torus neither grows nor decays (on one without losses neighbours drift apart in proportion to the
# time), and no section of it is the first one again. The limits of the measure were chosen with
# other lanes and partly other machines.
#
# Run with `python experiments/benchmarks/regimes.py` (`--quick`: 8 lanes each, writes nothing).

# %%
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] if "__file__" in globals() else "experiments"))

import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from tools.study import QUICK, say
from tools.tables import table

LANES, SETTLE, LONG, SEED = (8, 2000, 20_000, 5) if QUICK else (200, 2000, 20_000, 5)


class Ring(vi.AbstractMachine):
    """r ← r (1 + b - r²), φ ← φ + 2πa + 0.3 r² once in a cycle, seen as (x, y + 0.7 x²)."""

    a: Any = 0.2
    b: Any = 0.1
    cycle = 1.0

    @property
    def events(self):
        return (vi.Reset(lambda machine, s, x: jnp.sin(2 * jnp.pi * (s - 0.5)), Ring.kicked),)

    def kicked(self, s, z):
        x, y = z.x, z.y - 0.7 * z.x**2
        square = x**2 + y**2
        turn, growth = 2 * jnp.pi * self.a + 0.3 * square, 1 + self.b - square
        c, s = jnp.cos(turn), jnp.sin(turn)
        x, y = growth * (c * x - s * y), growth * (s * x + c * y)
        return vi.State(x=x, y=y + 0.7 * x**2)

    def field(self, s, z):
        return dict(x=0.0 * z.x, y=0.0 * z.y)


class Driven(vi.Mechanical):
    """A machine whose cycle is that of a drive."""

    omega: Any = 1.0

    @property
    def cycle(self):
        return 2 * jnp.pi / self.omega


class Row(Driven):
    """Two bodies in a row; the first is driven and strikes a stop."""

    q = ("a", "b")
    mass = 1.0, 0.5
    gap: Any = 1.1

    def force(self, t, q, v):
        link = q.a - q.b + 0.05 * (v.a - v.b)
        return dict(a=jnp.cos(self.omega * t - 2) - q.a - 0.1 * v.a - link, b=link)

    @property
    def contacts(self):
        return vi.RigidStop(self.gap, 0.8, on="a")


class Coupled(Driven):
    """Two coupled van der Pol oscillators; the first one is driven."""

    q = ("x", "y")
    mass = 1.0, 1.0
    coupling: Any = 0.3

    def force(self, t, q, v):
        link = self.coupling * (q.x - q.y)
        first = 0.3 * (1 - q.x**2) * v.x - q.x + 0.6 * jnp.cos(self.omega * t) - link
        return dict(x=first, y=0.3 * (1 - q.y**2) * v.y - 1.35**2 * q.y + link)


def _scene(damping: float) -> vi.Scene:
    return vi.Scene.ideal(frequency_ratio=0.9, restitution=0.8, gap=2.0, damping_ratio=damping)


# For each machine: its name, itself, a start, and the ranges of its parameters.
UNDAMPED, DAMPED = _scene(0.0), _scene(0.02)
RATIO, GAP, RESTITUTION = "drive.frequency_ratio", "stops.0.gap", "stops.0.restitution"
MACHINES: Any = (
    ("map of a ring", Ring(), vi.State(x=0.3, y=0.1), {"a": (0, 1), "b": (-0.2, 1.6)}),
    ("two bodies with a stop", Row(), Row().at(), {"omega": (0.95, 1.03), "gap": (1.0, 1.2)}),
    (
        "two coupled van der Pol oscillators", Coupled(), Coupled().at(x=0.5, y=-0.3),
        {"omega": (0.7, 1.6), "coupling": (0.05, 0.5)},
    ),
    (
        "oscillator with a stop, undamped", UNDAMPED, UNDAMPED.start(),
        {RATIO: (0.6, 1.5), GAP: (1.0, 3.0), RESTITUTION: (0.5, 1.0)},
    ),
    (
        "oscillator with a stop, damped", DAMPED, DAMPED.start(),
        {RATIO: (0.6, 1.5), GAP: (0.0, 3.0), RESTITUTION: (0.5, 0.95)},
    ),
)  # fmt: skip

# Growth over the long run, as a logarithm: more is chaos, less is a motion that attracts. Between
# them is the drift without losses, ln 20,000 = 9.9.
GROWS, FALLS, DRIFTS = 20.0, -1.0, 12.0


def longer(machine: Any, start: Any, axes: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return for each lane the logarithm of the growth over the long run, and the distance of the
    nearest of 4,095 sections from the one after them."""
    data = vi.scan(
        machine, axes, start=start, measure=(vi.Exponent(LONG), vi.Sections(4096)),
        settle=SETTLE + 6400, paired=True, progress=False,
    )  # fmt: skip
    omega = axes.get("omega", axes.get(RATIO))  # of the drive; the ring's map has cycles of 1
    cycle = 1.0 if omega is None else 2 * np.pi / omega
    sections = [x.values for x in data.values() if "cycle" in x.dims]
    rows = np.stack(sections, axis=-1)
    nearest = np.abs(rows[:, :-1] - rows[:, -1:]).max(axis=-1).min(axis=-1)
    return data.exponent.values * LONG * cycle, nearest


# %%
def main() -> None:
    rng, kinds = np.random.default_rng(SEED), ("torus", "chaotic", "other")
    labels = ("quasi-periodic", "chaotic", "transient", "unsettled", "failed", "periodic")
    counts, tori = {kind: dict.fromkeys(labels, 0) for kind in kinds}, []
    names = {"quasiperiodic": "quasi-periodic"}
    codes = {int(x): names.get(x.name, x.name) for x in vi.REGIMES}
    for name, machine, start, ranges in MACHINES:
        axes = {leaf: rng.uniform(low, high, LANES) for leaf, (low, high) in ranges.items()}
        data = vi.scan(
            machine, axes, start=start, measure="regime", settle=SETTLE, paired=True,
            progress=False,
        )  # fmt: skip
        growth, nearest = longer(machine, start, axes)
        chaotic = growth > GROWS
        torus = (growth > FALLS) & (growth < DRIFTS) & (nearest > 1e-9)
        truth = np.select([torus, chaotic], kinds[:2], kinds[2])
        found = np.array([codes.get(int(p), "periodic") for p in data.period.values])
        for kind, label in zip(truth, found, strict=True):
            counts[kind][label] += 1
        right = int(np.sum((truth == "torus") & (found == "quasi-periodic")))
        tori.append([name, int(np.sum(truth == "torus")), right])
        wrong = np.flatnonzero((truth != "torus") & (found == "quasi-periodic"))
        say(f"{name}: {tori[-1][1]} tori, {right} recognised, {wrong.size} wrong {growth[wrong]}")
    if QUICK:
        return
    rows = [[f"{sum(x.values())} {kind}", *x.values()] for kind, x in counts.items()]
    text = f"""# Regimes beside long runs

Labels of the measure `"regime"` (columns) of {LANES} random lanes of each of five machines, after
{SETTLE:,} cycles. The rows are results of a run of another {LONG:,} cycles: chaos grows by e²⁰ and
more; a torus does not grow, but for a drift in proportion to the time, and does not repeat; others
repeat, settle, or do neither.

{table(["lanes", *labels], rows)}

{table(["machine", "tori", "recognised"], tori)}
"""
    Path(__file__).with_suffix(".md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
