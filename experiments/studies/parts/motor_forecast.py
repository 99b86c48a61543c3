"""The forecast of `motor_frequency_response.py`: a motor's κ from the ideal machine alone."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from tools.ideal import vibration

from .motor_sweeps import FAR, LOAD, NEAR, PER_NM, XI, K, Key


def load(zeta: np.ndarray, speed: Any = 0.0, phase: Any = 0.0) -> np.ndarray:
    """Mean load torque on the shaft in units of Jω²; without impacts if no speed is given."""
    kick = (1 + K) * speed * zeta * np.exp(-1j * phase) / (2 * np.pi)
    return -LOAD * np.imag((0.5 - kick) / (1 - zeta**2 + 2j * XI * zeta))


def ideal(zeta: Any) -> vi.ClosedFormOrbits:
    """The 2π motions with one impact, in closed form."""
    driven = vi.Scene.ideal(
        frequency_ratio=zeta, restitution=K, gap=NEAR / 0.04, damping_ratio=XI
    )  # fmt: skip
    return vi.closed_form_orbits(driven)


ZETAS = np.sort(np.concatenate([np.linspace(0.4, 3.0, 2601), np.linspace(1.40, 1.45, 501)]))
# In batches of 256: batched LAPACK calls of two thousand matrices may wait for each other forever
# where XLA has only two threads.
_exact = jax.jit(lambda z: jax.lax.map(ideal, z, batch_size=256))(jnp.asarray(ZETAS))
_exact = jax.tree.map(np.asarray, _exact)
HARD = load(ZETAS, _exact.impact_speed[:, 0], _exact.impact_phase[:, 0])
HARD = np.where(_exact.admissible[:, 0], HARD, np.nan)  # the faster of two motions
"""Load at each of `ZETAS` with one impact in a cycle; NaN where there is no such motion."""
IDLE = load(ZETAS)
"""The same without impacts."""
_REACH = np.abs(vibration(ZETAS, XI))


def forecast(torque: float, gap: float, way: str) -> float:
    """κ of the jump up or down."""
    tau = PER_NM * torque
    if way == "up":
        part = ZETAS < 1.05 if gap == FAR else np.isfinite(HARD)
        return float(np.nanmax((ZETAS + (IDLE if gap == FAR else HARD) / tau)[part]))
    part = (ZETAS > 1.0) if gap == FAR else (ZETAS > 1.0) & (_REACH < NEAR / 0.04)
    return float(np.min((ZETAS + IDLE / tau)[part]))


def misfit(key: Key, impacts: int, branch: vi.Branch) -> float:
    """Largest error of the forecast κ - ζ along a continued branch, as a part of the largest."""
    turn = int(np.argmax(branch.parameter)) if impacts else len(branch.parameter)
    keep = np.arange(len(branch.parameter)) <= turn
    if impacts and branch.parameter[0] > branch.parameter[-1]:
        keep = np.arange(len(branch.parameter)) >= turn
    zeta, kappa = branch.frequency_ratio[keep], branch.parameter[keep]
    expected = np.interp(zeta, ZETAS, HARD if impacts else IDLE)
    slip = kappa - zeta
    return float(np.nanmax(np.abs(slip - expected / (PER_NM * key[0]))) / np.nanmax(np.abs(slip)))


def weakest_without_fold() -> tuple[float, float]:
    """The torques in N·m below which the free motion folds: stop out of reach, and at 2a."""
    fine = np.linspace(0.9, 3.0, 200_001)
    steepest = -np.gradient(load(fine), fine)
    clear = np.abs(vibration(fine, XI)) < NEAR / 0.04
    return float(steepest[fine < 3].max() / PER_NM), float(steepest[clear].max() / PER_NM)
