"""The motions behind Figures 3 and 4, simulated, fitted by gradient descent and found by Newton."""

from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from vi_jax.flow import ExactFlight, Run, simulate
from vi_jax.machines import Parameters, Scene
from vi_jax.orbit import ClosedFormOrbits, Gradient, Orbit, closed_form_orbits, find_orbit

# ζ, k and d of both figures.
FREQUENCY_RATIO, RESTITUTION, GAP = 0.9, 0.5, 2.0
# Cycles of the runs, samples per cycle, and those of a quick reproduction: choices.
CYCLES, QUICK_CYCLES = 200, 60
SAMPLES, QUICK_SAMPLES = 96, 64
# Relative error of the fit's guess, and tolerance of the fit, at which no transient is visible.
_WRONG, _FITTED = 0.05, 1e-10


class Case(NamedTuple):
    """One damping: its scene, closed forms and simulations."""

    name: str
    """"undamped" (as in the paper's figures) or "damped" (Table 1)."""
    scene: Scene
    short: ClosedFormOrbits
    """2π motions in closed form."""
    long: ClosedFormOrbits
    """4π motions in closed form."""
    from_rest: Run
    """Figure 3: from Y = V = 0."""
    from_long: Run
    """From the 4π closed-form state; if not admissible, from that of the undamped scene."""
    from_fit: Run
    """Figure 4: from the 4π initial conditions that optax fits to the undamped scene."""
    on_short: Run
    """From the 2π closed-form state; its first cycle is the 2π closed form."""
    long_shift: int
    """Shift of the 4π closed form in Figure 3, in cycles: 0 or 1."""

    @property
    def long_exists(self) -> bool:
        """True if the 4π closed form is a motion: it stays inside the gap between impacts."""
        return bool(self.long.admissible[0])

    @property
    def short_minimum(self) -> float:
        """The smallest Y of the 2π closed form."""
        return float(self.short.y_min[0])

    @property
    def growth(self) -> float:
        """The largest |multiplier| of the 2π motion."""
        return float(np.abs(np.asarray(self.short.multipliers[0])).max())


def figure_scene(damping_ratio: Any, *, restitution: Any = RESTITUTION, gap: Any = GAP) -> Scene:
    """Return the scene of Figures 3 and 4 with this ξ (dimensionless), at ζ = 0.90."""
    scene = Scene.ideal(
        frequency_ratio=FREQUENCY_RATIO,
        restitution=restitution,
        gap=gap,
        damping_ratio=damping_ratio,
    )
    # The section is a number, so that runs from other crank angles share one program.
    return scene.at_section(0.0)


def table_damping_ratio() -> float:
    """Return ξ of Table 1 (dimensionless)."""
    return float(Parameters().scene(drive="ideal").damping_ratio)


def simulate_cases(*, quick: bool = False) -> tuple[Case, Case]:
    """Simulate the undamped and the damped case; `quick` takes fewer cycles and samples."""
    cycles, samples = (QUICK_CYCLES, QUICK_SAMPLES) if quick else (CYCLES, SAMPLES)
    undamped = figure_scene(0.0)
    long_state = closed_form_orbits(undamped, cycles=2)
    fitted = fit_long(undamped)
    cases = []
    for name, ratio in (("undamped", 0.0), ("damped", table_damping_ratio())):
        scene = figure_scene(ratio)
        short, long = (closed_form_orbits(scene, cycles=n) for n in (1, 2))
        origin = long if bool(long.admissible[0]) else long_state
        runs = [
            run_of(scene, start, cycles, samples)
            for start in (
                scene.start(),
                scene.start(Y=origin.Y[0], V=origin.V[0]),
                fitted.state,
                scene.start(Y=short.Y[0], V=short.V[0]),
            )
        ]
        jax.block_until_ready(runs)
        shift = _alignment(runs[0], runs[1]) if bool(long.admissible[0]) else 0
        cases.append(Case(name, scene, short, long, *runs, long_shift=shift))
    return cases[0], cases[1]


def run_of(scene: Scene, start: Any, cycles: int, samples: int) -> Run:
    """Simulate with the options of all runs here, so that they share one compiled program."""
    return simulate(
        scene, start, cycles, method=ExactFlight(), samples=samples, impact_log=2, throw=True
    )


def _alignment(from_rest: Run, orbit: Run) -> int:
    """Return 1 if, after an even number of cycles, the run from rest is on the second section of a
    4π motion, else 0."""
    settled = np.asarray(from_rest.sections.Y)
    even = (settled.size - 1) // 2 * 2
    first, second = np.asarray(orbit.sections.Y)[:2]
    return int(abs(settled[even] - second) < abs(settled[even] - first))


def sampled(run: Run) -> np.ndarray:
    """Return sampled Y and V, shape (2, cycles, samples)."""
    assert run.samples is not None
    state, cycles = run.samples.state, run.impacts.shape[0]
    return np.stack([state.Y, state.V])[:, :-1].reshape(2, cycles, -1)


def last_minima(run: Run) -> list[float]:
    """Return the smallest Y of each of the last two cycles, the smaller one first."""
    return sorted(np.asarray(run.y_min)[-2:].tolist())


def closed_form(case: Case, cycles: int, period: int) -> np.ndarray:
    """Return Y of the 2π (`period` 1) or 4π (2) closed form over the cycles of Figure 3."""
    run, shift = (case.on_short, 0) if period == 1 else (case.from_long, case.long_shift)
    one = sampled(run)[0][:period]
    return one[(np.arange(cycles) - shift) % period]


def half_turn_states(run: Run) -> np.ndarray:
    """Return (Y, V) at φ = π of each cycle, shape (cycles, 2). The impacts lie near φ = 0: states
    on a section there would be before the jump in some cycles and after it in others."""
    both = sampled(run)
    return both[:, :, both.shape[2] // 2].T


class TableRow(NamedTuple):
    """One motion of the orbit table."""

    scene: str
    orbit: Orbit
    kappa: float | None = None
    """κ of a motor, tuned so that the mean ζ is 0.90."""


def mean_ratio(orbit: Orbit) -> float:
    """Return the mean ζ of a driven motion."""
    assert orbit.frequency_ratio is not None
    return float(orbit.frequency_ratio)


def fit_long(scene: Scene) -> Orbit:
    """Fit the 4π motion by optax' Adam from a state 5 % off the closed form, as accurately as the
    paper's Figure 4 needs to skip the transient."""
    closed = closed_form_orbits(scene, cycles=2)
    guess = scene.start(Y=(1 + _WRONG) * closed.Y[0], V=(1 - _WRONG) * closed.V[0])
    steps = 2000
    descent = Gradient(
        optax.adam(optax.cosine_decay_schedule(0.02, steps)), tolerance=_FITTED, max_steps=steps
    )
    return find_orbit(scene, guess, cycles=2, root_finder=descent, throw=True)


def orbit_table(scenes: dict[str, Scene]) -> list[TableRow]:
    """Find the 2π and 4π motions of named ideal scenes, stable or not, by Newton's method from
    their closed forms."""
    rows = []
    for name, scene in scenes.items():
        for cycles in (1, 2):
            closed = closed_form_orbits(scene, cycles=cycles)
            if bool(closed.admissible[0]):
                guess = scene.start(Y=closed.Y[0], V=closed.V[0])
                orbit = find_orbit(scene, guess, cycles=cycles, throw=True)
                rows.append(TableRow(f"ideal, {name}", orbit))
    return rows
