"""Headline numbers of the reproduction, the bifurcation diagram and the regime maps."""

import numpy as np
import vi_jax as vi

from .closed_forms import ROOT, XI, Expected, doubling, touch


def bifurcation_diagram() -> Expected:
    numbers = {
        "4π motion doubles": doubling(0.8, 0.0, 2, 0.95, 0.96),
        "4π motion doubles, upper end": doubling(0.8, 0.0, 2, 0.99, 0.9935),
        "2π motion doubles": doubling(0.8, 0.0, 1, 0.99, 0.999),
        "4π motion touches the stop": touch(0.8, 0.0, 0.9937, 0.9939),
    }
    return {name: (value, ROOT) for name, value in numbers.items()}


def regime_maps() -> Expected:
    """Use every fourth lane in both directions of the map with Table 1's damping."""
    data = vi.scan(
        lambda zeta, k: vi.Scene.ideal(
            frequency_ratio=zeta, restitution=k, gap=2.0, damping_ratio=XI
        ),
        {"zeta": np.linspace(0.5, 1.9, 256)[::4], "k": np.linspace(0.05, 0.95, 256)[::4]},
        measure="regime", settle=400, method=vi.ExactFlight(), progress=False,
    )  # fmt: skip
    period, impacts = data["period"].values, data["impacts"].values
    parts = {
        "without impacts, periodic, %": (impacts == 0) & (period > 0),
        "2π with impacts, %": (impacts > 0) & (period == 1),
        "4π with one impact, %": (impacts == 1) & (period == 2),
    }
    # On the coarse grid the borders shift by half a grid step, about 1 % of a side.
    name = "(ζ, k), c = 0.5 N·s/m (Table 1)"
    return {f"{name}: {kind}": (100 * float(np.mean(x)), 1.0) for kind, x in parts.items()}
