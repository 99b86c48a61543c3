"""The measurements of a method by `speed_accuracy.py`."""

import time
from typing import NamedTuple

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
    """The results of a method for all lanes."""

    states: np.ndarray
    """States on the sections, (lanes, cycles + 1, components of the state)."""
    phase: np.ndarray
    counts: np.ndarray
    y_min: np.ndarray
    good: np.ndarray


def observe(choice: Choice, drive: str, *, shift: float = 0.0) -> Seen:
    """Return the motion of all lanes."""

    def lane(method, ratio, shift):
        machine = machine_of(drive, ratio)
        start = machine.start(Y=shift)
        # With d = 2 no force holds the body on the stop, but a traced gap does not show this.
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
    """Return the largest difference in each lane; infinite if only one of two numbers is NaN."""
    apart = np.abs(a.astype(float) - b.astype(float)).reshape(len(a), -1)
    same = np.isnan(a.reshape(len(a), -1)) & np.isnan(b.reshape(len(b), -1))
    return np.where(same, 0, np.where(np.isfinite(apart), apart, np.inf)).max(axis=1)


def most(errors: np.ndarray) -> float:
    """Return the 95 % quantile of the lanes' errors."""
    return float(np.quantile(errors, 0.95, method="higher"))


def errors_of(seen: Seen, truth: Seen, calm: np.ndarray) -> dict[str, float]:
    """Return the errors over the calm lanes."""
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


def timed(choice: Choice, drive: str) -> Program:
    """Return a run of all lanes for the measurement of time."""

    def lane(method, ratio):
        machine = machine_of(drive, ratio)
        run = vi.simulate(
            machine, machine.start(), TIMED, method=method, record="sections", rests=False
        )
        return run.last

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
    """Return labels, and the seconds of a second run, which is compiled already."""
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
