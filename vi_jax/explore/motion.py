"""What the page shows of one motion: its course, its impacts, its regime and its multipliers.

Every number of the scene and of the start is traced, so that no other value is another program.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._messages import so_many
from .._programs import compiled
from .._types import State
from ..flow import RESULTS, Run, chosen, simulate
from ..machine import (
    AbstractMachine,
    adopt,
    cycles_in_words,
    is_autonomous,
    raveled,
    unit_of,
    with_unit,
)
from ..orbit import STABILITY, complex_in_words, cycle_map, multipliers_of, stability_of
from ..plot import MotionPath, motion_path
from ..scans import REGIMES, Regime, lyapunov, taken_along

WINDOW = 8
"""Drive cycles drawn as a motion."""

OBSERVED = 256
"""Drive cycles observed for the maps, the regime and the multipliers."""

# As for scans but shorter, for a slider: choices.
_REGIME = Regime(longest=32, observed=128, lasting=0)

# Samples of a cycle; impacts of one that are drawn, and that enter the impact map.
_SAMPLES, _DRAWN, _MAPPED = 48, 8, 4

# Multipliers so near to 1 in size, or to the real axis, count as on it.
_NEUTRAL = 1e-7

# Steps beyond which a motion is given up, so that no slider waits for long.
_MOST_STEPS = 400_000


class Motion(NamedTuple):
    """One motion as NumPy arrays."""

    machine: AbstractMachine
    path: MotionPath
    """The motion over `WINDOW` cycles, with its impacts."""
    impact_phase: np.ndarray
    """Crank angle of each impact observed (radians)."""
    impact_speed: np.ndarray
    """Speed V⁻ before each impact observed (unit: a ω)."""
    frequency_ratio: np.ndarray
    """ζ of each cycle observed."""
    extremes: tuple[float, float]
    """Smallest and greatest Y over the cycles observed."""
    period: int
    """Period in drive cycles, or one of `REGIMES`."""
    impacts: float
    """Impacts in a period; in a cycle, on average, where there is no period."""
    multipliers: np.ndarray
    """Floquet multipliers, the greatest first; none where there is no period."""
    exponent: float
    """Greatest Lyapunov exponent where there is no period, else NaN."""
    fault: str
    """Why it could not be simulated; empty if it could."""
    places: tuple[np.ndarray, np.ndarray]
    """Position and velocity on the sections of the cycles observed."""
    quantities: dict[str, float]
    """The machine's own quantities on the last section, and its averages over the cycles."""
    window: Run
    """What is drawn."""

    @property
    def regime(self) -> str:
        """The regime in words: its period and impacts, or what has no period."""
        if self.period > 0:
            impacts = so_many(round(self.impacts), "impact")
            return f"period {cycles_in_words(self.machine, self.period)} with {impacts}"
        kind = REGIMES(self.period).meaning
        if self.period == REGIMES.failed:
            return kind
        if self.period == REGIMES.unsettled:
            longest = cycles_in_words(self.machine, _REGIME.longest)
            kind = f"no period up to {longest}: still settling, or quasi-periodic"
        return f"{kind}, {self.impacts:.2f} impacts in a cycle"

    @property
    def stability(self) -> str:
        """The multipliers in words, or the exponent."""
        if self.period <= 0:
            if self.fault or not np.isfinite(self.exponent):
                return ""
            rate = unit_of(self.machine.units, "rate")
            return with_unit(f"greatest Lyapunov exponent {self.exponent:.4f}", rate)
        if not np.isfinite(self.multipliers).all():
            return "no multipliers: an impact falls on the section"
        verdict = STABILITY[stability_of(jnp.asarray(self.multipliers))]
        if abs(abs(self.multipliers[0]) - 1) < _NEUTRAL:
            verdict = STABILITY[STABILITY.neutral]
        values = ", ".join(complex_in_words(m, 4, _NEUTRAL) for m in self.multipliers)
        return f"multipliers {values}: {verdict}"


def look(scene: AbstractMachine, start: State, settle: int = 1000) -> Motion:
    """The motion of a scene after `settle` cycles, by its standard method.

    A start beyond a stop is moved onto it.
    """
    run, window, found, multipliers, places = _seen(scene, start, jnp.asarray(float(settle)))
    period = int(found["period"])
    exponent = np.nan
    if period == REGIMES.unsettled:
        exponent = _exponent_of(scene, run.last)
        if exponent > _REGIME.threshold:
            period = int(REGIMES.chaotic)
    log, ratio = run.impact_log, run.frequency_ratio
    assert log is not None and run.y_min is not None and run.y_max is not None
    numbers = {name: x[-1] for name, x in run.quantities.items()}
    numbers |= {name: x.mean() for name, x in run.averages.items()}
    met = np.asarray(log.stop) >= 0
    return Motion(
        machine=scene,
        path=motion_path(window, machine=seen_evenly(scene, run.last)),
        impact_phase=np.asarray(log.phase)[met],
        impact_speed=np.asarray(log.speed)[met],
        frequency_ratio=np.full(OBSERVED, np.nan) if ratio is None else np.asarray(ratio),
        extremes=(float(np.min(run.y_min)), float(np.max(run.y_max))),
        period=period,
        impacts=float(found["impacts"]),
        multipliers=np.asarray(multipliers) if period > 0 else np.empty(0, complex),
        exponent=exponent,
        fault="" if bool(run.successful) else str(RESULTS[run.result]),
        places=(np.asarray(places[0]), np.asarray(places[1])),
        quantities={name: float(x) for name, x in numbers.items() if not np.ndim(x)},
        window=window,
    )


def prepare(scene: AbstractMachine, start: State) -> None:
    """Compile what `look` needs for scenes of this structure."""
    _exponent_of(scene, look(scene, start, 0).window.last)


@compiled
def _seen(scene: AbstractMachine, start: State, settle: Any) -> tuple[Run, Run, Any, Any, Any]:
    """The run observed, its first cycles sampled, its regime, its multipliers, and position and
    velocity on its sections."""
    method = chosen(scene, None)
    options = {"method": method, "max_steps": _MOST_STEPS}
    start = taken_along(scene, adopt(scene, start))
    run = simulate(scene, start, OBSERVED, settle=settle, impact_log=_MAPPED, **options)
    first = jtu.tree_map(lambda x: x[0], run.sections)
    window = simulate(
        seen_evenly(scene, first), first, WINDOW, samples=_SAMPLES, impact_log=_DRAWN, **options
    )
    found = _REGIME(scene, run)
    places = tuple(jax.vmap(f)(run.sections) for f in (scene.position, scene.velocity))
    multipliers = multipliers_of(_monodromy(scene, run, found["period"], method))
    return run, window, found, multipliers, places


def seen_evenly(machine: AbstractMachine, state: State) -> AbstractMachine:
    """The machine; one without a drive observed at equal intervals, where samples can be taken."""
    if not is_autonomous(machine, state):
        return machine
    return machine.observed_every(jnp.asarray(machine.cycle))


def _monodromy(scene: AbstractMachine, run: Run, period: Any, method: Any) -> jax.Array:
    """Derivative of the map over the last `period` cycles, cycle by cycle."""
    the_map = cycle_map(scene, method=method)
    cycles = jnp.maximum(period, 0).astype(jnp.int32)

    def one(i, product):
        place = OBSERVED - cycles + i
        return the_map.jacobian(jtu.tree_map(lambda x: x[place], run.sections)) @ product

    row = raveled(run.last)[0]
    return jax.lax.fori_loop(0, cycles, one, jnp.eye(row.size, dtype=row.dtype))


def _exponent_of(scene: AbstractMachine, state: State) -> float:
    """The greatest exponent; NaN for a machine that has none (a drift renewed on its section)."""
    try:
        return float(lyapunov(scene, state, _REGIME.observed, settle=0, number=1).exponents[0])
    except ValueError:
        return float("nan")
