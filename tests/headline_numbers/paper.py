"""Headline numbers of the reproduction, the bifurcation diagram and the regime maps."""

import numpy as np
import vi_jax as vi
from scipy.optimize import brentq

from .closed_forms import ROOT, XI, Expected, births, closed, doubling, fold, touch


def reproduction() -> Expected:
    """Return the points of Figure 2 and of the boundaries."""
    numbers = {}
    places = {
        (0.8, 0.0): (0.99377, 1.73167), (0.8, XI): (0.96554, 1.58722),
        (0.5, 0.0): (0.93990, 1.52349), (0.5, XI): (0.82456, 1.44326),
    }  # fmt: skip
    for (k, xi), (near_doubling, near_fold) in places.items():
        name = f"k = {k:g}, {'damped' if xi else 'undamped'}"
        first, second = births(xi)
        doubles = doubling(k, xi, 1, near_doubling - 2e-3, near_doubling + 2e-3)
        numbers[f"{name}: BB'"], numbers[f"{name}: CC'"] = first, doubles
        motion = f"{name}, 2π, 1 impact"
        numbers[f"{motion}: grazing {first:.3f}"] = first
        numbers[f"{motion}: grazing {second:.3f}"] = second
        numbers[f"{motion}: period-doubling {doubles:.3f}"] = doubles
        folds = fold(k, xi, near_fold - 1e-2, near_fold + 1e-2)
        numbers[f"{motion}: fold {folds:.3f}"] = folds
        numbers[f"{name}, 4π, 2 impacts: period-doubling {doubles:.3f}"] = doubles
    long = {
        (0.8, 0.0): (0.8343, 0.99383),
        (0.8, XI): (0.8334, 0.9691),
        (0.5, 0.0): (0.8503, 0.9412),
    }
    for (k, xi), ends in long.items():
        name = f"k = {k:g}, {'damped' if xi else 'undamped'}, 4π"
        for end in ends:
            touches = touch(
                k, xi, end - 1e-3 * (end < 0.99) - 1e-4, end + 1e-3 * (end < 0.99) + 1e-4
            )
            for count in ("1 impact", "2 impacts"):
                numbers[f"{name}, {count}: grazing {touches:.3f}"] = touches
    for low, high in ((0.95, 0.96), (0.99, 0.9935)):
        at = doubling(0.8, 0.0, 2, low, high)
        numbers[f"k = 0.8, undamped, 4π, 1 impact: period-doubling {at:.3f}"] = at
    return _boundaries() | {name: (value, ROOT) for name, value in numbers.items()}


def _boundaries() -> Expected:
    per_c = XI / float(vi.Parameters().damping)

    def test(c):
        found = closed(0.9, 0.5, c * per_c, 2.0, cycles=1)
        return float(np.real(np.prod(np.asarray(found.multipliers[0]) + 1)))

    def clear(c):
        return float(closed(0.9, 0.5, c * per_c, 2.0, cycles=2).clearance[0])

    numbers = {
        "birth, undamped, ζ": births(0.0)[0],
        "doubling at k = 0.5, undamped, ζ": doubling(0.5, 0.0, 1, 0.93, 0.95),
        "doubling at k = 0.8, undamped, ζ": doubling(0.8, 0.0, 1, 0.99, 0.999),
        "4π motion at k = 0.5, undamped, from ζ": touch(0.5, 0.0, 0.849, 0.852),
        "4π motion at k = 0.5, undamped, to ζ": touch(0.5, 0.0, 0.9405, 0.942),
        "fold at k = 0.5, undamped, ζ": fold(0.5, 0.0, 1.51, 1.53),
        "fold at k = 0.8, undamped, ζ": fold(0.8, 0.0, 1.72, 1.74),
        "doubling at ζ = 0.9, k = 0.5, c": float(brentq(test, 0.26, 0.28, xtol=1e-13)),
        "4π motion at ζ = 0.9, k = 0.5, up to c": float(brentq(clear, 0.28, 0.30, xtol=1e-13)),
        "birth at Table 1's c, k = 0.5, ζ": births(XI)[0],
        "doubling at Table 1's c, k = 0.5, ζ": doubling(0.5, XI, 1, 0.82, 0.83),
        "fold at Table 1's c, k = 0.5, ζ": fold(0.5, XI, 1.44, 1.45),
    }
    # The study interpolates its curves by splines, with an error of 1e-5.
    return {name: (value, 1e-5) for name, value in numbers.items()}


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
