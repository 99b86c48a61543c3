"""Of the studies of motors and of other machines."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import vi_jax as vi
from scipy.linalg import solve_continuous_lyapunov
from scipy.optimize import brentq

from .closed_forms import XI, Expected, closed, fold


def motors() -> Expected:
    numbers: Expected = _armature() | _rotor()
    # On the study's grid of ζ, 1e-4 apart at the fold.
    numbers["ideal drive: 2π motion folds, ζ"] = (fold(0.5, XI, 1.44, 1.45), 1.1e-4)
    table = vi.Parameters()
    coupling = float(table.body_mass * table.crank_radius**2 / table.inertia)
    per_nm = 1 / float(table.inertia * table.natural_frequency**2)
    fine = np.linspace(0.9, 3.0, 210_001)
    idle = -coupling * np.imag(0.5 / (1 - fine**2 + 2j * XI * fine))
    clear = np.abs(1 - fine**2 + 2j * XI * fine) > 0.5
    for torque, gap in (
        (100, 2), (10, 2), (2, 2), (0.2, 2), (0.1, 2), (0.05, 2), (2, 20), (0.5, 20)
    ):  # fmt: skip
        kappa = fine + idle / (per_nm * torque)
        name = f"T0 = {torque:g} N·m, gap {gap:g}a"
        down = kappa[(fine > 1) & (clear | (gap == 20))].min()
        numbers[f"{name}, close-down: forecast, κ"] = (float(down), 1.1e-3)  # its grid of ζ
        if gap == 20:
            numbers[f"{name}, run-up: forecast, κ"] = (float(kappa[fine < 1.05].max()), 1.1e-3)
    return numbers


def _armature() -> Expected:
    """From closed forms of the ideal drive on; the study comes from a long simulation."""
    guess = closed(0.896, 0.5, XI, 2.0, cycles=1)
    found = []
    for time in (None, 0.1):
        lag = None if time is None else time / float(vi.Parameters().natural_frequency)
        scene = vi.Parameters(torque=10.0, restitution=0.5, electrical_time=lag).scene()
        begin = scene.start(Y=guess.Y[0], V=guess.V[0], W=0.896)
        found.append(vi.find_orbit(scene, begin, method="reference", throw=True))
    line, lagging = found
    return {
        "T0 = 10 N·m, κ = 0.9, straight line: min Y": (float(line.y_min), 1e-7),
        "T0 = 10 N·m, κ = 0.9, τe = 0.1: min Y": (float(lagging.y_min), 1e-7),
        "T0 = 10 N·m, κ = 0.9, τe = 0.1: ζ": (float(lagging.frequency_ratio), 1e-7),
    }


def relief_valve() -> Expected:
    """The Hopf bifurcation by eigenvalues, the others from motions beside them."""

    def growth(rate: float) -> float:
        lift = brentq(lambda y: rate - y * np.sqrt(y + 10), 1e-9, 50)
        root = np.sqrt(lift + 10)
        jacobian = [[0, 1, 0], [-1, -1.25, 1], [-20 * root, 0, -10 * lift / root]]
        return float(np.linalg.eigvals(np.array(jacobian)).real.max())

    def special(rate: float, bounds: tuple[float, float]) -> vi.Point:
        valve = vi.machines.ReliefValve(flow_rate=rate)
        settled = vi.simulate(valve, valve.start(), 1, settle=400).last
        branch = vi.continue_orbit(
            vi.find_orbit(valve, settled), parameter="flow_rate", bounds=bounds
        )
        return branch.special[0]

    return {
        "Hopf, q": (float(brentq(growth, 8.0, 9.0)), 1e-6),
        "grazing, q": (special(7.8, (7.4, 7.9)).parameter, 1e-8),
        "first doubling, q": (special(1.6, (1.2, 1.7)).parameter, 1e-8),
        "second doubling, q": (special(5.8, (5.7, 6.2)).parameter, 1e-8),
    }


def noise() -> Expected:
    """By Lyapunov's equation and the barometric law, within four standard errors of the study."""
    flow = np.array([[0, 1, 0, 0], [-1, -0.08, 0, -1], [0, 0, 0, 1], [0, 0, -1, -0.2]])
    covariance = solve_continuous_lyapunov(flow, -np.diag([0, 0, 0, 0.4]))
    power, D = 0.06 * float(covariance[1, 1]), 0.6**2 / 0.4
    flux = np.sqrt(D / (2 * np.pi)) / D * (1 + np.exp(-1 / D)) / (1 - np.exp(-1 / D))
    return {
        "harvester, no stops, Ω = 1, power": (power, 4 * 0.034),
        "the same by Lyapunov's equation": (power, 1e-9),
        "gears, e = 1, σ = 0.6, impacts per unit time": (float(flux), 4 * 0.0021),
    }


def woodpecker(kept: dict[str, float]) -> Expected:
    """Of cycles beside each other, whose differences give Newton's steps and multipliers."""

    def returned(friction: Any, begins: Any) -> Any:
        toy = vi.machines.Woodpecker(friction=friction)
        start = toy.start(speed=begins[0], bird_rate=begins[1])
        run = vi.simulate(toy, start, 1, settle=0, method=vi.Adaptive(rtol=1e-12))
        last = run.last
        return jnp.stack([last.speed, last.bird_rate, run.duration[0], last.drop])

    steps = np.array([2e-5, 5e-4])
    moves = np.concatenate([np.zeros((1, 2)), np.diag(steps), -np.diag(steps)])
    lanes = vi.jit(jax.vmap(jax.vmap(returned, (None, 0))))
    doubles = "period doubles, μ"
    beside = kept[doubles] + np.array([-1e-4, 1e-4])
    frictions = np.array([0.3, 0.6, 0.8, 1.0, *beside])
    guesses = [(-0.34, -7.46), (-0.0, -11.0), (-0.0, -11.0), (-0.0, -11.0)]
    x = np.array([*guesses, (-0.29, -7.46), (-0.29, -7.46)])
    ends, slopes = np.zeros(0), np.zeros(0)
    # Some cycles first, by which guesses come near.
    for turn in range(70):
        ends = np.asarray(lanes(jnp.asarray(frictions), jnp.asarray(x[:, None] + moves)))
        slopes = ((ends[:, 1:3, :2] - ends[:, 3:5, :2]) / (2 * steps[:, None])).transpose(0, 2, 1)
        newton = np.linalg.solve(np.eye(2) - slopes, (ends[:, 0, :2] - x)[..., None])[..., 0]
        x = ends[:, 0, :2] if turn < 60 else x + newton
    numbers: Expected = {}
    for i, value in enumerate(frictions[:4]):
        numbers[f"period at μ = {value:g}, ms"] = (1e3 * float(ends[i, 0, 2]), 1e-6)
        numbers[f"drop at μ = {value:g}, mm"] = (1e3 * float(ends[i, 0, 3]), 1e-6)
    multipliers = np.linalg.eigvals(slopes).real.min(axis=1)
    numbers["multiplier at μ = 0.3"] = (float(multipliers[0]), 1e-6)
    numbers[doubles] = (float(np.interp(1.0, -multipliers[4:], beside)), 2e-6)
    return numbers


def _rotor() -> Expected:
    """Where the averaged κ = ζ + ε ξ ζ⁵/(τ0 D) turns; the motion's own folds lie beside it."""
    numbers: Expected = {}

    def kappa(z: float, strength: float) -> float:
        return z + 0.01 * 0.05 * z**5 / ((1 - z * z) ** 2 + (0.1 * z) ** 2) / strength

    def slope(z: float, strength: float) -> float:
        return (kappa(z + 1e-6, strength) - kappa(z - 1e-6, strength)) / 2e-6

    for strength in (0.1, 0.2):
        for way, low, high in (("run-up", 0.9, 1.03), ("close-down", 1.03, 1.4)):
            at = kappa(float(brentq(slope, low, high, args=(strength,))), strength)
            numbers[f"τ0 = {strength:g}, {way}: averaged fold, κ"] = at, 1e-8
            numbers[f"τ0 = {strength:g}, {way}: fold, κ"] = at, 1e-3
    return numbers
