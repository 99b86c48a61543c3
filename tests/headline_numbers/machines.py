"""Headline numbers of the studies of motors and of the relief valve."""

import numpy as np
import vi_jax as vi
from scipy.optimize import brentq

from .closed_forms import XI, Expected, fold


def motors() -> Expected:
    numbers: Expected = {}
    # The study's grid of ζ has a spacing of 1e-4 at the fold.
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
        numbers[f"{name}, close-down: forecast, κ"] = (float(down), 1.1e-3)  # grid spacing
        if gap == 20:
            numbers[f"{name}, run-up: forecast, κ"] = (float(kappa[fine < 1.05].max()), 1.1e-3)
    return numbers


def relief_valve() -> Expected:
    """Compute the Hopf point from eigenvalues, the others by branches that start nearby."""

    def growth(rate: float) -> float:
        lift = brentq(lambda y: rate - y * np.sqrt(y + 10), 1e-9, 50)
        root = np.sqrt(lift + 10)
        jacobian = [[0, 1, 0], [-1, -1.25, 1], [-20 * root, 0, -10 * lift / root]]
        return float(np.linalg.eigvals(np.array(jacobian)).real.max())

    def special(rate: float, bounds: tuple[float, float]) -> vi.Point:
        valve = vi.machines.ReliefValve(flow_rate=rate)
        settled = vi.simulate(valve, valve.start(), 1, settle=400).last
        orbit = vi.find_orbit(valve, settled)
        return vi.continue_orbit(orbit, parameter="flow_rate", bounds=bounds).special[0]

    return {
        "Hopf, q": (float(brentq(growth, 8.0, 9.0)), 1e-6),
        "grazing, q": (special(7.8, (7.4, 7.9)).parameter, 1e-8),
        "first doubling, q": (special(1.6, (1.2, 1.7)).parameter, 1e-8),
        "second doubling, q": (special(5.8, (5.7, 6.2)).parameter, 1e-8),
    }
