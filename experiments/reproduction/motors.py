"""Figures 3 and 4 with the motor of Table 1 instead of the ideal drive, tuned to ζ = 0.90."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from tools.pictures import panels
from vi_jax.flow import Run, simulate
from vi_jax.machines import Parameters, Scene
from vi_jax.orbit import Orbit, closed_form_orbits, find_orbit
from vi_jax.plot import STOP, angle_axis, color_of

from .figures import common_legend
from .motions import (
    CYCLES,
    FREQUENCY_RATIO,
    RESTITUTION,
    SAMPLES,
    TableRow,
    figure_scene,
    mean_ratio,
)

# T0 in N·m: a choice around Table 1's 10.
TORQUES = (2.0, 10.0, 100.0)
# (k, c in N·s/m, label): the figures, and the case in which Table 1's machine has a 4π motion.
_MACHINES = (
    (RESTITUTION, 0.0, "k = 0.5, undamped"),
    (0.8, float(Parameters().damping), "k = 0.8, Table 1's damping"),
)
# Tolerance of the tuned ζ: a choice.
_TUNED = 1e-9


class MotorRun(NamedTuple):
    """The motions of the machine of Figures 3 and 4 with one motor; lengths in units of a."""

    torque: float
    """T0, the stall torque at κ = 1 (N·m)."""
    kappa: float
    """κ, tuned so that the 4π motion has ζ = 0.90."""
    orbit: Orbit
    """The 4π motion with this motor."""
    from_rest: Run
    """200 cycles from Y = V = 0 and the no-load speed."""
    from_long: Run
    """200 cycles from the 4π motion."""

    @property
    def speed_variation(self) -> float:
        """(largest - smallest crank speed) / mean, over the 4π motion."""
        assert self.from_long.samples is not None
        W = np.asarray(self.from_long.samples.state.W)[: 2 * SAMPLES + 1]
        return float(np.ptp(W) / FREQUENCY_RATIO)


def _machine(torque: Any, kappa: Any, k: Any, c: Any) -> Scene:
    return Parameters(torque=torque, control=kappa, restitution=k, damping=c).scene()


def _tuned(cycles: int, torque: float, k: float, c: float) -> tuple[float, Orbit]:
    """Return the κ at which the motion of this period has ζ = 0.90, and the motion."""
    ratio = Parameters(damping=c).scene(drive="ideal").damping_ratio
    closed = closed_form_orbits(figure_scene(ratio, restitution=k), cycles=cycles)
    kappa, slope, before = FREQUENCY_RATIO, 1.0, None
    guess = _machine(torque, kappa, k, c).start(Y=closed.Y[0], V=closed.V[0], W=FREQUENCY_RATIO)
    for _ in range(8):
        orbit = find_orbit(_machine(torque, kappa, k, c), guess, cycles=cycles, throw=True)
        off = mean_ratio(orbit) - FREQUENCY_RATIO
        if abs(off) < _TUNED:
            return kappa, orbit
        if before is not None and kappa != before[0]:  # secants
            slope = (off - before[1]) / (kappa - before[0])
        before = kappa, off
        kappa, guess = kappa - off / slope, orbit.state
    raise RuntimeError("No κ gives the motion its frequency ratio.")


def _run(torque: float, kappa: float, **start: Any) -> Run:
    scene = _machine(torque, kappa, RESTITUTION, 0.0)
    return simulate(scene, scene.start(**start), CYCLES, samples=SAMPLES)


def simulate_motors() -> tuple[list[TableRow], list[MotorRun]]:
    """Return the motions of Figures 3 and 4 with each motor of Table 1, and their runs."""
    rows, runs = [], []
    for k, c, words in _MACHINES:
        for torque in TORQUES:
            for cycles in (1, 2):
                kappa, orbit = _tuned(cycles, torque, k, c)
                rows.append(TableRow(f"motor T0 = {torque:g} N·m, {words}", orbit, kappa))
            if (k, c) == (RESTITUTION, 0.0):
                there = {name: float(getattr(orbit.state, name)) for name in "YVW"}
                from_rest = _run(torque, kappa, Y=0.0, V=0.0, W=kappa)
                runs.append(MotorRun(torque, kappa, orbit, from_rest, _run(torque, kappa, **there)))
    return rows, runs


def draw_motors(motors: Sequence[MotorRun], ideal: Run) -> Figure:
    """Draw the last 8π from rest with each motor, and with the ideal drive, above crank speeds."""
    figure, grid = panels(14, 6.6, 2, len(motors), w_pad=0.08, sharex=True, sharey="row")
    last = slice(-4 * SAMPLES - 1, None)
    place = np.linspace(0, 8, 4 * SAMPLES + 1)
    assert ideal.samples is not None
    for (above, below), motor in zip(grid.T, motors, strict=True):
        assert motor.from_rest.samples is not None
        state = motor.from_rest.samples.state
        above.plot(place, np.asarray(state.Y)[last], color="0.2", lw=3.0, alpha=0.55, label="motor")
        above.plot(
            place, _in_step(np.asarray(ideal.samples.state.Y), np.asarray(state.Y))[last],
            color=color_of(2, 1), lw=1.8, dashes=(5, 3), label="ideal drive, 4π",
        )  # fmt: skip
        above.axhline(2.0, color=STOP, lw=1.8, label="stop, Y = 2")
        below.plot(place, np.asarray(state.W)[last], color="0.2", lw=1.6)
        below.axhline(FREQUENCY_RATIO, color="0.4", lw=1.2, ls=":", label="mean ζ = 0.90")
        above.set_title(f"T0 = {motor.torque:g} N·m, κ = {motor.kappa:.4f}", fontsize=11)
        angle_axis(below, every=2)
        below.set_xlim(0, 8)
        for ax in (above, below):
            ax.grid(alpha=0.25, lw=0.5)
    grid[0, 0].set_ylabel("Y = y/a")
    grid[1, 0].set_ylabel("crank speed dφ/dτ (ω)")
    common_legend(figure, grid[:, 0], 4)
    figure.suptitle(
        f"Figures 3 and 4 with the motor: the last 8π of {CYCLES} cycles from rest "
        "(k = 0.50, undamped, Δ = 2a, mean ζ = 0.90)"
    )
    return figure


def _in_step(ideal: np.ndarray, motor: np.ndarray) -> np.ndarray:
    """Return the ideal run, a cycle later if its 4π motion then agrees with the motor's."""
    later = np.roll(ideal, SAMPLES)
    tail = slice(-2 * SAMPLES, None)
    near = [np.abs(x[tail] - motor[tail]).max() for x in (ideal, later)]
    return ideal if near[0] <= near[1] else later
