"""What `speed_accuracy.py` measures of a method."""

import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import vi_jax as vi
from tools.study import QUICK

from .methods import MACHINES, Choice, Program, carried, machine_of, ratios

LANES, MANY, FEW, TIMED = (64, 60, 20, 20) if QUICK else (256, 1000, 20, 200)
GRID = 8 if QUICK else 32


class Seen(NamedTuple):
    """What a method says of all lanes."""

    states: np.ndarray
    """(lanes, cycles + 1, parts of the state)"""
    phase: np.ndarray
    counts: np.ndarray
    y_min: np.ndarray
    good: np.ndarray


def observe(choice: Choice, drive: str, *, shift: float = 0.0) -> Seen:
    """The motion of all lanes."""

    def lane(method, ratio, shift):
        machine = machine_of(drive, ratio)
        start = machine.start(Y=shift)
        # With d = 2 nothing presses the body on, which a traced gap does not show.
        rests = {"method": method, "rests": False}
        long = vi.simulate(machine, start, MANY, record="sections", **rests)
        short = vi.simulate(machine, start, FEW, impact_log=3, **rests)
        assert short.impact_log is not None
        states = jnp.stack(jtu.tree_leaves(long.sections), axis=-1)
        return states, short.impact_log.phase, short.impacts, short.y_min, long.successful

    batch = jax.vmap(lane, in_axes=(None, 0, 0))
    program = carried(f"{drive} seen", choice, batch, ratios(LANES), np.full(LANES, shift))
    found = program.run()
    return Seen(*(np.asarray(x) for x in found))


def differ(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The largest difference in each lane; infinite where one of them is no number."""
    apart = np.abs(a.astype(float) - b.astype(float)).reshape(len(a), -1)
    same = np.isnan(a.reshape(len(a), -1)) & np.isnan(b.reshape(len(b), -1))
    return np.where(same, 0, np.where(np.isfinite(apart), apart, np.inf)).max(axis=1)


def most(errors: np.ndarray) -> float:
    """What 95 of 100 lanes stay under."""
    return float(np.quantile(errors, 0.95, method="higher"))


def errors_of(seen: Seen, truth: Seen, calm: np.ndarray) -> dict[str, float]:
    """Errors over the calm lanes."""
    counted = (seen.counts == truth.counts).all(axis=1)
    both = calm & counted
    few = differ(seen.states[:, FEW], truth.states[:, FEW])[calm]
    many = differ(seen.states[:, -1], truth.states[:, -1])[calm]
    return {
        "state": float(np.median(few)),
        "state95": most(few),
        "late": float(np.median(many)),
        "late95": most(many),
        "phase95": most(differ(seen.phase, truth.phase)[both]) if both.any() else np.inf,
        "extremes95": most(differ(seen.y_min, truth.y_min)[calm]),
        "counts": float(np.mean(~counted[calm])),
        "lost": float(np.mean(many > 1e-2)),
        "failed": float(np.mean(~seen.good)),
    }


def timed(choice: Choice, drive: str, *, alone: bool = False) -> Program:
    """A run of all lanes, or of one, for the clock."""

    def lane(method, ratio):
        machine = machine_of(drive, ratio)
        run = vi.simulate(
            machine, machine.start(), TIMED, method=method, record="sections", rests=False
        )
        return run.last

    if alone:
        return carried(f"{drive} alone", choice, lane, np.array(0.9))
    return carried(f"{drive} timed", choice, jax.vmap(lane, in_axes=(None, 0)), ratios(LANES))


AXES = {
    "ideal": {
        "drive.frequency_ratio": np.linspace(0.5, 1.9, GRID),
        "stops.0.restitution": np.linspace(0.1, 0.95, GRID),
    },
    "motor": {
        "drive.control": np.linspace(0.5, 1.9, GRID),
        "stops.0.restitution": np.linspace(0.1, 0.95, GRID),
    },
}


def regimes(choice: Choice, drive: str) -> tuple[np.ndarray, float]:
    """Labels, and the seconds of a second run."""
    with jax.enable_x64(choice.double):
        machine = jtu.tree_map(jnp.asarray, MACHINES[drive])
        axes = {name: x.astype(jnp.result_type(float)) for name, x in AXES[drive].items()}
        measure = vi.Regime(longest=16, observed=128, tolerance=1e-6 if choice.double else 1e-3)

        def once():
            begin = time.perf_counter()
            data = vi.scan(
                machine, axes, measure=measure, settle=60 if QUICK else 400, method=choice.method,
                progress=False,
            )  # fmt: skip
            labels = np.stack([data.period, np.where(data.period > 0, data.impacts, 0)])
            return labels, time.perf_counter() - begin

        once()
        return once()


def cycle(choice: Choice, drive: str, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One drive cycle from eight section states, and its derivatives by state and ζ (or κ)."""

    def one(method, ratio, state):
        def after(numbers):
            machine = machine_of(drive, numbers[-1])
            names = ("Y", "V", "W")[: state.size]
            start = machine.start(**dict(zip(names, numbers, strict=False)))
            run = vi.simulate(machine, start, 1, method=method, record="sections", rests=False)
            return jnp.stack(jtu.tree_leaves(run.last))

        numbers = jnp.append(state, ratio)
        return after(numbers), jax.jacfwd(after)(numbers)

    batch = jax.vmap(one, in_axes=(None, 0, 0))
    after, slope = carried(f"{drive} cycle", choice, batch, ON, states).run()
    return np.asarray(after), np.asarray(slope)


ON = np.linspace(1.05, 1.4, 8)


def orbit_of(
    choice: Choice, drive: str, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The 2π motions near `states` by Newton's method: states, multipliers, d(state)/dζ."""
    slope = matrix = np.empty(0)
    for _ in range(8):
        after, slope = cycle(choice, drive, states)
        matrix = np.eye(states.shape[1]) - slope[:, :, :-1]
        states = states + np.linalg.solve(matrix, (after - states)[..., None])[..., 0]
    multipliers = np.sort_complex(np.linalg.eigvals(slope[:, :, :-1]))
    return states, multipliers, np.linalg.solve(matrix, slope[:, :, -1:])[..., 0]


def guesses(drive: str) -> np.ndarray:
    """The closed forms of the ideal drive."""
    machines = [vi.Scene.ideal(frequency_ratio=x, restitution=0.8) for x in ON]
    found = [vi.closed_form_orbits(machine, cycles=1) for machine in machines]
    states = np.array([[float(x.Y[0]), float(x.V[0])] for x in found])
    return states if drive == "ideal" else np.column_stack([states, ON])


def undamped(machine: vi.Scene) -> vi.Scene:
    """Without damping there is more chaos."""
    return eqx.tree_at(lambda s: s.oscillator.damping_ratio, machine, jnp.zeros(()))


def horizon(
    choice: Choice, drive: str, at: float, truth: np.ndarray | None
) -> tuple[np.ndarray, float]:
    """States of 32 starts at one ζ (or κ), and the median cycle at which they leave the truth."""

    def lane(method, ratio, Y):
        machine = undamped(machine_of(drive, ratio))
        run = vi.simulate(
            machine, machine.start(Y=Y), 200, method=method, record="sections", rests=False
        )
        return jnp.stack([run.sections.Y, run.sections.V], axis=-1)

    batch = jax.vmap(lane, in_axes=(None, 0, 0))
    lanes = np.full(32, at), np.linspace(-1, 1, 32)
    found = np.asarray(carried(f"{drive} chaos", choice, batch, *lanes).run())
    if truth is None:
        return found, np.nan
    apart = np.abs(found - truth).max(axis=-1)
    apart = np.where(np.isfinite(apart), apart, np.inf)
    first = np.where((apart > 1e-3).any(axis=1), (apart > 1e-3).argmax(axis=1), 200)
    return found, float(np.median(first))


def most_chaotic(drive: str) -> tuple[float, float]:
    """The ζ or κ of the greatest Lyapunov exponent (unit: ω), and that exponent."""
    name = next(iter(AXES[drive]))
    values = np.linspace(0.5, 1.9, 15 if QUICK else 141)
    machine = undamped(jtu.tree_map(jnp.asarray, MACHINES[drive]))
    data = vi.scan(machine, {name: values}, measure=vi.Exponent(), settle=200, progress=False)
    best = int(np.argmax(data.exponent.values))
    return float(values[best]), float(data.exponent[best])
